"""One bit flipped at a time in every file of a home: noticed, harmless, silent or a traceback.

Everything that is kept of a campaign, a twin and what is served is read after each flip and compared with
what was read before. Silent is another content without an error; a traceback is any error that is not one
for users. Run: python benchmarks/bench_flips.py [--flips 10000] [--only bundles] [--short] [--json]
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.amending import amend, leave_out
from dtwin.config import Home
from dtwin.errors import DtwinError
from dtwin.lake.store import Lake
from dtwin.schema import Campaign, Run, RunMeta, SignalGroup
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle_file import create_bundle, load_bundle, save_bundle
from dtwin.serve.interface import Input, Output
from dtwin.serve.pointer import machine_folder, on_trial, read_machine, resolve, write_machine, write_pointer
from dtwin.serve.withdrawn import stop_serving, withdrawn_why
from dtwin.twins.verbs import Twins

FLIPS, SEED = 10_000, 1


def made_home(root: Path) -> Home:
    """A campaign of eight runs with signals, amended, one run left out; a twin with a diagnosis."""
    home = Home(root)
    rng = np.random.default_rng(0)
    t_s = np.arange(240) / 20.0
    runs = []
    for number in range(8):
        way = "CCW" if number % 2 else "CW"
        angle = 30.0 * t_s * (1.0 if way == "CCW" else -1.0)
        error = 4.0 * np.cos(np.radians(2 * angle)) + 0.3 * rng.standard_normal(t_s.size)
        meta = RunMeta(
            f"r{number}",
            plane="XY",
            direction=way,
            radius_mm=100.0,
            feed_mm_min=3141.6,
            repeat=1 + number // 2,
            sample_rate_hz=20.0,
            covariates={"temperature_c": 20.0},
        )
        signals = SignalGroup("accelerometers", 100.0, {"x_g": rng.normal(size=600).astype("f4")})
        samples = {"t_s": t_s, "angle_deg": angle, "deviation_um": error}
        runs.append(Run(meta, samples, signals=(signals,)))
    lake = Lake(home.lake)
    campaign = Campaign("flips", "mill-a", instrument={"calibrated_mm": 100.0})
    lake.commit(campaign, runs[:5])
    lake.commit(campaign, runs[5:])
    amend(lake, "flips", ["instrument.calibrated_mm=100.01"], "another master")
    leave_out(lake, "flips", ["r7"], "the magnet slipped")
    twins = Twins(home)
    twins.fit("flips", [], "flipped")
    twins.diagnose("flipped")
    promoted(home)
    return home


def promoted(home: Home) -> None:
    """A champion, a version on trial, a tool and two withdrawn versions, as promotion writes them."""
    write_machine("cobot-a", home, {"type": "ur10e", "tcp_mm": [0.0, 1.5, 158.3]})
    for version in (1, 2):
        stop_serving("cobot-a", home, version, "worse with the correction")
    for version, state in ((3, "champion"), (4, "trial")):
        g = GraphBuilder()
        made = create_bundle(
            name="harmonic",
            machine="cobot-a",
            model_version=version,
            inputs=[Input("path_angle_rad", "rad", "path", 500.0, "path", -50.0, 50.0)],
            outputs=[Output("radial_error_um", "path_radial")],
            tick_graph=g.graph({"radial_error_um": 20.0 * g.apply("sin", g.input("path_angle_rad"))}),
        )
        path = save_bundle(made, machine_folder("cobot-a", home) / f"v{version:04d}.json")
        write_pointer("cobot-a", home, path, version, state)  # type: ignore[arg-type]


def lake_of(home: Home) -> Any:
    lake = Lake(home.lake)
    return [(row, lake.load(row)) for row in lake.runs(left_out=True)]


def twins_of(home: Home) -> Any:
    twins = Twins(home)
    return twins.history("flipped"), twins.newest("flipped"), twins.compare("flipped").as_dict()


def served_of(home: Home) -> Any:
    found: list[Any] = [on_trial("cobot-a", home), read_machine("cobot-a", home)]
    found += [withdrawn_why("cobot-a", home, version) for version in range(6)]
    for model in ("latest", "trial"):
        resolved = resolve(model, "cobot-a", home)
        compiled = load_bundle(resolved.path, "cobot-a")
        found += [resolved, compiled.bundle.body()]
        found += compiled.run(np.linspace(-3.0, 3.0, 20)[:, None]).tolist()
    return found


READERS: dict[str, Callable[[Home], Any]] = {
    "lake": lake_of,
    "twins": twins_of,
    "reduced": twins_of,
    "bundles": served_of,
}
"""Folder of the home and what reads it."""


def flipped(home: Home, folder: str, flips: int, dice: random.Random) -> Counter[str]:
    """Flip bits of one folder's files, and count what came of it."""
    files = sorted(p for p in (home.root / folder).rglob("*") if p.is_file() and p.stat().st_size)
    read = READERS[folder]
    whole = repr(read(home))
    counts: Counter[str] = Counter()
    for _ in range(flips):
        path = dice.choice(files)
        clean = path.read_bytes()
        damaged = bytearray(clean)
        damaged[dice.randrange(len(clean))] ^= 1 << dice.randrange(8)
        path.write_bytes(damaged)
        try:
            counts["silent" if repr(read(home)) != whole else "harmless"] += 1
        except DtwinError:
            counts["noticed"] += 1
        # What else a flip raises is what is looked for.
        except Exception as error:
            counts["traceback"] += 1
            print(f"{path}: {type(error).__name__}: {error}"[:200], file=sys.stderr)
        path.write_bytes(clean)
    return counts


def main(arguments: list[str] | None = None) -> dict[str, dict[str, int]]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--flips", type=int, default=FLIPS, help="in all folders together")
    parser.add_argument("--only", choices=READERS, help="one of the folders")
    parser.add_argument("--short", action="store_true", help="a few flips of each folder")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args(arguments)
    folders = [asked.only] if asked.only else list(READERS)
    flips = 30 * len(folders) if asked.short else asked.flips
    dice = random.Random(SEED)
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        home = made_home(Path(folder) / "home")
        for name in folders:
            results[name] = dict(flipped(home, name, flips // len(folders), dice))
    if asked.json:
        print(json.dumps(results, indent=1))
    else:
        for name, counts in results.items():
            print(f"{name:8}", ", ".join(f"{n} {what}" for what, n in sorted(counts.items())))
    return results


if __name__ == "__main__":
    found = main()
    sys.exit(any(part.get("silent") or part.get("traceback") for part in found.values()))
