"""What a home on a shared store costs: requests, and seconds at a given way to the store, beside the same work at home.

A real S3 server (moto) on loopback, and a proxy before it that lets every request wait ``--way-ms``. ``local_s`` and ``shared_s`` are
the shortest of three; ``requests`` is the least of them. The work: keep a campaign of six runs, list a campaign, read its runs, follow the store
when nothing and when one twin changed; with few and with many campaigns there.

Run: python benchmarks/bench_shared_home.py [--campaigns 100] [--way-ms 20] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "system"))

from fleet_lake import fill
from shared_servers import BUCKET, KEYS, StoreProxy, running_store

from dtwin.atomic import write_toml
from dtwin.config import Home
from dtwin.documents import write_document
from dtwin.home_file import HOME_FILE
from dtwin.lake.store import Lake
from dtwin.schema import Campaign
from dtwin.shared_documents import follow_shared

_TRIES = 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--campaigns", type=int, default=100)
    parser.add_argument("--way-ms", type=float, default=20.0)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    chosen = parser.parse_args()
    counts = (1, 3) if chosen.short else (1, chosen.campaigns)
    os.environ.update(KEYS)
    with tempfile.TemporaryDirectory() as folder, running_store() as port:
        proxy = StoreProxy(port)
        rows = [row for count in counts for row in _measured(Path(folder) / str(count), proxy, count, chosen.way_ms)]
        proxy.close()
    if chosen.json:
        print(json.dumps({"way_ms": chosen.way_ms, "rows": rows}))
        return
    print(f"{chosen.way_ms:g} ms to the store")
    print("| work | campaigns there | local s | shared s | requests |\n|---|---|---|---|---|")
    for r in rows:
        print(f"| {r['work']} | {r['there']} | {r['local_s']:.3f} | {r['shared_s']:.2f} | {r['requests']} |")


def _measured(folder: Path, proxy: StoreProxy, count: int, way_ms: float) -> Iterator[dict[str, Any]]:
    local, shared = Home(folder / "local"), Home(folder / "shared")
    stated = {
        "store": f"s3://{BUCKET}/of-{count}",
        "endpoint": f"http://127.0.0.1:{proxy.port}",
        "registry": "http://127.0.0.1:9",
    }
    write_toml(shared.root / HOME_FILE, stated, "the settings")
    for home in (local, shared):
        fill(home, count)
        follow_shared(home)
    proxy.wrong, proxy.wait_s = "slow", way_ms / 1e3
    for work, does in _WORK.items():
        at_home = min(_timed(does, local, k) for k in range(_TRIES))
        tries = []
        for k in range(_TRIES):
            before = proxy.asked
            tries.append((_timed(does, shared, k), proxy.asked - before))
        least, requests = min(s for s, _ in tries), min(n for _, n in tries)
        yield {"work": work, "there": count, "local_s": at_home, "shared_s": least, "requests": requests}
    proxy.wrong = ""


def _timed(does: Callable[[Home, int], None], home: Home, k: int) -> float:
    begun = time.perf_counter()
    does(home, k)
    return time.perf_counter() - begun


def _keep(home: Home, k: int) -> None:
    lake = Lake(home.lake)
    runs = list(lake.iterate("c00"))
    lake.commit(Campaign(f"new-{k}", "mill-0", "circular", None, {}), runs)


def _list(home: Home, _k: int) -> None:
    assert len(Lake(home.lake).runs("c00")) == 6


def _read(home: Home, _k: int) -> None:
    assert len(list(Lake(home.lake).iterate("c00"))) == 6


def _follow(home: Home, _k: int) -> None:
    follow_shared(home)


def _change(home: Home, k: int) -> None:
    write_document(home.root / "twins" / "t" / f"v{k + 1:03d}.json", {"version": k}, "a twin")
    follow_shared(home)


_WORK: dict[str, Callable[[Home, int], None]] = {
    "read a campaign and keep it under another name": _keep,
    "list a campaign": _list,
    "read a campaign": _read,
    "follow, nothing new": _follow,
    "follow, one version of a twin new": _change,
}


if __name__ == "__main__":
    main()
