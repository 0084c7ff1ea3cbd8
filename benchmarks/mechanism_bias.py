"""The published simulated machines, built of mechanisms: what a fit finds beside what was set.

The published simulator adds formulas, and the library's formulas find its parameters again
(tests/campaign/physics/test_simulator_table.py). Here the same numbers go into the virtual mill,
where play is taken up over a distance, a bent guideway is an arc, and the servo loop has its
own time: what is found differs, and this is printed as a bias. Reversal spikes are left out:
friction in a loop has no height that could be set. Width of play below zero is a screw that
winds up the other way round.

Run: OMP_NUM_THREADS=1 python benchmarks/mechanism_bias.py [--json]
"""

from __future__ import annotations

import argparse
import json
import tomllib
from pathlib import Path
from typing import Any

from dtwin.machines.mill import VirtualMill
from dtwin.machines.mill_parameters import CircularTest, MillParameters, NoiseParameters
from dtwin.physics.fit import Fit, fit
from dtwin.physics.library import Library
from dtwin.physics.observations import observe
from dtwin.physics.twin import chosen_terms

TABLE = Path(__file__).parents[1] / "data" / "published" / "ballbar_simulator.toml"
NOISE_UM, REPEATS, FEEDS_MM_MIN = 0.1, 3, (300.0, 1000.0, 6000.0)
UNITS, SERVO_MS = 0.2, 0.01
EFFECTS = (
    "scale_mismatch",
    "squareness",
    "straightness",
    "servo_mismatch",
    "backlash",
    "backlash_taper",
    "lateral_play",
    "lateral_play_taper",
    "cyclic_error",
    "cyclic_error_by_direction",
)


def built(machine: dict[str, Any]) -> MillParameters:
    """Return a mill with the published numbers."""
    mill = MillParameters(squareness_um_m={"XY": machine["squareness"]})
    per_100_mm, radius = 100.0 / machine["radius"], machine["radius"]
    for axis, sign in (("X", 1.0), ("Y", -1.0)):
        low = axis.lower()
        play, side = machine[f"backlash_{low}"], machine.get(f"lateral_play_{low}", [0.0, 0.0])
        right, left = machine.get(f"cyclic_{low}", [0.0, 0.0])
        lag_s = sign * machine.get("servo_mismatch", 0.0) / 2e3
        mill = mill.with_axis(
            axis,
            scale_ppm=machine[f"scale_{low}"],
            bow_um=machine[f"straightness_{low}"] * (100.0 / radius) ** 2,
            play_um=sum(play) / 2,
            play_taper_um=(play[0] - play[1]) / 2 * per_100_mm,
            lateral_um=sum(side) / 2,
            lateral_taper_um=(side[0] - side[1]) / 2 * per_100_mm,
            pitch_mm=machine.get(f"pitch_{low}", 10.0),
            pitch_error_um=(right + left) / 4,
            pitch_flank_um=(right - left) / 4,
            feed_forward=1.0 - lag_s * mill.axis(axis).position_gain_1_s,
        )
    return mill


def wanted(machine: dict[str, Any]) -> dict[tuple[str, str, str], float]:
    """Return what was set, by effect, axis and parameter of the library."""
    per_100_mm = 100.0 / machine["radius"]
    out = {
        ("scale_mismatch", "XY", "scale"): machine["scale_x"] - machine["scale_y"],
        ("squareness", "XY", "squareness"): machine["squareness"],
        ("servo_mismatch", "XY", "delay"): machine.get("servo_mismatch", 0.0),
    }
    for axis in "XY":
        low = axis.lower()
        bow = machine[f"straightness_{low}"] * per_100_mm**2
        out["straightness", axis, "bow_at_100_mm"] = bow
        for effect, name, key in (("backlash", "backlash", "backlash"), ("lateral_play", "play", "lateral_play")):
            if f"{key}_{low}" in machine:
                first, second = machine[f"{key}_{low}"]
                out[effect, axis, name] = (first + second) / 2
                slope = (first - second) / 2 * per_100_mm
                out[f"{effect}_taper", axis, "change_per_100_mm"] = slope
    return out


def compared(machine: dict[str, Any], seed: int) -> list[dict[str, Any]]:
    """Measure the mill, fit, and set every parameter beside its truth."""
    tests = [
        CircularTest("XY", direction, machine["radius"], feed, repeat)
        for repeat in range(1, REPEATS + 1)
        for feed in FEEDS_MM_MIN
        for direction in ("CCW", "CW")
    ]
    made = VirtualMill(built(machine), seed, NoiseParameters(NOISE_UM, "plain"))
    obs = observe(made.campaign("simulated"), made.measure(tests))
    effects = [e for e in EFFECTS if "cyclic_x" in machine or not e.startswith("cyclic")]
    found: Fit = fit(obs, chosen_terms(effects, Library(), obs))
    by_name = {(e.effect, e.axis, e.name): e for e in found.estimates}
    rows = []
    for key, truth in wanted(machine).items():
        estimate = by_name[key]
        bias = estimate.value - truth
        limit = SERVO_MS if key[0] == "servo_mismatch" else UNITS
        rows.append(
            {
                "parameter": " ".join(key),
                "unit": estimate.unit,
                "set": truth,
                "found": estimate.value,
                "uncertainty": estimate.uncertainty,
                "bias": bias,
                "within": abs(bias) <= limit,
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    machines = tomllib.loads(TABLE.read_text(encoding="utf-8"))
    if arguments.short:
        machines = dict(list(machines.items())[:1])
    found = {name: compared(machine, arguments.seed) for name, machine in machines.items()}
    if arguments.json:
        print(json.dumps(found))
        return
    for name, rows in found.items():
        within = sum(row["within"] for row in rows)
        print(f"{name}: {within} of {len(rows)} within {UNITS} units (servo {SERVO_MS} ms)")
        for row in rows:
            mark = " " if row["within"] else "*"
            print(
                f"  {mark} {row['parameter']:44s} set {row['set']:8.3f}  found {row['found']:8.3f} "
                f"+- {row['uncertainty']:.3f} {row['unit']:8s} bias {row['bias']:+.3f}"
            )


if __name__ == "__main__":
    main()
