"""Run a planned campaign on a bench; what was measured survives a killed process."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from dtwin.acquire._recovery import recover_folder
from dtwin.acquire.b5r import write_b5r
from dtwin.acquire.campaign_folder import write_campaign_file
from dtwin.acquire.signal_files import write_signals
from dtwin.errors import Interrupted, StoreError
from dtwin.plan import Plan, PlannedTest
from dtwin.progress import Progress, silent
from dtwin.schema import DEFAULT_KIND, Direction, Run

_MANIFEST = "manifest.jsonl"


@runtime_checkable
class Bench(Protocol):
    """A machine with its instruments, able to run one direction of a planned test.

    A bench is warmed up before the first test and closed after the last.
    """

    name: str

    def describe(self) -> Mapping[str, Mapping[str, Any]]:
        """Return the tables ``machine_geometry`` and ``instrument`` of the campaign file."""
        ...

    def warm_up(self) -> None:
        """Bring machine and instruments to a steady state."""
        ...

    def measure(self, test: PlannedTest, direction: Direction) -> Run:
        """Run one direction of a test and return what was measured."""
        ...

    def close(self) -> None:
        """Release machine and instruments; safe to call twice."""
        ...


@dataclass(frozen=True)
class CampaignRun:
    """What a campaign left in its folder.

    Attributes:
        folder: Campaign folder, complete with ``campaign.toml``.
        measured, kept: Tests measured now, and tests that an earlier process had measured.
        raw_bytes: Size of all measured files.
    """

    folder: Path
    measured: int
    kept: int
    raw_bytes: int


def run_campaign(plan: Plan, bench: Bench, folder: Path, progress: Progress = silent) -> CampaignRun:
    """Measure every test of a plan that the folder does not hold yet.

    A test is done when its files are there with the checksums of the manifest, so the same
    call continues after an interruption or a killed process.

    Args:
        folder: Campaign folder; created.
        progress: Called with (done, total, test id).

    Raises:
        Interrupted: On Ctrl-C; everything measured so far can be ingested or continued.
        StoreError: When the folder belongs to another plan or cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _claim(folder, plan)
    # Streams of a killed process; their tests are not in the manifest and are measured again.
    recover_folder(folder)
    done = _done(folder)
    missing = [test for test in plan.tests if test.test_id not in done]
    kept = len(plan.tests) - len(missing)

    def save(test: PlannedTest, runs: Sequence[Run]) -> None:
        done[test.test_id] = _save(folder, plan, test, runs)
        progress(len(done), len(plan.tests), test.test_id)

    try:
        if missing:
            bench.warm_up()
        _measure(bench, missing, plan.directions, save)
    except KeyboardInterrupt as interrupt:
        _write_toml(folder, plan, bench, done)
        raise Interrupted(
            f"{len(done)} of {len(plan.tests)} tests are kept",
            code="campaign.interrupted",
            where=str(folder),
            hint="run the same command again to continue",
        ) from interrupt
    finally:
        bench.close()
    _write_toml(folder, plan, bench, done)
    size = sum(path.stat().st_size for path in folder.iterdir() if path.is_file())
    return CampaignRun(folder, len(missing), kept, size)


def _measure(
    bench: Bench,
    tests: Sequence[PlannedTest],
    directions: Sequence[Direction],
    save: Callable[[PlannedTest, Sequence[Run]], None],
) -> None:
    """Measure tests one after the other; each is saved while the next is measured, and no more than one waits."""
    with ThreadPoolExecutor(1) as disk:
        saving: Future[None] | None = None
        for test in tests:
            runs = [bench.measure(test, direction) for direction in directions]
            if saving is not None:
                saving.result()
            saving = disk.submit(save, test, runs)
        if saving is not None:
            saving.result()


def _save(folder: Path, plan: Plan, test: PlannedTest, runs: Sequence[Run]) -> dict[str, Any]:
    """Write a test's files, then its line in the manifest: only then it is done."""
    main = folder / f"{test.test_id}.b5r"
    write_b5r(main, runs, name=f"{plan.name} {test.test_id}", machine=plan.machine)
    files = [main]
    for run in runs:
        for group in run.signals:
            path = folder / f"{test.test_id}-{str(run.meta.direction).lower()}.{group.name}.parquet"
            tagged = type(group)(f"{group.name}@{run.meta.direction}", group.rate_hz, group.columns, group.start_s)
            write_signals(path, tagged)
            files.append(path)
    entry = {
        "test": test.test_id,
        "files": {path.name: _sha256(path) for path in files},
        "started": runs[0].meta.started,
        "covariates": dict(runs[0].meta.covariates),
    }
    with (folder / _MANIFEST).open("a", encoding="utf-8") as manifest:
        manifest.write(json.dumps(entry) + "\n")
        manifest.flush()
        os.fsync(manifest.fileno())
    return entry


def _done(folder: Path) -> dict[str, dict[str, Any]]:
    """Return manifest entries whose files are there and unchanged."""
    path = folder / _MANIFEST
    done: dict[str, dict[str, Any]] = {}
    if not path.exists():
        return done
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            entry = json.loads(line)
            intact = all(_sha256(folder / f) == sha for f, sha in entry["files"].items())
        except (ValueError, KeyError, OSError):
            # The last line of a killed process, or a file that is gone: measure it again.
            continue
        if intact:
            done[entry["test"]] = entry
    return done


def _claim(folder: Path, plan: Plan) -> None:
    content = json.dumps(
        {
            "name": plan.name,
            "machine": plan.machine,
            "tests": [vars(t) for t in plan.tests],
            "directions": plan.directions,
        },
        indent=1,
    )
    path = folder / "plan.json"
    if path.exists() and path.read_text(encoding="utf-8") != content:
        raise StoreError(
            "the folder holds another plan's measurements",
            code="campaign.other_plan",
            where=str(folder),
            hint="use another folder, or the plan that it was begun with",
        )
    path.write_text(content, encoding="utf-8")


def _write_toml(folder: Path, plan: Plan, bench: Bench, done: Mapping[str, Mapping[str, Any]]) -> None:
    tests = [test for test in plan.tests if test.test_id in done]
    if not tests:
        return
    head = {
        "name": plan.name,
        "machine": plan.machine,
        "kind": DEFAULT_KIND,
        "started": done[tests[0].test_id]["started"],
        **bench.describe(),
    }
    runs = []
    for test in tests:
        entry = done[test.test_id]
        run = {
            "id": test.test_id,
            "file": f"{test.test_id}.b5r",
            "plane": test.plane,
            "radius_mm": test.radius_mm,
            "feed_mm_min": test.feed_mm_min,
            "repeat": test.repeat,
            "setup": test.setup,
            "started": entry["started"],
            "signals": sorted(f for f in entry["files"] if f.endswith(".parquet")),
        }
        runs.append(run | ({"covariates": entry["covariates"]} if entry["covariates"] else {}))
    write_campaign_file(folder, head, runs)


def _sha256(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
