"""What commands print of a twin, whatever its kind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from dtwin.kinds.registry import kind_named
from dtwin.report.html import Section
from dtwin.report.text import micrometres
from dtwin.report.twins import history_text
from dtwin.schema import DEFAULT_KIND

if TYPE_CHECKING:
    from dtwin.kinds.kind import TwinReport
    from dtwin.kinds.volumetric import HeatTwin
    from dtwin.physics.twin import Twin


def twin_text(twin: Twin | HeatTwin) -> str:
    """Return a twin for the terminal."""
    return _of(twin.as_dict()).twin_text(twin)


def comparison_text(result: Mapping[str, Any]) -> str:
    """Return a comparison, as its ``as_dict`` gives it, for the terminal."""
    return _of(result).comparison_text(result)


def diagnosis_text(name: str, result: Mapping[str, Any]) -> str:
    """Return a diagnosis, as its ``as_dict`` gives it, for the terminal."""
    return _of(result).diagnosis_text(name, result)


def discovery_text(payload: Mapping[str, Any], least_share: float) -> str:
    """Return what was found for the terminal: versions, every name with those that the runs cannot tell from it, what is left.

    ``payload``: twin, groups of the effects added, the effect first, history, and the last diagnosis.
    ``least_share``: of what repeats agreed on, below which nothing was added.
    """
    rungs, groups, last = payload["history"], payload["groups"], payload["final"]
    rest = diagnosis_text(payload["twin"], last)
    if not groups:
        return f"{history_text(rungs)}\n\n{rest}"
    lines = ["found", *(f"  {' or '.join(group)}" for group in groups)]
    before, left = (rungs[n].get("systematic_rms_um") for n in (-1 - len(groups), -1))
    if before and left is not None:
        share = 100.0 * left / before
        lines.append(
            f"of {micrometres(before)} µm RMS that repeats agree on, {micrometres(left)} µm are left ({share:z.0f} %)"
        )
    small = [f"{one['effect']} {one['axis']}".strip() for one, *_ in last.get("found", ())]
    if small:
        lines.append(f"not added: {', '.join(small)}: below {100.0 * least_share:z.0f} % of that, as laws may be off")
    return "\n\n".join([history_text(rungs), "\n".join(lines), f"what is left\n{rest}"])


def diagnosis_section(name: str, result: Mapping[str, Any]) -> Section:
    """Return a diagnosis, as its ``as_dict`` gives it, for a report."""
    return _of(result).diagnosis_section(name, result)


def twin_section(twin: Twin | HeatTwin) -> Section:
    """Return a twin for a report."""
    return _of(twin.as_dict()).twin_section(twin)


def history_section(twin: Twin | HeatTwin, rungs: Sequence[Mapping[str, Any]]) -> Section:
    """Return the rungs of a twin for a report."""
    return _of(twin.as_dict()).history_section(rungs)


def comparison_sections(found: Any, result: Mapping[str, Any]) -> list[Section]:
    """Return a comparison, and what its ``as_dict`` gives, for a report."""
    return _of(result).comparison_sections(found, result)


def _of(document: Mapping[str, Any]) -> TwinReport:
    if "campaigns" in document:
        from dtwin.report import several

        return several
    # A twin of tests of a path names no kind.
    return kind_named(document.get("kind", DEFAULT_KIND)).twin_report
