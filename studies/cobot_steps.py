"""What the demo has done for it, and the plain way to do it.

``flows`` has another way, whose steps are runs on the Prefect page.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, TypeVar

from dtwin.acquire.ingest import IngestReport
from dtwin.acquire.runner import CampaignRun
from dtwin.config import Home
from dtwin.lifecycle import evidence
from dtwin.lifecycle import train as training
from dtwin.pipeline import measuring
from dtwin.plan import EvidencePlan, Plan
from dtwin.progress import Progress
from dtwin.report.checking import check_source
from dtwin.train.closed_loop import Evidence
from dtwin.train.registry import RegisteredVersion
from studies.wall_clock import Circle, serve_wall_clock

ProgressOf = Callable[[str], Progress]
Result = TypeVar("Result")


class Work(Protocol):
    """The parts of the main job, one method each; errors are those of ``dtwin.pipeline``."""

    def check(self, source: Path) -> dict[str, Any]:
        """Return what a file or folder says, and what is wrong with it."""

    def ingest(self, source: Path) -> IngestReport:
        """Bring a file or folder into the lake."""

    def measure(self, plan: Plan, folder: Path, seed: int) -> CampaignRun:
        """Measure a plan on the virtual cobot."""

    def features(self, campaign: str) -> measuring.FeatureReport:
        """Compute the signal features of a campaign."""

    def train(self, campaign: str) -> training.Registered:
        """Train every candidate and register the proposed one."""

    def put_on_trial(self, version: RegisteredVersion, comment: str) -> Path:
        """Put a version on trial."""

    def serve(self, machine: str, circle: Circle, duration_s: float, seed: int) -> dict[str, Any]:
        """Serve the trial on the wall clock."""

    def evidence(self, version: RegisteredVersion, plan: EvidencePlan, seed: int) -> Evidence:
        """Measure circles with and without a version."""

    def make_champion(self, version: RegisteredVersion, comment: str) -> tuple[Path | None, str]:
        """Make a version champion, or return why not."""

    def reported(self, path: Path, conclusion: str) -> None:
        """Take note of the written report and of what the job came to."""


class Steps(Protocol):
    """Who does the steps of a job."""

    def step(self, name: str, title: str, do: Callable[[Work], Result]) -> Result:
        """Do one step: call it with what does the work."""


class PlainSteps:
    """Plain function calls, nothing else."""

    def __init__(self, home: Home, progress: ProgressOf) -> None:
        self._work = _PlainWork(home, progress)

    def step(self, name: str, title: str, do: Callable[[Work], Result]) -> Result:
        """Do one step; see ``Steps``."""
        return do(self._work)


class _PlainWork:
    """``Work`` by the functions of ``dtwin.pipeline``. ``progress``: returns a progress callback for a title."""

    def __init__(self, home: Home, progress: ProgressOf) -> None:
        self._home, self._progress = home, progress

    def check(self, source: Path) -> dict[str, Any]:
        return check_source(source)

    def ingest(self, source: Path) -> IngestReport:
        return measuring.ingest(source, self._home, self._progress("ingest"))

    def measure(self, plan: Plan, folder: Path, seed: int) -> CampaignRun:
        return measuring.simulate(plan, folder, seed=seed, progress=self._progress("measure"))

    def features(self, campaign: str) -> measuring.FeatureReport:
        return measuring.compute_features(self._home, campaign, self._progress("features"))

    def train(self, campaign: str) -> training.Registered:
        lines: dict[str, Progress] = {}

        def tell(stage: str, done: int, total: int, what: str) -> None:
            lines.setdefault(stage, self._progress(stage))(done, total, what)

        return training.train(self._home, campaign, progress=tell)

    def put_on_trial(self, version: RegisteredVersion, comment: str) -> Path:
        return training.put_on_trial(self._home, version, comment)

    def serve(self, machine: str, circle: Circle, duration_s: float, seed: int) -> dict[str, Any]:
        return serve_wall_clock(self._home, machine, circle, duration_s, seed)

    def evidence(self, version: RegisteredVersion, plan: EvidencePlan, seed: int) -> Evidence:
        return evidence.measure(self._home, version, seed=seed, plan=plan, progress=self._progress("circles"))

    def make_champion(self, version: RegisteredVersion, comment: str) -> tuple[Path | None, str]:
        return evidence.make_champion(self._home, version, comment)

    def reported(self, path: Path, conclusion: str) -> None:
        """Take note of nothing: the terminal has it."""
