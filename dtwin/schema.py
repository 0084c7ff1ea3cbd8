"""The records that every part of dtwin speaks."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError

_R = TypeVar("_R", "Run", Mapping[str, Any], dict[str, Any])
Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Direction = Literal["CCW", "CW"]
Plane = Literal["XY", "YZ", "ZX"]

DEFAULT_KIND = "circular"
ALONG_KIND = "linear"
"""Of positioning tests of axes that move along."""
MIXED_CORRECTION = "mixed"
"""Correction of a run that was corrected during a part of it only, or by several models."""
PLANES: tuple[Plane, ...] = ("XY", "YZ", "ZX")
_FLIPPED: dict[str, Plane] = {"YX": "XY", "ZY": "YZ", "XZ": "ZX"}
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,99}")
DEVICE = re.compile(r"(?i)(con|prn|aux|nul|com[0-9]|lpt[0-9])(\..*)?")
"""What Windows takes for a device, whatever the ending: such a file cannot be copied there."""


def require_name(name: object, what: str) -> str:
    """Return ``name`` when it is safe as an identifier and as a file name.

    Args:
        name: The proposed campaign, run, machine or twin name.
        what: What is being named, for the error message.

    Raises:
        InputError: When the name could leave its folder or be misread.
    """
    if isinstance(name, str) and _NAME.fullmatch(name) and ".." not in name and not DEVICE.fullmatch(name):
        return name
    raise InputError(
        f"{what} is not a usable name",
        code="name.invalid",
        got=repr(name)[:120],
        allowed="1 to 100 letters, digits and . _ + -, starting with a letter or digit, without '..', no device such as CON",
    )


def fresh_name(name: str, taken: Container[str]) -> str:
    """Return a name that is not taken: itself, else with the first number from 2 that makes it one."""
    number = 1
    while (fresh := name if number == 1 else f"{name}-{number}") in taken:
        number += 1
    return fresh


def of_one_way(runs: Sequence[_R]) -> list[_R]:
    """Return the runs of a campaign, or their rows, that show one state of the machine: without a correction, if some are.

    Runs with and without a correction take turns in evidence; they are no repeats of each other. Where every run had one, it
    is the correction of most of them.
    """
    corrections = [str(run["correction"]) if isinstance(run, Mapping) else run.meta.correction for run in runs]
    ways = Counter(corrections)
    taken = "" if "" in ways else max(ways, key=ways.__getitem__, default="")
    return [run for run, correction in zip(runs, corrections, strict=True) if correction == taken]


def standard_plane(plane: str, direction: Direction) -> tuple[Plane, Direction]:
    """Return the plane as XY, YZ or ZX, flipping the direction when the axes are swapped.

    Args:
        plane: Two axis letters in any order and case.
        direction: Sense of motion seen from the positive side of the named plane. One of "CCW", "CW".
    """
    wanted = plane.upper()
    if wanted in PLANES:
        return wanted, direction
    if wanted in _FLIPPED:
        return _FLIPPED[wanted], "CW" if direction == "CCW" else "CCW"
    raise InputError(
        "unknown plane", code="run.plane", got=plane[:40], allowed="XY, YZ, ZX, and XZ, ZY, YX, which are converted"
    )


@dataclass(frozen=True)
class Finding:
    """One thing that is noteworthy or wrong with the data of a run.

    Attributes:
        code: Stable identifier, for example ``"arc.window_short"``.
        severity: ``error`` keeps the run out of training unless the user insists. One of "info", "warning", "error".
        message: One sentence with the numbers in it.
        numbers: The figures behind the message, named with their units.
    """

    code: str
    severity: Literal["info", "warning", "error"]
    message: str
    numbers: Mapping[str, float | list[float]] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {"code": self.code, "severity": self.severity, "message": self.message, "numbers": dict(self.numbers)}


@dataclass(frozen=True)
class Encoded:
    """A Parquet file whose pages were verified, and the columns that were read from it.

    Attributes:
        columns: What it holds: the object itself, by which its owner knows that nothing was replaced.
    """

    data: bytes | memoryview
    columns: Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class SignalGroup:
    """High-rate signals of one device during a run, on that device's own clock.

    Attributes:
        name: Device group, for example ``"accelerometers"`` or ``"controller"``.
        columns: Signals by column name; names carry the unit. Shape (n,) each.
        start_s: Time of the first sample on the device's own clock.
        encoded: The file that the columns come from; the lake keeps it instead of encoding them again.
    """

    name: str
    rate_hz: float
    columns: Mapping[str, NDArray[Any]]
    start_s: float = 0.0
    encoded: Encoded | None = field(default=None, repr=False, compare=False)

    @property
    def n_samples(self) -> int:
        """Number of samples per channel."""
        return len(next(iter(self.columns.values()))) if self.columns else 0

    @property
    def t_s(self) -> Floats:
        """Sample times on the device's own clock, shape (n,)."""
        return self.start_s + np.arange(self.n_samples) / self.rate_hz


@dataclass(frozen=True)
class RunMeta:
    """What is known of a run besides its samples.

    Attributes:
        run_id: Unique inside the campaign.
        kind: Kind of campaign that the run belongs to.
        plane, direction, radius_mm, feed_mm_min: Condition of a circular run; None for other kinds.
        condition: Conditions of the other kinds (axis, amplitude, frequency ...), names with units.
        repeat: Counts repeats of the same condition from 1.
        setup: One mounting of the instrument; centre and zero belong to it.
        started: ISO 8601 time, empty when unknown.
        covariates: Numbers logged once per run.
        vendor: Figures that the vendor's file itself states for this run, names with units.
        correction: Checksum of the model (``Bundle.model_sha256``) whose correction was in force, empty when none was.
    """

    run_id: str
    kind: str = DEFAULT_KIND
    plane: Plane | None = None
    direction: Direction | None = None
    radius_mm: float | None = None
    feed_mm_min: float | None = None
    condition: Mapping[str, float | str] = field(default_factory=dict)
    repeat: int = 1
    setup: str = "s1"
    started: str = ""
    sample_rate_hz: float = math.nan
    covariates: Mapping[str, float] = field(default_factory=dict)
    vendor: Mapping[str, float] = field(default_factory=dict)
    correction: str = ""


_FED_TIMES = 2.0


@dataclass(frozen=True)
class Run:
    """One pass of the machine under one condition, as measured.

    Attributes:
        samples: Samples of the reference instrument. A circular run has ``t_s``, ``angle_deg`` and ``deviation_um``;
            optional ``cmd_x_mm`` ... ``act_z_mm`` and covariate columns. Shape (n,) each.
        window: First and one-past-last sample of the part that the vendor's file marks as the test.
        signals: High-rate signals, each group on its own clock.
        source: File that the run was read from.
        machine: What that file itself calls the machine; empty where it does not.
    """

    meta: RunMeta
    samples: Mapping[str, NDArray[Any]]
    window: tuple[int, int] | None = None
    signals: tuple[SignalGroup, ...] = ()
    source: str = ""
    findings: tuple[Finding, ...] = ()
    machine: str = ""

    @property
    def n_samples(self) -> int:
        """Number of samples of the reference instrument."""
        return len(next(iter(self.samples.values()))) if self.samples else 0

    @property
    def marked(self) -> slice:
        """The samples that the vendor's file marks as the test; all where it marks none."""
        return slice(None) if self.window is None else slice(*self.window)

    @property
    def arc(self) -> tuple[Floats, Floats]:
        """Angle in degrees and deviation in µm of the marked part of a circle, shapes (n,)."""
        return self.samples["angle_deg"][self.marked], self.samples["deviation_um"][self.marked]

    @property
    def on_circle(self) -> slice:
        """The samples between feeding the bar in and out, where deviations are far beyond those of the marked arc."""
        deviation = self.samples["deviation_um"]
        first, last, _ = self.marked.indices(deviation.size)
        marked = deviation[first:last]
        far = np.flatnonzero(np.abs(deviation - np.median(marked)) > _FED_TIMES * np.ptp(marked))
        return slice(int(max(far[far < first] + 1, default=0)), int(min(far[far >= last], default=deviation.size)))


@dataclass(frozen=True)
class Campaign:
    """A plan of runs over a grid of conditions, done on one machine.

    Attributes:
        name, machine: Identifiers; both are safe as file names.
        started: ISO 8601 time, empty when unknown.
        machine_geometry: What joint, lag and Abbe effects need: type, chain, centre_mm, tcp_mm, joint_branch.
        instrument: model, nominal_mm, calibrated_mm, sample_rate_hz, offset_mm.
    """

    name: str
    machine: str
    kind: str = DEFAULT_KIND
    started: str = ""
    machine_geometry: Mapping[str, Any] = field(default_factory=dict)
    instrument: Mapping[str, Any] = field(default_factory=dict)

    def of_kind(self, kind: str, where: str = "") -> Campaign:
        """Return it. Raises ``InputError`` when it is of another kind of test."""
        if self.kind != kind:
            raise InputError(
                f"not a {kind} campaign", code="campaign.kind", where=where or self.name, got=self.kind, allowed=kind
            )
        return self
