"""Closed-loop evidence on the virtual mill: the served bundle, in the loop of its axes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import t as student

from dtwin.machines.mill import Correction, SetupErrors, VirtualMill
from dtwin.machines.mill_drive import STEP_S, Command
from dtwin.machines.mill_noise import NoiseParameters
from dtwin.machines.mill_parameters import CircularTest
from dtwin.schema import PLANES, Direction, Floats, Plane
from dtwin.serve.bundle import Bundle
from dtwin.serve.direction import Direction as Frame
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.safety import Guard
from dtwin.train.dataset import TICK_HZ
from dtwin.train.evidence import (
    WAYS,
    ConditionResult,
    Evidence,
    EvidencePlan,
    Progress,
    condition_result,
    profile_of,
)
from dtwin.units import UM_PER_MM

TRANSPORT_S = 1.0 / TICK_HZ
_EVERY = round(1.0 / TICK_HZ / STEP_S)
_DIRECTIONS: tuple[Direction, Direction] = ("CCW", "CW")
_QUIET = NoiseParameters(rms_um=0.0)
_CENTRED = SetupErrors(centre_mm=0.0, radius_um=0.0, jitter_us=0.0, trigger_samples=0.0)
# Another session: other mountings and other noise than those of the campaign.
_SESSION = 7919
MakeMill = Callable[..., VirtualMill]
Wanted = Callable[[Floats, Floats], Floats]


class ServedCorrection:
    """What serving a bundle adds to the commands of the virtual mill.

    Equation, direction and guard are those that serve a real machine, evaluated at 500 Hz on the
    commanded path; a correction arrives one period after the state that it answers.

    Parameters
    ----------
    bundle : Bundle
        What to serve.
    covariates : dict of str to float
        Logged channels that it asks for.

    Attributes
    ----------
    acted : dict of str to dict
        How often each reason of the guard acted, by direction of the newest circle.
    """

    def __init__(self, bundle: Bundle, covariates: Mapping[str, float] | None = None) -> None:
        self.bundle, self.covariates = bundle, dict(covariates or {})
        self.acted: dict[str, dict[str, int]] = {}
        self._compiled, self._frame = CompiledBundle(bundle), Frame(bundle.outputs)

    def __call__(self, test: CircularTest, command: Command) -> Floats:
        """Return mm along the two axes of the plane, one column for each step."""
        self._compiled.reset()
        values = _states(test, command, self.covariates)
        rows = np.column_stack([values[name] for name in self.bundle.tick_inputs])
        rows = np.ascontiguousarray(rows)
        added, self.acted[test.direction] = _guarded(self.bundle, test, command, rows, self._wanted)
        return added

    def _wanted(self, inputs: Floats, place: Floats) -> Floats:
        self._compiled.tick_inputs[:] = inputs
        self._compiled.evaluate()
        return self._frame.apply(self._compiled.outputs, place[0], place[1])


def mill_evidence(
    bundle: Bundle,
    make_mill: MakeMill,
    *,
    seed: int,
    plan: EvidencePlan,
    delay_s: float,
    covariates: Mapping[str, float] | None = None,
    progress: Progress | None = None,
) -> Evidence:
    """Measure compensated, uncompensated and oracle circles on the virtual mill, interleaved.

    The order of the three ways is drawn anew for every repeat, inside one mounting of the bar that
    no training saw. The unit of replication is the run.

    Parameters
    ----------
    bundle : Bundle
        What to serve.
    make_mill : callable
        ``make_mill(seed=..., noise=..., setup_errors=..., corrections=...)`` returns the machine.
    seed : int
        Of noise, mountings and order.
    plan : EvidencePlan
        Circles.
    delay_s : float
        Between a correction and the motion that it causes; for the oracle, and for the report.
    covariates : dict of str to float
        Logged channels that the bundle asks for.
    progress : callable, optional
        Called with (done, total, what).
    """
    results: list[ConditionResult] = []
    profiles: dict[str, Any] = {}
    rng = np.random.default_rng([seed, 41])
    for done, (plane, radius, feed) in enumerate(plan.conditions, start=1):
        oracle = _oracle(bundle, make_mill, plane, radius, feed, delay_s)
        served = ServedCorrection(bundle, covariates)
        ways = {"compensated": served, "oracle": oracle}
        runs: dict[str, list[dict[str, Any]]] = {way: [] for way in WAYS}
        order = [WAYS[i] for _ in range(plan.repeats) for i in rng.permutation(len(WAYS))]
        tests = [_test(plane, radius, feed, d, way) for way in order for d in _DIRECTIONS]
        mill = make_mill(seed=_SESSION + seed + done, corrections=ways)
        for test, run in zip(tests, mill.measure(tests), strict=True):
            runs[test.correction or "uncompensated"].append(
                {
                    "direction": test.direction,
                    "angle_rad": np.radians(run.samples["angle_deg"]) % (2.0 * np.pi),
                    "deviation_um": run.samples["deviation_um"],
                    "acted": served.acted[test.direction],
                }
            )
        found = condition_result(plane, radius, feed, feed in plan.trained_feeds, runs)
        results.append(_by_direction(found, runs))
        if plane == "XY":
            profiles[f"{plane} R{radius:g} F{feed:g}"] = {
                way: {
                    d: profile_of([r for r in runs[way] if r["direction"] == d])
                    for d in _DIRECTIONS
                }
                for way in WAYS
            }
        if progress is not None:
            progress(done, len(plan.conditions), f"{plane} R{radius:g} F{feed:g}")
    return Evidence(
        kind="virtual",
        clock="machine clock (correction at 500 Hz, axes at 1 kHz)",
        bundle_sha256=bundle.sha256,
        conditions=tuple(results),
        delays={"position_loop_s": delay_s - TRANSPORT_S, "transport_s": TRANSPORT_S},
        profiles=profiles,
    )


def _test(plane: str, radius: float, feed: float, direction: Direction, way: str) -> CircularTest:
    standard: Plane = next(p for p in PLANES if p == plane)
    return CircularTest(
        plane=standard, direction=direction, radius_mm=radius, feed_mm_min=feed,
        setup="evidence", correction="" if way == "uncompensated" else way,
    )  # fmt: skip


def _by_direction(
    found: ConditionResult, runs: Mapping[str, Sequence[Mapping[str, Any]]]
) -> ConditionResult:
    """Return the result with intervals from the spread inside each direction.

    Both directions are always run; that their errors differ is not what repeats disagree by.
    """
    widths = {}
    for way in ("uncompensated", "compensated"):
        sizes = [
            [float(np.sqrt(np.mean(r["rest_um"] ** 2))) for r in runs[way] if r["direction"] == d]
            for d in _DIRECTIONS
        ]
        n = sum(len(s) for s in sizes)
        freedom = n - len(sizes)
        spread = sum((len(s) - 1) * float(np.var(s, ddof=1)) for s in sizes if len(s) > 1)
        known = freedom > 0
        widths[way] = (
            float(student.ppf(0.975, freedom)) * np.sqrt(spread / freedom / n) if known else np.inf
        )
    return replace(
        found,
        before_ci_um=float(widths["uncompensated"]),
        after_ci_um=float(widths["compensated"]),
    )


def _oracle(
    bundle: Bundle, make_mill: MakeMill, plane: str, radius: float, feed: float, delay_s: float
) -> Correction:
    """Return the correction that knows the machine's repeatable error, under the same guard."""
    known: dict[str, tuple[Floats, Floats]] = {}
    for direction in _DIRECTIONS:
        test = _test(plane, radius, feed, direction, "uncompensated")
        (run,) = make_mill(seed=0, noise=_QUIET, setup_errors=_CENTRED).measure([test])
        angle = np.degrees(np.radians(run.samples["angle_deg"])) % 360.0
        order = np.argsort(angle)
        known[direction] = angle[order], run.samples["deviation_um"][order]

    def correct(test: CircularTest, command: Command) -> Floats:
        angle_deg, error_um = known[test.direction]
        sign = 1.0 if test.direction == "CCW" else -1.0
        ahead = sign * delay_s * test.feed_mm_min / 60.0 / test.radius_mm
        number = PLANES.index(test.plane)

        def wanted(_: Floats, place: Floats) -> Floats:
            angle = place[0]
            size = -np.interp(np.degrees(angle + ahead), angle_deg, error_um, period=360.0)
            out = np.zeros(3)
            out[number], out[(number + 1) % 3] = size * np.cos(angle), size * np.sin(angle)
            return out

        rows = np.zeros((len(range(0, len(command.phase_rad), _EVERY)), 0))
        return _guarded(bundle, test, command, rows, wanted)[0]

    return correct


def _states(
    test: CircularTest, command: Command, covariates: Mapping[str, float]
) -> dict[str, Floats]:
    """Return what the control tells of the commanded path at every tick."""
    phase = command.phase_rad[::_EVERY]
    first, second = command.velocity_mm_s[:, ::_EVERY]
    constant = {
        "direction_sign": 1.0 if test.direction == "CCW" else -1.0,
        "radius_mm": test.radius_mm,
        "plane_id": float(PLANES.index(test.plane)),
        **covariates,
    }
    return {
        "path_angle_rad": phase,
        "commanded_speed_mm_s": np.hypot(first, second),
        **{name: np.full(len(phase), value) for name, value in constant.items()},
    }


def _guarded(
    bundle: Bundle, test: CircularTest, command: Command, inputs: Floats, wanted: Wanted
) -> tuple[Floats, dict[str, int]]:
    """Return corrections in mm (2, n) through the guard, one period late, and what it did."""
    boxes = {i.name: (i.low, i.high) for i in bundle.inputs}
    box = np.array([boxes[n] for n in bundle.tick_inputs]) if inputs.shape[1] else np.empty((0, 2))
    guard = Guard(bundle.safety, np.ascontiguousarray(box[:, 0]), np.ascontiguousarray(box[:, 1]))
    number = PLANES.index(test.plane)
    phase = command.phase_rad[::_EVERY]
    sent = np.zeros((2, len(phase) + 1))
    place = np.array([0.0, float(number)])
    for tick in range(len(phase)):
        place[0] = phase[tick]
        row = inputs[tick]
        asked = wanted(row, place)
        safe = guard.step(asked, row, age_s=0.0, elapsed_s=TRANSPORT_S, enabled=True)
        sent[0, tick + 1], sent[1, tick + 1] = safe[number], safe[(number + 1) % 3]
    held = np.repeat(sent[:, :-1], _EVERY, axis=1)[:, : len(command.phase_rad)]
    return np.asarray(held / UM_PER_MM), guard.counted()
