"""What an engine adds to the diagnosis of many campaigns, and what more workers take off.

One lake of ``--campaigns`` ball-bar campaigns, of 18 runs each or with ``--everyday`` of six at one feed, is diagnosed
from nothing by the plain loop, by ``dtwin fleet`` in line, with two processes, and by one and two workers of a Dask
scheduler on this computer. ``wall_s`` is by the
clock, workers started before; ``cpu_s`` of all processes that worked; ``peak_mb`` of the largest Dask worker, else of this process.
Every engine must keep the same bytes, else the benchmark fails. Leave the host alone meanwhile.

Run: python benchmarks/bench_fleet.py [--campaigns 100] [--everyday] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.config import Home
from dtwin.fleet.jobs import DIAGNOSE
from dtwin.fleet.run import run_fleet
from dtwin.lake.store import Lake
from dtwin.schema import Campaign, Run, RunMeta

Measured = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--campaigns", type=int, default=100)
    parser.add_argument("--everyday", action="store_true", help="campaigns of six runs at one feed")
    parser.add_argument(
        "--dask-only", action="store_true", help="the plain loop and Dask, neither in line nor processes"
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    chosen = parser.parse_args()
    count = 4 if chosen.short else chosen.campaigns
    runs = 6 if chosen.everyday else 18
    with tempfile.TemporaryDirectory() as folder:
        rows = list(_measured(Path(folder), count, runs, dask_only=chosen.dask_only))
    plain = rows[0]
    for row in rows:
        row["of_plain"] = row["wall_s"] / plain["wall_s"]
    if chosen.json:
        print(json.dumps({"campaigns": count, "runs": runs, "rows": rows}))
        return
    print(f"{count} campaigns of {runs} runs")
    print("| how | wall s | of the plain loop | CPU s | peak MB |\n|---|---|---|---|---|")
    for r in rows:
        print(f"| {r['how']} | {r['wall_s']:.1f} | {r['of_plain']:.2f} | {r['cpu_s']:.1f} | {r['peak_mb']:.0f} |")


def _measured(folder: Path, count: int, runs: int, *, dask_only: bool) -> Iterator[Measured]:
    home = Home(folder / "home")
    lake = Lake(home.lake)
    for number in range(count):
        lake.commit(
            Campaign(f"c{number:05d}", f"m{number % 20}", "circular", "2026-01-05T08:00:00Z", {}), _runs(number)[:runs]
        )
    # Reduced runs are kept by the first that reads them: for all alike.
    run_fleet(home, DIAGNOSE, workers=2)

    def plain() -> None:
        for unit in DIAGNOSE.units(home, ())[0]:
            DIAGNOSE.keep(home, unit, DIAGNOSE.work(str(home.root), unit, 0))

    yield _once("plain loop", plain, home)
    kept = _kept(home)
    if not dask_only:
        yield _same(kept, home, _once("in line", lambda: run_fleet(home, DIAGNOSE, workers=1), home))
        yield _same(kept, home, _once("two processes", lambda: run_fleet(home, DIAGNOSE, workers=2), home))
    for workers in (1, 2):
        with _plant(folder, workers) as (address, pids):
            name = f"Dask, {workers} worker{'s' * (workers > 1)}"
            row = _once(name, lambda at=address: run_fleet(home, DIAGNOSE, on=at), home, pids)  # type: ignore[misc]
            yield _same(kept, home, row)


def _runs(number: int) -> list[Run]:
    """Circles at three feeds, one after the other, both ways, three times, with squareness, backlash and a lag that grows with the feed."""
    rng = np.random.default_rng(number)
    runs = []
    for index in range(18):
        feed, way = (500.0, 1500.0, 3000.0)[index // 6], 1.0 if index % 2 else -1.0
        turn = np.linspace(0.0, 720.0, 1500, endpoint=False)
        theta = np.radians(way * turn)
        error = 2.0 * np.sin(2.0 * theta) - 1.5 * np.sign(way * np.sin(theta)) * np.cos(theta) - feed / 2000.0
        samples = {"t_s": turn * 100.0 * np.pi / 180.0 / feed * 60.0, "angle_deg": way * turn}
        samples["deviation_um"] = error + rng.normal(0.0, 0.3, turn.size)
        meta = RunMeta(
            f"r{index:02d}",
            plane="XY",
            direction="CCW" if way > 0.0 else "CW",
            radius_mm=100.0,
            feed_mm_min=feed,
            repeat=index % 6 // 2 + 1,
            setup="a",
            sample_rate_hz=1500.0 / float(samples["t_s"][-1]),
        )
        runs.append(Run(meta, samples))
    return runs


def _once(how: str, work: Callable[[], object], home: Home, pids: tuple[int, ...] = ()) -> Measured:
    shutil.rmtree(home.root / "kept", ignore_errors=True)
    before = _cpu_s(pids)
    begun = time.perf_counter()
    work()
    wall_s = time.perf_counter() - begun
    # Of workers alone where they are known: this process holds the lake's runs besides.
    peak_mb = max(_peak_mb(pid) for pid in (pids or (os.getpid(),)))
    return {"how": how, "wall_s": wall_s, "cpu_s": _cpu_s(pids) - before, "peak_mb": peak_mb}


def _cpu_s(pids: tuple[int, ...]) -> float:
    own = sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own + sum(_ticks(pid) for pid in pids) / os.sysconf("SC_CLK_TCK")


def _ticks(pid: int) -> int:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])


def _peak_mb(pid: int) -> float:
    status = Path(f"/proc/{pid}/status").read_text()
    return float(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))) / 1024.0


def _kept(home: Home) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in (home.root / "kept").rglob("*.json")}


def _same(kept: dict[str, bytes], home: Home, row: Measured) -> Measured:
    if _kept(home) != kept:
        raise SystemExit(f"{row['how']}: what was kept is not what the plain loop keeps")
    return row


@contextmanager
def _plant(folder: Path, workers: int) -> Iterator[tuple[str, tuple[int, ...]]]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    log = folder / "scheduler.log"
    names: list[tuple[str, ...]] = [("scheduler", "--port", str(port))]
    names += [("worker", f"tcp://127.0.0.1:{port}", "--nthreads", "1", "--no-nanny")] * workers
    started = []
    try:
        with log.open("w") as out:
            for words in names:
                command = [sys.executable, "-m", "dask", *words, "--host", "127.0.0.1", "--no-dashboard"]
                # As docs/how-to/fleet.md starts them.
                env = {**os.environ, "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "false"}
                started.append(subprocess.Popen(command, stdout=out, stderr=out, cwd=folder, env=env))
        until = time.monotonic() + 60.0
        while log.read_text().count("Register worker") < workers:
            if time.monotonic() > until:
                raise SystemExit(f"no workers: {log.read_text()}")
            time.sleep(0.05)
        yield f"dask://127.0.0.1:{port}", tuple(process.pid for process in started[1:])
    finally:
        for process in started:
            process.send_signal(signal.SIGKILL)
            process.wait()


if __name__ == "__main__":
    main()
