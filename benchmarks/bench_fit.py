"""A fit of a million samples and thirty linear parameters beside ``numpy.linalg.lstsq``.

Each solver runs in a process of its own; extra memory is the growth of the peak beyond the arrays
that it is given. Accuracy is the error of the solution at a condition number of 1e6, against the
parameters that the noise-free measurements were made with.

Run: OMP_NUM_THREADS=1 python benchmarks/bench_fit.py [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from dtwin.physics._solve import in_blocks, solve_blocks

ROWS, COLUMNS, CONDITION = 1_000_000, 30, 1e6


def problem(rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return columns of a known condition number, the measurements, and the true parameters."""
    rng = np.random.default_rng(0)
    columns = rng.standard_normal((rows, COLUMNS)) / np.sqrt(rows)
    turn, _ = np.linalg.qr(rng.standard_normal((COLUMNS, COLUMNS)))
    columns = columns @ (np.geomspace(1.0, 1.0 / CONDITION, COLUMNS)[:, None] * turn)
    truth = rng.standard_normal(COLUMNS)
    return columns, columns @ truth, truth


def status_bytes(field: str) -> int:
    """Return a memory figure of this process (Linux)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{field}:"):
            return 1024 * int(line.split()[1])
    raise SystemExit(f"/proc/self/status has no {field}")


def solved(name: str, columns: np.ndarray, right: np.ndarray) -> np.ndarray:
    if name == "lstsq":
        return np.linalg.lstsq(columns, right, rcond=None)[0]
    return solve_blocks(in_blocks(columns, right)).x


def step(name: str, rows: int) -> dict[str, float]:
    """Solve once in this process and say what it took."""
    columns, right, truth = problem(rows)
    solved(name, columns[:5000], right[:5000])
    before = status_bytes("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    begun = time.perf_counter()
    found = solved(name, columns, right)
    seconds = time.perf_counter() - begun
    return {
        "seconds": seconds,
        "extra_mb": (status_bytes("VmHWM") - before) / 1e6,
        "error": float(np.linalg.norm(found - truth) / np.linalg.norm(truth)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--step", choices=("lstsq", "blocks"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    rows, repeats = (20_000, 1) if arguments.short else (ROWS, arguments.repeats)
    if arguments.step:
        print(json.dumps(step(arguments.step, rows)))
        return
    load = os.getloadavg()[0]
    best: dict[str, dict[str, float]] = {}
    for _ in range(repeats):
        for name in ("lstsq", "blocks"):
            out = subprocess.run(
                [sys.executable, __file__, "--step", name, *["--short"][: int(arguments.short)]],
                capture_output=True,
                text=True,
                check=True,
            )
            got = json.loads(out.stdout)
            if name not in best or got["seconds"] < best[name]["seconds"]:
                best[name] = got
    ratio = best["lstsq"]["seconds"] / best["blocks"]["seconds"]
    if arguments.json:
        print(json.dumps({"load_before": load, "solvers": best, "times_faster": ratio}))
        return
    print(f"{rows:g} rows x {COLUMNS} columns, condition {CONDITION:g}; load before {load:.2f}")
    for name, got in best.items():
        print(
            f"  {name:7s} {got['seconds']:7.3f} s  {got['extra_mb']:7.1f} MB extra  relative error {got['error']:.1e}"
        )
    print(f"  {ratio:.1f} times faster")


if __name__ == "__main__":
    main()
