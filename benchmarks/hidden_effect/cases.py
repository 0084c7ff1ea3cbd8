"""The making of one case: what is hidden, how large, and what is measured."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

import numpy as np
from along import line_case
from causes import BASE, LIBRARY, Cause, foreign, thermal_drift, thermal_growth
from designs import DESIGNS
from published import drawn_case, published_case
from robot import GEOMETRY, JOINTS, joint_cause
from rows import NOISE_UM, ROWS, Row
from second_faults import LIBRARY as SECOND
from second_machine import Bench as SecondBench
from second_machine import Machine
from sizing import Bench, Sized, acting, sum_of

from dtwin.machines.mill import Disturbance, Moment, VirtualMill
from dtwin.machines.mill_parameters import CircularTest, HeatParameters, MillParameters, NoiseParameters
from dtwin.schema import Campaign, Floats, Run

__all__ = ["NOISE_UM", "ROWS", "Case", "Row", "make_case"]

# Effects that set the same parameters of an axis cannot be hidden together.
_ONE_MECHANISM = (
    {"reversal_ringing", "structural_resonance", "inertial_compliance"},
    {"reversal_spike", "friction"},
    {"cyclic_error", "cyclic_error_by_direction"},
)


@dataclass(frozen=True)
class Case:
    """What was made: runs for the tool, truth for the examiner.

    ``also`` are labels that are right, too, but too small to be asked for.
    """

    row: Row
    number: int
    runs: list[Run]
    campaign: Campaign
    known: tuple[str, ...]
    hidden: tuple[Cause, ...]
    sizes: tuple[float, ...]
    truths: dict[str, float] = field(default_factory=dict)
    also: tuple[str, ...] = ()


def make_case(row: Row, number: int) -> Case:
    """Return one case; its seed is derived from the name of the row and the number."""
    rng = np.random.default_rng([zlib.crc32(row.name.encode()), number])
    if row.kind != "circular":
        made_of = line_case(row, number, rng)
        return Case(row, number, made_of.runs, made_of.campaign, (), made_of.hidden, made_of.sizes)
    if row.machine in ("published", "drawn"):
        if row.machine == "drawn":
            campaign, runs, sizes, also = drawn_case(number, row.everyday, row.noise_um, rng)
        else:
            campaign, runs, sizes, also = published_case(number, row.noise_um, rng)
        found = tuple(Cause(label, 1.0) for label in sizes)
        return Case(row, number, runs, campaign, (), found, tuple(sizes.values()), also=also)
    if row.machine == "second":
        return _second_case(row, number, rng)
    hidden = _hidden(row, number, rng)
    base_names = _base_names(row, hidden, rng)
    heights = any(cause.design == "heights" for cause in hidden)
    tests = replace(DESIGNS[row.design], heights=heights).tests(rng)
    heat = HeatParameters(feed_share=0.0 if row.design == "warm_up" else 0.5)
    seed = int(rng.integers(2**31))
    base = _sized_base(base_names, rng)
    mill = MillParameters(heat=heat)
    for cause, size in base:
        mill = cause.change(mill, size)
    bench = Bench(_enough(tests, hidden), seed)
    sized = _sized(row, hidden, base, mill, bench, rng)
    extra: list[Disturbance] = []
    for cause, size in sized:
        mill = cause.change(mill, size)
        extra += acting(cause, size)
    mill = _spoilt(row, number, mill)
    channels = _channels(len(tests), rng) if row.distractors else {}
    if row.hidden == ("coolant",):
        extra.append(_coolant(channels["coolant_v"], NOISE_UM * row.k, rng.uniform(0, 6.28)))
    made = VirtualMill(
        mill,
        seed,
        NoiseParameters(row.noise_um, row.noise),
        disturbance=sum_of(extra),
        samples_per_turn=row.samples_per_turn,
    )
    truths: dict[str, float] = {}
    for cause, size in [*base, *sized]:
        truths.update(cause.truths(size))
    return Case(
        row=row,
        number=number,
        runs=[_with_channels(r, channels, i) for i, r in enumerate(made.measure(tests))],
        campaign=_campaign(made, f"{row.name}-{number}", hidden),
        known=base_names,
        hidden=hidden,
        sizes=tuple(size for _, size in sized),
        truths=truths,
    )


def _second_case(row: Row, number: int, rng: np.random.Generator) -> Case:
    """Return a case of the second machine; each fault alone shows as 0.5 to 2 um RMS."""
    design = DESIGNS[row.design]
    bench = SecondBench(design.radii_mm, design.feeds_mm_min, design.repeats, design.paired)
    machine, sizes = Machine(), []
    hidden = _many(row, SECOND, rng)
    for fault in hidden:
        sizes.append(bench.sized(fault, rng.uniform(0.5, 2.0)) * _sign(fault, rng))
        machine = fault.change(machine, sizes[-1])
    campaign, runs = bench.measured(machine, row.noise_um, rng)
    causes = tuple(Cause(fault.label, 1.0) for fault in hidden)
    also = tuple(name for fault in hidden for name in fault.also)
    return Case(row, number, runs, campaign, (), causes, tuple(sizes), also=also)


def _sized_base(names: Sequence[str], rng: np.random.Generator) -> list[Sized]:
    """Return the known effects, of half to one and a half times their ordinary size."""
    made = [(BASE[name][0](BASE[name][1][0], rng), BASE[name][2]) for name in names]
    return [(cause, size * rng.uniform(0.5, 1.5) * _sign(cause, rng)) for cause, size in made]


def _enough(tests: Sequence[CircularTest], hidden: Sequence[Cause]) -> list[CircularTest]:
    """Return the tests that size the hidden effects: one of each, unless they change in time."""
    in_time = any(cause.in_time for cause in hidden)
    return [test for test in tests if in_time or test.repeat == 1]


def _sized(
    row: Row,
    hidden: Sequence[Cause],
    base: Sequence[Sized],
    mill: MillParameters,
    bench: Bench,
    rng: np.random.Generator,
) -> list[Sized]:
    """Return the hidden effects in the size that the row asks for.

    Where nothing is told, each alone shows as 0.5 to 2 um RMS, whatever the noise.
    """
    if not hidden:
        return []
    hides = bench.hiding(base, MillParameters(heat=mill.heat))

    def wanted_um() -> float:
        return rng.uniform(0.5, 2.0) if row.right == "every" else row.k * NOISE_UM

    return [(c, bench.size_of(c, mill, hides, wanted_um()) * _sign(c, rng)) for c in hidden]


class _Labelled(Protocol):
    @property
    def label(self) -> str: ...

    @property
    def signed(self) -> bool: ...


_Fault = TypeVar("_Fault", bound=_Labelled)


def _many(
    row: Row, makers: Mapping[str, Callable[[str, np.random.Generator], _Fault]], rng: np.random.Generator
) -> tuple[_Fault, ...]:
    """Return so many faults at once, at most one of each mechanism on an axis."""
    out: list[_Fault] = []
    if not row.hidden:
        return ()
    while len(out) < row.how_many:
        name = str(rng.choice(row.hidden))
        cause = makers[name]("XY"[rng.integers(2)], rng)
        if not any(_clash(cause.label, other.label) for other in out):
            out.append(cause)
    return tuple(out)


def _clash(first: str, second: str) -> bool:
    """Tell whether two effects set the same parameters of an axis."""
    (a, _, axis), (b, _, other) = first.partition(" "), second.partition(" ")
    same_axis = axis == other or not axis or not other
    return first == second or (same_axis and any({a, b} <= m for m in _ONE_MECHANISM))


def _spoilt(row: Row, number: int, mill: MillParameters) -> MillParameters:
    """Return the machine with what has no size k."""
    if row.right == "spread":
        return mill.with_axis("XY"[number % 2], slip_um=4.0, slip_mm_s=6.0)
    if row.right == "absorbed":
        # Both scales alike: nothing but a longer bar.
        for axis in "XY":
            mill = mill.with_axis(axis, scale_ppm=mill.axis(axis).scale_ppm + 30.0)
    return mill


def _campaign(made: VirtualMill, name: str, hidden: Sequence[Cause]) -> Campaign:
    campaign = made.campaign(name)
    if hidden and hidden[0].label.split()[0] in JOINTS:
        return replace(campaign, machine="virtual-robot", machine_geometry=GEOMETRY)
    return campaign


def _hidden(row: Row, number: int, rng: np.random.Generator) -> tuple[Cause, ...]:
    if not row.hidden or row.hidden[0] in ("coolant", "bar", "stick_slip"):
        return ()
    if row.right == "every":
        many = _many(row, LIBRARY, rng)
        beside = row.unknown[number % len(row.unknown)] if row.unknown else ""
        return (*many, foreign(beside, rng)) if beside else many
    if row.hidden[0] in LIBRARY:
        names = [row.hidden[number % len(row.hidden)]]
        for name in rng.permutation([n for n in row.hidden if n != "angular_error"]):
            if len(names) < row.how_many and not any(_share_parameters(name, n) for n in names):
                names.append(str(name))
        return tuple(LIBRARY[n]("XY"[rng.integers(2)], rng) for n in names)
    if row.hidden[0] == "thermal_growth":
        return (thermal_growth("", rng),)
    if row.hidden[0] == "thermal_drift":
        return (thermal_drift("", rng),)
    if row.hidden[0] in JOINTS:
        return (joint_cause(row.hidden[number % len(row.hidden)], rng),)
    return (foreign(row.hidden[0], rng),)


def _share_parameters(first: str, second: str) -> bool:
    return first == second or any({first, second} <= parts for parts in _ONE_MECHANISM)


def _base_names(row: Row, hidden: Sequence[Cause], rng: np.random.Generator) -> tuple[str, ...]:
    taken = {cause.label.replace(" ", ":") for cause in hidden}
    if row.base is not None:
        return tuple(name for name in row.base if name not in taken)
    free = [name for name in BASE if name not in taken]
    n = min(int(rng.integers(3, 5)), len(free))
    return tuple(sorted(str(name) for name in rng.permutation(free)[:n]))


def _sign(cause: _Labelled, rng: np.random.Generator) -> float:
    drawn = 1.0 if rng.random() < 0.5 else -1.0
    return drawn if cause.signed else 1.0


def _channels(n: int, rng: np.random.Generator) -> dict[str, Floats]:
    """Return ten random walks that have nothing to do with the error."""
    names = [f"channel{i}_v" for i in range(9)] + ["coolant_v"]
    out = {}
    for name in names:
        walk = np.cumsum(rng.standard_normal(n))
        out[name] = (walk - walk.mean()) / walk.std()
    return out


def _coolant(pressure: Floats, rms_um: float, phase: float) -> Disturbance:
    def act(moment: Moment) -> Floats:
        return np.sqrt(2.0) * rms_um * pressure[moment.number] * np.cos(3 * moment.angle_rad + phase)

    return act


def _with_channels(run: Run, channels: dict[str, Floats], number: int) -> Run:
    logged = dict(run.meta.covariates)
    for i, (name, walk) in enumerate(channels.items()):
        # Every third bystander follows the temperature.
        follows = logged["temperature_c"] if name != "coolant_v" and i % 3 == 0 else 0.0
        logged[name] = float(walk[number] + follows)
    return replace(run, meta=replace(run.meta, covariates=logged))
