"""Kinds of campaign: one record each, refusals that say what serves instead, kinds of others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from dtwin.acquire.campaign_folder import open_campaign
from dtwin.acquire.ingest import open_source
from dtwin.acquire.quality import judge_run
from dtwin.errors import InputError
from dtwin.kinds import registry
from dtwin.kinds.kind import VERBS, Kind, NotOffered
from dtwin.kinds.registry import kind_named, kind_names, kinds, verb_table
from dtwin.schema import Finding, Run

ROOT = Path(__file__).parents[3]


def test_every_kind_has_columns_and_judges_its_runs() -> None:
    for kind in kinds():
        assert kind.columns
        assert kind.offers("judge_run")


def test_a_kind_that_is_not_there_is_refused_with_those_that_are() -> None:
    with pytest.raises(InputError) as refused:
        kind_named("spiral")
    assert refused.value.allowed == ", ".join(kind_names())


@pytest.mark.parametrize("verb", VERBS)
def test_what_a_kind_lacks_is_refused_with_its_name_and_a_way_out(verb: str) -> None:
    for kind in kinds():
        if kind.offers(verb):
            kind.require(verb)
            continue
        with pytest.raises(NotOffered) as refused:
            kind.require(verb)
        assert (refused.value.got, refused.value.code) == (kind.name, "kind.not_offered")
        assert refused.value.hint


def test_the_table_of_the_docs_is_that_of_the_records() -> None:
    assert verb_table() in (ROOT / "docs/reference/kinds.md").read_text(encoding="utf-8")


class _Spindle(Kind):
    """Run-out of a spindle: a kind that dtwin does not know."""

    name = "spindle"
    columns = ("t_s", "run_out_um")

    def judge_run(self, run: Run) -> list[Finding]:
        worst = float(abs(run.samples["run_out_um"]).max())
        return [Finding("spindle.wild", "error", "beyond any spindle")] if worst > 100.0 else []

    def judge_campaign(self, runs: Sequence[Run]) -> list[Finding]:
        return [Finding("spindle.few", "info", f"{len(runs)} runs")]


SPINDLE = _Spindle()
NO_KIND = object()


@pytest.fixture
def spindle(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    points = [
        EntryPoint("spindle", f"{__name__}:SPINDLE", "dtwin.kinds"),
        EntryPoint("broken", f"{__name__}:NO_KIND", "dtwin.kinds"),
    ]
    monkeypatch.setattr(registry, "entry_points", lambda group: points)
    registry._of_others.cache_clear()
    registry.kind_named.cache_clear()
    yield
    registry._of_others.cache_clear()
    registry.kind_named.cache_clear()


@pytest.mark.usefixtures("spindle")
def test_a_kind_of_others_is_read_and_judged_like_ours(tmp_path: Path) -> None:
    (tmp_path / "r1.csv").write_text("t_s,run_out_um\n0.0,1.0\n0.1,250.0\n", encoding="utf-8")
    (tmp_path / "campaign.toml").write_text(
        '[campaign]\nname = "s"\nmachine = "m"\nkind = "spindle"\n[[run]]\nid = "r1"\nfile = "r1.csv"\n',
        encoding="utf-8",
    )
    assert open_campaign(tmp_path).campaign.kind == "spindle"
    _, sources, _ = open_source(tmp_path, None)
    ((runs, _),) = list(sources)
    assert [finding.code for finding in judge_run(runs[0])] == ["spindle.wild"]
    with pytest.raises(NotOffered, match="training is not offered for spindle campaigns"):
        kind_named("spindle").training()


@pytest.mark.usefixtures("spindle")
def test_an_entry_point_that_gives_no_kind_is_refused() -> None:
    with pytest.raises(InputError, match="gives no kind"):
        kind_named("broken")
