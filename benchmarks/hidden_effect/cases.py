"""Rows of the exam and the making of one case: what is hidden, how large, what is measured."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from causes import BASE, LIBRARY, Cause, foreign, thermal_drift, thermal_growth
from designs import DESIGNS
from robot import GEOMETRY, JOINTS, joint_cause

from dtwin.machines.mill import Moment, SetupErrors, VirtualMill
from dtwin.machines.mill_noise import NoiseParameters
from dtwin.machines.mill_parameters import CircularTest, HeatParameters, MillParameters
from dtwin.schema import Campaign, Floats, Run

NOISE_UM = 0.5
_LARGEST = 1000.0
# Effects that set the same parameters of an axis cannot be hidden together.
_ONE_MECHANISM = (
    {"reversal_ringing", "structural_resonance", "inertial_compliance"},
    {"reversal_spike", "friction"},
    {"cyclic_error", "cyclic_error_by_direction"},
)
_QUIET = NoiseParameters(rms_um=0.0)
_STEADY = SetupErrors(jitter_us=0.0, trigger_samples=0.0)


@dataclass(frozen=True)
class Row:
    """One row: how its cases are made and what the right answer is."""

    name: str
    right: str
    cases: int
    k: float = 0.0
    hidden: tuple[str, ...] = ()
    how_many: int = 1
    design: str = "full"
    noise: str = "plain"
    distractors: bool = False
    base: tuple[str, ...] | None = None
    held_out: bool = False
    samples_per_turn: int = 1080


def _rows() -> list[Row]:
    every = tuple(LIBRARY)
    unknown = ("threshold_lobe", "quartic_scale", "play_curve", "gear_harmonic",
               "heat_times_feed", "hysteretic_heat", "lobe_with_feed")  # fmt: skip
    noises = ("plain", "feed", "reversal", "tails", "bad_run", "lobes")
    rows = [Row(f"null_{kind}", "nothing", 1000, noise=kind) for kind in noises]
    rows.append(Row("null_distractors", "nothing", 1000, distractors=True))
    rows.append(Row("null_odd_sampling", "nothing", 1000, samples_per_turn=1007))
    rows += [
        Row("single_half", "name", 200, 0.5, every),
        Row("single_quarter", "name", 200, 0.25, every),
    ]
    rows += [Row(f"single_{n}", "name", 40, k, every, held_out=k >= 1.0)
             for n, k in (("eighth", 0.125), ("one", 1.0), ("two", 2.0))]  # fmt: skip
    rows += [Row("pair_one", "all", 40, 1.0, every, 2), Row("triple_one", "all", 40, 1.0, every, 3)]
    rows += [Row(f"unknown_{kind}", "unknown", 40, 1.0, (kind,)) for kind in unknown]
    rows.append(Row("unknown_coolant", "channel", 40, 1.0, ("coolant",), distractors=True))
    rows += [Row(f"{kind}_k{k:g}", "unknown", 40, k, (kind,), base=("squareness:XY", "backlash:X"))
             for kind in ("square_law", "flat_law") for k in (1.0, 2.0)]  # fmt: skip
    rows += [
        Row("aliased_one_way", "group", 40, 1.0, ("squareness", "servo_mismatch"), design="one_way",
            base=("backlash:X", "straightness:Y")),
        Row("absorbed", "absorbed", 40, 0.0, ("bar",)),
        Row("heat_warm_up", "confounded", 40, 1.0, ("thermal_growth",), design="warm_up"),
        Row("heat_cool_down", "name", 40, 1.0, ("thermal_growth",)),
        Row("drift_cool_down", "name", 40, 1.0, ("thermal_drift",)),
        Row("lateral_play_half", "name", 40, 0.5, ("lateral_play",)),
        Row("one_repeat", "need_repeats", 40, 1.0, every, design="one_repeat"),
        Row("bad_run_half", "name", 40, 0.5, every, noise="bad_run"),
        Row("distractors_half", "name", 40, 0.5, every, distractors=True),
        Row("stick_slip", "spread", 40, 0.0, ("stick_slip",)),
    ]  # fmt: skip
    one_condition = tuple(
        n for n in every if n not in ("servo_lag", "measurement_delay", "angular_error")
    )
    plain = ("backlash", "cyclic_error", "reversal_spike", "squareness", "lateral_play")
    few = ("backlash:X", "straightness:Y")
    rows += [
        Row("one_circle_half", "name", 40, 0.5, one_condition, design="one_circle", base=few),
        Row("both_ways_half", "name", 40, 0.5, one_condition, design="both_ways", base=few),
        Row("two_repeats_half", "name", 40, 0.5, every, design="two_repeats"),
        Row("three_planes_half", "name", 40, 0.5, plain, design="three_planes", base=few),
    ]
    rows.append(Row("robot_joint_one", "name", 40, 1.0, tuple(JOINTS), base=()))
    return rows


ROWS = {row.name: row for row in _rows()}


@dataclass(frozen=True)
class Case:
    """What was made: runs for the tool, truth for the examiner."""

    row: Row
    number: int
    runs: list[Run]
    campaign: Campaign
    known: tuple[str, ...]
    hidden: tuple[Cause, ...]
    sizes: tuple[float, ...]
    truths: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Bench:
    """A machine, a session and its seed."""

    tests: Sequence[CircularTest]
    seed: int

    def response(self, mill: MillParameters, extra: Sequence[object] = ()) -> Floats:
        """Return what the bar would show without noise, by degree: shape (tests, 360)."""
        made = VirtualMill(mill, self.seed, _QUIET, _STEADY, _sum_of(extra)).measure(self.tests)
        return np.array([r.samples["deviation_um"].reshape(360, -1).mean(axis=1) for r in made])


def make_case(row: Row, number: int) -> Case:
    """Return one case; its seed is derived from the name of the row and the number."""
    rng = np.random.default_rng([zlib.crc32(row.name.encode()), number])
    hidden = _hidden(row, number, rng)
    base_names = _base_names(row, hidden, rng)
    design = DESIGNS["heights" if any(c.design == "heights" for c in hidden) else row.design]
    if any(c.design == "heights" for c in hidden):
        design = replace(DESIGNS[row.design], heights=True)
    tests = design.tests(rng)
    heat = HeatParameters(feed_share=0.0 if row.design == "warm_up" else 0.5)
    seed = int(rng.integers(2**31))
    base_causes = [(BASE[name][0](BASE[name][1][0], rng), BASE[name][2]) for name in base_names]
    base = [(c, s * rng.uniform(0.5, 1.5) * _sign(c, rng)) for c, s in base_causes]
    mill = MillParameters(heat=heat)
    for cause, size in base:
        mill = cause.change(mill, size)
    # One repeat of each condition shows what repeats share.
    in_time = any(c.in_time for c in hidden)
    session = [t for t in tests if in_time or t.repeat == 1]
    signed = [_sign(c, rng) for c in hidden]
    sizes = tuple(
        size * sign
        for size, sign in zip(_sizes(row, hidden, base, mill, session, seed), signed, strict=True)
    )
    extra = []
    for cause, size in zip(hidden, sizes, strict=True):
        mill = cause.change(mill, size)
        extra += [cause.disturbance(size)] if cause.disturbance else []
    if row.right == "spread":
        mill = mill.with_axis("XY"[number % 2], slip_um=4.0, slip_mm_s=6.0)
    if row.right == "absorbed":
        # Both scales alike: nothing but a longer bar.
        mill = mill.with_axis("X", scale_ppm=mill.x.scale_ppm + 30.0)
        mill = mill.with_axis("Y", scale_ppm=mill.y.scale_ppm + 30.0)
    channels = _channels(len(tests), rng) if row.distractors else {}
    if row.hidden == ("coolant",):
        extra.append(_coolant(channels["coolant_v"], NOISE_UM * row.k, rng.uniform(0, 6.28)))
    made = VirtualMill(
        mill, seed, NoiseParameters(NOISE_UM, row.noise), disturbance=_sum_of(extra),
        samples_per_turn=row.samples_per_turn,
    )  # fmt: skip
    runs = [_with_channels(r, channels, i) for i, r in enumerate(made.measure(tests))]
    campaign = made.campaign(f"{row.name}-{number}")
    if hidden and hidden[0].label.split()[0] in JOINTS:
        campaign = replace(campaign, machine="virtual-robot", machine_geometry=GEOMETRY)
    truths: dict[str, float] = {}
    for cause, size in [*base, *zip(hidden, sizes, strict=True)]:
        truths.update(cause.truths(size))
    return Case(row, number, runs, campaign, base_names, hidden, sizes, truths)


def _hidden(row: Row, number: int, rng: np.random.Generator) -> tuple[Cause, ...]:
    if not row.hidden or row.hidden[0] in ("coolant", "bar", "stick_slip"):
        return ()
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


def _sign(cause: Cause, rng: np.random.Generator) -> float:
    drawn = 1.0 if rng.random() < 0.5 else -1.0
    return drawn if cause.signed else 1.0


def _sizes(row, hidden, base, mill, session, seed) -> list[float]:  # type: ignore[no-untyped-def]
    """Return sizes that make each hidden effect visible with RMS k times the noise."""
    if not hidden or row.k == 0.0:
        return [c.start for c in hidden]
    bench = _Bench(session, seed)
    ideal = MillParameters(heat=mill.heat)
    nothing = bench.response(ideal)
    basis = [bench.response(c.change(ideal, s)) - nothing for c, s in base]
    without = bench.response(mill)
    projector = _projector(bench.tests, basis)
    out = []
    for cause in hidden:
        size, reached = cause.start, 0.0
        for _ in range(5):
            extra = [cause.disturbance(size)] if cause.disturbance else []
            seen = bench.response(cause.change(mill, size), extra) - without
            flat = seen.ravel()
            left = flat - projector @ (projector.T @ flat)
            reached = float(np.sqrt((left**2).mean()))
            if abs(reached / (row.k * NOISE_UM) - 1.0) < 0.02:
                break
            size *= row.k * NOISE_UM / max(reached, 1e-9)
            if size > _LARGEST * cause.start:
                raise ValueError(f"{cause.label} cannot be seen in this design")
        out.append(size)
    return out


def _projector(tests: Sequence[CircularTest], basis: Sequence[Floats]) -> Floats:
    """Return orthonormal columns of centre and radius by set-up and of the base effects."""
    angle = np.radians(np.arange(360) + 0.5)
    shapes = np.stack([np.ones(360), np.cos(angle), np.sin(angle)])
    names = sorted({t.setup for t in tests})
    columns = []
    for name in names:
        here = np.array([t.setup == name for t in tests])
        columns += [np.outer(here, shape).ravel() for shape in shapes]
    # Samples run with the motion: clockwise ones start at 360 degrees.
    columns = [_along(np.asarray(c).reshape(len(tests), 360), tests).ravel() for c in columns]
    columns += [b.ravel() for b in basis]
    return np.linalg.qr(np.stack(columns, axis=1))[0]


def _along(values: Floats, tests: Sequence[CircularTest]) -> Floats:
    return np.array(
        [v if t.direction == "CCW" else v[::-1] for v, t in zip(values, tests, strict=True)]
    )


def _sum_of(parts):  # type: ignore[no-untyped-def]
    if not parts:
        return None
    return lambda moment: np.sum([part(moment) for part in parts], axis=0)


def _channels(n: int, rng: np.random.Generator) -> dict[str, Floats]:
    """Return ten random walks that have nothing to do with the error."""
    names = [f"channel{i}_v" for i in range(9)] + ["coolant_v"]
    out = {}
    for name in names:
        walk = np.cumsum(rng.standard_normal(n))
        out[name] = (walk - walk.mean()) / walk.std()
    return out


def _coolant(pressure: Floats, rms_um: float, phase: float):  # type: ignore[no-untyped-def]
    def act(moment: Moment) -> Floats:
        return (
            np.sqrt(2.0) * rms_um * pressure[moment.number] * np.cos(3 * moment.angle_rad + phase)
        )

    return act


def _with_channels(run: Run, channels: dict[str, Floats], number: int) -> Run:
    logged = dict(run.meta.covariates)
    for i, (name, walk) in enumerate(channels.items()):
        # Every third bystander follows the temperature.
        follows = logged["temperature_c"] if name != "coolant_v" and i % 3 == 0 else 0.0
        logged[name] = float(walk[number] + follows)
    return replace(run, meta=replace(run.meta, covariates=logged))
