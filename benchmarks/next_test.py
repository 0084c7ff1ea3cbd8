"""Which test next: how soon are the faults of a machine told, by proposals, by chance, and by a fixed full design?

Drawn machines with six faults on three axes. Circles come from the virtual mill (mechanisms, noise 0.1 µm; in
upright planes the arcs of their programs), positions from formulas of their own (``tests/laser_axis.py``: lead and lost motion, noise 0.15 µm, datum 0.3 µm). Every test is diagnosed from
nothing, and the tests that were made are compared by ``dtwin.physics.joint``. A fault is told when one test names it alone, or
another test settles the group that it is in, or its size follows from several tests. What a full design of all tests tells in the end is the mark; counted are the minutes,
mounting included, until a policy has told the same. ``proposed`` takes, after each test, the one with the most bits per minute;
``by chance`` takes a random one of the same list (mean of ten orders). Unit of replication: the machine.

Run: python benchmarks/next_test.py [--machines N] [--short] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from laser_axis import DATUM_UM, errors_um

from dtwin.kinds.kind import Planned
from dtwin.kinds.registry import kinds
from dtwin.machines.mill import VirtualMill
from dtwin.machines.mill_parameters import CircularTest, MillParameters, NoiseParameters
from dtwin.physics.diagnose import diagnose
from dtwin.physics.joint import Joint, MachineTest, joint
from dtwin.physics.library import Library
from dtwin.physics.next_test import Knowledge, Made, unclear
from dtwin.physics.observations import Observations, observe
from dtwin.report.text import table
from dtwin.schema import PLANES, Campaign, Run, RunMeta

LIBRARY = Library()
AXES = "XYZ"
FAULTS, ORDERS = 6, 10
# What is drawn on an axis: parameter of the mill, its sizes, and the names that are right.
ON_AXES: Mapping[str, tuple[str, float, float, tuple[str, ...]]] = {
    "scale": ("scale_ppm", 10.0, 40.0, ("lead_error",)),
    "backlash": ("play_um", 1.5, 6.0, ("backlash",)),
    "straightness": ("bow_um", 1.5, 5.0, ("straightness",)),
    "lateral play": ("lateral_um", 1.0, 4.0, ("lateral_play",)),
    "cyclic error": ("pitch_error_um", 0.8, 3.0, ("cyclic_error", "screw_error")),
    "friction": ("stribeck_mm_s2", 20.0, 60.0, ("friction",)),
}
UNSIGNED = ("backlash", "friction")


class Machine:
    """A drawn machine, and what each test of it finds; a test is the same whenever it is made."""

    def __init__(self, number: int, axes: str = AXES, faults: int = FAULTS) -> None:
        rng = np.random.default_rng([2026, number])
        self.number, self.mill, self.laser = number, MillParameters(), {axis: [0.0, 0.0] for axis in axes}
        self.faults: dict[str, set[str]] = {}
        planes = [plane for plane in PLANES if set(plane) <= set(axes)]
        every = [(name, axis) for name in ON_AXES for axis in axes] + [("squareness", plane) for plane in planes]
        for i in rng.permutation(len(every))[:faults]:
            self._add(*every[i], rng)
        record = {axis: {"travel_mm": 400.0, "pitch_mm": 10.0} for axis in axes}
        self.planned: list[Planned] = [
            kind.plan(document, "proposal")
            for kind in kinds()
            if kind.offers("proposals")
            for document in kind.proposals("drawn", record)
        ]
        self.minutes = [(p.duration_s + p.mounting_s) / 60.0 for p in self.planned]
        self._made: dict[int, MachineTest] = {}

    def _add(self, name: str, where: str, rng: np.random.Generator) -> None:
        sign = 1.0 if name in UNSIGNED else float(rng.choice([-1.0, 1.0]))
        if name == "squareness":
            self.mill = replace(
                self.mill, squareness_um_m={**self.mill.squareness_um_m, where: sign * rng.uniform(10.0, 40.0)}
            )
            self.faults[f"{name} {where}"] = {f"squareness {where}"}
            return
        parameter, low, high, names = ON_AXES[name]
        size = sign * rng.uniform(low, high)
        self.mill = self.mill.with_axis(where, **{parameter: size})
        self.faults[f"{name} {where}"] = {f"{label} {where}" for label in names}
        if name in ("scale", "backlash"):
            self.laser[where][name == "backlash"] = size

    def test(self, number: int) -> MachineTest:
        """Return a test with what its diagnosis found."""
        if number not in self._made:
            plan = self.planned[number]
            obs = self._circles(plan, number) if plan.kind == "circular" else self._sweeps(plan, number)
            self._made[number] = MachineTest(str(number), "2026-01-01", obs, diagnose(obs, [], LIBRARY))
        return self._made[number]

    def _circles(self, planned: Planned, number: int) -> Observations:
        mill = VirtualMill(self.mill, seed=100 * self.number + number, noise=NoiseParameters(rms_um=0.1))
        tests = [
            CircularTest(t.plane, way, t.radius_mm, t.feed_mm_min, t.repeat, t.setup)
            for t in planned.plan.tests
            for way in planned.plan.directions
        ]
        obs, mask = observe(mill.campaign(), mill.measure(tests)), _foreseen(planned).mask
        return replace(obs, mask=mask, y_um=np.where(mask, obs.y_um, 0.0))

    def _sweeps(self, planned: Planned, number: int) -> Observations:
        rng = np.random.default_rng([7, self.number, number])
        plan, at = planned.plan, np.array(planned.plan.targets)
        lead, lost = self.laser[plan.axis]
        runs = []
        for repeat in range(1, plan.runs + 1):
            error = np.concatenate([errors_um(at, forward, lead, lost, rng) for forward in (True, False)])
            ways = np.array(["forward"] * at.size + ["reverse"] * at.size, dtype=object)
            samples = {
                "t_s": 10.0 * np.arange(2 * at.size),
                "position_mm": np.tile(at, 2),
                "direction": ways,
                "error_um": error + DATUM_UM * rng.standard_normal(),
            }
            runs.append(
                Run(RunMeta(f"r{repeat}", kind="linear", condition={"axis": plan.axis}, repeat=repeat), samples)
            )
        return observe(Campaign(plan.name, "drawn", kind="linear", machine_geometry={"screw_pitch_mm": 10.0}), runs)

    def told(self, numbers: Sequence[int]) -> set[str]:
        """Return the faults that these tests tell together."""
        alone = {group[0] for groups in self.groups(numbers) for group in groups if len(group) == 1}
        sizes = {(one.cause, one.axis) for one in self._joint(numbers).shared if not one.apart}
        alone |= {
            f"{effect.name} {axis}" for effect in LIBRARY.values() for cause, axis in sizes if effect.cause == cause
        }
        return {fault for fault, names in self.faults.items() if names & alone}

    def _joint(self, numbers: Sequence[int]) -> Joint:
        return joint([self.test(n) for n in numbers], LIBRARY)

    def groups(self, numbers: Sequence[int]) -> list[list[tuple[str, ...]]]:
        """Return what each of these tests finds by itself, settled by the others."""
        tests = [self.test(n) for n in numbers]
        settled = {(s.campaign, s.group): s.left for s in self._joint(numbers).settled}
        found = [[tuple(s.label for s in group) for group in test.found.found] for test in tests]
        return [
            [settled.get((test.campaign, group)) or group for group in groups]
            for test, groups in zip(tests, found, strict=True)
        ]

    @cached_property
    def full(self) -> list[int]:
        """The longest plan of every plane and axis."""
        longest: dict[str, int] = {}
        for i, p in enumerate(self.planned):
            place = p.plan.tests[0].plane if p.kind == "circular" else p.plan.axis
            if place not in longest or self.minutes[longest[place]] < self.minutes[i]:
                longest[place] = i
        return list(longest.values())

    def until(self, choose: Callable[[list[int], list[int]], int], mark: set[str]) -> float:
        """Return the minutes until a policy has told the mark; NaN when it never does."""
        made: list[int] = []
        left = list(range(len(self.planned)))
        while left:
            made.append(choose(made, left))
            left.remove(made[-1])
            if mark <= self.told(made):
                return sum(self.minutes[n] for n in made)
        return float("nan")

    def proposed(self, made: list[int], left: list[int]) -> int:
        """Return the test with the most bits per minute."""
        empty = [_foreseen(self.planned[n]) for n in left]
        noise = {p.kind: p.noise_um for p in self.planned}
        measured = [self.test(n).obs for n in made]
        known = [
            Made(obs, left) for obs, left in zip(measured, unclear(self.groups(made), measured, LIBRARY), strict=True)
        ]
        knowledge = Knowledge(known, empty, LIBRARY, noise)
        return max(left, key=lambda n: knowledge.worth(left.index(n)).bits / self.minutes[n])


def _foreseen(planned: Planned) -> Observations:
    return next(kind for kind in kinds() if kind.name == planned.kind).foreseen(planned)


def row(machine: Machine, orders: int) -> dict[str, Any]:
    """Return how long each policy took on one machine; ``orders``: how many of chance."""
    full_min = sum(machine.minutes[n] for n in machine.full)
    mark = machine.told(machine.full)
    rng = np.random.default_rng([9, machine.number])
    random = [machine.until(lambda made, left: int(rng.choice(left)), mark) for _ in range(orders)]
    return {
        "machine": machine.number,
        "faults": len(machine.faults),
        "told by all": len(mark),
        "full, min": full_min,
        "proposed, min": machine.until(machine.proposed, mark),
        "by chance, min": float(np.mean(random)),
    }


def main() -> None:
    """Print a row a machine, and the medians of the ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", type=int, default=20)
    parser.add_argument("--short", action="store_true", help="one machine of two axes")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    rows = []
    for number in range(1 if asked.short else asked.machines):
        machine = Machine(number, "XY", 2) if asked.short else Machine(number)
        rows.append(row(machine, 1 if asked.short else ORDERS))
        if not asked.json:
            print(rows[-1], file=sys.stderr, flush=True)
    if asked.json:
        print(json.dumps(rows))
        return
    print(table(list(rows[0]), [list(r.values()) for r in rows]))
    middles = {name: float(np.nanmedian([r[name] for r in rows])) for name in rows[0] if name.endswith("min")}
    print("medians: " + ", ".join(f"{name} {value:.0f}" for name, value in middles.items()))
    for one, other in (
        ("proposed, min", "full, min"),
        ("by chance, min", "full, min"),
        ("proposed, min", "by chance, min"),
    ):
        ratios = [r[one] / r[other] for r in rows]
        low, middle, high = np.nanquantile(ratios, [0.25, 0.5, 0.75])
        names = " / ".join(name.partition(",")[0] for name in (one, other))
        print(
            f"{names}: median {middle:.2f}, quartiles {low:.2f} to {high:.2f}; at most half: {sum(r <= 0.5 for r in ratios)}"
        )


if __name__ == "__main__":
    main()
