"""The main job: from a real recording and an 81-test campaign to a served equation."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from dtwin.atomic import write_text
from dtwin.config import Home, sample_recording
from dtwin.lifecycle.train import Registered
from dtwin.plan import DEFAULT_EVIDENCE, EvidencePlan, Plan, quick_training_plan, training_plan
from dtwin.progress import Progress
from dtwin.report.campaign import (
    comparison_table,
    evidence_section,
    evidence_table,
    recording_section,
    training_section,
)
from dtwin.report.checking import render_check
from dtwin.report.html import Section, Table, page
from dtwin.report.text import table
from dtwin.train.gates import Verdict
from dtwin.train.promotion import verdict_lines
from studies.cobot_steps import PlainSteps, Result, Steps, Work
from studies.integration_check import sample_check
from studies.wall_clock import serving_numbers

# 7500 ticks: the slowest in a thousand are seven of them.
_SERVE_S = 15.0


class _Screen(Protocol):
    """Where the demo shows what it does."""

    def say(self, text: str) -> None:
        """Show a finished result."""

    def progress(self, title: str) -> Progress:
        """Return a progress callback for a piece of work."""


@dataclass(frozen=True)
class _DemoSize:
    """How much is measured. ``evidence``: circles with and without correction."""

    plan: Plan
    evidence: EvidencePlan
    serve_s: float


def full_size() -> _DemoSize:
    """Return the demo of the README: 81 tests, 162 runs, twelve conditions."""
    return _DemoSize(training_plan(), DEFAULT_EVIDENCE, _SERVE_S)


def quick_size() -> _DemoSize:
    """Return a demo for tests: twelve tests."""
    evidence = EvidencePlan((("YZ", 150.0, 5000.0), ("YZ", 100.0, 6000.0)), 2, (4000.0, 6000.0))
    return _DemoSize(quick_training_plan(), evidence, 3.0)


def run_demo(
    home: Home, screen: _Screen, size: _DemoSize, *, seed: int = 0, steps: Steps | None = None
) -> dict[str, Any]:
    """Run the five steps, by plain functions without others, and return what they found.

    Returns, JSON-ready: recording, campaign, comparison, gates, serving, evidence, champion, report, seconds by step.
    """
    clock = _Clock(screen, steps or PlainSteps(home, screen.progress))
    sections: list[Section] = []
    recording = clock.step(
        "1 of 5  a real recording: what it says, and what is wrong with it",
        "recording",
        lambda work: _recording(work, screen, sections),
    )
    campaign = clock.step(
        f"2 of 5  {len(size.plan.tests)} tests on the virtual cobot, machine clock",
        "campaign",
        lambda work: _measure(work, home, screen, size, seed),
    )
    registered = clock.step(
        "3 of 5  features, candidates, comparison", "training", lambda work: _train(work, screen, size, sections)
    )
    outcome = clock.step(
        "4 of 5  gates, trial, serving, evidence",
        "correction",
        lambda work: _correct(work, screen, size, seed, registered, sections),
    )
    path = clock.step("5 of 5  report", "report", lambda work: _report(work, home, screen, size, outcome, sections))
    screen.say(_final(outcome, clock.seconds))
    return {
        "recording": recording,
        "campaign": campaign,
        "comparison": _comparison(registered),
        "report": str(path),
        "seconds": clock.seconds,
        **outcome,
    }


def _recording(work: Work, screen: _Screen, sections: list[Section]) -> dict[str, Any]:
    path = sample_recording()
    report = work.ingest(path)
    result = work.check(path)
    screen.say(render_check(result))
    screen.say(
        f"in the lake as campaign {report.campaign}: {len(report.added)} runs added, {len(report.unchanged)} were there"
    )
    seen = sample_check()
    said = str(seen)
    screen.say(said)
    section = recording_section(path, result)
    sections.append(replace(section, paragraphs=(*section.paragraphs, said)))
    return {**result, "integration": seen.as_dict()}


def _measure(work: Work, home: Home, screen: _Screen, size: _DemoSize, seed: int) -> dict[str, Any]:
    done = work.measure(size.plan, home.campaigns / size.plan.name, seed)
    report = work.ingest(done.folder)
    codes = sorted({finding.code for _, finding in report.findings})
    screen.say(
        f"{done.measured} tests measured, {done.kept} kept from before, "
        f"{done.raw_bytes / 1e6:z.0f} MB; {len(report.added)} runs added to the lake, "
        f"{len(report.unchanged)} unchanged; findings: {', '.join(codes) or 'none'}"
    )
    return {
        "folder": str(done.folder),
        "tests": len(size.plan.tests),
        "runs": size.plan.n_runs,
        "raw_bytes": done.raw_bytes,
        "added": len(report.added),
        "findings": codes,
    }


def _train(work: Work, screen: _Screen, size: _DemoSize, sections: list[Section]) -> Registered:
    features = work.features(size.plan.name)
    screen.say(
        f"{features.windows} windows of {features.runs} runs, table version "
        f"{features.version}; {features.not_finite} not finite, {features.constant} constant"
    )
    registered = work.train(size.plan.name)
    report = registered.training.report
    head, rows = comparison_table(report.candidates)
    screen.say(table(head, rows))
    screen.say(
        f"error without a model {report.rms_before_um:z.1f} µm RMS, noise floor "
        f"{report.noise_floor_text} (unit of replication: the run)\n"
        + "".join(f"{line}\n" for line in report.told)
        + f"proposed: {report.proposed}, registered as version {registered.version.version}"
    )
    sections.append(training_section(report))
    return registered


def _correct(
    work: Work, screen: _Screen, size: _DemoSize, seed: int, registered: Registered, sections: list[Section]
) -> dict[str, Any]:
    version = registered.version
    screen.say("\n".join(verdict_lines(registered.verdicts)))
    if not all(v.passed for v in registered.verdicts):
        return _stopped(registered.verdicts, "an offline gate said no")
    work.put_on_trial(version, "demo")
    screen.say(f"version {version.version} is on trial (a quarter of its clamp)")
    with ThreadPoolExecutor(1) as beside:
        # The loop waits for the wall clock in a process of its own: evidence needs one of the other processors.
        served = beside.submit(
            copy_context().run, work.serve, version.machine, size.evidence.conditions[0], size.serve_s, seed
        )
        evidence = work.evidence(version, size.evidence, seed)
        serving = served.result()
    screen.say(_serving_text(serving))
    measured = evidence.as_dict()
    screen.say(table(*evidence_table(measured)))
    path, reason = work.make_champion(version, "demo")
    screen.say(f"champion: version {version.version}, {path}" if path else f"not promoted\n{reason}")
    sections += [_serving_section(serving), evidence_section(measured, evidence.profiles)]
    return {
        "gates": [vars(v) for v in registered.verdicts],
        "serving": serving,
        "evidence": measured,
        "champion": version.version if path else None,
        "refused": reason,
    }


def _report(
    work: Work, home: Home, screen: _Screen, size: _DemoSize, outcome: Mapping[str, Any], sections: list[Section]
) -> Path:
    title = "dtwin: from a recording to a served correction"
    content = page(title, f"machine {size.plan.machine}", sections)
    path = write_text(home.reports / "demo.html", content, "the report")
    work.reported(path, _conclusion(outcome))
    screen.say(f"report: {path}")
    return path


def _stopped(verdicts: list[Verdict], reason: str) -> dict[str, Any]:
    return {
        "gates": [vars(v) for v in verdicts],
        "serving": None,
        "evidence": None,
        "champion": None,
        "refused": reason,
    }


def _serving_text(serving: Mapping[str, Any]) -> str:
    head = "served over RTDE on the wall clock (trial: a quarter of the clamp), while evidence was measured"
    return head + "\n" + table(("what", "value"), serving_numbers(serving))


def _serving_section(serving: Mapping[str, Any]) -> Section:
    return Section(
        "Serving on the wall clock",
        [
            "The real ur-rtde client against the virtual controller over RTDE on loopback: timing "
            "figures come from here, while evidence was measured; error figures from the machine clock below."
        ],
        [],
        [Table(("what", "value"), serving_numbers(serving))],
    )


def _comparison(registered: Registered) -> list[dict[str, Any]]:
    return [
        {
            "name": c.name,
            "promotable": c.promotable,
            "complexity": c.complexity,
            "scores": {k: s.as_dict() for k, s in c.scores.items()},
            "p50_us": c.latency.p50_us if c.latency else None,
            "p99_us": c.latency.p99_us if c.latency else None,
        }
        for c in registered.training.report.candidates
    ]


def _final(outcome: Mapping[str, Any], seconds: Mapping[str, float]) -> str:
    return (
        f"{_conclusion(outcome)}; {sum(seconds.values()):z.0f} s in all\n"
        "look further: dtwin models, dtwin runs, dtwin up (MLflow and Prefect pages)"
    )


def _conclusion(outcome: Mapping[str, Any]) -> str:
    champion = f"champion: {outcome['champion'] or 'none'}"
    evidence = outcome["evidence"]
    if not evidence:
        return champion
    return (
        f"share of the oracle's reduction: "
        f"{100 * evidence['share_of_oracle_unseen_feeds']:z.0f} % on feeds never trained, "
        f"{100 * evidence['share_of_oracle_trained_feeds']:z.0f} % on trained ones\n{champion}"
    )


class _Clock:
    """Announces steps and remembers how long they took."""

    def __init__(self, screen: _Screen, steps: Steps) -> None:
        self.screen, self.steps = screen, steps
        self.seconds: dict[str, float] = {}

    def step(self, title: str, name: str, do: Callable[[Work], Result]) -> Result:
        self.screen.say(f"\n== {title}")
        begun = time.monotonic()
        result = self.steps.step(name, title, do)
        self.seconds[title.split("  ")[0]] = round(time.monotonic() - begun, 1)
        return result
