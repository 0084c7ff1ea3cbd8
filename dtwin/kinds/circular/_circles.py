"""One circle of the virtual cobot with or without a correction, and its error as a figure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from dtwin.machines.cobot import CircleCondition, CobotRecording, RunTicks, VirtualCobot
from dtwin.schema import Direction, Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.decision import Decision
from dtwin.serve.interface import SafetyLimits
from dtwin.serve.lockstep import serve_lockstep
from dtwin.serve.runtime import CompiledBundle
from dtwin.statistics import rms
from dtwin.train.oracle import best_offsets, follow

_DIRECTIONS: tuple[Direction, Direction] = ("CCW", "CW")


class CorrectedCircles:
    """Circles of the virtual cobot in lock-step, by three ways: nothing, a bundle, or the best that is found.

    What the machine does is the same in every mounting and repeat: each program runs once, and the instruments record
    it every time.

    ``bundle``: what is served; the oracle takes its limits.
    ``tcp_mm`` (3,): tool centre point.
    """

    def __init__(self, cobot: VirtualCobot, bundle: Bundle, tcp_mm: Floats) -> None:
        self._cobot, self._bundle, self._tcp_mm = cobot, bundle, tcp_mm
        self._ran: dict[tuple[CircleCondition, str], tuple[RunTicks, dict[str, int]]] = {}

    def measure(
        self, condition: CircleCondition, setup: str, repeat: int, way: str
    ) -> tuple[CobotRecording, dict[str, int]]:
        """Return the recording of one circle, and how often each guard acted.

        ``condition``, ``setup``, ``repeat``: what is run, in which mounting of the bar, which repeat.
        ``way``, one of "uncompensated", "compensated", "oracle": nothing, the bundle, or the best that is found with
        the truth known (:mod:`dtwin.train.oracle`).
        """
        condition = condition.standard()
        if (condition, way) not in self._ran:
            self._ran[condition, way] = self._run(condition, way)
        ticks, acted = self._ran[condition, way]
        return self._cobot.recording_of(condition, self._cobot.plan(condition), ticks, setup, repeat), acted

    def _run(self, condition: CircleCondition, way: str) -> tuple[RunTicks, dict[str, int]]:
        if way == "uncompensated":
            return self._cobot.run(self._cobot.plan(condition)), {}
        controller = self._cobot.controller(condition, setup="", repeat=1)
        if way == "compensated":
            acted = serve_lockstep(Decision(CompiledBundle(self._bundle), self._tcp_mm), controller).reasons
        else:
            both = [replace(condition, direction=direction) for direction in _DIRECTIONS]
            offsets = _best_of_both(self._cobot, both[0], self._bundle.safety)[both.index(condition)]
            acted = follow(controller, offsets, self._bundle.safety)[1]
        return controller.ticks(), acted


@lru_cache(maxsize=8)
def _best_of_both(cobot: VirtualCobot, condition: CircleCondition, safety: SafetyLimits) -> list[Floats]:
    """Return the oracle's offsets of both directions; the same for every mounting and repeat."""
    begun = [
        partial(cobot.controller, replace(condition, direction=way), setup="oracle", repeat=1) for way in _DIRECTIONS
    ]
    centre = cobot.centre_mm(condition.radius_mm)
    return best_offsets(begun, centre, cobot.parameters.controller, safety)


def evaluate_circle(recording: CobotRecording, direction: str) -> dict[str, Any]:
    """Return ``direction``, ``angle_rad`` and ``deviation_um`` of a recording's measured arc."""
    start, end = recording.window
    arc = 2.0 * math.pi if recording.condition.plane == "XY" else math.pi
    turned = np.arange(end - start) / (end - start) * arc
    return {
        "direction": direction,
        "angle_rad": turned if direction == "CCW" else arc - turned,
        "deviation_um": recording.deviation_mm[start:end] * 1000.0,
    }


def rms_per_run(runs: Sequence[Mapping[str, Any]]) -> Floats:
    """Return each run's RMS after the set-up's centre and radius, common to these runs.

    ``runs``: from ``evaluate_circle``; each gets its remainder under ``rest_um``.
    Returns (runs,): in um.
    """
    angle = np.concatenate([r["angle_rad"] for r in runs])
    value = np.concatenate([r["deviation_um"] for r in runs])
    basis = np.column_stack([np.ones_like(angle), np.cos(angle), np.sin(angle)])
    rest = value - basis @ np.linalg.lstsq(basis, value, rcond=None)[0]
    parts = np.split(rest, np.cumsum([len(r["angle_rad"]) for r in runs])[:-1])
    for run, part in zip(runs, parts, strict=True):
        run["rest_um"] = part  # type: ignore[index]
    return np.array([rms(part) for part in parts])
