"""What a virtual machine is: how it is measured, served and judged, and what it can be asked."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from dtwin.errors import InputError

# The command line reads the records for its help: they import nothing heavy, numpy included.
if TYPE_CHECKING:
    from pathlib import Path

    from dtwin.config import Home
    from dtwin.machines.axis_server import Clock, ServedMachine
    from dtwin.progress import Progress
    from dtwin.serve.bundle import Bundle
    from dtwin.train.closed_loop import Evidence
    from dtwin.train.oracle import MeasuredWays
    from dtwin.train.registry import RegisteredVersion, Registry
    from dtwin.train.still_helps import CheckedRun

FROM_THE_LAKE = "dtwin evidence VERSION --without C --with C computes it from campaigns of the lake"
"""Where evidence comes from when no virtual machine gives it."""
Options = Mapping[str, tuple[str, ...]]
"""Options of a machine by name, each with its values, the usual first."""
PLAN = "plan"
"""Option of a machine that measures a plan file; its values are files, not words."""


@dataclass(frozen=True)
class Request:
    """What is to be measured on a virtual machine.

    Attributes:
        quick: A small campaign; never beside a plan.
        plan: Plan of the machine's kind; None for its own campaign.
        options: A value for each of the machine's options.
    """

    out: Path
    seed: int
    quick: bool
    plan: Any
    options: Mapping[str, str]


@dataclass(frozen=True)
class Simulated:
    """What was measured: JSON-ready, and as lines of text."""

    payload: Mapping[str, Any]
    lines: Sequence[str]


@dataclass(frozen=True)
class EvidenceRequest:
    """What closed-loop evidence is asked for.

    Attributes:
        geometry: ``machine_geometry`` that it was trained with.
        plan: What the machine is measured by, in the form of its kind; None when it chooses.
    """

    registry: Registry
    version: RegisteredVersion
    bundle: Bundle
    geometry: Mapping[str, Any]
    plan: Any
    seed: int
    progress: Progress


def require_no_campaign(folder: Path) -> None:
    """Refuse a folder that holds a campaign already."""
    if (folder / "campaign.toml").exists():
        raise InputError(
            "the folder holds a campaign already", code="simulate.exists", where=str(folder), hint="give another --out"
        )


class VirtualMachine(ABC):
    """A machine that exists only as equations; what it lacks is refused by name.

    Attributes:
        name: As in ``dtwin simulate --machine``.
        type: As in ``machine_geometry`` of its campaigns.
        options: Options of ``dtwin simulate`` that it has, with their values, the usual first.
        clocks: On which it can be corrected while it is measured, the usual first.
        seeds_measuring: Whether a seed is of noise and set-ups alone, so that another one is another test of the same
            machine.
        robot: Whether what serves it must know a kinematic chain and a tool.
    """

    name: ClassVar[str]
    type: ClassVar[str]
    kind: ClassVar[str]
    options: ClassVar[Options] = {}
    clocks: ClassVar[tuple[Clock, ...]] = ()
    seeds_measuring: ClassVar[bool] = False
    robot: ClassVar[bool] = False

    @abstractmethod
    def simulate(self, request: Request, progress: Progress) -> Simulated:
        """Measure a campaign and write its folder."""

    def served(self, request: Request) -> ServedMachine:
        """Return the machine under its program, for corrections that come while it runs."""
        raise self.lacks("being corrected while it is measured", "leave --listen away")

    def evidence(self, request: EvidenceRequest) -> MeasuredWays:
        """Measure the machine with and without a bundle, by turns."""
        raise self.lacks("closed-loop evidence", FROM_THE_LAKE)

    def checked(self, request: EvidenceRequest, blocks: int) -> list[CheckedRun]:
        """Measure pairs with and without a bundle, in an order of its own for each of some blocks."""
        raise self.lacks("a check by pairs of runs", "dtwin recheck judges fresh evidence")

    def prediction(self, home: Home, version: RegisteredVersion, progress: Progress) -> Evidence:
        """Return evidence that other campaigns of the lake give, where nothing is served."""
        raise self.lacks("predicted evidence", FROM_THE_LAKE)

    def offers(self, verb: str) -> bool:
        """Tell whether the machine has ``served``, ``evidence``, ``checked`` or ``prediction``."""
        return getattr(type(self), verb) is not getattr(VirtualMachine, verb)

    def lacks(self, what: str, hint: str) -> InputError:
        """Return the refusal of something, with what serves instead."""
        return InputError(
            f"{what} is not offered for the virtual {self.name}", code="machine.not_offered", got=self.name, hint=hint
        )

    def chosen(self, given: Mapping[str, str | None]) -> dict[str, str]:
        """Return a value for each option but the plan, the usual where none is given.

        Args:
            given: Options by name, ``plan`` among them; None when it was not given.

        Raises:
            InputError: When the machine has no such option, or the option no such value.
        """
        for name, value in given.items():
            if value is not None and name not in self.options:
                raise InputError(
                    f"the virtual {self.name} has no such option",
                    code="simulate.option",
                    got=f"--{name} {value[:40]}",
                    hint=f"leave --{name} away",
                    allowed=", ".join(f"--{option}" for option in self.options) or "none of its own",
                )
            if value is not None and name != PLAN and value not in self.options[name]:
                raise InputError(
                    f"the virtual {self.name} cannot be so",
                    code=f"simulate.{name}",
                    got=f"--{name} {value[:40]}",
                    allowed=", ".join(self.options[name]),
                )
        return {name: given.get(name) or values[0] for name, values in self.options.items() if name != PLAN}
