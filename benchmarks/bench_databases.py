"""What a command, a page and a flow cost while the databases of MLflow and Prefect grow over years.

Versions of twins of ``--twins`` machines are written by the shelf and logged by the process that logs them after every fit; runs of a
flow are told to Prefect as ended. At every size of ``--sizes`` one more twin is fitted and logged, a history is told, models are listed, pages
are asked of a real server, and a flow takes in a campaign, each by a new process. Time of processor
(user and system) and peak memory are of that process and its children; pages are asked by the clock, so leave the host alone meanwhile.

Run: python benchmarks/bench_databases.py [--sizes 10,100,1000] [--home FOLDER] [--json]
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

from bench_growth import answers, told, used

from dtwin.acquire.ingest import ingest
from dtwin.config import Home
from dtwin.lake.store import Lake
from dtwin.train.registry import Registry
from dtwin.twins.registration import log_waiting
from dtwin.twins.shelf import PATHS, TwinShelf

CAMPAIGN = "mill-backlash"
PAGES = ("/twins", "/twins/t000", "/models")
_FLOW_RUNS = """
import sys
from dtwin.config import home
from prefect.client.orchestration import get_client
from prefect.states import Completed
from flows._runtime import runtime
from flows.ingest import ingest_flow
with runtime(home()), get_client(sync_client=True) as client:
    for number in range(int(sys.argv[1])):
        client.create_flow_run(ingest_flow, parameters={"sources": []}, state=Completed())
"""
_INGEST = """
import sys
from flows._runtime import run
from flows.ingest import ingest_flow
run(ingest_flow, sources=[sys.argv[1]])
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="10,100,1000", help="versions of twins, and runs of a flow, rising")
    parser.add_argument("--twins", type=int, default=200)
    parser.add_argument("--home", type=Path, help="a folder that is kept, and gone on with when it is there")
    parser.add_argument("--repeats", type=int, default=20, help="of every page")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    chosen = parser.parse_args()
    sizes = [2, 4] if chosen.short else [int(n) for n in chosen.sizes.split(",")]
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as made, nullcontext(chosen.home or made) as folder:
        home, source = Home(Path(folder) / "home"), Path(folder) / "mill"
        # The working directory is no home: flows may read what lies in the home alone.
        if not source.exists():
            used(home, "simulate", "--machine", "mill", "--out", str(source), "--quick")
            shutil.copytree(source, home.root / "mill")
            ingest(source, Lake(home.lake))
            used(home, "twin", "fit", CAMPAIGN, "--effects", "squareness", "--name", "first", at_once=True)
        for size in sizes:
            spent = grown(home, size, min(chosen.twins, size))
            rows.append({"size": size, **spent, **measured(home, size, 2 if chosen.short else chosen.repeats)})
            if not chosen.json:
                print(*(f"{name} {value}" for name, value in rows[-1].items()), sep="; ", flush=True)
    told(rows, as_json=chosen.json)


def grown(home: Home, size: int, twins: int) -> dict[str, float]:
    """Bring the databases to a size; return what logging each further version cost, nothing where there was none."""
    shelf = TwinShelf(home, PATHS)
    document, _ = shelf.newest_document("first")
    there = sum(shelf.next_version(name, document["machine"]) - 1 for name in shelf.names() if name.startswith("t"))
    began = time.process_time()
    # Each store would start a process of its own: all are logged at once after it.
    with mock.patch("dtwin.twins.shelf.log_soon"):
        for number in range(there, size):
            name = f"t{number % twins:03d}"
            shelf.store({**document, "twin": name, "version": shelf.next_version(name, document["machine"])})
    left = log_waiting(home)
    if left:
        raise SystemExit(f"MLflow did not take {left[0].label}: {left[0].failed}")
    if size <= there:
        return {}
    version_ms = 1e3 * (time.process_time() - began) / (size - there)
    used(home, str(size - there), program=("-c", _FLOW_RUNS))
    return {"logging a version, ms": round(version_ms, 1)}


def measured(home: Home, size: int, repeats: int) -> dict[str, Any]:
    """Return seconds of processor and the largest memory, in MB, of processes, and answers of pages in ms."""
    fit = ["twin", "fit", CAMPAIGN, "--effects", "squareness,scale_mismatch", "--name", f"new-{size}"]
    found: dict[str, Any] = {}

    def note(name: str, spent: tuple[float, float]) -> None:
        found[f"{name}_s"], found[f"{name}_mb"] = round(spent[0], 2), round(spent[1])

    note("fit_and_log", used(home, *fit, at_once=True))
    note("history", used(home, "twin", "history", "t000"))
    note("models", used(home, "models"))
    note("flow", used(home, str(home.root / "mill"), program=("-c", _INGEST)))
    found |= answers(home, PAGES, repeats)
    databases = {"mlflow": Path(Registry(home).uri.removeprefix("sqlite:///")), "prefect": home.prefect / "prefect.db"}
    return {**found, **{f"{name}.db MB": round(path.stat().st_size / 1e6, 1) for name, path in databases.items()}}


if __name__ == "__main__":
    main()
