"""One part through the virtual cell: load, hold, four quarters, unload; step by step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.kinematics import UR10E
from dtwin.machines.cobot import ELBOW_UP_RAD, TOOL_DOWN, VirtualCobot
from dtwin.schema import Floats
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.targets import Target, TargetCorrection, TargetFrame
from studies.cell_state import COBOT, DONE, INTERRUPTED, MILL, NONE, RUNNING, STEPS, CellFile, live_twin, next_step, now
from studies.machines import cubesat
from studies.machines.hybrid_mill import HybridMill
from studies.machines.joint_program import Waypoint, drive_program
from studies.placement_model import JOINT_MOTION, TrainingPlacement, placement_bundle

_TCP_MM = np.array([0.0, 0.0, 158.3])
_TAUGHT = 6
_PROBED, _PROBE_UM = 60, 0.3
Do = Callable[[str, int, str], dict[str, Any]]


@dataclass(frozen=True)
class _Outcome:
    """What became of a job.

    ``state``: state of the cell at the end.
    ``stopped``: why it stopped before its end; empty when all steps are done.
    """

    state: dict[str, Any]
    stopped: str


def run_job(cell: CellFile, do: Do | None = None) -> _Outcome:
    """Do the steps that are left, until all are done or somebody asks to stop.

    A step that was running when a process ended is done again: the machines start every step from
    where they stand safely. Only the twin of the running step is live.

    ``do``: ``do(step, part, twin)`` does one step and returns its result; by default here and now.
    Raises ``InputError`` when the cell is running already, or has no job.
    """
    with cell.alone():
        state = cell.read()
        seed = int(state["seed"])
        work = do or (lambda step, part, twin: do_step(step, part, twin, seed))
        for entry in state["steps"]:
            if entry["state"] == RUNNING:
                entry["state"] = INTERRUPTED
        while (number := next_step(state)) is not None:
            reason = cell.stop_asked()
            if reason is not None:
                cell.write(state)
                cell.take_stop()
                return _Outcome(state, reason)
            entry = state["steps"][number]
            entry |= {"state": RUNNING, "started": now()}
            cell.write(state)
            try:
                result = work(entry["step"], entry["part"], entry["twin"])
            except BaseException:
                entry["state"] = INTERRUPTED
                cell.write(state)
                raise
            entry |= {"state": DONE, "ended": now(), "result": result}
            cell.write(state)
        cell.take_stop()
        return _Outcome(state, "")


def do_step(step: str, part: int, twin: str, seed: int) -> dict[str, Any]:
    """Do one step on the virtual machines and return its figures, machine clock.

    ``step``, ``twin``: one of ``STEPS``, and the twin that is live in it.
    ``part``: from 1.
    Raises ``InputError`` when there is no such step, or another twin than the step's would be live.
    """
    if (step, twin) not in STEPS:
        raise InputError(
            "the cell has no such step with this twin live",
            code="cell.step",
            got=f"{step[:40]}, {twin[:20]}",
            allowed=", ".join(f"{s}: {t}" for s, t in STEPS),
        )
    if twin == COBOT:
        return _load(seed) if step == "load" else _unload(seed)
    if twin == MILL:
        return _quarter(int(step.rsplit(" ", 1)[1]), part, seed)
    if step == "hold and bolt":
        return {"duration_s": cubesat.HOLD_S}
    mill = _mill(seed, part)
    run = mill.run(np.array([[0.0, 0.0], cubesat.LOAD_POSITION_MM]), 3000.0)
    return {"duration_s": float(run.t_s[-1]), "x_mm": float(cubesat.LOAD_POSITION_MM[0])}


def status(cell: CellFile) -> dict[str, Any]:
    """Return the one view of a cell: every step, the live twin, whether it runs or was asked to stop."""
    state = cell.read()
    running = cell.running
    left = next_step(state)
    condition = "done" if left is None else "running" if running else "stopped"
    return {
        **state,
        "condition": condition,
        "live_twin": live_twin(state) if running else NONE,
        "stop_asked": cell.stop_asked(),
        "done_steps": sum(s["state"] == DONE for s in state["steps"]),
        "next": None if left is None else state["steps"][left]["step"],
    }


def step_rows(seen: Mapping[str, Any]) -> list[list[Any]]:
    """Return the steps of a cell, as :func:`status` gives them, as rows: part, step, twin, state, s, errors without and with."""
    numbers = ("duration_s", "error_without_um", "error_um")
    return [
        [
            *(step[name] for name in ("part", "step", "twin", "state")),
            *(f"{step['result'][k]:z.1f}" if k in step["result"] else "" for k in numbers),
        ]
        for step in seen["steps"]
    ]


def _load(seed: int) -> dict[str, Any]:
    """Fetch a part and place it; the target Place is rewritten before its move starts."""
    cobot, correction = _cobot_twin(seed)
    made = correction.correct(Target("CubeSat Place", cubesat.PLACE_MM, cubesat.ROBOT_FEED_MM_MIN))
    plain, _ = _placed(cobot, cubesat.PLACE_MM)
    reached, duration_s = _placed(cobot, made.position_mm)
    return {
        "duration_s": duration_s,
        "offset_um": made.offset_um.tolist(),
        "guard": made.reason,
        "error_without_um": _distance_um(plain),
        "error_um": _distance_um(reached),
    }


def _unload(seed: int) -> dict[str, Any]:
    """Fetch the part where it was put, with the same correction."""
    cobot, correction = _cobot_twin(seed)
    made = correction.correct(Target("CubeSat Place", cubesat.PLACE_MM, cubesat.ROBOT_FEED_MM_MIN))
    stops = [
        Waypoint("clear of the mill", cubesat.CLEAR_MILL_MM),
        Waypoint("above the mill", cubesat.PLACE_SAFE_MM),
        Waypoint("part", made.position_mm),
        Waypoint("above the mill", cubesat.PLACE_SAFE_MM),
        Waypoint("above the jig", cubesat.LOAD_SAFE_MM),
    ]
    ends, duration_s = _drive(cobot, stops)
    return {
        "duration_s": duration_s,
        "offset_um": made.offset_um.tolist(),
        "guard": made.reason,
        "error_um": _distance_um(ends[2]),
    }


def _quarter(number: int, part: int, seed: int) -> dict[str, Any]:
    """Mill one quarter with the mill's twin live, and once without for what it would have been."""
    angle = cubesat.C_DEG[number - 1]
    corners, feed = cubesat.QUARTER_MM, cubesat.MILL_FEED_MM_MIN
    plain = _mill(seed, part).run(corners, feed, c_deg=angle)
    mill = _mill(seed, part)
    command = mill.command(corners, feed)
    weights = _mill_twin(seed, angle)
    wanted_um = -(weights @ _terms(command.position_mm))
    run = mill.run(corners, feed, c_deg=angle, wanted_um=wanted_um)
    return {
        "duration_s": float(run.t_s[-1]),
        "c_deg": angle,
        "temperature_c": run.temperature_c,
        "largest_correction_um": float(25.0 * np.abs(run.analogue_v - 5.0).max()),
        "error_without_um": _rms_um(plain.error_um),
        "error_um": _rms_um(run.error_um),
    }


@lru_cache(maxsize=4)
def _cobot_twin(seed: int) -> tuple[VirtualCobot, TargetCorrection]:
    """Return the robot and its twin, taught by placements that were measured beforehand."""
    cobot = VirtualCobot(seed=seed)
    error_mm, _ = _placed(cobot, cubesat.PLACE_MM)
    rng = np.random.default_rng([seed, 71])
    taught = [
        TrainingPlacement(
            motion, cubesat.ROBOT_FEED_MM_MIN, 1e3 * (error_mm - cubesat.PLACE_MM) + 10.0 * rng.standard_normal(3)
        )
        for motion in ("MoveL", "MoveJ")
        for _ in range(_TAUGHT)
    ]
    bundle = placement_bundle(taught, "virtual-cobot", feeds_mm_min=(500.0, 6000.0))
    joints = UR10E.inverse(cubesat.PLACE_MM, TOOL_DOWN, _TCP_MM, ELBOW_UP_RAD)
    frame = TargetFrame("XY", cubesat.LOAD_SAFE_MM, joints)
    return cobot, TargetCorrection(CompiledBundle(bundle), _TCP_MM, frame, {JOINT_MOTION: 0.0})


@lru_cache(maxsize=16)
def _mill_twin(seed: int, angle_deg: float) -> Floats:
    """Return what a probed artefact says of the mill at one angle of C, shape (2, 3)."""
    mill = HybridMill(seed)
    run = mill.run(cubesat.QUARTER_MM, cubesat.MILL_FEED_MM_MIN, c_deg=angle_deg)
    at = np.linspace(0, run.error_um.shape[1] - 1, _PROBED).astype(int)
    rng = np.random.default_rng([seed, 72, round(angle_deg)])
    seen = run.error_um[:, at] + _PROBE_UM * rng.standard_normal((2, _PROBED))
    terms = _terms(run.items["ProgramPositionCommand"][:, at])
    return np.asarray(np.linalg.lstsq(terms.T, seen.T, rcond=None)[0].T)


def _terms(position_mm: Floats) -> Floats:
    return np.vstack([np.ones(position_mm.shape[1]), position_mm])


def _mill(seed: int, part: int) -> HybridMill:
    """Return the mill as it is when a part arrives; a part takes a quarter of an hour."""
    return HybridMill(seed, time_s=900.0 * part)


def _placed(cobot: VirtualCobot, target_mm: Floats) -> tuple[Floats, float]:
    stops = [
        Waypoint("above the jig", cubesat.LOAD_SAFE_MM),
        Waypoint("part", cubesat.LOAD_MM),
        Waypoint("above the jig", cubesat.LOAD_SAFE_MM),
        Waypoint("above the mill", cubesat.PLACE_SAFE_MM),
        Waypoint("place", target_mm, 0.3),
        Waypoint("above the mill", cubesat.PLACE_SAFE_MM),
        Waypoint("clear of the mill", cubesat.CLEAR_MILL_MM),
    ]
    ends, duration_s = _drive(cobot, stops)
    return ends[4], duration_s


def _drive(cobot: VirtualCobot, stops: list[Waypoint]) -> tuple[Floats, float]:
    return drive_program(
        cobot, stops, motion="MoveL", feed_mm_min=cubesat.ROBOT_FEED_MM_MIN, datum_mm=cubesat.LOAD_SAFE_MM
    )


def _distance_um(reached_mm: Floats) -> float:
    return float(1e3 * np.linalg.norm(reached_mm - cubesat.PLACE_MM))


def _rms_um(error_um: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(error_um**2, axis=0))))
