"""Freezes of the loop, its driver and the machine's end: does a correction ever jump?

``dtwin serve`` corrects a machine's end with a constant; then it, the driver process, the machine's end or
several of them are stopped (SIGSTOP) for 2 ms to 5 s, at random, and go on. Judged is what the machine's end held,
by its own clock: a change is a failure when it is longer than the bundle's slew limit allows in one period, unless
the machine's own watchdog was leading to zero. So is a correction that does not come back.

Run: python benchmarks/freezes/run.py [--tries 40] [--link robot] [--short] [--seed 0] [--json]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from ends import SLEW_UM_S, End, Held, axis_control, axis_end, board_end, linuxcnc_client, linuxcnc_end, robot_end

from dtwin.config import Home
from dtwin.errors import MissingPart

LINKS: dict[str, Callable[[Home], AbstractContextManager[End]]] = {
    "robot": robot_end,
    "axes": partial(axis_end, clock="wall"),
    "axes, machine clock": partial(axis_end, clock="machine"),
    "analogue": board_end,
    "linuxcnc": linuxcnc_end,
}
SHORTEST_S, LONGEST_S = 0.002, 5.0
_COMES_BACK_S, _AFTER_S = 60.0, 0.3


def jumps(held: Held, step_um: float, lost: bool) -> tuple[int, float]:
    """Return how many changes were longer than a step, and the longest of those not of the end's own.

    Args:
        held: What the machine's end held.
        step_um: What the slew limit allows in one period, with what the output can resolve.
        lost: Whether the link was lost: then the machine's end, or the driver's last word, releases at once.
    """
    if len(held.value_um) < 2:
        return 0, 0.0
    before, after = held.value_um[:-1], held.value_um[1:]
    length = np.linalg.norm(after - before, axis=1)
    shrinks = (np.abs(after) <= np.abs(before)).all(axis=1) & (after * before >= 0.0).all(axis=1)
    counts = ~((held.own[1:] | (held.zeros[1:] & lost)) & shrinks)
    longest = float(length[counts].max(initial=0.0))
    return int((length[counts] > step_um * (1.0 + 1e-6)).sum()), longest


def noted(home: Home) -> Counter[str]:
    """Return how often the journal has each event."""
    lines = [line for path in home.logs.glob("*.events.jsonl") for line in path.open("rb")]
    return Counter(str(json.loads(line)["event"]) for line in lines if line.endswith(b"\n"))


def frozen(pids: list[int], gap_s: float) -> None:
    """Stop processes for a time."""
    try:
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        time.sleep(gap_s)
    finally:
        for pid in pids:
            # A driver that hangs for seconds is ended by its host.
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)


def wait(holds: Callable[[], bool]) -> bool:
    """Wait until something holds; tell whether it did in time."""
    until_s = time.monotonic() + _COMES_BACK_S
    while not holds():
        if time.monotonic() > until_s:
            return False
        time.sleep(0.01)
    return True


def measure(link: str, tries: int, seed: int) -> dict[str, Any]:
    """Freeze a link so often; return counts of failures and what the journal said."""
    rng = np.random.default_rng([seed, sorted(LINKS).index(link)])
    found: Counter[str] = Counter()
    longest_um, period_s = 0.0, 0.0
    with tempfile.TemporaryDirectory(prefix="dtwin-frz-") as folder:
        home = Home(Path(folder))
        with LINKS[link](home) as end:
            period_s = end.period_s
            step_um = SLEW_UM_S * end.period_s + end.quantum_um
            found["never corrected"] += not wait(end.corrected)
            end.held()
            for number in range(tries):
                choice = end.processes()
                whom = list(choice)[number % len(choice)]
                gap_s = float(np.exp(rng.uniform(np.log(SHORTEST_S), np.log(LONGEST_S))))
                # Not always at the same moment of a period.
                time.sleep(float(rng.uniform(0.0, 0.02)))
                before = noted(home)["link_lost"]
                frozen(choice[whom], gap_s)
                # It was corrected before, too: what comes of the freeze takes its time.
                time.sleep(_AFTER_S)
                found["not come back"] += not wait(end.corrected)
                lost = noted(home)["link_lost"] > before
                count, one_um = jumps(end.held(), step_um, lost)
                found[f"jumps, {whom}"] += count > 0
                found[f"tries, {whom}"] += 1
                longest_um = max(longest_um, one_um)
        found.update({f"journal: {event}": count for event, count in noted(home).items()})
    failures = sum(n for name, n in found.items() if name.startswith(("jumps", "not", "never")))
    return {
        "tries": tries,
        "failures": failures,
        "allowed_um": step_um,
        "longest_um": longest_um,
        "period_ms": 1e3 * period_s,
        **found,
    }


def show(result: dict[str, dict[str, Any]]) -> None:
    for link, one in result.items():
        if "skipped" in one:
            print(f"{link}: skipped: {one['skipped']}")
            continue
        print(
            f"{link}: {one['tries']} freezes, {one['failures']} failures; longest change "
            f"{one['longest_um']:.3f} µm, allowed {one['allowed_um']:.3f} µm in {one['period_ms']:g} ms"
        )
        print(
            "  " + ", ".join(f"{k} {v}" for k, v in sorted(one.items()) if k[:7] in ("jumps, ", "tries, ", "journal"))
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tries", type=int, default=40, help="freezes of each link")
    parser.add_argument("--link", action="append", choices=LINKS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--short", action="store_true", help="a few freezes only")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--axis-control", help=argparse.SUPPRESS)
    parser.add_argument("--linuxcnc-client", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--home", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.axis_control:
        axis_control(Home(chosen.home), chosen.axis_control)
        return
    if chosen.linuxcnc_client:
        linuxcnc_client(Home(chosen.home), chosen.linuxcnc_client)
        return
    result: dict[str, dict[str, Any]] = {}
    for link in chosen.link or LINKS:
        try:
            result[link] = measure(link, 8 if chosen.short else chosen.tries, chosen.seed)
        except MissingPart as error:
            result[link] = {"skipped": str(error), "failures": 0}
    print(json.dumps(result)) if chosen.json else show(result)
    raise SystemExit(int(any(one["failures"] for one in result.values())))


if __name__ == "__main__":
    main()
