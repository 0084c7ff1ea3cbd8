"""Processor time (user and system) of the verbs of a twin, a new process each, in a home that exists.

A quick campaign of the virtual mill, 36 runs with one hidden effect; medians of five twins. Beside it
the same with MLflow told before the command ends, as ``DTWIN_MLFLOW=now`` has it.

Then time by the clock of ``dtwin twin discover``, right after ``fit``, from nothing: machines of the exam with twelve
faults in 36 runs (row ``untold_12_noise_0.1``); each machine's time, for they differ.

Run: python benchmarks/bench_verbs.py [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "hidden_effect"))

from cases import ROWS, make_case

from dtwin.acquire.virtual_mill import write_runs
from dtwin.config import Home
from dtwin.twins.registration import waiting

KNOWN = "scale_mismatch,squareness"
VERBS = {
    "fit": ["fit", "mill-backlash", "--effects", KNOWN, "--name"],
    "compare": ["compare"],
    "diagnose": ["diagnose"],
    "add": ["add", "{twin}", "backlash", "--axis", "X"],
    "history": ["history"],
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        home = Home(Path(folder) / "home")
        campaign = str(Path(folder) / "mill")
        cpu_s(home, "later", "simulate", "--machine", "mill", "--out", campaign, "--quick")
        cpu_s(home, "later", "ingest", campaign)
        # The first version of a home pays for MLflow's tables.
        cpu_s(home, "now", "twin", *VERBS["fit"], "first")
        found = {when: measured(home, when, 1 if chosen.short else 5) for when in ("later", "now")}
        found["discover"] = discovered_s(home, Path(folder), 1 if chosen.short else 5)
    if chosen.json:
        print(json.dumps(found))
        return
    for verb in VERBS:
        print(f"{verb:9s} {found['later'][verb]:.2f} s, MLflow at once {found['now'][verb]:.2f} s")
    print("discover ", ", ".join(f"{spent:.1f}" for spent in found["discover"].values()), "s by the clock")


def measured(home: Home, when: str, twins: int) -> dict[str, float]:
    times_s: dict[str, list[float]] = {verb: [] for verb in VERBS}
    for number in range(twins):
        twin = f"{when}-{number}"
        for verb, words in VERBS.items():
            named = [word.format(twin=twin) for word in words]
            named += [] if "{twin}" in words else [twin]
            times_s[verb].append(cpu_s(home, when, "twin", *named))
            while waiting(home):
                # The process in the background is not to take the verb's processor.
                time.sleep(0.1)
    return {verb: round(statistics.median(t), 2) for verb, t in times_s.items()}


def discovered_s(home: Home, folder: Path, machines: int) -> dict[str, float]:
    times_s: dict[str, float] = {}
    for number in range(machines):
        case = make_case(ROWS["untold_12_noise_0.1"], number)
        name = f"twelve-{number}"
        write_runs(folder / name, replace(case.campaign, name=name), case.runs)
        cpu_s(home, "later", "ingest", str(folder / name))
        cpu_s(home, "later", "twin", "fit", name, "--name", name)
        began = time.monotonic()
        cpu_s(home, "later", "twin", "discover", name)
        times_s[name] = round(time.monotonic() - began, 1)
    return times_s


def cpu_s(home: Home, when: str, *words: str) -> float:
    settings = {"DTWIN_HOME": str(home.root), "DTWIN_MLFLOW": when}
    done = subprocess.Popen(
        [sys.executable, "-m", "dtwin", *words], env={**os.environ, **settings}, stdout=subprocess.DEVNULL
    )
    # Of this process alone: what it leaves in the background is nobody's child.
    _, status, used = os.wait4(done.pid, 0)
    done.returncode = os.waitstatus_to_exitcode(status)
    if done.returncode:
        raise SystemExit(f"dtwin {' '.join(words)} ended with {done.returncode}")
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
