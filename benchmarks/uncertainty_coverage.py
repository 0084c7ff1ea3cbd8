"""How often the uncertainty of a test sheet covers the truth: machines whose errors, instruments and temperatures are drawn here.

Each machine is tested once under circumstances of its own: an instrument with a wrong scale or length, a temperature that is
misread, an expansion that is not what was told, readings that scatter. dtwin is told only the k = 2 of each. True is what the
same machine would show at 20 °C to an instrument without error, in the mean of many tests with as many repeats: a standard's
figure of few repeats is itself biased, and that is no error of the test.

Run: python benchmarks/uncertainty_coverage.py [--machines N] [--short] [--json]
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np

from dtwin.kinds.registry import kind_named
from dtwin.report.checking import sheet_of
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


def figures(kind: str, runs: list[Run]) -> dict[str, tuple[float, float]]:
    """Return value and U of every figure, as a user gets them."""
    sheet = sheet_of(kind_named(kind), Campaign("c", "m", kind, instrument=TOLD), runs, {})
    return {c["symbol"]: (c["value_um"], c["expanded_um"]) for c in sheet["parts"][0]["characteristics"]}


Maker = Callable[[RNG], list[Run]]
TESTS: dict[str, tuple[Maker, Maker, tuple[str, ...]]] = {
    "linear": (tested_axis, lambda rng: axis_runs(rng, 0.0, 0.0, 0.4), ("A", "E", "M", "R", "B", "B̄")),
    "circular": (tested_circle, lambda rng: circle_runs(rng, 0.0, 0.0, 0.4), ("D", "Fmax(CCW)", "G(CCW)", "G(b)", "H")),
}


def measured(machines: int, seed: int) -> list[dict[str, Any]]:
    """Return how often each figure was covered."""
    rows = []
    for number, (kind, (tested, perfect, symbols)) in enumerate(TESTS.items()):
        rng = np.random.default_rng([seed, number])
        many: dict[str, list[float]] = defaultdict(list)
        for _ in range(AGAIN if machines > 100 else 60):
            for symbol, (value, _) in figures(kind, perfect(rng)).items():
                many[symbol].append(value)
        truth = {symbol: float(np.mean(values)) for symbol, values in many.items()}
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
