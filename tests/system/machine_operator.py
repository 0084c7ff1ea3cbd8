"""An operator: reads the desk of a campaign folder, does what it says, saves the instrument's file.

A process of its own, as a person is. It interprets the G-code that was handed out, moves one of the
virtual machines by it, and writes the ball bar's file slowly into the inbox. ``--spoil N`` loses the ball
in the N-th recording and answers ``repeat``; ``--answer-done`` says so instead of waiting.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from virtual_robot import virtual_robot

from dtwin.acquire.b5r import write_b5r
from dtwin.acquire.linuxcnc_circles import run_circles
from dtwin.acquire.linuxcnc_circles import run_of as run_of_trace
from dtwin.acquire.virtual import VirtualCobotBench, run_of
from dtwin.acquire.virtual_mill import virtual_mill
from dtwin.kinds.circular._evidence import CorrectedCircles
from dtwin.machines.cobot import CircleCondition
from dtwin.machines.linuxcnc.circles import Circle
from dtwin.machines.linuxcnc.instance import LinuxcncSession
from dtwin.machines.mill_parameters import CircularTest
from dtwin.pipeline.desk import DONE, REPEAT, _open_question, give_answer
from dtwin.plan import PlannedTest
from dtwin.schema import Direction, Plane, Run
from dtwin.serve.bundle_file import load_bundle

_PLANES: dict[str, Plane] = {"G17": "XY", "G18": "ZX", "G19": "YZ"}


@dataclass(frozen=True)
class Motion:
    """What a G-code program does."""

    plane: Plane
    radius_mm: float
    feed_mm_min: float
    directions: tuple[Direction, ...]


def interpreted(text: str) -> Motion:
    plane = next(_PLANES[word] for word in re.findall(r"G1[789]", text))
    feed = float(re.findall(r"G1 F([\d.]+)", text)[0])
    centre = re.findall(r"G[23] .*?([IJK])(-?[\d.]+) ([IJK])(-?[\d.]+)", text)[0]
    radius = float(np.hypot(float(centre[1]), float(centre[3])))
    words = re.findall(r"^G([23]) ", text, re.M)
    ways: list[Direction] = ["CCW" if word == "3" else "CW" for word in dict.fromkeys(words)]
    return Motion(plane, round(radius, 3), feed, tuple(ways))


Move = Callable[[Motion, int, str], list[Run]]


def cobot(held: ExitStack) -> Move:
    bench = VirtualCobotBench(0)

    def move(motion: Motion, number: int, bundle: str) -> list[Run]:
        runs = []
        for direction in motion.directions:
            if bundle:
                served = load_bundle(Path(bundle), "virtual-cobot").bundle
                condition = CircleCondition(motion.plane, motion.radius_mm, motion.feed_mm_min, direction)
                tcp = np.array([0.0, 0.0, bench.cobot.parameters.motion.tcp_z_mm])
                circles = CorrectedCircles(bench.cobot, served, tcp)
                found, _ = circles.measure(condition, "shop", 50 + number, "compensated")
                runs.append(run_of(found, direction.lower(), motion.plane, datetime.now(UTC)))
            else:
                test = PlannedTest("t001", motion.plane, motion.radius_mm, motion.feed_mm_min, 50 + number, "shop")
                runs.append(bench.measure(test, direction))
        return runs

    return move


def mill(held: ExitStack) -> Move:
    def move(motion: Motion, number: int, bundle: str) -> list[Run]:
        tests = [
            CircularTest(
                plane=motion.plane,
                direction=d,
                radius_mm=motion.radius_mm,
                feed_mm_min=motion.feed_mm_min,
                repeat=number,
                setup="shop",
            )
            for d in motion.directions
        ]
        # Another warm-up and other noise each time: a machine does nothing twice alike.
        return virtual_mill("backlash", seed=number).measure(tests)

    return move


def linuxcnc(held: ExitStack) -> Move:
    session = held.enter_context(LinuxcncSession(seed=1))

    def move(motion: Motion, number: int, bundle: str) -> list[Run]:
        circles = [Circle(motion.plane, motion.radius_mm, motion.feed_mm_min, d) for d in motion.directions]
        traces = run_circles(session, circles)
        return [run_of_trace(trace, "r", number, "shop", "") for trace in traces]

    return move


MACHINES: dict[str, Callable[[ExitStack], Move]] = {"cobot": cobot, "mill": mill, "linuxcnc": linuxcnc}


def save(path: Path, runs: list[Run], machine: str, *, spoilt: bool) -> None:
    """Write a ball-bar file the way a busy computer copies it onto a share."""
    whole = []
    for run in runs:
        n = len(run.samples["t_s"])
        window = run.window or (0, n - 1)
        samples = dict(run.samples)
        if spoilt:
            # The ball falls out of its cup half-way: the transducer stays at its stop.
            samples["deviation_um"] = np.where(np.arange(n) < n // 2, samples["deviation_um"], 1100.0)
        meta = replace(run.meta, started=run.meta.started or datetime.now(UTC).isoformat())
        whole.append(replace(run, meta=meta, samples=samples, window=window))
    made = path.with_name(f".{path.name}.made")
    write_b5r(made, whole, name=path.stem, machine=machine)
    content = made.read_bytes()
    made.unlink()
    with path.open("wb") as file:
        for part in range(4):
            file.write(content[part * len(content) // 4 : (part + 1) * len(content) // 4])
            file.flush()
            time.sleep(0.15)


def questions(folder: Path, until_s: float) -> Iterator[dict[str, Any]]:
    last = ""
    while time.monotonic() < until_s:
        found = _open_question(folder)
        if found is not None and found["id"] != last:
            last = found["id"]
            yield dict(found)
        time.sleep(0.1)


def main() -> int:
    options = argparse.ArgumentParser()
    options.add_argument("folder", type=Path)
    options.add_argument("inbox", type=Path)
    options.add_argument("--machine", choices=MACHINES, required=True)
    options.add_argument("--name", required=True)
    options.add_argument("--spoil", type=int, default=0)
    options.add_argument("--answer-done", action="store_true")
    given = options.parse_args()
    number, session = 0, None
    with ExitStack() as held:
        move = MACHINES[given.machine](held)
        host = ""
        for asked in questions(given.folder, time.monotonic() + 600.0):
            text = asked["text"]
            if session is not None and session.poll() is not None:
                # A busy computer may be too slow for the loop: it releases, and is started again.
                session = None
            if "start it now" in text and session is None:
                host = host or held.enter_context(virtual_robot("--feed-mm-min=3000")).host
                command = [
                    sys.executable,
                    "-m",
                    "dtwin",
                    "serve",
                    "--machine",
                    given.name,
                    "--model",
                    "trial",
                    "--host",
                    host,
                    "--priority=0",
                ]
                session = subprocess.Popen(command, stdout=subprocess.DEVNULL)
                held.callback(session.kill)
            elif "end dtwin serve now" in text and session is not None:
                session.send_signal(signal.SIGINT)
                session.wait()
                session = None
            elif asked["answers"] == [REPEAT, "keep"]:
                give_answer(given.folder, asked["id"], REPEAT)
            elif asked["programs"]:
                number += 1
                program = next(p for p in asked["programs"] if p.endswith(".nc"))
                motion = interpreted(Path(program).read_text(encoding="utf-8"))
                bundle = ""
                if session is not None:
                    home = Path(os.environ["DTWIN_HOME"])
                    (bundle,) = map(str, (home / "bundles" / given.name).glob("v*.json"))
                runs = move(motion, number, bundle)
                path = given.inbox / f"result-{number}.b5r"
                save(path, runs, given.name, spoilt=number == given.spoil)
                if given.answer_done:
                    give_answer(given.folder, asked["id"], DONE)
                print(json.dumps({"number": number, "served": bool(bundle)}), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
