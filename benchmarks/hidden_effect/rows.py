"""Rows of the exam: what is hidden, in which design and noise, and what the right answer is."""

from __future__ import annotations

from dataclasses import dataclass

import axis_machine
import second_faults
import tone_machine
from causes import LIBRARY
from robot import JOINTS

NOISE_UM = 0.5
# Along an axis and in tones a hidden effect is drawn between these times the noise.
FAINTEST, LOUDEST = 4.0, 20.0
MEAN_K = 0.5 * (FAINTEST + LOUDEST)
# Of a first test: an angular error needs a second height, and a delay of the instrument that shows
# at all turns the whole circle.
NOT_AT_FIRST = ("angular_error", "measurement_delay")
# Published machines from nothing: name, and what a reversal spike is constant in.
PUBLISHED = tuple((name, law) for name in ("sim1", "sim2", "sim3", "sim5") for law in ("time", "angle"))


@dataclass(frozen=True)
class Row:
    """One row: how its cases are made and what the right answer is.

    ``machine`` is what makes the runs: the virtual mill, the second machine, the published simulator, or that with
    machines that are drawn.
    In a row of the ``everyday`` design a group may hold more effects, counted without their axes.
    """

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
    noise_um: float = NOISE_UM
    unknown: tuple[str, ...] = ()
    kind: str = "circular"
    machine: str = "mill"
    everyday: bool = False


def _rows() -> list[Row]:
    every = tuple(LIBRARY)
    unknown = (
        "threshold_lobe",
        "quartic_scale",
        "play_curve",
        "gear_harmonic",
        "heat_times_feed",
        "hysteretic_heat",
        "lobe_with_feed",
    )
    noises = ("plain", "feed", "reversal", "tails", "bad_run", "lobes")
    rows = [Row(f"null_{kind}", "nothing", 1000, noise=kind) for kind in noises]
    rows.append(Row("null_distractors", "nothing", 1000, distractors=True))
    rows.append(Row("null_odd_sampling", "nothing", 1000, samples_per_turn=1007))
    rows += [Row("single_half", "name", 200, 0.5, every), Row("single_quarter", "name", 200, 0.25, every)]
    rows += [
        Row(f"single_{n}", "name", 40, k, every, held_out=k >= 1.0)
        for n, k in (("eighth", 0.125), ("one", 1.0), ("two", 2.0))
    ]
    rows += [Row("pair_one", "all", 40, 1.0, every, 2), Row("triple_one", "all", 40, 1.0, every, 3)]
    # Growth that lags has had names since the library got growth with time; the row kept its own for its seeds.
    rows += [
        Row(f"unknown_{kind}", "lagging" if kind == "hysteretic_heat" else "unknown", 40, 1.0, (kind,))
        for kind in unknown
    ]
    rows.append(Row("unknown_coolant", "channel", 40, 1.0, ("coolant",), distractors=True))
    rows += [
        Row(f"{kind}_k{k:g}", "unknown", 40, k, (kind,), base=("squareness:XY", "backlash:X"))
        for kind in ("square_law", "flat_law")
        for k in (1.0, 2.0)
    ]
    rows += [
        Row(
            "aliased_one_way",
            "group",
            40,
            1.0,
            ("squareness", "servo_mismatch"),
            design="one_way",
            base=("backlash:X", "straightness:Y"),
        ),
        Row("absorbed", "absorbed", 40, 0.0, ("bar",)),
        Row("heat_warm_up", "confounded", 40, 1.0, ("thermal_growth",), design="warm_up"),
        Row("heat_cool_down", "name", 40, 1.0, ("thermal_growth",)),
        Row("drift_cool_down", "name", 40, 1.0, ("thermal_drift",)),
        Row("lateral_play_half", "name", 40, 0.5, ("lateral_play",)),
        Row("one_repeat", "need_repeats", 40, 1.0, every, design="one_repeat"),
        Row("bad_run_half", "name", 40, 0.5, every, noise="bad_run"),
        Row("distractors_half", "name", 40, 0.5, every, distractors=True),
        Row("stick_slip", "spread", 40, 0.0, ("stick_slip",)),
    ]
    one_condition = tuple(n for n in every if n not in ("servo_lag", "measurement_delay", "angular_error"))
    plain = ("backlash", "cyclic_error", "reversal_spike", "squareness", "lateral_play")
    few = ("backlash:X", "straightness:Y")
    rows += [
        Row("one_circle_half", "name", 40, 0.5, one_condition, design="one_circle", base=few),
        Row("both_ways_half", "name", 40, 0.5, one_condition, design="both_ways", base=few),
        Row("two_repeats_half", "name", 40, 0.5, every, design="two_repeats"),
        Row("three_planes_half", "name", 40, 0.5, plain, design="three_planes", base=few),
    ]
    rows.append(Row("robot_joint_one", "name", 40, 1.0, tuple(JOINTS), base=()))
    ordinary = tuple(n for n in every if n not in NOT_AT_FIRST)
    rows += [
        Row(f"untold_{n}_noise_{noise:g}", "every", 100, hidden=ordinary, how_many=n, base=(), noise_um=noise)
        for n in (3, 5, 8, 12)
        for noise in (0.1, 0.5)
    ]
    rows += [
        Row(
            "untold_5_and_unknown",
            "every",
            100,
            hidden=ordinary,
            how_many=5,
            base=(),
            noise_um=0.1,
            unknown=("gear_harmonic", "threshold_lobe", "quartic_scale", "lobe_with_feed"),
        )
    ]
    rows.append(
        Row(
            "everyday_6",
            "every",
            100,
            hidden=one_condition,
            how_many=6,
            base=(),
            design="both_ways",
            noise_um=0.1,
            everyday=True,
        )
    )
    rows.append(Row("everyday_null", "nothing", 400, base=(), design="both_ways", noise_um=0.1))
    return rows + _of_others() + _of_lines()


def _of_others() -> list[Row]:
    """Return the rows of the second machine and of the published ones; nothing is told in any."""
    every = tuple(second_faults.LIBRARY)
    # At one feed for each radius a lag of both axes is a longer bar.
    everyday = tuple(n for n in every if n != "servo_lag")
    rows = [
        Row(
            f"second_untold_{n}_noise_{noise:g}",
            "every",
            200 if n == 5 else 100,
            hidden=every,
            how_many=n,
            base=(),
            noise_um=noise,
            machine="second",
        )
        for n in (3, 5, 8)
        for noise in (0.1, 0.5)
    ]
    rows += [
        Row(
            f"second_{design}",
            "every",
            100,
            hidden=every if design == "one_radius" else everyday,
            how_many=4,
            base=(),
            noise_um=0.1,
            design=design,
            machine="second",
            everyday=design == "one_feed",
        )
        for design in ("one_radius", "one_feed", "paired")
    ]
    rows += [
        Row("second_null", "nothing", 200, base=(), machine="second"),
        Row("second_everyday_null", "nothing", 400, base=(), design="both_ways", machine="second"),
        Row(
            "second_everyday_6",
            "every",
            100,
            hidden=everyday,
            how_many=6,
            base=(),
            design="both_ways",
            noise_um=0.1,
            machine="second",
            everyday=True,
        ),
        Row("published_from_nothing", "every", len(PUBLISHED), base=(), noise_um=0.1, machine="published"),
        Row("drawn_from_nothing", "every", 40, base=(), noise_um=0.1, machine="drawn"),
        Row("drawn_everyday", "every", 40, base=(), design="both_ways", noise_um=0.1, machine="drawn", everyday=True),
    ]
    return rows


def _of_lines() -> list[Row]:
    """Return the rows of positioning tests along an axis, and of tones.

    Nothing is told in any of them; hidden is 4 to 20 times the noise.
    """
    axes, tones = tuple(axis_machine.LIBRARY), tuple(tone_machine.LIBRARY)
    # What gives way to inertia is a mode far above the tones: a group of four.
    told_apart = tuple(n for n in tones if n != "inertial_compliance")
    some = {"k": MEAN_K, "base": ()}
    rows = [
        Row("axis_null", "nothing", 200, design="5 runs", base=(), kind="linear"),
        Row("axis_single", "name", 100, hidden=axes, design="5 runs", kind="linear", **some),
        Row("axis_untold_5", "every", 100, hidden=axes, how_many=5, design="5 runs", kind="linear", **some),
        Row("axis_curve", "name", 100, hidden=tuple(axis_machine.CURVES), design="5 runs", kind="linear", **some),
        Row("axis_channel", "channel", 100, hidden=axis_machine.CHANNELS, design="5 runs", kind="linear", **some),
        Row("tone_null", "nothing", 200, design="tones", base=(), kind="sinusoidal"),
        Row("tone_single", "name", 100, hidden=tones, design="tones", kind="sinusoidal", **some),
        Row("tone_untold_3", "every", 100, hidden=told_apart, how_many=3, design="tones", kind="sinusoidal", **some),
        Row(
            "tone_unknown",
            "unknown",
            100,
            hidden=tuple(tone_machine.FOREIGN),
            design="tones",
            kind="sinusoidal",
            **some,
        ),
        Row("tone_channel", "channel", 100, hidden=tone_machine.CHANNELS, design="tones", kind="sinusoidal", **some),
    ]
    rows += [
        Row(f"axis_unknown_{name}", "unknown", 100, hidden=(name,), design="5 runs", kind="linear", **some)
        for name in ("flank", "dent")
    ]
    return rows


ROWS = {row.name: row for row in _rows()}
