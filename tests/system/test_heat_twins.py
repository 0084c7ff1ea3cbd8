"""Twins of ball arrays: the verbs of ``dtwin twin`` on a virtual mill whose causes are known."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from laser_axis import write_laser
from typer.testing import CliRunner

from dtwin.cli import app
from dtwin.config import home
from dtwin.errors import InputError, StoreError
from dtwin.kinds.volumetric._simulate import TRUTHS, simulate_volumetric
from dtwin.kinds.volumetric.heat_twins import HeatTwins
from dtwin.machines.volumetric import _SENSITIVITY, VolumetricParameters
from dtwin.plan_file import planned_campaign
from dtwin.train.registry import Registry
from dtwin.twins.on_campaign import look_at
from dtwin.twins.verbs import Twins

pytestmark = pytest.mark.system

EVERYTHING = "rigid_shift,rigid_turn,axis_expansion,uneven_expansion,squareness_drift,guideway_bending,carriage_turning"
NO_THERMOCOUPLE = ("foundation", "coolant_tank")
# The same mill with a thermocouple in everything that deforms it: cores through pockets. With
# sensors on the surface a twin without memory does not come down to the floor.
SEEN = {
    name: {body: k for body, k in of.items() if body not in NO_THERMOCOUPLE}
    for name, of in _SENSITIVITY.items()
    if set(NO_THERMOCOUPLE) & set(of)
}
Said = Callable[..., dict[str, Any]]


def measured(folder: Path, name: str, parameters: VolumetricParameters) -> None:
    """Measure 26 cycles and bring them into the lake."""
    plan = folder / f"{name}.toml"
    plan.write_text(
        f'[plan]\nkind = "volumetric"\nname = "{name}"\nmachine = "{name}-mill"\nhours = 234\nevery_h = 9\n'
    )
    simulate_volumetric(folder / name, lambda *_: None, parameters=parameters, plan=planned_campaign(plan).plan)
    assert CliRunner().invoke(app, ["ingest", str(folder / name)]).exit_code == 0


@pytest.fixture(scope="module")
def lake(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a home with a mill as it is and one with everything seen but one motion hidden."""
    folder = tmp_path_factory.mktemp("heat")
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("DTWIN_HOME", str(folder / "home"))
        measured(folder, "plain", VolumetricParameters())
        hidden = {**SEEN, "ECX1": {"column_side": 2.0}}
        measured(folder, "hidden", replace(TRUTHS["pockets"], hidden=hidden))
    return folder / "home"


@pytest.fixture
def said(lake: Path, monkeypatch: pytest.MonkeyPatch) -> Said:
    """Return what runs a verb of ``dtwin twin`` and gives its JSON."""
    monkeypatch.setenv("DTWIN_HOME", str(lake))

    def run(*words: str) -> dict[str, Any]:
        done = CliRunner().invoke(app, ["twin", *words, "--json"], catch_exceptions=False)
        assert done.exit_code == 0, done.output
        return dict(json.loads(done.stdout))

    return run


def in_group(found: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    return {c["effect"]: c for c in found["candidates"] if c["in_group"]}


def left_of(compared: Mapping[str, Any], motion: str) -> float:
    return float(next(m["rms_after_um"] for m in compared["motions"] if m["effect"] == motion))


def test_a_hidden_motion_is_named_and_the_error_falls_to_the_floor(said: Said) -> None:
    fitted = said("fit", "hidden", "--effects", EVERYTHING, "--name", "h")
    found = said("diagnose", "h")
    assert (found["verdict"], set(in_group(found))) == ("missing_effect", {"ECX1"})
    ecx1 = in_group(found)["ECX1"]
    assert (ecx1["axis"], ecx1["add"], ecx1["family"]) == ("X", "ECX1", "carriage_turning")
    assert ecx1["cv_gain"] > 0.9
    assert ecx1["p_value"] < 0.01
    assert any(s.startswith("column_side") for s in ecx1["temperatures"])
    floor = found["noise_floor_um"]
    assert found["residual_rms_um"] > 1.3 * floor
    assert {place["axis"] for place in found["where"]} <= {"X", "Y"}, "a turn about Z"
    added = said("add", "h", ecx1["effect"], "--axis", ecx1["axis"])
    assert added["before"] == fitted["figures"]
    assert added["figures"]["rms_after_um"] < 1.3 * floor
    # Every motion that acts is in the twin, but 26 cycles do not tell what drives one of them from time: that is told, and not named.
    last = said("diagnose", "h")
    assert (last["verdict"], [(c["effect"], c["as_time_alone"]) for c in last["candidates"]]) == (
        "ambiguous",
        [("EC0", ["column_top"])],
    )
    assert "so does time alone" in last["headline"]
    rungs = said("history", "h")["rungs"]
    assert [(r["action"], r["verdict"]) for r in rungs] == [("fit", "missing_effect"), ("add ECX1", "ambiguous")]
    assert rungs[0]["group"] == ["ECX1"]
    versions = Registry(home()).client.search_model_versions("name='twin-h'")
    assert {v.tags["verdict"] for v in versions} == {"missing_effect", "ambiguous"}


def test_what_was_left_out_is_found_again_one_by_one(said: Said) -> None:
    begun = "rigid_shift,squareness_drift,guideway_bending,carriage_turning,ECX1"
    said("fit", "hidden", "--effects", begun, "--name", "ladder")
    found = said("discover", "ladder")
    assert not any(c["add"] and not c["as_time_alone"] for c in found["final"]["candidates"])
    assert {label.partition("@")[0] for label in found["added"]} >= {"EXX1", "EYY1", "EZZ1", "EA0", "EB0"}
    errors = [rung["rms_after_um"] for rung in found["history"]]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1.3 * found["final"]["noise_floor_um"] < 0.2 * errors[0]


def test_what_no_thermocouple_tells_is_unknown_and_the_logged_cause_is_named(said: Said) -> None:
    said("fit", "plain", "--effects", EVERYTHING, "--name", "p")
    found = said("diagnose", "p")
    assert found["verdict"] == "unknown_effect"
    exz1 = in_group(found)["EXZ1"]
    assert (exz1["explained_by"], exz1["add"]) == ("coolant_tank_c", "EXZ1@coolant_tank_c")
    assert found["channels"] == ["coolant_tank_c"]
    assert "coolant_tank_c" in found["headline"]
    before = left_of(said("compare", "p"), "EXZ1")
    said("add", "p", exz1["add"])
    assert left_of(said("compare", "p"), "EXZ1") < 0.2 * before
    last = said("diagnose", "p")
    assert "EXZ1" not in in_group(last)
    # The foundation has no thermocouple and is not logged: the twin must not claim to be whole.
    assert last["verdict"] in ("ambiguous", "unknown_effect")
    assert next(c for c in last["candidates"] if c["effect"] == "EX0")["add"] is None


def test_a_twin_is_compared_shown_and_put_back(said: Said, tmp_path: Path) -> None:
    said("fit", "plain", "--effects", "rigid_shift,EXX1@bed", "--name", "c")
    found = said("compare", "c")
    assert found["residual_rms_um"] < found["rms_before_um"]
    motions = {m["effect"]: m for m in found["motions"]}
    assert (motions["EXX1"]["in_twin"], motions["EYY1"]["in_twin"]) == ("EXX1@bed", None)
    assert motions["EYY1"]["rms_after_um"] == motions["EYY1"]["rms_before_um"]
    assert sum(day["cycles"] for day in found["conditions"]) == 26
    shown = said("show", "c", "--html", str(tmp_path / "whole.html"))
    (exx1,) = [e for e in shown["effects"] if e["effect"] == "EXX1"]
    assert exx1["sources"] == ["bed"]
    assert all(name.startswith("bed_") for name in exx1["temperatures"])
    written = (tmp_path / "whole.html").read_text("utf-8")
    assert all(part in written for part in ("What is missing", "Every error motion", "day by day"))
    fewer = said("remove", "c", "rigid_shift")
    assert [e["label"] for e in fewer["effects"]] == ["EXX1@bed"]
    assert fewer["figures"]["rms_after_um"] > shown["figures"]["rms_after_um"]
    wider = said("add", "c", "EXX1@back_air")
    assert [e["sources"] for e in wider["effects"] if e["effect"] == "EXX1"] == [["back_air", "bed"]]
    back = said("restore", "c", "--version", "1")
    assert back["figures"] == shown["figures"]
    told = CliRunner().invoke(app, ["twin", "diagnose", "c"]).stdout
    assert "try: dtwin twin add c " in told


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("fit", "plain", "--effects", "backlash", "--name", "q"), "twin.effect"),
        (("fit", "plain", "--effects", "EXZ1@oven_c", "--name", "q"), "volumetric.sensors"),
        (("fit", "plain", "--effects", "EBZ1", "--name", "q"), "volumetric.rank"),
        (("fit", "plain", "--effects", "EXX1,EXX1@bed", "--name", "q"), "twin.effect_twice"),
        (("fit", "plain", "--effects", "EXX1", "--name", "q", "--robust"), "twin.robust"),
        (("add", "kept", "EXX1"), "twin.has_effect"),
        (("add", "kept", "axis_expansion", "--axis", "Q"), "twin.effect_axis"),
        (("remove", "kept", "EYY1"), "twin.no_effect"),
        (("compare", "kept", "--on", "hidden"), "twin.machine"),
        (("compare", "kept", "--split-hz", "5"), "split.no_columns"),
        (("learn", "kept"), "kind.not_offered"),
        (("show", "kept", "--version", "9"), "twin.version"),
    ],
)
def test_what_cannot_be_is_refused_and_nothing_written(
    said: Said, lake: Path, words: tuple[str, ...], code: str
) -> None:
    if not (lake / "twins" / "kept").exists():
        said("fit", "plain", "--effects", "EXX1", "--name", "kept")
    before = sorted((lake / "twins").rglob("*.json"))
    with pytest.raises(InputError) as caught:
        CliRunner().invoke(app, ["twin", *words], catch_exceptions=False)
    assert caught.value.code == code
    assert sorted((lake / "twins").rglob("*.json")) == before


def test_a_ball_array_and_a_laser_of_one_mill_have_one_twin(said: Said, tmp_path: Path) -> None:
    write_laser(tmp_path / "laser", "plain-mill", "X", 20.0, 2.0)
    assert CliRunner().invoke(app, ["ingest", str(tmp_path / "laser")]).exit_code == 0
    made = said("fit", "laser", "plain", "--effects", "backlash:X,EXX1", "--name", "both")
    assert [(c["campaign"], c["kind"]) for c in made["campaigns"]] == [("laser", "linear"), ("plain", "volumetric")]
    assert {e["label"]: e["campaigns"] for e in made["effects"]} == {"backlash:X": ["laser"], "EXX1": ["plain"]}
    assert said("compare", "both", "--on", "plain")["motions"]


def test_twins_of_one_kind_are_not_taken_for_those_of_another(said: Said, lake: Path) -> None:
    shutil.rmtree(lake / "twins", ignore_errors=True)
    said("fit", "plain", "--effects", "EXX1", "--name", "heat")
    assert "heat" in HeatTwins(home()).names()
    assert "heat" not in Twins(home()).names()
    seen = {view.name: view.result for view in look_at(home(), "plain-mill", "plain")}
    assert seen["heat"]["verdict"] == "missing_effect"
    spoilt = lake / "twins" / "heat" / "v001.json"
    spoilt.write_text(spoilt.read_text("utf-8").replace('"effects"', '"defects"'), "utf-8")
    with pytest.raises(StoreError, match="cannot be read"):
        HeatTwins(home()).newest("heat")
