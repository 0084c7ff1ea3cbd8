"""A computer that writes to a shared home until it has written all: ``python shared_writer.py HOME NUMBER CAMPAIGNS``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from dtwin.config import Home
from dtwin.documents import write_document
from dtwin.lake.store import Lake
from dtwin.schema import Campaign, Run, RunMeta
from dtwin.shared_documents import follow_shared


def campaign(name: str) -> tuple[Campaign, list[Run]]:
    """Return a campaign whose readings are told by its name."""
    rng = np.random.default_rng(list(name.encode()))
    runs = [
        Run(
            RunMeta(f"r{k}", plane="XY", radius_mm=100.0, feed_mm_min=1000.0, sample_rate_hz=40.0),
            {"t_s": np.arange(50) / 40.0, "deviation_um": rng.normal(size=50)},
        )
        for k in range(2)
    ]
    return Campaign(name, "mill-a"), runs


def main() -> None:
    home, number, count = Home(Path(sys.argv[1])), int(sys.argv[2]), int(sys.argv[3])
    follow_shared(home)
    for k in range(count):
        # One of its own, and one that every computer brings.
        for name in (f"of-{number}-{k}", f"of-all-{k}"):
            Lake(home.lake).commit(*campaign(name))
        path = home.root / "twins" / f"twin-{number}" / f"v{k + 1:03d}.json"
        if not path.exists():
            write_document(path, {"twin": number, "version": k + 1}, "a twin")
        line = home.root / "bundles" / "mill-a" / "promotions.jsonl"
        line.parent.mkdir(parents=True, exist_ok=True)
        said = f'{{"by": {number}, "version": {k}}}\n'
        if not line.exists() or said not in line.read_text():
            with line.open("a") as file:
                file.write(said)
        follow_shared(home)
    print("done", flush=True)


if __name__ == "__main__":
    main()
