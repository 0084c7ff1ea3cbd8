"""The only place where functions of dtwin become tasks.

One task is one file, one campaign, one training: what would be worth repeating by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from pathlib import Path
from typing import Any

from prefect import Task, get_run_logger, task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, TaskRun

from dtwin.acquire.ingest import IngestReport
from dtwin.acquire.runner import CampaignRun
from dtwin.config import home
from dtwin.errors import DeviceError, StoreError
from dtwin.fleet.nightly import Night, nightly
from dtwin.kinds.machine import Request, Simulated
from dtwin.kinds.registry import machine_named
from dtwin.lifecycle import drift, schedule
from dtwin.lifecycle import evidence as closed_loop
from dtwin.lifecycle import recheck as rechecking
from dtwin.lifecycle import train as training
from dtwin.pipeline import campaign_figures as figures
from dtwin.pipeline import measuring
from dtwin.pipeline.campaign_job import CampaignRequest, run_request
from dtwin.pipeline.desk import Desk
from dtwin.plan import EvidencePlan, Plan
from dtwin.progress import Progress, StageProgress
from dtwin.report.checking import check_source
from dtwin.train.closed_loop import Evidence
from dtwin.train.registry import RegisteredVersion, Registry
from dtwin.twins.on_campaign import TwinView, look_at
from flows import _told  # noqa: F401 - every flow imports this module
from studies import cell, papers
from studies.cobot_steps import ProgressOf
from studies.wall_clock import Circle, serve_wall_clock

_LOGGED_SHARE = 0.2
_watching: ContextVar[ProgressOf | None] = ContextVar("watching", default=None)


def _may_pass(_task: Task[..., Any], _run: TaskRun, state: State[Any]) -> bool:
    """Only what may be over in a moment is tried again, never a mistake or a gate's no."""
    error = state.result(raise_on_failure=False)
    if isinstance(error, DeviceError):
        return True
    return isinstance(error, StoreError) and error.code == "store.busy"


# The lake knows by content what is done already; a second cache beside it could only disagree.
_REPEATABLE: dict[str, Any] = {
    "retries": 2,
    "retry_delay_seconds": [2, 10],
    "retry_condition_fn": _may_pass,
    "cache_policy": NO_CACHE,
}
_ONCE: dict[str, Any] = {"cache_policy": NO_CACHE}


@task(name="check", task_run_name="check {source}", **_REPEATABLE)
def check(source: Path) -> dict[str, Any]:
    """Say what one campaign folder or file shows, and what is wrong with it."""
    return check_source(source, logged("check"))


@task(name="measure", task_run_name="measure {plan.name}", **_REPEATABLE)
def measure(plan: Plan, folder: Path, seed: int) -> CampaignRun:
    """Measure a plan on the virtual cobot; tests that are in the folder already are kept."""
    return measuring.simulate(plan, folder, seed=seed, progress=logged("measure"))


@task(name="simulate", task_run_name="measure on the virtual {machine}", **_ONCE)
def simulated(machine: str, request: Request) -> Simulated:
    """Measure a plan on a virtual machine."""
    return machine_named(machine).simulate(request, logged("measure"))


@task(name="campaign", task_run_name="measure {request.plan.name}", **_ONCE)
def measure_on_machine(request: CampaignRequest, desk_of: Callable[[Path], Desk]) -> dict[str, Any]:
    """Measure a campaign on a machine; what the folder holds already is kept."""
    return run_request(home(), request, desk_of, lambda: False)


@task(name="ingest", task_run_name="ingest {source}", **_REPEATABLE)
def ingest(source: Path) -> IngestReport:
    """Bring one campaign folder or file into the lake."""
    return measuring.ingest(source, home(), logged("ingest"))


@task(name="features", task_run_name="features {campaign}", **_REPEATABLE)
def compute_features(campaign: str) -> measuring.FeatureReport:
    """Compute the signal features of a campaign."""
    return measuring.compute_features(home(), campaign, logged("features"))


@task(name="cell-step", task_run_name="part {part}: {step}", **_ONCE)
def cell_step(step: str, part: int, twin: str, seed: int) -> dict[str, Any]:
    """Do one step of the cell; ``twin`` says which twin is live in it."""
    get_run_logger().info("live twin: %s", twin)
    return cell.do_step(step, part, twin, seed)


@task(name="train", task_run_name="train {campaign}", **_ONCE)
def train(campaign: str, seed: int) -> training.Registered:
    """Train every candidate and register the proposed one."""
    return training.train(home(), campaign, seed=seed, progress=logged_stages())


@task(name="scheduled training", **_ONCE)
def scheduled_training(seed: int) -> schedule.Scheduled:
    """Train when there is new data."""
    return schedule.scheduled_training(home(), seed=seed, progress=logged_stages())


@task(name="trial", task_run_name="trial of version {version.version}", **_ONCE)
def put_on_trial(version: RegisteredVersion, comment: str) -> Path:
    """Put a version on trial; offline gates decide."""
    return training.put_on_trial(home(), version, comment)


@task(name="evidence", task_run_name="evidence for version {version.version}", **_ONCE)
def evidence(version: RegisteredVersion, seed: int) -> Evidence:
    """Return the evidence that is kept with a version, or measure it on its virtual machine."""
    return closed_loop.proven_or_measured(home(), version, seed=seed, progress=logged("evidence"))


@task(name="circles", task_run_name="circles with version {version.version}", **_ONCE)
def measure_evidence(version: RegisteredVersion, plan: EvidencePlan, seed: int) -> Evidence:
    """Measure circles with and without a version on the virtual cobot."""
    return closed_loop.measure(home(), version, seed=seed, plan=plan, progress=logged("runs"))


@task(name="paper", task_run_name="paper: {name}", **_ONCE)
def paper(name: str, quick: bool, seed: int) -> dict[str, Any]:
    """Compute the figures of a published system again."""
    return papers.computed(name, quick=quick, seed=seed, progress=logged(name))


@task(name="serve", task_run_name="serve {machine} for {duration_s} s", **_ONCE)
def serve(machine: str, circle: Circle, duration_s: float, seed: int) -> dict[str, Any]:
    """Serve the version on trial to the virtual controller, on the wall clock."""
    return serve_wall_clock(home(), machine, circle, duration_s, seed)


@task(name="promote", task_run_name="promote version {version.version}", **_ONCE)
def make_champion(version: RegisteredVersion, comment: str, despite: Sequence[str] = ()) -> tuple[Path | None, str]:
    """Make a version champion by its evidence, or return why not."""
    return closed_loop.make_champion(home(), version, comment, despite)


@task(name="recheck", task_run_name="recheck of {machine}", **_ONCE)
def recheck(machine: str, seed: int, blocks: int) -> rechecking.Rechecked:
    """Measure with and without a champion again, and withdraw it when it harms."""
    return rechecking.recheck(home(), machine, seed=seed, blocks=blocks, progress=logged("runs"))


@task(name="night", **_ONCE)
def night(folder: Path | None, seed: int) -> Night:
    """Take in what arrived, diagnose what is new, check champions, and tell what somebody should look at."""
    return nightly(home(), folder=folder, on=home().engine, seed=seed, progress=logged_stages())


@task(name="figures", task_run_name="figures of {campaign}", **_REPEATABLE)
def campaign_figures(campaign: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return figures and findings of a campaign, and its error curves."""
    found = figures.campaign_figures(home(), campaign, logged("figures"))
    return found, figures.error_curves(home(), campaign)


@task(name="drift", task_run_name="champion on {campaign}", **_REPEATABLE)
def champion_drift(machine: str, campaign: str) -> drift.DriftCheck | None:
    """Judge the champion on a campaign; None when nothing was promoted."""
    champion = Registry(home()).champion(machine)
    if champion is None:
        return None
    return drift.check_drift(home(), champion, campaign, logged("champion"))


@task(name="twins", task_run_name="twins of {machine} on {campaign}", **_REPEATABLE)
def look_at_twins(machine: str, campaign: str) -> list[TwinView]:
    """Diagnose the twins that were fitted to a campaign, and compare the machine's others."""
    return look_at(home(), machine, campaign)


@contextmanager
def watched(progress: ProgressOf) -> Iterator[None]:
    """Show the progress of tasks elsewhere too while the body runs.

    Args:
        progress: Returns a progress callback for a title.
    """
    before = _watching.set(progress)
    try:
        yield
    finally:
        _watching.reset(before)


def logged(title: str) -> Progress:
    """Return a progress callback that writes to the run's log, five times in all.

    Args:
        title: What is being done.
    """
    logger = get_run_logger()
    watching = _watching.get()
    watch = watching(title) if watching is not None else None
    # Some work tells its progress from a thread of its own, where Prefect would know of no server, and start one.
    run = copy_context()
    reached = 0.0

    def tell(done: int, total: int, what: str) -> None:
        nonlocal reached
        if watch is not None:
            watch(done, total, what)
        share = done / max(total, 1)
        if share >= min(1.0, reached + _LOGGED_SHARE):
            reached = share
            run.copy().run(logger.info, "%s: %d of %d %s", title, done, total, what)

    return tell


def logged_stages() -> StageProgress:
    """Return a progress callback for work in stages."""
    stages: dict[str, Progress] = {}

    def tell(stage: str, done: int, total: int, what: str) -> None:
        stages.setdefault(stage, logged(stage))(done, total, what)

    return tell
