"""Closed-loop evidence on the virtual mill: the served bundle, in the loop of its axes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dtwin.machines.mill import Correction, SetupErrors, VirtualMill
from dtwin.machines.mill_drive import STEP_S, Command
from dtwin.machines.mill_noise import NoiseParameters
from dtwin.machines.mill_parameters import CircularTest
from dtwin.schema import PLANES, Direction, Floats, Plane
from dtwin.serve.bundle import Bundle
from dtwin.serve.direction import Direction as Frame
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.safety import Guard
from dtwin.statistics import t_quantile
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
        phase, number = command.phase_rad[::_EVERY], float(PLANES.index(test.plane))
        wanted = self._frame.run(self._compiled.run(rows), phase, number)
        added, self.acted[test.direction] = _guarded(self.bundle, test, command, rows, wanted)
        return added


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
        results.append(by_direction(found, runs))
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


def by_direction(
    found: ConditionResult, runs: Mapping[str, Sequence[Mapping[str, Any]]]
) -> ConditionResult:
    """Return the result with intervals from the spread inside each direction.

    Both directions are always run; that their errors differ is not what repeats disagree by.

    Parameters
    ----------
    found : ConditionResult
        From ``condition_result``.
    runs : dict of str to sequence of dict
        The runs that it was made from.
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
            t_quantile(0.975, freedom) * np.sqrt(spread / freedom / n) if known else np.inf
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
    return oracle_correction(bundle, known, delay_s)


def oracle_correction(
    bundle: Bundle, known: Mapping[str, tuple[Floats, Floats]], delay_s: float
) -> Correction:
    """Return a correction from an error that is known, under the guard of a bundle.

    Parameters
    ----------
    bundle : Bundle
        Whose clamp and slew limit hold.
    known : mapping of str to (ndarray, ndarray)
        By direction: path angles in degrees, ascending in 0 to 360, and the radial error in um.
    delay_s : float
        Between a correction and the motion that it causes.
    """

    def correct(test: CircularTest, command: Command) -> Floats:
        angle_deg, error_um = known[test.direction]
        sign = 1.0 if test.direction == "CCW" else -1.0
        ahead = sign * delay_s * test.feed_mm_min / 60.0 / test.radius_mm
        number = PLANES.index(test.plane)
        phase = command.phase_rad[::_EVERY]
        size = -np.interp(np.degrees(phase + ahead), angle_deg, error_um, period=360.0)
        wanted = np.zeros((len(phase), 3))
        wanted[:, number] = size * np.cos(phase)
        wanted[:, (number + 1) % 3] = size * np.sin(phase)
        return _guarded(bundle, test, command, np.zeros((len(phase), 0)), wanted)[0]

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
    bundle: Bundle, test: CircularTest, command: Command, inputs: Floats, wanted_um: Floats
) -> tuple[Floats, dict[str, int]]:
    """Return corrections in mm (2, n) through the guard, one period late, and what it did."""
    boxes = {i.name: (i.low, i.high) for i in bundle.inputs}
    box = np.array([boxes[n] for n in bundle.tick_inputs]) if inputs.shape[1] else np.empty((0, 2))
    guard = Guard(bundle.safety, box[:, 0], box[:, 1])
    number = PLANES.index(test.plane)
    safe = guard.run(wanted_um, inputs, elapsed_s=TRANSPORT_S)
    sent = np.zeros((2, len(safe) + 1))
    sent[0, 1:], sent[1, 1:] = safe[:, number], safe[:, (number + 1) % 3]
    held = np.repeat(sent[:, :-1], _EVERY, axis=1)[:, : len(command.phase_rad)]
    return np.asarray(held / UM_PER_MM), guard.counted()
