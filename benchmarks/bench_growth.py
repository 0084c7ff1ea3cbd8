"""What a command and a page cost in a lake that grows: campaigns of many machines over years.

Campaigns of 36 ball-bar runs are committed to one lake, of ``--machines`` machines in turn, a day apart; ``--together`` in one
commit, each in files of its own, as if ingested alone, so that a large lake takes minutes.
At every size of ``--campaigns`` one more is measured, ingested, listed, fitted and diagnosed by commands, each a new
process, and pages are asked of a real server. Time of processor (user and system) and peak memory are of the
command alone; pages are asked by the clock, so leave the host alone meanwhile.

Run: python benchmarks/bench_growth.py [--campaigns 10,100,1000] [--home FOLDER] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from bench_workbench import asked, entered, made_runs

from dtwin.acquire.ingest import ingest
from dtwin.config import Home
from dtwin.lake._admission import accepted
from dtwin.lake.rows import RUN_SCHEMA, sealed
from dtwin.lake.store import Lake
from dtwin.schema import Campaign, Run

RUNS = 36
START = datetime(2016, 1, 4, 8, tzinfo=UTC)
_WATCHED = """
import resource, subprocess, sys
code = subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(code, used.ru_utime + used.ru_stime, used.ru_maxrss)
"""
PAGES = ("/machines", "/machines/m001", "/campaigns", "/campaigns/c00001", "/campaigns/c00001/runs/r0001", "/twins")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--campaigns", default="10,100,1000", help="sizes of the lake, rising")
    parser.add_argument("--machines", type=int, default=200)
    parser.add_argument("--together", type=int, default=20, help="campaigns in one commit")
    parser.add_argument("--home", type=Path, help="a folder that is kept, and gone on with when it is there")
    parser.add_argument("--repeats", type=int, default=20, help="of every page")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    chosen = parser.parse_args()
    sizes = [2, 4] if chosen.short else [int(n) for n in chosen.campaigns.split(",")]
    repeats = 2 if chosen.short else chosen.repeats
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as made, nullcontext(chosen.home or made) as folder:
        home, source = Home(Path(folder) / "home"), Path(folder) / "mill"
        if not source.exists():
            used(home, "simulate", "--machine", "mill", "--out", str(source), "--quick")
            ingest(source, Lake(home.lake))
            # The first version of a twin pays for MLflow's tables.
            used(home, "twin", "fit", "mill-backlash", "--effects", "squareness", "--name", "first")
        base, at = made_runs(RUNS), sum(name.startswith("c") for name in Lake(home.lake).campaigns())
        for size in sizes:
            for number in range(at, size, chosen.together):
                commit(Lake(home.lake), base, range(number, min(number + chosen.together, size)), chosen.machines)
            at = max(at, size)
            rows.append({"campaigns": size, **measured(home, source, size, repeats), **weight(home)})
            if not chosen.json:
                print(*(f"{name} {value}" for name, value in rows[-1].items()), sep="; ", flush=True)
    told(rows, as_json=chosen.json)


def told(rows: Sequence[Mapping[str, Any]], *, as_json: bool) -> None:
    """Print how the seconds of the last size stand to those of the first; as JSON with all rows."""
    ratios = {name: round(float(rows[-1][name]) / float(rows[0][name]), 2) for name in rows[0] if name.endswith("_s")}
    if as_json:
        print(json.dumps({"sizes": rows, "last_to_first": ratios}))
    else:
        print("the last size to the first:", *(f"{name} {ratio}" for name, ratio in ratios.items()))


def commit(lake: Lake, base: list[Run], numbers: range, machines: int) -> None:
    """Commit campaigns of their own readings, each in its own files, all in one step."""
    samples, files, table = [], [], lake.tables["runs"]
    for number in numbers:
        rng = np.random.default_rng(number)
        started = (START + timedelta(days=number)).isoformat().replace("+00:00", "Z")
        campaign = Campaign(f"c{number:05d}", f"m{number % machines:03d}", started=started)
        runs = [
            replace(run, samples={**run.samples, "deviation_um": run.samples["deviation_um"] + rng.normal(0.0, 1.0)})
            for run in base
        ]
        rows = accepted(campaign, runs)
        samples.append(lake._write_data(runs, rows)[0])
        files.append(table.write(f"{campaign.name}/{campaign.machine}", sealed(list(rows.values()), RUN_SCHEMA)))
    with lake._lock():
        first = samples[0]
        first.table.commit([file for batch in samples for file in batch._written], first._schema)
        table.commit(files, table.accepted([RUN_SCHEMA]))


def weight(home: Home) -> dict[str, float]:
    """Return the size of the lake: megabytes, files, and those of them that are of logs."""
    files = [path for path in home.lake.rglob("*") if path.is_file()]
    logs = [path for path in files if path.parent.name == "_delta_log"]
    return {
        "lake MB": round(sum(path.stat().st_size for path in files) / 1e6, 1),
        "files": len(files),
        "log MB": round(sum(path.stat().st_size for path in logs) / 1e6, 1),
        "log files": len(logs),
    }


def measured(home: Home, source: Path, size: int, repeats: int) -> dict[str, Any]:
    """Return seconds of processor and the largest memory, in MB, of commands, and answers of pages in ms."""
    name = f"new-{size}"
    folder = source.parent / name
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(source, folder)
    stated = (source / "campaign.toml").read_text(encoding="utf-8")
    (folder / "campaign.toml").write_text(re.sub(r'(?m)^name = ".*"', f'name = "{name}"', stated, count=1))
    verbs = {
        "ingest": ["ingest", str(folder)],
        "runs": ["runs", name],
        "fit": ["twin", "fit", name, "--effects", "squareness,scale_mismatch", "--name", name],
        "diagnose": ["twin", "diagnose", name],
        "first_machine": ["machine", "show", "m001"],
        "machine": ["machine", "show", "m001"],
    }
    found: dict[str, Any] = {}
    for verb, words in verbs.items():
        seconds, memory_mb = used(home, *words)
        found[f"{verb}_s"], found[f"{verb}_mb"] = round(seconds, 2), round(memory_mb)
    return {**found, **answers(home, PAGES, repeats)}


def answers(home: Home, pages: Sequence[str], repeats: int) -> dict[str, dict[str, int]]:
    """Return how long pages take, in ms: the first answer of a server, and median and 95th percentile of further ones."""
    found = {}
    with server(home) as (address, cookie):
        for page in pages:
            first, _ = asked(address + page, cookie)
            times = [asked(address + page, cookie)[0] for _ in range(repeats)]
            found[f"{page} ms"] = {
                "first": round(first),
                "median": round(statistics.median(times)),
                "p95": round(float(np.percentile(times, 95))),
            }
    return found


def used(
    home: Home, *words: str, program: tuple[str, ...] = ("-m", "dtwin"), at_once: bool = False
) -> tuple[float, float]:
    """Return the seconds of processor and the peak memory, in MB, of a command; ``at_once``: it tells MLflow itself."""
    # A small process between: what a child counts as its peak begins with its parent's.
    done = subprocess.run(
        [sys.executable, "-c", _WATCHED, sys.executable, *program, *words],
        env={**os.environ, "DTWIN_HOME": str(home.root), "DTWIN_MLFLOW": "now" if at_once else "later"},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    code, seconds, memory_kb = done.stdout.split()
    if code != "0":
        raise SystemExit(f"{' '.join((program[-1], *words))} ended with {code}")
    return float(seconds), float(memory_kb) / 1024


@contextmanager
def server(home: Home) -> Iterator[tuple[str, str]]:
    """Run the workbench; give its address and the cookie that opens it."""
    process = subprocess.Popen(
        [sys.executable, "-m", "dtwin", "ui", "--no-browser"],
        env=os.environ | {"DTWIN_HOME": str(home.root)},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        yield entered(process.stdout.readline())
    finally:
        process.terminate()
        process.wait(30)


if __name__ == "__main__":
    main()
