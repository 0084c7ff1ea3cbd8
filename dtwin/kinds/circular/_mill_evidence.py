"""Closed-loop evidence on the virtual mill: the served bundle, in the loop of its axes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np

from dtwin.kinds.circular._evidence import WAYS
from dtwin.machines.mill import Correction, SetupErrors, VirtualMill
from dtwin.machines.mill_drive import STEP_S, Command
from dtwin.machines.mill_parameters import CircularTest, NoiseParameters
from dtwin.plan import EvidencePlan
from dtwin.progress import Progress, silent
from dtwin.schema import PLANES, Direction, Floats, Plane, Run
from dtwin.serve.bundle import Bundle
from dtwin.serve.direction import Direction as Frame
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.safety import Guard
from dtwin.train.dataset import TICK_HZ
from dtwin.train.oracle import MeasuredWays, guard_shares, numbered
from dtwin.train.results import condition_name
from dtwin.units import UM_PER_MM

CLOCK = "machine clock (correction at 500 Hz, axes at 1 kHz)"
TRANSPORT_S = 1.0 / TICK_HZ
_EVERY = round(1.0 / TICK_HZ / STEP_S)
_DIRECTIONS: tuple[Direction, Direction] = ("CCW", "CW")
_QUIET = NoiseParameters(rms_um=0.0)
_CENTRED = SetupErrors(centre_mm=0.0, radius_um=0.0, jitter_us=0.0, trigger_samples=0.0)
# Another session: other mountings and other noise than those of the campaign.
_SESSION = 7919
_MakeMill = Callable[..., VirtualMill]


class ServedCorrection:
    """What serving a bundle adds to the commands of the virtual mill.

    Equation, direction and guard are those that serve a real machine, evaluated at 500 Hz on the
    commanded path; a correction arrives one period after the state that it answers.

    ``covariates``: logged channels that it asks for.
    ``acted``: how often each reason of the guard acted, by direction of the newest circle.
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


def measured_mill(
    bundle: Bundle, make_mill: _MakeMill, *, seed: int, plan: EvidencePlan, delay_s: float, progress: Progress = silent
) -> MeasuredWays:
    """Measure compensated, uncompensated and oracle circles on the virtual mill, interleaved.

    The order of the three ways is drawn anew for every repeat, inside one mounting of the bar that
    no training saw. The unit of replication is the run.

    ``make_mill``: ``make_mill(seed=..., noise=..., setup_errors=..., corrections=...)`` returns the machine.
    ``delay_s``: between a correction and the motion that it causes; for the oracle, and for the report.
    """
    kept: dict[str, list[Run]] = {"measured": [], "oracle": []}
    acted: dict[str, dict[str, float]] = {}
    rng = np.random.default_rng([seed, 41])
    for done, (plane, radius, feed) in enumerate(plan.conditions, start=1):
        # Each condition on a day of its own, in a mounting of its own.
        setup, day = f"evidence-{done}", timedelta(days=done)
        oracle = _oracle(bundle, make_mill, plane, radius, feed, delay_s)
        served = ServedCorrection(bundle)
        order = [WAYS[i] for _ in range(plan.repeats) for i in rng.permutation(len(WAYS))]
        tests = [_test(plane, radius, feed, d, way, setup) for way in order for d in _DIRECTIONS]
        mill = make_mill(seed=_SESSION + seed + done, corrections={"compensated": served, "oracle": oracle})
        for test, run in zip(tests, mill.measure(tests), strict=True):
            correction = bundle.model_sha256 if test.correction == "compensated" else ""
            started = (datetime.fromisoformat(run.meta.started) + day).isoformat()
            meta = replace(run.meta, correction=correction, started=started)
            group = "oracle" if test.correction == "oracle" else "measured"
            kept[group].append(replace(run, meta=meta))
        condition = {"plane": plane, "radius_mm": radius, "feed_mm_min": feed}
        acted[condition_name(condition)] = guard_shares(list(served.acted.values()))
        progress(done, len(plan.conditions), f"{plane} R{radius:g} F{feed:g}")
    return MeasuredWays(
        runs=numbered(kept["measured"]),
        clock=CLOCK,
        delays={"position_loop_s": delay_s - TRANSPORT_S, "transport_s": TRANSPORT_S},
        oracle=tuple(kept["oracle"]),
        acted=acted,
        trained=plan.trained,
    )


def _test(plane: Plane, radius: float, feed: float, direction: Direction, way: str, setup: str) -> CircularTest:
    return CircularTest(
        plane=plane,
        direction=direction,
        radius_mm=radius,
        feed_mm_min=feed,
        setup=setup,
        correction="" if way == "uncompensated" else way,
    )


def _oracle(
    bundle: Bundle, make_mill: _MakeMill, plane: Plane, radius: float, feed: float, delay_s: float
) -> Correction:
    """Return the correction that knows the machine's repeatable error, under the same guard."""
    known: dict[str, tuple[Floats, Floats]] = {}
    for direction in _DIRECTIONS:
        test = _test(plane, radius, feed, direction, "uncompensated", "evidence")
        (run,) = make_mill(seed=0, noise=_QUIET, setup_errors=_CENTRED).measure([test])
        angle = np.degrees(np.radians(run.samples["angle_deg"])) % 360.0
        order = np.argsort(angle)
        known[direction] = angle[order], run.samples["deviation_um"][order]
    return oracle_correction(bundle, known, delay_s)


def oracle_correction(bundle: Bundle, known: Mapping[str, tuple[Floats, Floats]], delay_s: float) -> Correction:
    """Return a correction from an error that is known, under the guard of a bundle.

    ``bundle``: whose clamp and slew limit hold.
    ``known``: by direction: path angles in degrees, ascending in 0 to 360, and the radial error in um.
    ``delay_s``: between a correction and the motion that it causes.
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


def _states(test: CircularTest, command: Command, covariates: Mapping[str, float]) -> dict[str, Floats]:
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
