"""Training without anybody asking: new data in, a candidate and its comparison with the champion out.

Nothing is promoted here. A version that is better than the champion waits under the alias
``candidate`` for somebody to read the comparison and run ``dtwin promote``.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.lake.rows import by_campaign
from dtwin.lake.store import Lake
from dtwin.lifecycle.drift import (
    DriftCheck,
    campaign_of,
    champion_error,
    check_drift,
    left_out_since,
    trained_rows,
    usable,
)
from dtwin.lifecycle.train import Registered, train
from dtwin.locks import locked
from dtwin.progress import StageProgress, silent
from dtwin.report.html import Section, Table, page
from dtwin.schema import Campaign
from dtwin.train.champion_error import um_text
from dtwin.train.promotion import verdict_lines
from dtwin.train.registry import RegisteredVersion, Registry

_Outcome = Literal["trained", "checked", "skipped"]
_CORRECTED = "a correction was in force while it was measured"
_NOT_IN_A_TAG = re.compile(r"[^A-Za-z0-9_. -]")


@dataclass(frozen=True)
class _CampaignNews:
    """What a campaign holds that no registered version was trained on.

    ``rows``: its usable runs, as rows of ``runs``.
    ``left_out``: how many runs the newest version that it trained has that are left out now.
    ``digest``: identifies the content of the usable runs.
    ``obstacle``: why the campaign cannot train a correction; empty when it can.
    """

    campaign: str
    machine: str
    rows: list[dict[str, Any]]
    new_runs: int
    left_out: int
    digest: str
    obstacle: str

    @property
    def is_new(self) -> bool:
        """Whether a training would have other runs than the last one."""
        return bool(self.new_runs or self.left_out)

    @property
    def told(self) -> str:
        """Why to train, or why not."""
        gone = f", {self.left_out} left out since the last training" if self.left_out else ""
        return self.obstacle or f"{self.new_runs} new runs{gone}"


@dataclass(frozen=True)
class Scheduled:
    """What one turn of the schedule did.

    ``outcome``: ``trained``, ``skipped``, or ``checked``: nothing could be trained, but the champion was judged on new
    runs.
    ``comparison``: candidate against champion; None without a champion.
    """

    outcome: _Outcome
    reason: str
    campaigns: dict[str, str] = field(default_factory=dict)
    registered: Registered | None = None
    comparison: _Comparison | None = None
    drift: tuple[DriftCheck, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        document: dict[str, Any] = {
            "outcome": self.outcome,
            "reason": self.reason,
            "campaigns": self.campaigns,
            "drift": [check.as_dict() for check in self.drift],
        }
        if self.registered is not None:
            report = self.registered.training.report
            document |= {
                "campaign": report.campaign,
                "machine": report.machine,
                "version": self.registered.version.version,
                "proposed": report.proposed,
                "table_versions": dict(report.table_versions),
                "gates_passed": all(v.passed for v in self.registered.verdicts),
            }
        if self.comparison is not None:
            document["comparison"] = vars(self.comparison) | {"verdict": self.comparison.verdict}
        return document


def scheduled_training(home: Home, *, seed: int = 1, progress: StageProgress = silent) -> Scheduled:
    """Train on the newest campaign if it has new runs, compare with the champion.

    Campaigns that are older than what a machine's newest training used are passed over, so the
    alias ``candidate`` always means the newest data. Nothing is promoted.
    """
    with locked(home.root / "locks" / "scheduled-training.lock") as mine:
        if not mine:
            return Scheduled("skipped", "another scheduled training is at work")
        registry = Registry(home)
        fresh = news(home, registry)
        if not fresh:
            return Scheduled("skipped", "the lake holds no campaign yet: dtwin ingest PATH")
        turn = _Turn(home, registry, seed, progress)
        for item in fresh:
            turn.look_at(item)
            if turn.registered is not None:
                break
        return turn.result(fresh)


def news(home: Home, registry: Registry, machines: Collection[str] = ()) -> list[_CampaignNews]:
    """Return what is new in every campaign of some machines, the newest ingest first; of all without names.

    New is a usable run whose content no registered version of the machine was trained on; what
    a version was trained on is read back from the lake at the version's own table version.
    """
    lake = Lake(home.lake)
    every = by_campaign(lake.runs(machine=machines or None))
    order = sorted(every, key=lambda n: max(r["ingested"] for r in every[n]))
    known = {machine: _known(registry, lake, machine) for machine in {rows[0]["machine"] for rows in every.values()}}
    news = []
    for name in reversed(order):
        rows = [row for row in every[name] if usable(row)]
        machine = every[name][0]["machine"]
        news.append(
            _CampaignNews(
                campaign=name,
                machine=machine,
                rows=rows,
                new_runs=len({row["content_sha256"] for row in rows} - known[machine]),
                left_out=_left_out(registry, lake, machine, name),
                digest=digest_of(rows),
                obstacle=_obstacle(rows, lake.campaign(name)),
            )
        )
    return news


def digest_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return what identifies the content of runs, given as rows of the lake."""
    contents = sorted(str(row["content_sha256"]) for row in rows)
    return hashlib.sha256("".join(contents).encode()).hexdigest()[:16]


def compared(home: Home, made: Registered) -> _Comparison | None:
    """Return a fresh candidate and the champion on the runs that it was trained on; None without a champion."""
    rows = [row for row in Lake(home.lake).runs(made.training.report.campaign) if usable(row)]
    return _compare_with_champion(home, made, rows)


def _known(registry: Registry, lake: Lake, machine: str) -> set[str]:
    versions = registry.versions(machine)
    return {row["content_sha256"] for v in versions for row in trained_rows(registry, lake, v)}


def _left_out(registry: Registry, lake: Lake, machine: str, campaign: str) -> int:
    of_it = (v for v in registry.versions(machine) if campaign_of(registry, v) == campaign)
    newest = next(of_it, None)
    return 0 if newest is None else len(left_out_since(registry, lake, newest))


def _obstacle(rows: list[dict[str, Any]], campaign: Campaign) -> str:
    if not rows:
        return "no usable runs"
    if campaign.machine_geometry.get("corrected", False):
        return _CORRECTED
    return kind_named(campaign.kind).training_obstacle(rows)


def _drift_once(home: Home, registry: Registry, item: _CampaignNews) -> DriftCheck | None:
    """Judge the champion on a newer campaign unless the same runs were judged before."""
    champion = registry.champion(item.machine)
    plain = item.rows and item.obstacle != _CORRECTED and not any(row["correction"] for row in item.rows)
    if champion is None or not plain:
        return None
    kind = kind_named(item.rows[0]["kind"])
    if not kind.offers("champion_error") or kind.drift_obstacle(item.rows):
        return None
    known = trained_rows(registry, Lake(home.lake), champion)
    if _ingested(item.rows) < _ingested(known):
        return None
    tag, mark = _NOT_IN_A_TAG.sub("_", f"drift.{item.campaign}"), f"[{item.digest}]"
    if champion.tags.get(tag, "").endswith(mark):
        return None
    check = check_drift(home, champion, item.campaign)
    registry.mark(champion, {tag: f"{'DRIFT: ' * check.drifted}{check.reason} {mark}"})
    if check.drifted:
        registry.attach(champion, {f"{tag}.json": json.dumps(check.as_dict(), indent=1)})
    return check


def _ingested(rows: list[dict[str, Any]]) -> str:
    return max((str(row["ingested"]) for row in rows), default="")


class _Turn:
    """One pass over the campaigns, the newest first."""

    def __init__(self, home: Home, registry: Registry, seed: int, progress: StageProgress) -> None:
        self.home, self.registry, self.seed, self.progress = home, registry, seed, progress
        self.told: dict[str, str] = {}
        self.drift: list[DriftCheck] = []
        self.settled: set[str] = set()
        self.registered: Registered | None = None
        self.comparison: _Comparison | None = None

    def look_at(self, item: _CampaignNews) -> None:
        """Judge the champion on a campaign, and train on it when it is new."""
        if item.machine in self.settled:
            older = "older than the newest campaign that was trained on"
            self.told[item.campaign] = item.obstacle or older
            return
        check = _drift_once(self.home, self.registry, item)
        if check is not None:
            self.drift.append(check)
        self.told[item.campaign] = item.told
        if item.obstacle:
            return
        if not item.is_new:
            self.settled.add(item.machine)
            return
        try:
            self.registered = train(self.home, item.campaign, seed=self.seed, progress=self.progress)
        except InputError as error:
            self.told[item.campaign] = error.message
            return
        self.comparison = compared(self.home, self.registered)

    def result(self, news: list[_CampaignNews]) -> Scheduled:
        """Return what was done."""
        outcome: _Outcome = "trained"
        if self.registered is not None:
            campaign = self.registered.training.report.campaign
            version = self.registered.version.version
            reason = f"{self.told[campaign]} in {campaign}: version {version} is the candidate"
        else:
            judged = any(check.error is not None for check in self.drift)
            outcome = "checked" if judged else "skipped"
            reason = "nothing new to train on" + _newest_training(self.registry, news)
        return Scheduled(outcome, reason, self.told, self.registered, self.comparison, tuple(self.drift))


def _newest_training(registry: Registry, news: list[_CampaignNews]) -> str:
    machine = news[0].machine
    versions = registry.versions(machine)
    if not versions:
        return ""
    newest = versions[0]
    return f" since version {newest.version} of {machine} ({campaign_of(registry, newest)})"


@dataclass(frozen=True)
class _Comparison:
    """Candidate and champion on the same runs.

    ``candidate_um``, ``champion_um``, ``before_um``: set-up-corrected RMS: of the candidate with each group (feed, run,
    hours ...) left out of its fit in turn, of the champion as it would have been served, and without a model.
    ``noise_floor_um``: what repeats disagree by.
    ``n_runs``, ``seen_by_champion``: number of runs, and how many of them the champion was trained on.
    """

    candidate: str
    champion: str
    candidate_um: float
    champion_um: float
    before_um: float
    noise_floor_um: float
    n_runs: int
    seen_by_champion: int

    @property
    def verdict(self) -> str:
        """One sentence for the reviewer."""
        change = 1.0 - self.candidate_um / self.champion_um
        what = f"{abs(100 * change):z.0f} % {'less' if change > 0 else 'more'} error"
        known = (
            f"; the champion was trained on {self.seen_by_champion} of these runs, which flatters it"
            if self.seen_by_champion
            else ", none of which the champion ever saw"
        )
        return (
            f"candidate {self.candidate} leaves {what} than champion {self.champion} "
            f"({um_text(self.candidate_um)} against {um_text(self.champion_um)} µm) on {self.n_runs} runs" + known
        )

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Return head and rows for pages."""
        return ["", "µm RMS, held out"], [
            ["no correction", um_text(self.before_um)],
            [f"champion {self.champion}", um_text(self.champion_um)],
            [f"candidate {self.candidate}", um_text(self.candidate_um)],
            ["noise floor", um_text(self.noise_floor_um)],
        ]


def _compare_with_champion(home: Home, registered: Registered, rows: Sequence[dict[str, Any]]) -> _Comparison | None:
    """Compare a fresh candidate with the champion, and leave the result for the reviewer.

    ``rows``: rows of ``runs`` that it was trained on.
    None when there is no champion, or none that recorded runs can judge; the reason is then the version's tag
    ``against_champion``.
    """
    registry = Registry(home)
    report = registered.training.report
    champion = registry.champion(report.machine)
    tags = {"trained_by": "schedule"}
    if champion is None:
        registry.mark(registered.version, tags | {"against_champion": "there is no champion"})
        return None
    lake = Lake(home.lake)
    try:
        error = champion_error(registry, champion, lake, rows)
    except InputError as refused:
        registry.mark(registered.version, tags | {"against_champion": refused.message})
        return None
    seen = {row["content_sha256"] for row in trained_rows(registry, lake, champion)}
    comparison = _Comparison(
        candidate=registered.version.version,
        champion=champion.version,
        candidate_um=report.candidate(report.proposed).held_out.rms_um,
        champion_um=error.rms_um,
        before_um=error.before_um,
        noise_floor_um=report.noise_floor_um,
        n_runs=error.n_runs,
        seen_by_champion=sum(row["content_sha256"] in seen for row in rows),
    )
    _leave_for_reviewer(registry, registered, champion, comparison)
    registry.mark(registered.version, tags | {"against_champion": comparison.verdict})
    return comparison


def _leave_for_reviewer(
    registry: Registry, registered: Registered, champion: RegisteredVersion, comparison: _Comparison
) -> None:
    section = Section(
        "Against the champion",
        [
            comparison.verdict + ".",
            "Both errors are on the same runs, what belongs to a set-up taken out. The candidate is scored with "
            f"every {registered.training.report.candidate(registered.training.report.proposed).held_out.group} left "
            "out of its search and fit in turn; the champion is its frozen bundle, as limited by its validity box "
            "when served.",
            "Nothing was promoted: dtwin promote does that, after trial and evidence.",
            *verdict_lines(registered.verdicts),
        ],
        tables=[Table(*comparison.table())],
    )
    title = f"Version {comparison.candidate} against champion {champion.version}"
    registry.attach(
        registered.version, {"against-champion.html": page(title, f"machine {champion.machine}", [section])}
    )
    before = registry.description(registered.version)
    registry.mark(registered.version, {}, description=f"{before}\n\nScheduled training: {comparison.verdict}.")
