"""How often the uncertainty of a test sheet covers the truth: machines whose errors, instruments and temperatures are drawn here.

Each machine is tested once under circumstances of its own: an instrument with a wrong scale or length, a temperature that is
misread, an expansion that is not what was told, readings that scatter. dtwin is told only the k = 2 of each. True is what the
same machine would show at 20 °C to an instrument without error, in the mean of many tests with as many repeats: a standard's
figure of few repeats is itself biased, and that is no error of the test. Of a drift of poses it is the largest change of the
mean of many tests, not the mean of the largest changes: scatter alone is no drift.

Run: python benchmarks/uncertainty_coverage.py [--machines N] [--short] [--json]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from typing import Any

import numpy as np

from dtwin.kinds.registry import kind_named
from dtwin.report.checking import _sheet_of
from dtwin.report.text import table
from dtwin.schema import Campaign, Floats, Run, RunMeta

RNG = np.random.Generator
TOLD = {
    "uncertainty_um": 0.4,
    "uncertainty_um_per_m": 2.0,
    "calibration_um": 1.0,
    "alignment_mm": 0.0,
    "height_difference_mm": 0.0,
    "temperature_uncertainty_k": 1.0,
    "expansion_um_per_m_k": 11.5,
    "expansion_uncertainty_um_per_m_k": 2.0,
}
"""What the instrument's owner states, all k = 2."""
PROBE = {"uncertainty_um": 0.0, "uncertainty_percent": 2.0}
"""The same of a probe, which reads everything too large or too small by a share."""
MACHINE_C = 22.5
TARGETS_MM = np.arange(0.0, 501.0, 50.0)
ANGLE_DEG = np.arange(1.0, 360.0, 2.0)
RADIUS_MM = 150.0
AGAIN = 600


def scale_um_per_m(rng: RNG, instrument: bool) -> float:
    """Return by how much lengths are read wrongly: scale, temperature and expansion, as far as they are not known."""
    scale = rng.normal(0.0, TOLD["uncertainty_um_per_m"] / 2) if instrument else 0.0
    misread_k = rng.normal(0.0, TOLD["temperature_uncertainty_k"] / 2)
    expansion = rng.normal(0.0, TOLD["expansion_uncertainty_um_per_m_k"] / 2)
    return float(scale + TOLD["expansion_um_per_m_k"] * misread_k + (MACHINE_C - 20.0) * expansion)


def axis_runs(rng: RNG, off_um_per_m: float, between_um: float, noise_um: float) -> list[Run]:
    """Return five runs of an axis with lead error, a wave and a lost motion, which is read wrongly by ``between_um``."""
    runs = []
    for n in range(5):
        place = np.concatenate([TARGETS_MM, TARGETS_MM[::-1]])
        way = np.repeat(["forward", "reverse"], TARGETS_MM.size)
        error = (0.04 + off_um_per_m / 1000.0) * place + np.sin(place / 40.0) - (3.0 + between_um) * (way == "reverse")
        samples = {
            "t_s": np.arange(place.size) * 1.0,
            "position_mm": place,
            "direction": way,
            "error_um": error + rng.normal(0.0, noise_um, place.size),
        }
        meta = RunMeta(
            f"r{n}", kind="linear", condition={"axis": "X"}, repeat=n + 1, covariates={"temperature_c": MACHINE_C}
        )
        runs.append(Run(meta, samples))
    return runs


def circle_runs(rng: RNG, off_um: float, between_um: float, noise_um: float) -> list[Run]:
    """Return five circles of each direction at two feeds: an oval, a lost motion, and a radius that scatters.

    ``off_um`` is added to all readings, ``between_um`` to half of each circle.
    """
    runs = []
    for n, feed in ((n, feed) for feed in (1000.0, 2000.0) for n in range(5)):
        for way, sign in (("CCW", 1.0), ("CW", -1.0)):
            angle = np.radians(sign * ANGLE_DEG)
            error = 4.0 * np.cos(2.0 * angle) + (sign + between_um / 2.0) * np.sign(np.sin(angle)) + 6.0 + off_um
            error = error + rng.normal(0.0, noise_um)
            oval = 1.0 + rng.normal(0.0, noise_um / 4.0)
            samples = {"angle_deg": sign * ANGLE_DEG, "deviation_um": error * oval}
            meta = RunMeta(
                f"{way}{feed:g}-{n}",
                plane="XY",
                direction=way,
                radius_mm=RADIUS_MM,
                feed_mm_min=feed,
                repeat=n + 1,
                covariates={"temperature_c": MACHINE_C},
            )
            runs.append(Run(meta, samples))
    return runs


def tested_axis(rng: RNG) -> list[Run]:
    """Return a real test of the axis: what the instrument adds to a difference of readings grows along the axis, too."""
    along, between = rng.normal(0.0, TOLD["uncertainty_um"] / 2, 2)
    slope = scale_um_per_m(rng, instrument=True) + along * 1000.0 / float(np.ptp(TARGETS_MM))
    return axis_runs(rng, slope, float(between), 0.4)


def tested_circle(rng: RNG) -> list[Run]:
    """Return a real test of the circle."""
    length = rng.normal(0.0, TOLD["calibration_um"] / 2)
    along, between = rng.normal(0.0, TOLD["uncertainty_um"] / 2, 2)
    off = length + along + scale_um_per_m(rng, instrument=False) * RADIUS_MM / 1000.0
    return circle_runs(rng, float(off), float(between), 0.4)


def chain_mm(joints_rad: Floats) -> Floats:
    """Return flanges of a UR5 (n, 4, 4) by Denavit and Hartenberg's product, row by row."""
    rows = ((0.0, 89.159, 90.0), (-425.0, 0.0, 0.0), (-392.25, 0.0, 0.0))
    rows = (*rows, (0.0, 109.15, 90.0), (0.0, 94.65, -90.0), (0.0, 82.3, 0.0))
    at = np.tile(np.eye(4), (len(joints_rad), 1, 1))
    for joint, (a, d, alpha) in enumerate(rows):
        c, s = np.cos(joints_rad[:, joint]), np.sin(joints_rad[:, joint])
        ca, sa = np.cos(np.radians(alpha)), np.sin(np.radians(alpha))
        one, zero = np.ones_like(c), np.zeros_like(c)
        link = np.array(
            [
                [c, -s * ca, s * sa, a * c],
                [s, c * ca, -c * sa, a * s],
                [zero, sa * one, ca * one, d * one],
                [zero, zero, zero, one],
            ]
        )
        at = at @ link.transpose(2, 0, 1)
    return at


HOME_RAD = np.array([0.0, -1.2, 1.2, 0.0, 0.5, 0.0])
POSES = HOME_RAD + np.random.default_rng(77).uniform(-1.2, 1.2, (40, 6))


def pose_runs(rng: RNG, off_um_per_m: float, reading_um: float, noise_um: float, cycles: int = 0) -> list[Run]:
    """Return 40 poses of an arm, five times each: its links bend, its joints are a little off; a tracker stands anywhere.

    ``cycles``: 12 poses one after the other, so often, while the arm warms.
    """
    number = np.tile(np.arange(12), cycles) if cycles else np.repeat(np.arange(len(POSES)), 5)
    joints = POSES[number]
    flange = chain_mm(joints + 4e-4 * np.sin(2.0 * joints + 0.3) + 3e-4 * np.cos(joints[:, ::-1]))
    point = flange[:, :3, 3] + flange[:, :3, :3] @ [30.0, -12.0, 55.0]
    if cycles:
        point = point + flange[:, :3, 2] * (0.15 * (1.0 - np.exp(-np.arange(len(number)) / 200.0)))[:, None]
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    turn[:, 0] *= np.sign(np.linalg.det(turn))
    # What the tracker reads wrongly belongs to the place, and comes again.
    wrong = rng.normal(0.0, reading_um, (len(POSES), 3))[number] / 1000.0
    seen = (point + wrong) * (1.0 + 1e-6 * off_um_per_m) + rng.normal(0.0, noise_um, point.shape) / 1000.0
    seen = seen @ turn.T + rng.uniform(-2000.0, 2000.0, 3)
    samples = {f"joint_{n}_deg": np.degrees(joints[:, n - 1]) for n in range(1, 7)}
    samples |= {f"measured_{axis}_mm": seen[:, n] for n, axis in enumerate("xyz")}
    meta = RunMeta("p", kind="poses", condition={"chain": "ur5"}, covariates={"temperature_c": MACHINE_C})
    return [Run(meta, {"t_s": np.arange(len(seen)) * 1.0, **samples})]


def tested_poses(rng: RNG, cycles: int) -> list[Run]:
    """Return a real test of the arm."""
    return pose_runs(rng, scale_um_per_m(rng, instrument=True), TOLD["uncertainty_um"] / 2, 20.0, cycles)


def true_changes(rng: RNG, again: int) -> dict[str, float]:
    """Return the largest changes, since the first ten readings of a pose, of what tests show of the warming arm in the mean."""
    repeatability = np.zeros((12, 3))
    for _ in range(again):
        samples = pose_runs(rng, 0.0, 0.0, 20.0, 30)[0].samples
        seen = np.stack([samples[f"measured_{axis}_mm"] for axis in "xyz"], axis=1)
        tens = 1000.0 * seen.reshape(3, 10, 12, 3).transpose(2, 0, 1, 3)
        away = np.linalg.norm(tens - tens.mean(axis=2, keepdims=True), axis=3)
        repeatability += (away.mean(axis=2) + 3.0 * away.std(axis=2, ddof=1)) / again
    still = figures("poses", pose_runs(rng, 0.0, 0.0, 0.001, 30))
    return {"dAP": still["dAP"][0], "dRP": float(np.abs(repeatability - repeatability[:, :1]).max())}


def drift_runs(rng: RNG, slope: float, noise_um: float) -> list[Run]:
    """Return a log of four hours, three readings a minute, of a machine that warms and breathes; its gauge is off by a share."""
    minute = np.repeat(np.arange(241.0), 3)
    moved = 12.0 * (1.0 - np.exp(-minute / 90.0)) + 1.5 * np.sin(minute / 25.0)
    samples = {
        "t_s": 60.0 * minute + np.tile([0.0, 1.0, 2.0], 241),
        "displacement_um": (1.0 + slope) * moved + rng.normal(0.0, noise_um, minute.size),
        "sample_1": minute,
        "temperature_room_c": 20.0 + 0.0 * minute,
    }
    return [Run(RunMeta("night", kind="drift"), samples)]


def tested_drift(rng: RNG) -> list[Run]:
    """Return a real log."""
    return drift_runs(rng, float(rng.normal(0.0, PROBE["uncertainty_percent"] / 200.0)), 0.3)


def turning_runs(rng: RNG, slope: float, noise_um: float) -> list[Run]:
    """Return 24 turns of an eccentric, oval target; a cage turns 0.41 times a turn, three lobes differ from turn to turn, and wander; a probe's scale is off."""
    angle = 2.0 * np.arange(24.1 * 180)
    turn, a = (angle // 360.0).astype(int), np.radians(angle)
    loose = rng.normal(0.0, 0.2, (2, 25))
    wander = rng.normal(0.0, 0.05, 2)
    for n in range(25):
        wander = 0.7 * wander + rng.normal(0.0, 0.05 * np.sqrt(1.0 - 0.7**2), 2)
        loose[:, n] += wander
    moved = 8.0 * np.cos(a - 0.5) + np.cos(2.0 * a) + 0.4 * np.cos(5.0 * a + 1.0)
    moved = moved + 0.3 * np.cos(0.41 * a + rng.uniform(0.0, 6.28))
    moved = moved + loose[0, turn] * np.cos(3.0 * a) + loose[1, turn] * np.sin(3.0 * a)
    samples = {
        "t_s": angle / 6.0 / 1200.0,
        "angle_deg": angle,
        "displacement_um": (1.0 + slope) * moved + rng.normal(0.0, noise_um, a.size),
    }
    condition: dict[str, float | str] = {"probe": "radial", "sense": "radial", "angle": "encoder"}
    return [Run(RunMeta("turns", kind="rotation", condition=condition), samples)]


def tested_turning(rng: RNG) -> list[Run]:
    """Return a real test."""
    return turning_runs(rng, float(rng.normal(0.0, PROBE["uncertainty_percent"] / 200.0)), 0.05)


def figures(kind: str, runs: list[Run]) -> dict[str, tuple[float, float]]:
    """Return value and U of every figure, as a user gets them."""
    geometry = {"chain": "ur5"} if kind == "poses" else {}
    campaign = Campaign("c", "m", kind, instrument=PROBE if kind in OF_A_PROBE else TOLD, machine_geometry=geometry)
    sheet = _sheet_of(kind_named(kind), campaign, runs, {})
    return {c["symbol"]: (c["value_um"], c["expanded_um"]) for c in sheet["parts"][0]["characteristics"]}


OF_A_PROBE = ("drift", "rotation")
Maker = Callable[[RNG], list[Run]]
Truth = Callable[[RNG, int], dict[str, float]]


def in_the_mean(kind: str, perfect: Maker) -> Truth:
    """Return what tests by a perfect instrument show in the mean."""

    def truth(rng: RNG, again: int) -> dict[str, float]:
        shown = [figures(kind, perfect(rng)) for _ in range(again)]
        return {symbol: float(np.mean([one[symbol][0] for one in shown])) for symbol in shown[0]}

    return truth


TESTS: tuple[tuple[str, Maker, Truth, tuple[str, ...]], ...] = (
    (
        "linear",
        tested_axis,
        in_the_mean("linear", lambda rng: axis_runs(rng, 0.0, 0.0, 0.4)),
        ("A", "E", "M", "R", "B", "B̄"),
    ),
    (
        "circular",
        tested_circle,
        in_the_mean("circular", lambda rng: circle_runs(rng, 0.0, 0.0, 0.4)),
        ("D", "Fmax(CCW)", "G(CCW)", "G(b)", "H"),
    ),
    (
        "poses",
        lambda rng: tested_poses(rng, 0),
        in_the_mean("poses", lambda rng: pose_runs(rng, 0.0, 0.0, 20.0)),
        ("AP", "AP mean", "AD", "AD rms", "RP"),
    ),
    ("drift", tested_drift, in_the_mean("drift", lambda rng: drift_runs(rng, 0.0, 0.3)), ("d", "d(1 h)")),
    (
        "rotation",
        tested_turning,
        in_the_mean("rotation", lambda rng: turning_runs(rng, 0.0, 0.05)),
        ("TIR", "e", "S", "A"),
    ),
    ("poses", lambda rng: tested_poses(rng, 30), true_changes, ("dAP", "dRP")),
)


def measured(machines: int, seed: int) -> list[dict[str, Any]]:
    """Return how often each figure was covered."""
    rows = []
    for number, (kind, tested, truth_of, symbols) in enumerate(TESTS):
        rng = np.random.default_rng([seed, number])
        truth = truth_of(rng, AGAIN if machines > 100 else 60)
        told = [figures(kind, tested(rng)) for _ in range(machines)]
        for symbol in symbols:
            value, half = np.array([t[symbol] for t in told]).T
            off: Floats = np.abs(value - truth[symbol])
            rows.append(
                {
                    "kind": kind,
                    "figure": symbol,
                    "machines": machines,
                    "covered": float(np.mean(off <= half)),
                    "mean_expanded_um": float(half.mean()),
                    "scatter_um": float(np.std(value - truth[symbol])),
                }
            )
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--short", action="store_true", help="60 machines")
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    rows = measured(60 if chosen.short else chosen.machines, chosen.seed)
    if chosen.json:
        print(json.dumps(rows))
        return
    head = ("kind", "figure", "machines", "covered", "U in the mean, µm", "deviation from the truth, µm")
    print(table(head, [[round(v, 3) if isinstance(v, float) else v for v in row.values()] for row in rows]))


if __name__ == "__main__":
    main()
