"""A library of physical terms for robots, written once as a graph for training and serving."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dtwin.features.path_inputs import PATH_INPUTS
from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.serve.tape import Tape
from dtwin.train.dataset import TICK_HZ, TickRun

_JOINTS = range(1, 7)
# Wider than any play worth modelling, far narrower than any motion: gives the loaded flank.
FLANK_RAD = 1e-4
_MOVING_MM_S = 0.5
RIPPLE, RINGING = "transmission ripple", "ringing after stops"
_ECCENTRICITIES = (1.0, 2.0, 3.0)


@dataclass(frozen=True)
class Gear:
    """Transmission error of one joint at one order.

    ``joint``: 1 to 6.
    ``order``: cycles per turn of the joint.
    """

    joint: int
    order: float


@dataclass(frozen=True)
class Mode:
    """A lightly damped structural mode that rings after the path starts or stops."""

    frequency_hz: float
    damping_ratio: float


@dataclass(frozen=True)
class _Atom:
    """One term of the library, before it gets a coefficient.

    ``unit``: unit of the term; a coefficient has um over it.
    ``cause``: physical cause that it stands for.
    """

    name: str
    unit: str
    cause: str


class Library:
    """Terms that are linear in their coefficients, as products in one graph.

    ``horizon_s``: joint angles are taken this far ahead along the commanded motion, to make up for the known delay
    between correction and motion. Zero in training.
    """

    def __init__(self, gears: Sequence[Gear], modes: Sequence[Mode], *, horizon_s: float = 0.0) -> None:
        self.gears = tuple(dict.fromkeys(gears))
        self.modes, self.horizon_s = tuple(modes), horizon_s
        self.builder = GraphBuilder()
        self.atoms: dict[_Atom, tuple[Expression, ...]] = {}
        self.initial: dict[str, float] = {}
        self.updates: dict[str, Expression] = {}
        self._q = {j: self._ahead(j) for j in _JOINTS}
        self._lever = {j: self.builder.input(f"lever_{j}_mm_rad") for j in _JOINTS}
        self._flank = {j: self._loaded_flank(j) for j in _JOINTS}
        self._orders = {(j, order) for j in _JOINTS for order in _ECCENTRICITIES}
        self._orders |= {(gear.joint, gear.order) for gear in gears}
        self._waves: dict[tuple[int, float], tuple[Expression, Expression]] = {}
        self._calibration()
        self._compliance()
        for gear in self.gears:
            self._transmission(gear)
        events = self._events() if modes else {}
        for mode in modes:
            self._structure(mode, events)

    @property
    def names(self) -> list[str]:
        """Readable names of the terms, in order."""
        return [atom.name for atom in self.atoms]

    def values(self, wanted: Sequence[Expression], runs: Sequence[TickRun]) -> list[NDArray[np.float32]]:
        """Return expressions of this graph at the rows of each run, shape (rows, expressions) each.

        Those that remember run through every tick of a run, the others through its rows alone.

        ``runs``: runs on the controller's clock.
        """
        outputs = {f"t{i}": expression for i, expression in enumerate(wanted)}
        live = self.live_states(outputs)
        graph = self.builder.graph(outputs, {k: self.updates[k] for k in live})
        used = [name for name in PATH_INPUTS if name in graph.inputs]
        places = np.array([PATH_INPUTS.index(name) for name in used], dtype=np.intp)
        tape = Tape(graph, used, {k: self.initial[k] for k in live}, list(outputs))
        columns = []
        for run in runs:
            tape.reset()
            inputs = run.inputs[:, places] if live else run.inputs[np.ix_(run.arc, places)]
            values = tape.run_many(inputs.astype(float))
            columns.append((values[run.arc] if live else values).astype(np.float32))
        return columns

    def live_states(self, outputs: Mapping[str, Expression]) -> list[str]:
        """Return the states that outputs read, directly or through other states, sorted."""
        wanted: set[str] = set()
        while True:
            graph = self.builder.graph(outputs, {k: self.updates[k] for k in wanted})
            read = {n.name for n in graph.nodes if n.op == "state"}
            if read <= wanted:
                return sorted(wanted)
            wanted |= read

    def _ahead(self, joint: int) -> Expression:
        q = self.builder.input(f"q{joint}_rad")
        if self.horizon_s == 0.0:
            return q
        return q + self.horizon_s * self.builder.input(f"qd{joint}_rad_s")

    def _loaded_flank(self, joint: int) -> Expression:
        """Return -1 ... 1: the tooth flank that carries the load, remembered at standstill."""
        name = f"flank_{joint}_rad"
        b, q = self.builder, self._q[joint]
        dragged = b.apply("min", b.apply("max", b.state(name), q - FLANK_RAD), q + FLANK_RAD)
        self.initial[name] = 0.0
        self.updates[name] = dragged
        return (q - dragged) * (1.0 / FLANK_RAD)

    def _wave(self, joint: int, order: float) -> tuple[Expression, Expression]:
        """Return cosine and sine of a multiple of a joint's angle.

        Multiples of a wave that is there come from it by the addition theorems, at a few
        products instead of two more transcendental functions.
        """
        key = joint, order
        if key not in self._waves:
            self._waves[key] = self._multiple(joint, order)
        return self._waves[key]

    def _multiple(self, joint: int, order: float) -> tuple[Expression, Expression]:
        if (joint, order / 2.0) in self._orders:
            cos, sin = self._wave(joint, order / 2.0)
            twice = 2.0 * sin
            return 1.0 - twice * sin, twice * cos
        if order == 3.0:
            (cos_1, sin_1), (cos_2, sin_2) = self._wave(joint, 1.0), self._wave(joint, 2.0)
            return cos_2 * cos_1 - sin_2 * sin_1, sin_2 * cos_1 + cos_2 * sin_1
        q = self._q[joint]
        angle = q if order == 1.0 else order * q
        return self.builder.apply("cos", angle), self.builder.apply("sin", angle)

    def _calibration(self) -> None:
        for j in _JOINTS:
            lever, flank = self._lever[j], self._flank[j]
            self._atom(f"lever{j}", "mm/rad", "zero error", lever)
            self._atom(f"lever{j}*flank{j}", "mm/rad", "joint backlash", lever, flank)
            for order in _ECCENTRICITIES:
                for function, wave in zip(("cos", "sin"), self._wave(j, order), strict=True):
                    name = f"lever{j}*{function}({order:g}*q{j})"
                    cause = "bearing and encoder eccentricity"
                    self._atom(name, "mm/rad", cause, lever, wave)

    def _compliance(self) -> None:
        b = self.builder
        upper = self._q[2] + self._q[3]
        for j in (2, 3, 4):
            for label, angle in (("q2+q3", upper), ("q2+q3+q4", upper + self._q[4])):
                for function in ("cos", "sin"):
                    name = f"lever{j}*{function}({label})"
                    term = self._lever[j], b.apply(function, angle)
                    self._atom(name, "mm/rad", "gravity", *term)

    def _transmission(self, gear: Gear) -> None:
        j = gear.joint
        lever, flank = self._lever[j], self._flank[j]
        for function, wave in zip(("cos", "sin"), self._wave(j, gear.order), strict=True):
            name = f"lever{j}*{function}({gear.order:g}*q{j})"
            self._atom(name, "mm/rad", RIPPLE, lever, wave)
            self._atom(f"{name}*flank{j}", "mm/rad", RIPPLE, lever, flank, wave)

    def _structure(self, mode: Mode, events: Mapping[str, Expression]) -> None:
        """Add a mode that rings after each start and stop, seen in the frame of joint 1.

        The kick goes along the direction of travel and grows with the programmed feed; how
        much of it the mode takes up, and in which direction it moves, is left to the fit.
        """
        b = self.builder
        cos, sin = self._wave(1, 1.0)

        def turned(prefix: str) -> tuple[Expression, Expression, Expression]:
            x, y, z = (b.input(f"{prefix}_{axis}_1") for axis in "xyz")
            return x * cos + y * sin, y * cos - x * sin, z

        seen, travel = turned("radial"), turned("tangent")
        feed = 0.001 * b.input("programmed_feed_mm_min")
        a = _free_step(mode, 1.0 / TICK_HZ)
        w = 2.0 * np.pi * mode.frequency_hz
        for event, happened in events.items():
            kick = happened * feed
            for push, along in zip("rtz", travel, strict=True):
                place, speed = (f"mode{mode.frequency_hz:g}_{event}_{push}_{k}" for k in "xv")
                x, v = b.state(place), b.state(speed)
                kicked = v + kick * along
                # The place is kept times w, so that it is a speed as well.
                moved = a[0][0] * x + a[0][1] * w * kicked
                moving = a[1][0] / w * x + a[1][1] * kicked
                self.initial |= {place: 0.0, speed: 0.0}
                self.updates |= {place: moved, speed: moving}
                for show, toward in zip("rtz", seen, strict=True):
                    name = f"mode{mode.frequency_hz:g}Hz_{event}_{push}->{show}"
                    self._atom(f"{name}_sin", "m/min", RINGING, toward, moved)
                    self._atom(f"{name}_cos", "m/min", RINGING, toward, moving)

    def _events(self) -> dict[str, Expression]:
        """Return what is 1 for the one tick in which the path starts, or stops."""
        b = self.builder
        moving = b.apply("step", b.input("commanded_speed_mm_s") - _MOVING_MM_S)
        before = b.state("was_moving_1")
        self.initial["was_moving_1"] = 0.0
        self.updates["was_moving_1"] = moving
        return {"start": moving * (1.0 - before), "stop": before * (1.0 - moving)}

    def _atom(self, name: str, unit: str, cause: str, *factors: Expression) -> None:
        self.atoms[_Atom(name, unit, cause)] = factors


def weighted_sum(builder: GraphBuilder, terms: Sequence[tuple[float, tuple[Expression, ...]]]) -> Expression:
    """Return the sum of weighted products, with what they share taken out of the brackets.

    ``terms``: products; terms whose factors begin alike share one bracket.
    """
    brackets: dict[Expression, list[tuple[float, tuple[Expression, ...]]]] = {}
    parts: list[Expression] = []
    for weight, factors in terms:
        if factors:
            brackets.setdefault(factors[0], []).append((weight, factors[1:]))
        else:
            parts.append(builder.constant(weight))
    parts += [weighted_sum(builder, inner) * factor for factor, inner in brackets.items()]
    return _balanced(builder, parts)


def _balanced(builder: GraphBuilder, parts: Sequence[Expression]) -> Expression:
    """Return a sum in which no addition waits for many others."""
    if len(parts) < 3:
        return builder.total(parts)
    half = len(parts) // 2
    return _balanced(builder, parts[:half]) + _balanced(builder, parts[half:])


def _free_step(mode: Mode, dt_s: float) -> list[list[float]]:
    """Return the exact step of ``x'' + 2 zeta w x' + w^2 x = 0``: ``[x, v] <- step [x, v]``."""
    w, zeta = 2.0 * np.pi * mode.frequency_hz, mode.damping_ratio
    wd = w * np.sqrt(1.0 - zeta**2)
    decay = np.exp(-zeta * w * dt_s)
    c, s = np.cos(wd * dt_s), np.sin(wd * dt_s)
    ratio = zeta * w / wd
    return [
        [float(decay * (c + ratio * s)), float(decay * s / wd)],
        [float(-decay * w**2 * s / wd), float(decay * (c - ratio * s))],
    ]


def equation_text(library: Library, weights: Mapping[str, float]) -> str:
    """Return the equation as text, grouped by cause, strongest first."""
    by_cause: dict[str, list[tuple[float, str]]] = {}
    for atom in library.atoms:
        weight = weights.get(atom.name, 0.0)
        if weight:
            by_cause.setdefault(atom.cause, []).append((weight, atom.name))
    lines = ["radial_error_um ="]
    for cause, terms in by_cause.items():
        lines.append(f"  # {cause}")
        lines += [f"  {weight:+.6g} * {name}" for weight, name in terms]
    return "\n".join(lines)
