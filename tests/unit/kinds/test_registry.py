"""Kinds of campaign: one record each, refusals that say what serves instead, kinds of others."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, ClassVar

import pytest
from typer.testing import CliRunner

from dtwin.acquire.campaign_folder import open_campaign
from dtwin.acquire.ingest import open_source
from dtwin.acquire.quality import judge_run
from dtwin.cli import app
from dtwin.errors import InputError
from dtwin.kinds import registry
from dtwin.kinds.kind import VERBS, Kind, NotOffered, Planned
from dtwin.kinds.machine import PLAN, Options, Request, Simulated, VirtualMachine
from dtwin.kinds.registry import kind_named, kind_names, kinds, machine_named
from dtwin.progress import Progress
from dtwin.schema import Campaign, Finding, Run

ROOT = Path(__file__).parents[3]


def test_every_kind_has_columns_and_judges_its_runs() -> None:
    for kind in kinds():
        assert kind.columns
        assert kind.offers("judge_run")


def test_a_campaign_of_another_kind_is_refused() -> None:
    campaign = Campaign("c", "m", "drift")
    assert campaign.of_kind("drift") is campaign
    with pytest.raises(InputError) as refused:
        campaign.of_kind("poses")
    assert (refused.value.code, refused.value.where, refused.value.got) == ("campaign.kind", "c", "drift")


def test_a_kind_that_is_not_there_is_refused_with_those_that_are() -> None:
    with pytest.raises(InputError) as refused:
        kind_named("spiral")
    assert refused.value.allowed == ", ".join(kind_names())


def test_the_table_of_the_docs_is_that_of_the_records() -> None:
    assert _verb_table() in (ROOT / "docs/reference/kinds.md").read_text(encoding="utf-8")


class _Spindle(Kind):
    """Run-out of a spindle: a kind that dtwin does not know."""

    name = "spindle"
    columns = ("t_s", "run_out_um")

    @property
    def machines(self) -> Sequence[VirtualMachine]:
        return (RIG,)

    def plan(self, document: Mapping[str, Any], where: str) -> Planned:
        turns = int(document["plan"]["turns"])
        few = [Finding("plan.few", "warning", "one turn shows no repeat")] if turns < 2 else []
        return Planned("spindle", turns, {"name": "s", "turns": turns}, 0.1 * turns, few, ("a spindle",))

    def judge_run(self, run: Run) -> list[Finding]:
        worst = float(abs(run.samples["run_out_um"]).max())
        return [Finding("spindle.wild", "error", "beyond any spindle")] if worst > 100.0 else []

    def judge_campaign(self, runs: Sequence[Run]) -> list[Finding]:
        return [Finding("spindle.few", "info", f"{len(runs)} runs")]


class _Rig(VirtualMachine):
    """A rig that runs out by a micrometre, or by another size."""

    name = "rig"
    type = "rig"
    kind = "spindle"
    options: ClassVar[Options] = {PLAN: (), "truth": ("1.0", "2.0")}

    def simulate(self, request: Request, progress: Progress) -> Simulated:
        turns = request.plan or 2
        rows = "".join(f"{0.1 * turn},{request.options['truth']}\n" for turn in range(turns))
        write_spindle(request.out, f"t_s,run_out_um\n{rows}")
        return Simulated({"turns": turns}, [f"{turns} turns"])


SPINDLE = _Spindle()
RIG = _Rig()
NO_KIND = object()


def write_spindle(folder: Path, table: str) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "r1.csv").write_text(table, encoding="utf-8")
    (folder / "campaign.toml").write_text(
        '[campaign]\nname = "s"\nmachine = "m"\nkind = "spindle"\n[[run]]\nid = "r1"\nfile = "r1.csv"\n',
        encoding="utf-8",
    )


@pytest.fixture
def spindle(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    yield from _registered(monkeypatch, EntryPoint("spindle", f"{__name__}:SPINDLE", "dtwin.kinds"))


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    yield from _registered(monkeypatch, EntryPoint("broken", f"{__name__}:NO_KIND", "dtwin.kinds"))


def _registered(monkeypatch: pytest.MonkeyPatch, point: EntryPoint) -> Iterator[None]:
    monkeypatch.setattr(registry, "entry_points", lambda group: [point])
    registry._of_others.cache_clear()
    registry.kind_named.cache_clear()
    yield
    registry._of_others.cache_clear()
    registry.kind_named.cache_clear()


@pytest.mark.usefixtures("spindle")
def test_a_kind_of_others_is_read_and_judged_like_ours(tmp_path: Path) -> None:
    write_spindle(tmp_path, "t_s,run_out_um\n0.0,1.0\n0.1,250.0\n")
    assert open_campaign(tmp_path).campaign.kind == "spindle"
    _, sources, _ = open_source(tmp_path, None)
    ((runs, _),) = list(sources)
    assert [finding.code for finding in judge_run(runs[0])] == ["spindle.wild"]
    with pytest.raises(NotOffered, match="training is not offered for spindle campaigns"):
        kind_named("spindle").training()


@pytest.mark.usefixtures("spindle")
def test_a_kind_of_others_is_planned_and_its_machine_measured(tmp_path: Path) -> None:
    def said(*words: object) -> dict[str, Any]:
        done = CliRunner().invoke(app, [*map(str, words), "--json"], catch_exceptions=False)
        found: dict[str, Any] = json.loads(done.stdout)
        return found

    plan, out = tmp_path / "plan.toml", tmp_path / "out"
    plan.write_text('[plan]\nkind = "spindle"\nturns = 1\n', encoding="utf-8")
    planned = said("plan", plan)
    assert (planned["turns"], planned["total_s"]) == (1, 0.1)
    assert [finding["code"] for finding in planned["findings"]] == ["plan.few"]
    with pytest.raises(NotOffered, match="what a plan could detect is not offered for spindle"):
        said("plan", plan, "--check")
    simulate = "simulate", "--machine", "rig", "--out", out
    assert said(*simulate, "--plan", plan, "--truth", "2.0")["turns"] == 1
    _, sources, _ = open_source(out, None)
    ((runs, _),) = list(sources)
    assert runs[0].samples["run_out_um"].tolist() == [2.0]
    with pytest.raises(InputError, match="the virtual rig has no such option"):
        said(*simulate, "--hidden", "wobble")


@pytest.mark.usefixtures("broken")
def test_an_entry_point_that_gives_no_kind_is_refused_and_hides_no_machine_of_ours() -> None:
    assert machine_named("volumetric").kind == "volumetric"
    with pytest.raises(InputError, match="gives no kind"):
        kind_named("broken")


def _verb_table() -> str:
    """Return which kind offers which verb, as Markdown."""
    every = list(kinds())
    lines = [f"| verb | {' | '.join(k.name for k in every)} |", "|---" * (len(every) + 1) + "|"]
    for verb, (title, _) in VERBS.items():
        cells = ("yes" if kind.offers(verb) else "no" for kind in every)
        lines.append(f"| {title} | {' | '.join(cells)} |")
    return "\n".join(lines)
