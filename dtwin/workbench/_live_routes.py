"""Page of the serving loop: what runs, how its sessions went, and the way to stop it."""

from __future__ import annotations

import json
import math
import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from fastapi import APIRouter, Request
from starlette.responses import JSONResponse, Response

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.report.live_plots import circle_figure, correction_figure, waiting_figure
from dtwin.report.model_plots import jitter_figure
from dtwin.report.text import counted
from dtwin.serve._lease import is_leased
from dtwin.serve.live_board import COLUMNS, RECENT_S, Seen, live_state, read_board
from dtwin.serve.served_time import events_path, never_released
from dtwin.workbench._bench import Here, bench_of
from dtwin.workbench._pages import drawn, rendered, when

router = APIRouter()
_NEWEST = 20
_TAIL_BYTES = 2_000_000
_EVENTS = ".events.jsonl"
_SHOWN_S, _DRAWN_EVERY_S = 20.0, 0.5
_BAND = slice(COLUMNS.index("band_x_um"), COLUMNS.index("band_z_um") + 1)
# What the page shows of every session.
_TRIPS = {
    "stale": "the state of the machine came too late",
    "stale_window": "the windows of the accelerometers came too late",
    "not_finite": "what came was no number",
    "impossible_state": "what came was no state of a machine",
    "clock_jump": "the controller's clock jumped",
}
"""What counts towards a latch, in words."""
_WHOLE = {"started", "duration_s", "ended", "clamp_um", "largest_um", "reasons"}
_CORRECTION = slice(COLUMNS.index("correction_x_um"), COLUMNS.index("correction_z_um") + 1)


@dataclass(frozen=True)
class _Serving:
    """A process that serves a machine now. ``since``: ISO 8601."""

    machine: str
    pid: int
    since: str


@router.get("/live")
def live_page(request: Request, bench: Here) -> Response:
    """Show what is served now, and the sessions that ended."""
    home = bench.home
    serving = _servings(home)
    silent = _never_ended(home)
    served = {s.machine for s in serving}
    begun = {m: last.isoformat() for m, (_, last) in silent.items() if last is not None and m not in served}
    # In another container a process holds its machine as well, and the kernel does not list it here.
    unseen = {machine for machine in begun if is_leased(machine, home)}
    return rendered(
        request,
        "live.html",
        title="Live",
        serving=serving,
        dead={machine: at for machine, at in begun.items() if machine not in unseen},
        unseen={machine: begun[machine] for machine in sorted(unseen)},
        states={s.machine: live_state(_board(s, home), time.monotonic()) for s in serving},
        seen=_seen(home),
        sessions=_listed(sessions(home), silent),
        events={s.machine: _newest_lines(events_path(home, s.machine))[::-1] for s in serving},
    )


@router.get("/api/live")
def live(bench: Here) -> dict[str, Any]:
    """Return what is served now, and the newest session of every machine."""
    return _seen(bench.home)


def _seen(home: Home) -> dict[str, Any]:
    return {
        "serving": [vars(s) for s in _servings(home)],
        "sessions": [{k: s[k] for k in ("machine", "started", "ended")} for s in sessions(home)],
    }


@router.get("/api/live/{machine}/now")
def now(bench: Here, machine: str) -> dict[str, Any]:
    """Return what a machine that is served does now, and the figures of the newest seconds when its loop shows them."""
    home = bench.home
    serving = _serving(home, machine)
    if serving is None:
        raise _none(machine)
    seen = _board(serving, home)
    state = live_state(seen, time.monotonic())
    if seen is None or not seen.ticks:
        return {"state": state.as_dict(), "ticks": 0}
    return {
        "state": state.as_dict(),
        "ticks": seen.ticks,
        "late_or_missed": (seen.late + seen.missed) / (seen.ticks + seen.missed),
        "clamp_um": seen.clamp_um,
        "reasons": {n: c for n, c in seen.reasons.items() if n not in ("ok", "disabled")},
        # Of a loop that shows no new tick they were true once.
        **({} if state.word == "silent" else _newest_figures(seen)),
    }


def _newest_figures(seen: Seen) -> dict[str, Any]:
    """Return the figures of the newest seconds, and the correction of the newest tick."""
    recent = seen.newest(RECENT_S)
    # The interval of the first tick was before: with it, a stall of a minute made a rate of nothing.
    interval, age = seen.column("interval_s")[recent][1:], seen.column("age_s")[recent]
    interval = interval[np.isfinite(interval)]
    return {
        "rate_hz": 1.0 / float(interval.mean()) if len(interval) and interval.mean() > 0.0 else None,
        "age_ms": [1e3 * float(v) for v in np.percentile(age, (50, 99))],
        "jitter_us_p99": 1e6 * float(np.percentile(np.abs(interval - seen.period_s), 99)) if len(interval) else None,
        "correction_um": seen.rows[-1, _CORRECTION].tolist(),
        "band_um": [v if math.isfinite(v) else None for v in seen.rows[-1, _BAND].tolist()],
    }


@router.get("/api/live/{machine}/correction")
def correction(request: Request, machine: str) -> Response:
    """Return the corrections of the newest seconds."""

    def draw(seen: Seen) -> go.Figure:
        rows = seen.rows[seen.newest(_SHOWN_S)]
        t_s = rows[:, 0] - rows[-1, 0]
        return correction_figure(t_s, rows[:, _CORRECTION], seen.clamp_um, rows[:, _BAND])

    return _moving(request, machine, draw)


@router.get("/api/live/{machine}/circle")
def circle(request: Request, machine: str) -> Response:
    """Return the newest circle with and without the correction."""

    def draw(seen: Seen) -> go.Figure:
        at = COLUMNS.index("actual_x_mm")
        position, centre, radius = np.split(seen.rows[:, at : at + 7], [3, 6], axis=1)
        figure = circle_figure(position, centre, radius[:, 0], seen.rows[:, _CORRECTION])
        told = "no whole circle was seen yet" if radius.any() else "this machine goes round no circle now"
        return figure or waiting_figure(told)

    return _moving(request, machine, draw)


def _moving(request: Request, machine: str, draw: Callable[[Seen], go.Figure]) -> Response:
    """Return a picture of a loop that runs: one for all pages that ask within a while, for drawing takes the loop's processors."""
    bench = bench_of(request)

    def make() -> bytes:
        serving = _serving(bench.home, machine)
        seen = None if serving is None else _board(serving, bench.home)
        if seen is None or not seen.ticks:
            raise _none(machine)
        return bytes(drawn(draw(seen)).body)

    key = (request.url.path, int(time.monotonic() / _DRAWN_EVERY_S))
    return Response(bench.live.get(key, make), media_type="application/json")


def _none(machine: str) -> InputError:
    return InputError(
        "no loop of this machine shows its figures", code="live.none", got=machine[:80], hint="reload the page"
    )


@router.get("/api/live/{machine}/jitter")
def jitter(bench: Here, machine: str, started: str) -> Response:
    """Return the jitter of the session that began at a time."""
    for session in sessions(bench.home):
        if (session["machine"], session.get("started")) == (machine, started) and session.get("timing"):
            figure: go.Figure = jitter_figure(session["timing"]["jitter_us_histogram"])
            return drawn(figure)
    raise InputError("no such session", code="page.unknown", got=f"{machine} {started}"[:100])


def _outside_share(session: Mapping[str, Any]) -> float:
    """Return the share of a session's ticks outside the model's range; 0 when its log does not say."""
    ticks = (session.get("timing") or {}).get("ticks") or 0
    return (session.get("reasons") or {}).get("outside_box", 0) / ticks if ticks else 0.0


def _latched_by(session: Mapping[str, Any]) -> str:
    """Return in words which faults a session latched for; empty when it did not."""
    reasons = session.get("reasons") or {}
    told = [f"{said} ({counted(reasons[name], 'tick')})" for name, said in _TRIPS.items() if reasons.get(name)]
    return "; ".join(told) if session.get("ended") == "latched" else ""


@router.post("/api/live/{machine}/stop")
def stop(bench: Here, machine: str) -> JSONResponse:
    """Ask the server of a machine to release its correction and end, as Ctrl-C does."""
    serving = _serving(bench.home, machine)
    if serving is not None:
        os.kill(serving.pid, signal.SIGINT)
        return JSONResponse({"stopped": serving.pid})
    raise InputError("nothing serves this machine now", code="live.none", got=machine[:80], hint="reload the page")


def _serving(home: Home, machine: str) -> _Serving | None:
    """Return the process that holds the lease of a machine."""
    return next((s for s in _servings(home) if s.machine == machine), None)


def _board(serving: _Serving, home: Home) -> Seen | None:
    """Return what a process shows; a board that one before it left behind, when it was killed, is none of its own."""
    seen = read_board(serving.machine, home)
    return seen if seen is not None and seen.pid == serving.pid else None


def _servings(home: Home) -> list[_Serving]:
    """Return the processes that hold a machine's lease.

    The lock itself is not touched: taking it even for a moment could refuse a server that
    starts.
    """
    held = _locked_inodes()
    servings = []
    for path in sorted((home.root / "locks").glob("machine-*.lock")):
        try:
            note = json.loads(path.read_text(encoding="utf-8"))
            pid, since = int(note["pid"]), str(note["since"])
            holder = held.get(path.stat().st_ino)
        except (OSError, ValueError, KeyError, TypeError):
            continue
        if holder == pid and pid > 1:
            servings.append(_Serving(path.stem.removeprefix("machine-"), pid, since))
    return servings


def sessions(home: Home) -> list[dict[str, Any]]:
    """Return the newest sessions of every machine as their logs state them, newest first.

    A log grows at its end: of one machine its order counts, also where the clock was set back between two sessions.
    """
    lines: list[tuple[str, int, dict[str, Any]]] = []
    for path in sorted(home.logs.glob("serve-*.jsonl")):
        if path.name.endswith(_EVENTS):
            continue
        machine = path.stem.removeprefix("serve-")
        latest = ""
        for number, line in enumerate(filter(_is_whole, _newest_lines(path))):
            latest = max(latest, line["started"])
            lines.append((latest, number, {"machine": machine, **line}))
    return [line for _, _, line in sorted(lines, key=lambda told: told[:2], reverse=True)]


def _is_whole(line: Mapping[str, Any]) -> bool:
    """Tell whether a line of a log is a session's, not what is left of one, or of another version."""
    timing = line.get("timing") or {"late_share": 0.0}
    texts = isinstance(line.get("started"), str) and isinstance(line.get("ended"), str)
    tables = isinstance(timing, dict) and isinstance(line.get("reasons"), dict)
    return texts and tables and line.keys() >= _WHOLE and "late_share" in timing


def _never_ended(home: Home) -> dict[str, tuple[list[datetime], datetime | None]]:
    """Return when sessions began that said nothing of their end, by machine, as ``never_released`` does."""
    paths = sorted(home.logs.glob(f"serve-*{_EVENTS}"))
    machines = [path.name.removeprefix("serve-").removesuffix(_EVENTS) for path in paths]
    return {machine: never_released(home, machine) for machine in machines}


def _listed(
    ended: Sequence[Mapping[str, Any]], silent: Mapping[str, tuple[Sequence[datetime], datetime | None]]
) -> list[dict[str, Any]]:
    """Return the sessions that ended, newest first, among them those without a word before the newest of their machine.

    ``seconds``: whether another one of the machine began in the same minute.
    """
    told = [{**s, "outside_share": _outside_share(s), "why": _latched_by(s)} for s in ended]
    for machine, (begun, _) in silent.items():
        for at in begun:
            started = at.isoformat()
            place = next((n for n, s in enumerate(told) if s["started"] <= started), len(told))
            told.insert(place, {"machine": machine, "started": started, "without_word": True})
    minutes = Counter((s["machine"], when(s["started"])) for s in told)
    return [{**s, "seconds": minutes[s["machine"], when(s["started"])] > 1} for s in told]


def _newest_lines(path: Path) -> list[Mapping[str, Any]]:
    if not path.is_file():
        return []
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - _TAIL_BYTES))
        lines = file.read().splitlines()
    newest: list[Mapping[str, Any]] = []
    for line in lines[-_NEWEST:]:
        try:
            said = json.loads(line)
        except (ValueError, RecursionError):
            # The first line may be cut.
            continue
        if isinstance(said, dict):
            newest.append(said)
    return newest


def _locked_inodes() -> dict[int, int]:
    """Return the process that holds the lock of each inode, as the kernel lists them."""
    holders = {}
    for line in Path("/proc/locks").read_text(encoding="ascii").splitlines():
        parts = line.split()
        if len(parts) >= 6 and parts[1] == "FLOCK":
            holders[int(parts[5].rsplit(":", 1)[-1])] = int(parts[4])
    return holders
