"""A lathe's slide on its screw, a control that runs its program, and a laser interferometer that looks at it.

Where the nut has play, the slide keeps its place until one of the screw's flanks reaches it: which
error a target shows depends on the path to it, not on a flag for the direction.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from dtwin.errors import InputError
from dtwin.machines._wandering import wandering
from dtwin.machines.laser_trigger import LaserSetup, Triggered, watch
from dtwin.machines.printed_network import MAPPED_IN, PITCH_IN, LatheNetwork
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

MM_PER_IN = 25.4
UM_PER_IN = MM_PER_IN * UM_PER_MM
_CHUNK = 20_000
_CONTACTS = 96


class _Screw(Protocol):
    """What the slide rests on: one flank while it is pushed up, the other while it is pushed down."""

    @property
    def pitch_mm(self) -> float:
        """Travel in one turn."""

    def flanks_um(self, position_mm: Floats) -> tuple[Floats, Floats]:
        """Return lower and upper limit of slide minus screw in um, each of shape (n,)."""


@dataclass(frozen=True)
class NetworkScrew:
    """The error of a real lathe as a network printed it, taken as two flanks.

    ``network``: forward error is the lower limit, reverse error the upper; ends of the map are held.
    """

    network: LatheNetwork
    pitch_mm: float = PITCH_IN * MM_PER_IN

    def flanks_um(self, position_mm: Floats) -> tuple[Floats, Floats]:
        """Return lower and upper limit of slide minus screw in um, each of shape (n,)."""
        position = np.clip(np.atleast_1d(position_mm) / MM_PER_IN, *MAPPED_IN)
        lower, upper = np.empty_like(position), np.empty_like(position)
        for begin in range(0, len(position), _CHUNK):
            part = slice(begin, begin + _CHUNK)
            zeros = np.zeros(len(position[part]))
            lower[part] = self.network.error_in(zeros, position[part])
            upper[part] = self.network.error_in(zeros + 1.0, position[part])
        return lower * UM_PER_IN, upper * UM_PER_IN


@dataclass(frozen=True)
class _FlankForm:
    """How one flank of the thread deviates over a turn, in um and radians."""

    once_um: float
    once_phase_rad: float
    twice_um: float
    twice_phase_rad: float


@dataclass(frozen=True)
class ThreadScrew:
    """A worn screw by its geometry: lead, two flanks, a tilted nut, play.

    The nut rests on the highest of its contacts around the thread. Each flank has its own form, and
    the tilted nut meets them with opposite sides: so the cyclic error differs with the direction.

    ``lead_um_per_m``, ``wave_um``, ``wave_mm``: slow lead error: slope, and a wave with its length.
    ``leading``, ``trailing``: the flank that pushes up, and the one that pushes down.
    ``tilt_um``, ``tilt_rad``: how far the nut's rim stands off, and where.
    ``play_um``, ``wear_um``, ``worn_at_mm``, ``worn_mm``: play, and what wear adds around a place.
    """

    pitch_mm: float = 6.35
    lead_um_per_m: float = 28.0
    wave_um: float = 5.0
    wave_mm: float = 410.0
    leading: _FlankForm = _FlankForm(8.0, 0.4, 16.0, 1.1)
    trailing: _FlankForm = _FlankForm(10.0, 2.9, 22.0, 2.3)
    tilt_um: float = 18.0
    tilt_rad: float = 0.7
    play_um: float = 72.0
    wear_um: float = 16.0
    worn_at_mm: float = 420.0
    worn_mm: float = 140.0

    def flanks_um(self, position_mm: Floats) -> tuple[Floats, Floats]:
        """Return lower and upper limit of slide minus screw in um, each of shape (n,)."""
        x = np.atleast_1d(np.asarray(position_mm, float))
        lead = self.lead_um_per_m * (x / 1000.0) + self.wave_um * np.sin(2 * np.pi * x / self.wave_mm)
        half = 0.5 * (self.play_um + self.wear_um * np.exp(-(((x - self.worn_at_mm) / self.worn_mm) ** 2)))
        turned = np.mod(x / self.pitch_mm, 1.0)
        push = _periodic(turned, self._contact(self.leading, highest=True))
        pull = _periodic(turned, self._contact(self.trailing, highest=False))
        return lead - half + push, lead + half + pull

    def _contact(self, form: _FlankForm, *, highest: bool) -> Floats:
        """Return the standing-off of the contact that bears, over one turn, less its mean."""
        turn = np.linspace(0.0, 2 * np.pi, 360, endpoint=False)[:, None]
        around = np.linspace(0.0, 2 * np.pi, _CONTACTS, endpoint=False)
        on_thread = around + turn
        stand = form.once_um * np.cos(on_thread - form.once_phase_rad)
        stand = stand + form.twice_um * np.cos(2 * on_thread - form.twice_phase_rad)
        stand = stand + self.tilt_um * np.cos(around - self.tilt_rad)
        bears = stand.max(axis=1) if highest else stand.min(axis=1)
        return bears - bears.mean()


@dataclass(frozen=True)
class Wander:
    """What moves while nothing is commanded: instrument, foundation, temperature.

    ``offset_um``, ``scale_um_per_m``, ``time_constant_s``: standard deviations of a wandering zero and a wandering
    scale, and how long they remember.
    ``reading_um``, ``quantum_um``: noise of a single reading, and the laser's step.
    ``heating_c``, ``heating_time_s``, ``expansion_um_per_m_c``: by how much the running screw warms up in the end, how
    fast, and what that does.
    ``fixed_at_mm``: where the screw's fixed bearing is.
    """

    offset_um: float = 0.00045 * UM_PER_IN
    scale_um_per_m: float = 0.0002 * UM_PER_IN / (40.0 * MM_PER_IN / 1000.0)
    time_constant_s: float = 3600.0
    reading_um: float = 0.00003 * UM_PER_IN
    quantum_um: float = 0.1582
    heating_c: float = 0.0
    heating_time_s: float = 5400.0
    expansion_um_per_m_c: float = 11.5
    fixed_at_mm: float = 0.0


@dataclass(frozen=True)
class LatheRecording:
    """What the laser recorded, and what it was.

    ``t_s``, shape (n,): end of each reading after the zeroing.
    ``error_um``, shape (n,): actual minus commanded, as the laser shows it.
    ``air_f``, ``air_inhg``, ``material_f``, shape (n,): what its sensors show.
    ``truth_um``, shape (n,): the slide's error without wander, noise and zeroing.
    """

    triggered: Triggered
    t_s: Floats
    error_um: Floats
    air_f: Floats
    air_inhg: Floats
    material_f: Floats
    truth_um: Floats


@dataclass(frozen=True)
class VirtualLathe:
    """One axis."""

    screw: _Screw
    wander: Wander = field(default_factory=Wander)
    seed: int = 0

    def slide_mm(self, screw_mm: Floats) -> Floats:
        """Return where the slide is after each position of the screw, shape (n,).

        ``screw_mm`` (n,): successive positions; the axis has come from below.
        """
        lower, upper = self.screw.flanks_um(screw_mm)
        low = (screw_mm + lower / UM_PER_MM).tolist()
        high = (screw_mm + upper / UM_PER_MM).tolist()
        place = low[0]
        out = []
        for below, above in zip(low, high, strict=True):
            place = below if place < below else above if place > above else place
            out.append(place)
        return np.array(out)

    def measure(
        self, motion: Motion, setup: LaserSetup, t_s: Floats | None = None, screw_mm: Floats | None = None
    ) -> LatheRecording:
        """Let the laser watch a motion.

        ``t_s``, ``screw_mm``, shape (n,): where the screw was sent instead, when a correction changed the command.
        """
        times = motion.t_s if t_s is None else t_s
        slide = self.slide_mm(motion.position_mm if screw_mm is None else screw_mm)
        seen = times >= motion.zeroed_s
        triggered = watch(times[seen], slide[seen], setup)
        return self._recorded(motion, triggered, times, slide)

    def _recorded(self, motion: Motion, triggered: Triggered, times: Floats, slide: Floats) -> LatheRecording:
        begin = np.array([r.begin_s for r in triggered.readings])
        end = np.array([r.end_s for r in triggered.readings])
        actual = _averages(times, slide, begin, end)
        target = np.array([r.target_mm for r in triggered.readings])
        zero_mm = float(np.interp(motion.zeroed_s, times, slide))
        first = float(motion.at(np.array([motion.zeroed_s]))[0])
        rng = np.random.default_rng(self.seed)
        at = np.concatenate([[motion.zeroed_s], end])
        x_m = np.concatenate([[first], target]) / 1000.0
        moved = self._wander_um(rng, at, x_m, motion)
        truth = (actual - target) * UM_PER_MM
        shown = truth - (zero_mm - first) * UM_PER_MM + moved[1:] - moved[0]
        shown = shown + self.wander.reading_um * rng.normal(size=len(shown))
        step = self.wander.quantum_um
        air = 70.4 + 0.3 * wandering(rng, at, 7200.0)[1:]
        return LatheRecording(
            triggered=triggered,
            t_s=end - motion.zeroed_s,
            error_um=np.round(shown / step) * step if step > 0 else shown,
            air_f=air,
            air_inhg=29.25 + 0.02 * wandering(rng, at, 20_000.0)[1:],
            material_f=air + 1.1 + 1.8 * self._warm_c(end - motion.t_s[0]),
            truth_um=truth,
        )

    def _wander_um(self, rng: np.random.Generator, at: Floats, x_m: Floats, motion: Motion) -> Floats:
        wander = self.wander
        offset = wander.offset_um * wandering(rng, at, wander.time_constant_s)
        scale = wander.scale_um_per_m * wandering(rng, at, wander.time_constant_s)
        reach = x_m - wander.fixed_at_mm / 1000.0
        grown = wander.expansion_um_per_m_c * self._warm_c(at - motion.t_s[0]) * reach
        return offset + scale * x_m + grown

    def _warm_c(self, elapsed_s: Floats) -> Floats:
        return self.wander.heating_c * (1.0 - np.exp(-elapsed_s / self.wander.heating_time_s))


def _averages(times: Floats, values: Floats, begin: Floats, end: Floats) -> Floats:
    """Return means over intervals of a function that is straight between knots, shape (n,)."""
    area = np.concatenate([[0.0], np.cumsum(np.diff(times) * (values[1:] + values[:-1]) / 2.0)])

    def until(t: Floats) -> Floats:
        k = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
        there = np.interp(t, times, values)
        return area[k] + (t - times[k]) * (values[k] + there) / 2.0

    return (until(end) - until(begin)) / (end - begin)


def _periodic(turned: Floats, over_one_turn: Floats) -> Floats:
    n = len(over_one_turn)
    return np.interp(turned * n, np.arange(n + 1), np.append(over_one_turn, over_one_turn[0]))


_SETTLE_S = 0.3
# What an operator takes to zero the laser, and to start the machine again: the laser takes its first
# reading in between.
_ZEROING_S, _RESUME_S = 20.0, 10.0
_WORD = re.compile(r"([A-Z])\s*(-?\d+\.?\d*|-?\.\d+)")


@dataclass(frozen=True)
class Motion:
    """Commanded positions of one axis over time, straight between knots.

    ``t_s``, ``position_mm``, shape (knots,): times and positions; a halt is two knots at one position.
    ``zeroed_s``: when the operator zeroed the laser, during the first program stop.
    """

    t_s: Floats
    position_mm: Floats
    zeroed_s: float

    def at(self, t_s: Floats) -> Floats:
        """Return commanded positions in mm at times, shape (n,)."""
        return np.interp(t_s, self.t_s, self.position_mm)


def run_program(text: str, axis: str) -> Motion:
    """Run a program on one axis.

    ``text``: moves in machine coordinates with feed, dwells, stops; inch or metric by G70/G20 or G71/G21. Anything that
    would move otherwise is refused.
    Raises ``InputError`` when a block is not understood, or the axis moves without a feed.
    """
    state = _State(axis)
    for number, line in enumerate(text.splitlines(), start=1):
        state.block(line, number)
    if len(state.t_s) < 2:
        raise InputError("the program moves nothing", code="lathe.program", got=f"axis {axis}")
    zeroed = state.zeroed_s if state.zeroed_s is not None else state.t_s[0]
    return Motion(np.array(state.t_s), np.array(state.position), zeroed)


class _State:
    def __init__(self, axis: str) -> None:
        self.axis = axis
        self.mm = 1.0
        self.feed_mm_s = 0.0
        self.t_s: list[float] = []
        self.position: list[float] = []
        self.zeroed_s: float | None = None

    def block(self, line: str, number: int) -> None:
        code = re.sub(r"\([^)]*\)", "", line).strip().upper()
        if not code or code == "%":
            return
        words = _WORD.findall(code)
        if re.sub(r"\s", "", "".join(a + b for a, b in words)) != re.sub(r"\s", "", code):
            raise self._refused(line, number)
        named = [(letter, float(value)) for letter, value in words]
        codes = {value for letter, value in named if letter == "G"}
        self._units(codes)
        values = {letter: value for letter, value in named if letter not in "GM"}
        if 4.0 in codes:
            self._halt(values.get("F", values.get("P", 0.0) / 1000.0))
            return
        if "F" in values:
            self.feed_mm_s = values["F"] * self.mm / 60.0
        if self.axis in values and 53.0 in codes:
            self._move(values[self.axis] * self.mm, line, number)
        elif set(values) - {"F"}:
            raise self._refused(line, number)
        if ("M", 0.0) in named:
            self._halt(_ZEROING_S)
            self.zeroed_s = self.t_s[-1] if self.zeroed_s is None else self.zeroed_s
            self._halt(_RESUME_S)

    def _units(self, codes: set[float]) -> None:
        if codes & {70.0, 20.0}:
            self.mm = 25.4
        elif codes & {71.0, 21.0}:
            self.mm = 1.0

    def _move(self, target: float, line: str, number: int) -> None:
        if not self.t_s:
            self.t_s, self.position = [0.0], [target]
            return
        if self.feed_mm_s <= 0.0:
            raise self._refused(line, number)
        length = abs(target - self.position[-1])
        if length > 0.0:
            self._knot(length / self.feed_mm_s, target)
        self._knot(_SETTLE_S, target)

    def _halt(self, seconds: float) -> None:
        if self.t_s and seconds > 0.0:
            self._knot(seconds, self.position[-1])

    def _knot(self, after_s: float, position: float) -> None:
        self.t_s.append(self.t_s[-1] + after_s)
        self.position.append(position)

    def _refused(self, line: str, number: int) -> InputError:
        return InputError(
            "the virtual lathe does not understand this block",
            code="lathe.block",
            where=f"line {number}",
            got=line[:60],
            allowed=f"G53 {self.axis}..., F, G04, M00, M01, M30, modes",
        )
