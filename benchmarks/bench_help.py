"""Wall time of ``dtwin --help``: a new process each time, median of ten.

Run: python benchmarks/bench_help.py [--json]
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from typing import Any


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    parser.add_argument("--repeats", type=int, default=10)
    chosen = parser.parse_args()
    times_s = {"dtwin --help": [], "python -c pass": []}  # type: dict[str, list[float]]
    for _ in range(1 if chosen.short else chosen.repeats):
        for name, command in (("dtwin --help", ["-m", "dtwin", "--help"]), ("python -c pass", ["-c", "pass"])):
            begun = time.perf_counter()
            subprocess.run([sys.executable, *command], check=True, stdout=subprocess.DEVNULL)
            times_s[name].append(time.perf_counter() - begun)
    result: dict[str, Any] = {
        name: {"median_s": round(statistics.median(t), 3), "max_s": round(max(t), 3)} for name, t in times_s.items()
    }
    result["ratio"] = round(result["dtwin --help"]["median_s"] / max(result["python -c pass"]["median_s"], 1e-3), 1)
    if chosen.json:
        print(json.dumps(result))
        return
    print(f"ratio of the medians {result.pop('ratio')}")
    for name, value in result.items():
        print(f"{name:16s} median {value['median_s']:.3f} s, longest {value['max_s']:.3f} s")


if __name__ == "__main__":
    main()
