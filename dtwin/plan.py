"""A campaign as data, before anything moves: grid, order, limits, time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.plan_file import read_plan_file
from dtwin.schema import Direction, Finding, Plane, require_name, standard_plane
from dtwin.units import is_number

_SETTINGS = {
    "plan": ("kind", "name", "machine", "seed", "calibrated_length"),
    "grid": ("plane", "radius_mm", "feed_mm_min", "directions", "repeats"),
    "limits": ("max_feed_mm_min", "max_radius_mm"),
}
_MAX_TESTS = 100_000
# Of mm and of mm/min.
_SMALLEST = 1e-3
# A ball-bar mount lets a bar swing through half a turn in a vertical plane.
_FULL_TURNS_DEG = 720.0
_HALF_TURN_DEG = 190.0
_STOP_S = 0.25
_TURNAROUND_S = 10.0


@dataclass(frozen=True)
class PlannedTest:
    """One file's worth of motion: a condition, run once in each direction.

    ``test_id``: ``t001`` ... in the order of measurement.
    ``setup``: mounting of the instrument; changes with plane and radius.
    """

    test_id: str
    plane: Plane
    radius_mm: float
    feed_mm_min: float
    repeat: int
    setup: str


@dataclass(frozen=True)
class Plan:
    """An ordered list of tests on one machine.

    ``tests``: in the order of measurement.
    ``directions``: directions of every test, in order.
    ``seed``: seed of the random order inside each set-up.
    """

    name: str
    machine: str
    tests: tuple[PlannedTest, ...]
    directions: tuple[Direction, ...]
    seed: int
    max_feed_mm_min: float
    max_radius_mm: float
    calibrated_length: bool = False

    @property
    def n_runs(self) -> int:
        """Number of runs: tests times directions."""
        return len(self.tests) * len(self.directions)


def arc_deg(plane: Plane) -> float:
    """Return the arc of one direction: two turns lying flat, half a turn upright."""
    return _FULL_TURNS_DEG if plane == "XY" else _HALF_TURN_DEG


def ends_deg(plane: Plane) -> tuple[float, float]:
    """Return the first and the last angle of an upright arc, counter-clockwise; its middle is where Z is largest: below, a spindle meets the table."""
    top_deg, half_deg = (90.0 if plane == "YZ" else 0.0), arc_deg(plane) / 2.0
    return top_deg - half_deg, top_deg + half_deg


def _motion_s(test: PlannedTest, n_directions: int = 2) -> float:
    """Estimate the time of pure motion of a test."""
    length_mm = math.radians(arc_deg(test.plane)) * test.radius_mm
    stops = arc_deg(test.plane) / 180.0
    return n_directions * (length_mm / (test.feed_mm_min / 60.0) + stops * _STOP_S)


def duration_s(plan: Plan) -> tuple[float, float]:
    """Return the time of pure motion, and the time with turnarounds between directions."""
    moving = sum(_motion_s(test, len(plan.directions)) for test in plan.tests)
    return moving, moving + plan.n_runs * _TURNAROUND_S


def training_plan(
    *,
    radii_mm: Sequence[float] = (100.0, 150.0, 300.0),
    feeds_mm_min: Sequence[float] = (2000.0, 4000.0, 6000.0),
    planes: Sequence[str] = ("XY", "YZ", "ZX"),
    repeats: int = 3,
    name: str = "training",
    seed: int = 1,
) -> Plan:
    """Return the training campaign of the demo: 81 tests, 162 runs."""
    document = {
        "plan": {"name": name, "machine": "virtual-cobot", "seed": seed},
        "grid": {
            "radius_mm": list(radii_mm),
            "feed_mm_min": list(feeds_mm_min),
            "plane": list(planes),
            "repeats": repeats,
        },
    }
    return expand(document, "training plan")


def quick_training_plan() -> Plan:
    """Return a small training campaign: one plane, three radii, two feeds, 12 tests.

    Three radii: without one of them two must remain, or orders cannot be told from each other.
    """
    return training_plan(feeds_mm_min=(4000.0, 6000.0), planes=("YZ",), repeats=2, name="training-quick")


def read_plan(path: Path) -> Plan:
    """Read a plan file.

    ``path``: TOML with the tables ``[plan]``, ``[grid]`` and, optional, ``[limits]``.
    Raises ``InputError`` with the place of the first thing that is wrong.
    """
    document = read_plan_file(path)
    return expand(document, str(path))


def expand(document: Mapping[str, Any], where: str) -> Plan:
    """Expand a grid into ordered tests.

    Feeds and repeats are crossed inside a set-up and shuffled there; plane and radius change
    only with the set-up.
    """
    _require_known(document, where)
    head, grid = _table(document, "plan", where), _table(document, "grid", where)
    planes = [standard_plane(str(p), "CCW")[0] for p in _listed(grid, "plane", where)]
    radii = _numbers(grid, "radius_mm", where)
    feeds = _numbers(grid, "feed_mm_min", where)
    for name, values in (("plane", planes), ("radius_mm", radii), ("feed_mm_min", feeds)):
        if len({*values}) < len(values):
            raise InputError(
                f"{name} holds a value twice",
                code="plan.grid",
                where=f"{where} grid.{name}",
                got=", ".join(map(str, values))[:80],
                allowed="each once",
                hint="repeats counts how often a condition is measured",
            )
    repeats = _whole("repeats", grid.get("repeats", 1), f"{where} grid", 1, 1000)
    if len(planes) * len(radii) * len(feeds) * repeats > _MAX_TESTS:
        raise InputError("the grid is absurdly large", code="plan.size", where=where, allowed=f"{_MAX_TESTS} tests")
    seed = _whole("seed", head.get("seed", 1), f"{where} plan", 0)
    calibrated = head.get("calibrated_length", False)
    if not isinstance(calibrated, bool):
        raise InputError(
            "calibrated_length is true or false",
            code="plan.calibrated_length",
            where=f"{where} plan",
            got=repr(calibrated)[:40],
        )
    tests = _ordered(planes, radii, feeds, repeats, seed)
    plan = Plan(
        name=require_name(head.get("name"), "plan.name"),
        machine=require_name(head.get("machine"), "plan.machine"),
        tests=tuple(tests),
        directions=tuple(_directions(grid, where)),
        seed=seed,
        max_feed_mm_min=_limit(document, "max_feed_mm_min", 15_000.0, where),
        max_radius_mm=_limit(document, "max_radius_mm", 350.0, where),
        calibrated_length=calibrated,
    )
    _check_limits(plan, where)
    return plan


def advice(plan: Plan) -> Iterator[Finding]:
    """Say what the plan cannot tell, before anything is measured."""
    if max(test.repeat for test in plan.tests) < 2:
        yield Finding(
            "plan.no_repeats",
            "warning",
            "no condition is repeated: the noise floor cannot be known, so no missing effect can be told from noise",
        )
    if len(plan.directions) < 2:
        yield Finding(
            "plan.one_direction",
            "warning",
            "one direction only: squareness and servo mismatch, and much else, look the same",
        )
    if len({test.feed_mm_min for test in plan.tests}) < 2:
        yield Finding("plan.one_feed", "warning", "one feed only: no effect that grows with feed can be named")
    if not plan.calibrated_length and len({test.radius_mm for test in plan.tests}) > 1:
        yield Finding(
            "plan.radius_law",
            "info",
            "every radius is a set-up with its own zero: how the mean radius depends on the radius "
            "stays unknown without a calibrated length (set plan.calibrated_length)",
        )


def _ordered(
    planes: Sequence[Plane], radii: Sequence[float], feeds: Sequence[float], repeats: int, seed: int
) -> list[PlannedTest]:
    rng = np.random.default_rng(seed)
    tests: list[PlannedTest] = []
    for plane, radius in product(planes, radii):
        setup = f"{plane.lower()}-r{radius:g}"
        inside = [(feed, repeat) for repeat in range(1, repeats + 1) for feed in feeds]
        for k in rng.permutation(len(inside)):
            feed, repeat = inside[int(k)]
            tests.append(PlannedTest(f"t{len(tests) + 1:03d}", plane, radius, feed, repeat, setup))
    return tests


def _check_limits(plan: Plan, where: str) -> None:
    for test in plan.tests:
        for name, value, limit in (
            ("radius_mm", test.radius_mm, plan.max_radius_mm),
            ("feed_mm_min", test.feed_mm_min, plan.max_feed_mm_min),
        ):
            if not _SMALLEST <= value <= limit:
                raise InputError(
                    f"{name} is outside the machine's limits",
                    code="plan.limits",
                    where=f"{where} grid.{name}",
                    got=f"{value:g}",
                    allowed=f"{_SMALLEST:g} to {limit:g}",
                    hint="drop it from the grid, or correct [limits]",
                )


def _require_known(document: Mapping[str, Any], where: str) -> None:
    """Refuse what is not read: a limit that is mistyped would hold nothing back."""
    told = {name: table if isinstance(table, dict) else {} for name, table in document.items()}
    unknown = [f"[{name}]" for name in told if name not in _SETTINGS]
    unknown += [f"{name}.{key}" for name, keys in _SETTINGS.items() for key in told.get(name, {}) if key not in keys]
    if unknown:
        raise InputError(
            "unknown setting of a plan",
            code="plan.setting",
            where=where,
            got=", ".join(unknown)[:80],
            allowed="; ".join(f"[{name}] {', '.join(keys)}" for name, keys in _SETTINGS.items()),
        )


def _table(document: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    value = document.get(name)
    if not isinstance(value, dict):
        raise InputError(f"the plan needs a [{name}] table", code="plan.table", where=where)
    return value


def _whole(name: str, value: object, where: str, least: int, most: int | None = None) -> int:
    if isinstance(value, int) and not isinstance(value, bool) and least <= value <= (value if most is None else most):
        return value
    raise InputError(
        f"{name} must be a whole number",
        code=f"plan.{name}",
        where=f"{where}.{name}",
        got=str(value)[:40],
        allowed=f"{least} or more" if most is None else f"{least} to {most}",
    )


def _limit(document: Mapping[str, Any], name: str, usual: float, where: str) -> float:
    value = _table(document, "limits", where).get(name, usual) if "limits" in document else usual
    if not is_number(value):
        raise InputError(
            f"{name} is not a number", code="plan.limits", where=f"{where} limits.{name}", got=repr(value)[:60]
        )
    return float(value)


def _listed(grid: Mapping[str, Any], name: str, where: str) -> list[Any]:
    value = grid.get(name)
    values = value if isinstance(value, list) else [value]
    if not values or values == [None]:
        raise InputError(f"the grid needs {name}", code="plan.grid", where=f"{where} grid.{name}")
    return values


def _numbers(grid: Mapping[str, Any], name: str, where: str) -> list[float]:
    values = _listed(grid, name, where)
    if not all(is_number(v) for v in values):
        raise InputError(
            f"{name} must be numbers", code="plan.grid", where=f"{where} grid.{name}", got=repr(values)[:80]
        )
    return [float(v) for v in values]


def _directions(grid: Mapping[str, Any], where: str) -> list[Direction]:
    stated = grid.get("directions", ["CCW", "CW"])
    if not isinstance(stated, list) or sorted(map(str, stated)) not in (["CCW"], ["CW"], ["CCW", "CW"]):
        raise InputError(
            "unknown direction",
            code="plan.grid",
            where=f"{where} grid.directions",
            got=repr(stated)[:60],
            allowed='["CCW", "CW"]',
        )
    return stated


@dataclass(frozen=True)
class EvidencePlan:
    """Which circles are measured.

    ``conditions``, of (plane, radius_mm, feed_mm_min): each is run in both directions.
    ``trained_feeds``: for the report: the others were never trained.
    """

    conditions: tuple[tuple[Plane, float, float], ...]
    repeats: int = 2
    trained_feeds: tuple[float, ...] = (2000.0, 4000.0, 6000.0)

    def trained(self, condition: Mapping[str, Any]) -> bool:
        """Tell whether the feed of a condition was trained."""
        return condition["feed_mm_min"] in self.trained_feeds


_PLANES: tuple[tuple[Plane, float], ...] = (("XY", 100.0), ("YZ", 150.0), ("ZX", 100.0))
DEFAULT_EVIDENCE = EvidencePlan(
    tuple((plane, radius, feed) for plane, radius in _PLANES for feed in (1000.0, 2000.0, 3000.0, 6000.0))
)


def plan_within(conditions: Sequence[tuple[Plane, float, float]]) -> EvidencePlan:
    """Return circles in the planes that were trained, at feeds that were and were not."""
    feeds = sorted({feed for _, _, feed in conditions})
    between = [0.5 * (feeds[0] + feeds[1])] if len(feeds) > 1 else []
    wanted = sorted({0.5 * feeds[0], feeds[0], *between, feeds[-1]})
    circles = []
    for plane in sorted({plane for plane, _, _ in conditions}):
        radii = sorted({radius for p, radius, _ in conditions if p == plane})
        circles += [(plane, radii[(len(radii) - 1) // 2], feed) for feed in wanted]
    return EvidencePlan(tuple(circles), trained_feeds=tuple(feeds))
