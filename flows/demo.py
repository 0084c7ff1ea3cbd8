"""The steps of the demo as flows: what they find is the same, and the Prefect page shows it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from prefect import flow

from dtwin.acquire.ingest import IngestReport
from dtwin.acquire.runner import CampaignRun
from dtwin.config import Home
from dtwin.errors import DtwinError
from dtwin.lifecycle.train import Registered
from dtwin.pipeline.measuring import FeatureReport
from dtwin.plan import EvidencePlan, Plan
from dtwin.train.closed_loop import Evidence
from dtwin.train.registry import RegisteredVersion
from flows import _artifacts, _tasks
from flows.diagnose import publish_figures
from flows.ingest import publish_ingest
from flows.promote import publish_champion, publish_circles, publish_refusal
from flows.reach import answers
from flows.train import publish_training
from studies.cobot_steps import PlainSteps, ProgressOf, Result, Work
from studies.wall_clock import Circle, serving_numbers


class FlowSteps:
    """``Steps`` that are flow runs.

    A server that dies on the way does not end the demo: the step is done again without it.

    Args:
        home: Where everything is kept.
        api: Address of the server that the runs are reported to.
        progress: Returns a progress callback for a title.
        say: Shows a line.
    """

    def __init__(self, home: Home, api: str, progress: ProgressOf, say: Callable[[str], None]) -> None:
        self._api, self._progress, self._say = api, progress, say
        self._plain = PlainSteps(home, progress)
        self._lost = False

    def step(self, name: str, title: str, do: Callable[[Work], Result]) -> Result:
        """Do one step as a run of the flow ``demo-<name>``; see ``Steps``."""
        if self._lost:
            return self._plain.step(name, title, do)

        @flow(name=f"demo-{name}", flow_run_name=" ".join(title.split()))
        def run() -> Result:
            return do(TaskWork())

        try:
            with _tasks.watched(self._progress):
                return run()
        except DtwinError:
            raise
        except Exception as error:
            if answers(f"{self._api}/health"):
                raise
            self._lost = True
            self._say(
                f"the Prefect server at {self._api} is gone ({type(error).__name__}): this step "
                "is done again without it, and the page will not show the rest"
            )
            return self._plain.step(name, title, do)


class TaskWork:
    """``Work`` by the tasks of the other flows, with what they publish."""

    def check(self, source: Path) -> dict[str, Any]:
        """Return what a file or folder says, and what is wrong with it."""
        found = _tasks.check(source)
        publish_figures(found["campaign"], found, f"Data quality of {source.name}")
        return found

    def ingest(self, source: Path) -> IngestReport:
        """Bring a file or folder into the lake."""
        report = _tasks.ingest(source)
        publish_ingest([report])
        return report

    def measure(self, plan: Plan, folder: Path, seed: int) -> CampaignRun:
        """Measure a plan on the virtual cobot."""
        done = _tasks.measure(plan, folder, seed)
        _artifacts.publish_table(
            f"measured-{plan.name}",
            ("tests", "runs", "measured now", "kept", "MB", "folder"),
            [[len(plan.tests), plan.n_runs, done.measured, done.kept, f"{done.raw_bytes / 1e6:z.1f}", done.folder]],
            "Measured on the virtual cobot, machine clock",
        )
        return done

    def features(self, campaign: str) -> FeatureReport:
        """Compute the signal features of a campaign."""
        return _tasks.compute_features(campaign)

    def train(self, campaign: str) -> Registered:
        """Train every candidate and register the proposed one."""
        registered = _tasks.train(campaign, 1)
        publish_training(registered)
        return registered

    def put_on_trial(self, version: RegisteredVersion, comment: str) -> Path:
        """Put a version on trial."""
        return _tasks.put_on_trial(version, comment)

    def serve(self, machine: str, circle: Circle, duration_s: float, seed: int) -> dict[str, Any]:
        """Serve the trial on the wall clock."""
        serving = _tasks.serve(machine, circle, duration_s, seed)
        _artifacts.publish_table(
            f"serving-{machine}",
            ("what", "value"),
            serving_numbers(serving),
            "Served over RTDE on the wall clock, a quarter of the clamp",
        )
        return serving

    def evidence(self, version: RegisteredVersion, plan: EvidencePlan, seed: int) -> Evidence:
        """Measure circles with and without a version."""
        evidence = _tasks.measure_evidence(version, plan, seed)
        publish_circles(version, evidence.as_dict())
        return evidence

    def make_champion(self, version: RegisteredVersion, comment: str) -> tuple[Path | None, str]:
        """Make a version champion, or return why not."""
        bundle, reason = _tasks.make_champion(version, comment)
        if bundle is None:
            publish_refusal(version.machine, reason)
        else:
            publish_champion(version, bundle)
        return bundle, reason

    def reported(self, path: Path, conclusion: str) -> None:
        """Leave where the report is and what the job came to."""
        text = f"{conclusion}\n\nThe report: `{path}`".replace("\n", "\n\n")
        _artifacts.publish_markdown("demo-report", text, "What the demo came to")
