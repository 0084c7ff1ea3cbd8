"""A bundle that is written to a file, without a registry, when its gates say so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dtwin.errors import InputError
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import save_bundle
from dtwin.train.gates import Verdict


@dataclass(frozen=True)
class JudgedBundle:
    """An equation with what its gates say of it, which its provenance holds."""

    bundle: Bundle
    verdicts: Sequence[Verdict]

    def __post_init__(self) -> None:
        noted = replace(self.bundle.provenance, gates={v.gate: v.passed for v in self.verdicts})
        object.__setattr__(self, "bundle", replace(self.bundle, provenance=noted))

    @property
    def passed(self) -> bool:
        """Whether every gate passed."""
        return all(v.passed for v in self.verdicts)

    def write(self, out: Path, *, force: bool) -> tuple[bool, list[str]]:
        """Write the bundle when it passed, or by ``force``; return whether it was, and what is told of the gates and that.

        Raises ``InputError`` when the file is there, without ``force``.
        """
        lines = [f"  {'passed' if v.passed else 'FAILED'}  {v.gate}: {v.reason}" for v in self.verdicts]
        if not self.passed and not force:
            return False, [*lines, "not written: a gate said no (--force writes it for comparison)"]
        require_new(out, force=force)
        save_bundle(self.bundle, out)
        return True, [
            *lines,
            f"{out} written" + ("" if self.passed else " though it did not pass: for comparison only"),
        ]


def require_new(path: Path, *, force: bool = False) -> None:
    """Refuse to write over a file, before hours are spent on what it would hold.

    Raises ``InputError`` when it is there and ``force`` is not set.
    """
    if path.exists() and not force:
        raise InputError(
            "the file is there already",
            code="bundle.exists",
            where=str(path),
            hint="another --out, or --force where the command has it",
        )
