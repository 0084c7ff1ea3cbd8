"""A minute of six channels at 25.6 kS/s: into a recording, a signal file and the lake.

Every step is set beside a plain pyarrow write with the same encoding in the same run; memory
is the growth of a process of its own. Then bits of a signal file are flipped one at a time.

Run: python benchmarks/bench_ingest.py [--json]; OMP_NUM_THREADS would hold Arrow's reader to fewer
threads than the command has.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dtwin.acquire._recording import Recorder
from dtwin.acquire._recovery import seal
from dtwin.acquire.signal_files import read_signals, write_signals
from dtwin.errors import StoreError
from dtwin.lake.parquet import read_parquet
from dtwin.lake.store import Lake
from dtwin.schema import Campaign, Run, RunMeta, SignalGroup

RATE_HZ, SECONDS, BLOCK_S = 25_600.0, 60, 0.1
CHANNELS = tuple(f"{place}_{axis}_g" for place in ("wrist", "base") for axis in "xyz")
STEP_G = 10.0 / 2**24
FLIPS = 150
SHORT_SECONDS, SHORT_FLIPS = 2, 20


def signals(seconds: float) -> dict[str, np.ndarray]:
    """Tones and noise in 24-bit steps, as a converter delivers them."""
    rng, t = np.random.default_rng(0), np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    columns = {}
    for number, name in enumerate(CHANNELS):
        g = 0.3 * np.sin(2 * np.pi * (9.4 + number) * t) + 0.02 * rng.standard_normal(t.size)
        columns[name] = (np.round(g / STEP_G) * STEP_G).astype(np.float32)
    return columns


def plain(columns: dict[str, np.ndarray], folder: Path) -> None:
    pq.write_table(
        pa.table(columns),
        folder / "plain.parquet",
        compression="zstd",
        compression_level=1,
        use_dictionary=False,
        column_encoding=dict.fromkeys(columns, "BYTE_STREAM_SPLIT"),
        write_page_checksum=True,
    )


def signal_file(columns: dict[str, np.ndarray], folder: Path) -> None:
    write_signals(folder / "r1.parquet", SignalGroup("accelerometers", RATE_HZ, columns))


def recording(columns: dict[str, np.ndarray], folder: Path) -> list[float]:
    """Append block by block; return the time of each."""
    n = int(BLOCK_S * RATE_HZ)
    types = dict.fromkeys(columns, np.float32)
    times = []
    with Recorder(folder / "r1.arrows", "accelerometers", RATE_HZ, types) as recorder:
        for first in range(0, len(columns[CHANNELS[0]]), n):
            begun = time.perf_counter()
            recorder.append({name: x[first : first + n] for name, x in columns.items()})
            times.append(time.perf_counter() - begun)
    return times


def sealing(folder: Path) -> None:
    seal(folder / "r1.arrows", folder / "sealed.parquet")


def commit(columns: dict[str, np.ndarray], folder: Path) -> None:
    """Hash signals that are in memory, write them into a new lake and commit them."""
    _commit(SignalGroup("accelerometers", RATE_HZ, columns), folder / "from-memory")


def lake(folder: Path) -> None:
    """Read a signal file with its checksums verified, then as ``commit``."""
    (group,) = read_signals(folder / "r1.parquet")
    _commit(group, folder / "lake")


def _commit(group: SignalGroup, root: Path) -> None:
    samples = {"t_s": np.arange(2.0), "angle_deg": np.arange(2.0), "deviation_um": np.zeros(2)}
    meta = RunMeta("r1", plane="XY", direction="CCW", radius_mm=100.0, feed_mm_min=2000.0)
    Lake(root).commit(Campaign("bench", "bench"), [Run(meta, samples, None, (group,))])


STEPS = ("plain", "signal_file", "recording", "sealing", "commit", "lake")


def status_bytes(field: str) -> int:
    """Return a memory figure of this process (Linux)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{field}:"):
            return 1024 * int(line.split()[1])
    raise SystemExit(f"/proc/self/status has no {field}")


def step(name: str, folder: Path, seconds: float) -> dict[str, float]:
    """Do one step in this process and say what it took."""
    warm_up(name)
    writes = name in ("plain", "signal_file", "recording", "commit")
    columns = dict(np.load(folder / "columns.npz")) if writes else {}
    raw = len(CHANNELS) * seconds * RATE_HZ * 4
    # The columns that a writing step is given count as well: somebody holds them.
    before = status_bytes("VmRSS") - (raw if writes else 0)
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    work: Callable[..., list[float] | None] = globals()[name]
    begun = time.perf_counter()
    times = work(columns, folder) if writes else work(folder)
    got = {"seconds": time.perf_counter() - begun}
    got["memory_x_raw"] = (status_bytes("VmHWM") - before) / raw
    if times:
        got["append_p50_ms"] = 1e3 * float(np.quantile(times, 0.5))
        got["append_p99_ms"] = 1e3 * float(np.quantile(times, 0.99))
    return got


def warm_up(name: str) -> None:
    """Import everything and touch every code path with little data."""
    little = signals(0.2)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        plain(little, folder)
        signal_file(little, folder)
        recording(little, folder)
        sealing(folder)
        if name == "commit":
            commit(little, folder)
        if name == "lake":
            lake(folder)


def measured(folder: Path, seconds: float, repeats: int) -> dict[str, dict[str, float]]:
    """Run every step in processes of their own, the best of several, in turn."""
    best: dict[str, dict[str, float]] = {}
    np.savez(folder / "columns.npz", **signals(seconds))
    for _ in range(repeats):
        for root in ("lake", "from-memory"):
            shutil.rmtree(folder / root, ignore_errors=True)
        for name in STEPS:
            out = subprocess.run(
                [sys.executable, __file__, "--step", name, "--folder", str(folder), "--seconds", str(seconds)],
                capture_output=True,
                text=True,
                check=True,
            )
            got = json.loads(out.stdout)
            if name not in best or got["seconds"] < best[name]["seconds"]:
                best[name] = got
    return best


def flipped_bits(folder: Path, flips: int) -> dict[str, int]:
    """Flip single bits of a signal file; a flip counts as silent when other values are read."""
    path, rng = folder / "flips.parquet", random.Random(0)
    write_signals(path, SignalGroup("accelerometers", RATE_HZ, signals(1.0)))
    whole, true = path.read_bytes(), read_parquet(path)
    counts = {"detected": 0, "harmless": 0, "silent": 0}
    for _ in range(flips):
        data = bytearray(whole)
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(data)
        try:
            same = read_parquet(path).equals(true)
        except StoreError:
            counts["detected"] += 1
        else:
            counts["harmless" if same else "silent"] += 1
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--step", choices=STEPS, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="length of the recording")
    arguments = parser.parse_args()
    seconds, flips_n = arguments.seconds, FLIPS
    if arguments.short:
        seconds, flips_n, arguments.repeats = SHORT_SECONDS, SHORT_FLIPS, 1
    if arguments.step:
        print(json.dumps(step(arguments.step, arguments.folder, seconds)))
        return
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        steps = measured(folder, seconds, arguments.repeats)
        flips = flipped_bits(folder, flips_n)
        size_mb = (folder / "r1.parquet").stat().st_size / 1e6
    for got in steps.values():
        got["x_plain"] = got["seconds"] / steps["plain"]["seconds"]
    if arguments.json:
        print(json.dumps({"load_before": load, "steps": steps, "bit_flips": flips, "signal_file_mb": size_mb}))
        return
    print(
        f"{seconds:g} s x {len(CHANNELS)} channels x {RATE_HZ / 1e3:g} kS/s, file {size_mb:.1f} MB; "
        f"load before {load:.2f}"
    )
    print(f"  {'step':12s} {'seconds':>8s} {'x plain':>8s} {'peak / raw':>11s}")
    for name, got in steps.items():
        line = f"  {name:12s} {got['seconds']:8.3f} {got['x_plain']:8.2f}"
        print(f"{line} {got['memory_x_raw']:11.2f}")
    p50, p99 = steps["recording"]["append_p50_ms"], steps["recording"]["append_p99_ms"]
    share = p99 / (1e3 * BLOCK_S)
    print(f"  append of {BLOCK_S:g} s, on disk: p50 {p50:.2f} ms, p99 {p99:.2f} ms ({share:.1%})")
    print(f"  {flips_n} flipped bits: {flips}")


if __name__ == "__main__":
    main()
