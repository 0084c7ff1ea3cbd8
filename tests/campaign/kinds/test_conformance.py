"""Every kind goes every way that its record offers, and refuses the others by name."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient
from typer.testing import CliRunner

from dtwin.acquire.amending import amend
from dtwin.cli import app
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.kind import VERBS, Kind, NotOffered
from dtwin.kinds.registry import kinds
from dtwin.lake.store import Lake
from dtwin.report.html import page
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle
from dtwin.train.comparison_models import RECIPES
from dtwin.train.symbolic import Found
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application

ROOT = Path(__file__).parents[3]
# Where a kind has no virtual machine.
FOLDERS = {"poses": ROOT / "data/poses/ur5-random", "rotary": Path(__file__).parent / "rotary_table"}
# The quickest machine of a kind that has several, and a cause that its errors have.
MACHINES = {"circular": "mill"}
EFFECTS = {
    "circular": "squareness",
    "linear": "lead_error",
    "sinusoidal": "structural_mode",
    "volumetric": "EA0",
    "poses": "joint_zero",
    "drift": "follows",
}


# What a verb is called with, where it is refused.
GIVEN: dict[str, tuple[Any, ...]] = {
    "plan": ({}, "here"),
    "draft": ("m", {}, ()),
    "programs": (None, ""),
    "foreseen": (None,),
    "proposals": ("m", {}),
    "judge_run": (None,),
    "sheet": ((), None),
    "variation": ((), ""),
    "twins": (None, None),
    "export_twin": (None, "", ""),
    "axis_errors": (None,),
    "rows": ((), ()),
    "gates": (None, {}),
    "champion_error": (None, (), None, {}),
    "run_errors": ((),),
}


# Where the quick campaign is too short to train on.
PLANS = {
    "linear": """
[plan]
kind = "linear"
name = "z"
machine = "lathe"
axis = "Z"
unit = "in"
start = 1
end = 4
step = 0.025
runs = 3
dwell_s = 6
feed_min = 20
overshoot = 0.1
window = 0.01
axis_low = 0
axis_high = 41
pitch = 0.25
"""
}


@dataclass(frozen=True)
class Measured:
    """A campaign of a kind in a home of its own."""

    kind: Kind
    home: Home
    folder: Path
    campaign: str

    def said(self, *words: object) -> Any:
        """Return what a command that must succeed prints as JSON."""
        done = CliRunner(env={"DTWIN_HOME": str(self.home.root)}).invoke(
            app, [*map(str, words), "--json"], catch_exceptions=False
        )
        assert done.exit_code == 0, done.output
        return json.loads(done.stdout)


class Stub:
    """Searches for nothing: what a search finds is not asked here."""

    name = "stub"

    def search(self, inputs: Mapping[str, Floats], target: Floats, seed: int) -> list[Found]:
        return [Found(f"1.0 * {next(iter(inputs))}", 3, 0.0)]


def with_data(kind: Kind) -> bool:
    return bool(kind.machines) or kind.name in FOLDERS


@pytest.fixture(scope="module", params=[kind for kind in kinds() if with_data(kind)], ids=lambda kind: kind.name)
def measured(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Measured:
    kind: Kind = request.param
    root = tmp_path_factory.mktemp(kind.name)
    made = Measured(kind, Home(root / "home"), FOLDERS.get(kind.name, root / "campaign"), "")
    if kind.name not in FOLDERS:
        machine = MACHINES.get(kind.name, kind.machines[0].name)
        size: tuple[object, ...] = ("--quick",)
        if kind.name in PLANS:
            (root / "plan.toml").write_text(PLANS[kind.name], encoding="utf-8")
            size = ("--plan", root / "plan.toml")
            assert made.said("plan", size[1])["total_s"] > 0.0
        made.said("simulate", "--machine", machine, *size, "--out", made.folder)
    (ingested,) = made.said("ingest", made.folder)["campaigns"]
    return Measured(kind, made.home, made.folder, ingested["campaign"])


@pytest.fixture(scope="module")
def twin(measured: Measured) -> str:
    if measured.kind.offers("twins"):
        measured.said("twin", "fit", measured.campaign, "--effects", EFFECTS[measured.kind.name], "--name", "t")
    return "t"


def test_every_kind_is_measured_here_or_says_that_it_cannot_be_simulated() -> None:
    assert {kind.name for kind in kinds() if not with_data(kind)} == {"placement"}


@pytest.mark.parametrize("kind", list(kinds()), ids=lambda kind: kind.name)
@pytest.mark.parametrize("verb", VERBS)
def test_what_a_kind_lacks_is_refused_with_its_name_and_a_way_out(kind: Kind, verb: str) -> None:
    if kind.offers(verb):
        kind.require(verb)
        return
    given = GIVEN.get(verb, ())
    asked = [lambda: kind.require(verb)]
    # Laws are a mark: nothing to call.
    asked += [lambda: getattr(kind, verb)(*given)] if verb != "laws" else []
    for ask in asked:
        with pytest.raises(NotOffered) as refused:
            ask()
        assert (refused.value.got, refused.value.code) == (kind.name, "kind.not_offered")
        assert refused.value.hint


@pytest.mark.parametrize("kind", list(kinds()), ids=lambda kind: kind.name)
def test_what_does_a_verb_takes_and_gives_what_the_verb_does(kind: Kind) -> None:
    for verb in kind.places:
        stated = inspect.getattr_static(Kind, verb)
        done = kind._done(verb)
        if isinstance(stated, property) or verb in {"training", "twin_correction"}:
            assert done is not None
        elif inspect.isclass(done):
            inspect.signature(done).bind(*list(inspect.signature(stated).parameters)[1:])
        else:
            asked, given = inspect.signature(stated), inspect.signature(done)
            given.bind(*list(asked.parameters)[1:])
            told = [str(s.return_annotation).replace("Mapping", "dict") for s in (asked, given)]
            one, other = (re.sub(r"\W|Sequence|Iterator|list|None", "", text) for text in told)
            assert one == other, verb


def test_effects_of_single_kinds_are_listed_and_shown() -> None:
    listed = json.loads(CliRunner().invoke(app, ["effects", "list", "--json"]).stdout)["of_kinds"]
    assert {(one["name"], *one["kinds"]) for one in listed} == {(name, k.name) for k in kinds() for name in k.effects}
    for one in listed:
        shown = CliRunner().invoke(app, ["effects", "show", one["name"]])
        assert f"{one['name']}: {one['title']}" in shown.output
        assert f"group: {one['group']}" in shown.output


def test_it_is_in_the_lake_as_it_was_measured(measured: Measured) -> None:
    lake = Lake(measured.home.lake)
    assert lake.campaign(measured.campaign).kind == measured.kind.name
    run = lake.load(lake.runs(measured.campaign)[0])
    assert set(measured.kind.columns) <= set(run.samples)
    again = measured.said("ingest", measured.folder)["campaigns"][0]
    assert again["added"] == []


def test_it_is_checked_and_told_after_its_standard(measured: Measured) -> None:
    checked = measured.said("check", measured.folder)
    assert not [f for f in checked.get("findings", []) if f["severity"] == "error"]
    assert ("sheet" in checked) == measured.kind.offers("sheet")
    if "sheet" in checked:
        told = {c["symbol"] for part in checked["sheet"]["parts"] for c in part["characteristics"]}
        assert told
        assert told <= set(measured.kind.figures)


def test_a_twin_is_fitted_diagnosed_compared_and_told(measured: Measured, twin: str) -> None:
    if not measured.kind.offers("twins"):
        with pytest.raises(NotOffered, match=f"a twin is not offered for {measured.kind.name} campaigns"):
            measured.said("twin", "fit", measured.campaign, "--effects", "", "--name", "t")
        return
    kind = measured.kind
    twins = kind.twins(measured.home, None)
    shown, diagnosis = twins.diagnose(twin)
    result = json.loads(json.dumps(diagnosis.as_dict(), default=float))
    assert result["verdict"]
    report = kind.twin_report
    assert EFFECTS[kind.name].split(":")[0] in json.dumps(
        [str(term) for term in measured.said("twin", "show", twin)["effects"]]
    )
    assert report.diagnosis_text(twin, result)
    sections = [report.twin_section(shown), report.diagnosis_section(twin, result)]
    assert "<section" in page("a twin", "", sections)


def test_its_runs_are_drawn_in_the_browser(measured: Measured) -> None:
    run = Lake(measured.home.lake).runs(measured.campaign)[0]["run_id"]
    browser = TestClient(application(Bench(measured.home, Access("127.0.0.1", 8765))), base_url="http://127.0.0.1:8765")
    shown = browser.get(f"/campaigns/{measured.campaign}/runs/{run}")
    assert shown.status_code == 200
    if not measured.kind.offers("drawings"):
        assert f'data-figure="/api/campaigns/{measured.campaign}/runs/' not in shown.text
        return
    named = [drawing.name for drawing in measured.kind.drawings]
    absent = browser.get(f"/api/campaigns/{measured.campaign}/runs/{run}/nothing")
    assert (absent.status_code, absent.json()["error"]["allowed"]) == (404, ", ".join(named))
    for drawing in measured.kind.drawings:
        figure = f"/api/campaigns/{measured.campaign}/runs/{run}/{drawing.name}"
        in_sheet = drawing.in_sheet and f"/api/campaigns/{measured.campaign}/sheet/" in shown.text
        assert (figure in shown.text) is not in_sheet
        assert browser.get(figure).json()["data"]


def test_an_equation_is_trained_gated_and_served_or_it_is_said_why_not(
    measured: Measured, monkeypatch: pytest.MonkeyPatch
) -> None:
    # All models that equations are compared with take half of the time; test_pipeline trains every one.
    few = [recipe for recipe in RECIPES if recipe.name in ("linear", "tree")]
    assert len(few) == 2
    monkeypatch.setattr("dtwin.kinds.sinusoidal._candidates.RECIPES", few)
    kind, lake = measured.kind, Lake(measured.home.lake)
    if not kind.offers("training"):
        with pytest.raises(NotOffered):
            measured.said("train", measured.campaign)
        return
    obstacle = kind.training_obstacle(lake.runs(measured.campaign))
    train = partial(kind.training(), lake, measured.campaign, seed=1, engine=Stub())
    if obstacle:
        with pytest.raises(InputError) as refused:
            train()
        assert refused.value.code.startswith("train.")
        return
    training = train()
    candidate = training.report.candidate(training.report.proposed)
    assert candidate.bundle is not None
    bundle = Bundle.from_dict(candidate.bundle) if isinstance(candidate.bundle, dict) else candidate.bundle
    assert bundle.corrects == kind.name
    assert kind.gates(bundle, candidate.numbers)
    CompiledBundle(bundle)


def test_a_twin_says_nothing_of_runs_that_turned_out_to_be_of_another_machine(measured: Measured, twin: str) -> None:
    if not measured.kind.offers("twins"):
        return
    lake = Lake(measured.home.lake)
    before = lake.campaign(measured.campaign).machine
    amend(lake, measured.campaign, ["machine=other"], "a wrong name")
    twins = measured.kind.twins(measured.home, None)
    for ask in (twins.diagnose, twins.compare):
        with pytest.raises(InputError, match="another machine"):
            ask(twin)
    amend(lake, measured.campaign, [f"machine={before}"], "it was right")
