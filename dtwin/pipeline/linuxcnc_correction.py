"""Circles on a LinuxCNC with a correction: live through external offsets, or as a table."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.acquire.linuxcnc_circles import PERIOD_S, run_circles
from dtwin.errors import DeviceError
from dtwin.links.linuxcnc import Bridge, LinuxcncLink
from dtwin.machines.linuxcnc.circles import Circle, Trace
from dtwin.machines.linuxcnc.instance import LinuxcncSession
from dtwin.progress import Progress, silent
from dtwin.serve.bundle import Bundle
from dtwin.serve.decision import Decision
from dtwin.serve.loop import ServeStatus, ServingLoop
from dtwin.serve.runtime import CompiledBundle

_PATIENCE_S = 15.0
_POLL_S = 0.05
_LONGEST_S = 3600.0
_NO_TOOL = np.zeros(3)


@dataclass(frozen=True)
class LiveTrace:
    """A turn with the correction served, and how the serving went.

    ``trips``: how often the component in the controller dropped the correction while it ran.
    """

    trace: Trace
    status: ServeStatus
    trips: int


class LiveCorrection:
    """Serves one bundle to a LinuxCNC, circle after circle."""

    def __init__(self, session: LinuxcncSession, bundle: Bundle) -> None:
        self.session = session
        self.decision = Decision(CompiledBundle(bundle), _NO_TOOL)
        self._sequence = 1

    def run(self, circle: Circle) -> LiveTrace:
        """Run one circle with the correction.

        Raises ``DeviceError`` when the link fails or the correction did not return to zero.
        """
        statuses: list[ServeStatus] = []
        with Bridge(self.session.socket_path) as bridge:
            link = LinuxcncLink(bridge)
            before = int(bridge.ask(do="get", pin="correction.trips")["value"])

            def serve(begin: Callable[[], None], ended: Callable[[], bool]) -> None:
                statuses.append(self._serve(link, begin, ended))
                while not ended():
                    time.sleep(_POLL_S)

            (trace,) = run_circles(self.session, [circle], serve)
            trips = int(bridge.ask(do="get", pin="correction.trips")["value"]) - before
        (status,) = statuses
        if status.fault or not status.released:
            raise DeviceError("serving failed", code="linuxcnc.served", got=str(status.fault or status.ended))
        return LiveTrace(trace, status, trips)

    def _serve(self, link: LinuxcncLink, begin: Callable[[], None], ended: Callable[[], bool]) -> ServeStatus:
        self.decision.reset()
        self.decision.guard.reset()
        begun_s = 0.0

        def stop() -> bool:
            nonlocal begun_s
            if not begun_s:
                # Only now: the loop may need a second to lock its memory, which is part of a circle.
                begin()
                begun_s = time.monotonic()
            if link.circles_seen:
                return not link.in_circle
            # LinuxCNC's status can keep a busy computer waiting: it is asked only when nothing comes.
            return time.monotonic() - begun_s > _PATIENCE_S and ended()

        loop = ServingLoop(self.decision, link, period_s=PERIOD_S, first_sequence=self._sequence)
        # Where real-time priority is allowed it would starve the controller, which has none.
        status = loop.run(_LONGEST_S, stop=stop, priority=0)
        self._sequence = status.last_sequence + 1
        return status


def measure_live(
    session: LinuxcncSession, bundle: Bundle, circles: Sequence[Circle], progress: Progress = silent
) -> list[LiveTrace]:
    """Run circles, in order, with a correction served live."""
    live = LiveCorrection(session, bundle)
    out = []
    for done, circle in enumerate(circles, start=1):
        out.append(live.run(circle))
        progress(done, len(circles), named(circle))
    return out


def named(circle: Circle) -> str:
    """Return a short name of a circle."""
    return f"{circle.plane} R{circle.radius_mm:g} F{circle.feed_mm_min:g} {circle.direction}"


def served_figures(measured: Sequence[LiveTrace]) -> dict[str, Any]:
    """Return how serving went over several circles."""
    acted: dict[str, int] = {}
    for figures in measured:
        for reason, count in figures.status.reasons.items():
            acted[reason] = acted.get(reason, 0) + count
    return {
        "circles": len(measured),
        # Latched, or dropped by the controller: not corrected throughout.
        "interrupted": sum(bool(m.trips or m.status.reasons.get("latched")) for m in measured),
        "acted": acted,
        "watchdog_trips": sum(m.trips for m in measured),
        "largest_um": max((m.status.largest_um for m in measured), default=0.0),
    }
