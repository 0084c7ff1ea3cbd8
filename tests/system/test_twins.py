"""The heart: compare, see where it fails, learn what is missing, add it, watch the error fall."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_here import command_here, printed, said
from starlette.testclient import TestClient
from typer.testing import CliRunner

from dtwin.acquire.amending import amend, leave_out
from dtwin.cli import app
from dtwin.config import Home
from dtwin.documents import finite
from dtwin.errors import GateRefusal, InputError, StoreError
from dtwin.lake.store import Lake
from dtwin.locks import take
from dtwin.physics.library import Library
from dtwin.physics.several_twin import SeveralTwin
from dtwin.progress import telling
from dtwin.report.twins import twin_text
from dtwin.train.residual_formula import place_map, place_map_effect
from dtwin.train.symbolic import OperonEngine
from dtwin.twins.confirm import confirm, interventions
from dtwin.twins.learn import learn_formula, learn_law, learn_map
from dtwin.twins.measured import load
from dtwin.twins.registration import diagnosis_path
from dtwin.twins.verbs import Twins
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application

pytestmark = pytest.mark.system

NOISE_UM = 0.3
KNOWN = ["centre_offset", "radius_offset", "scale_mismatch", "squareness"]


def deviation_um(theta: np.ndarray, radius_mm: float, feed_mm_min: float, sign: float, hidden: str) -> np.ndarray:
    """Push points of a circle and measure the distance: no formula of the library."""
    x, y = radius_mm * np.cos(theta), radius_mm * np.sin(theta)
    ex = x * 30e-3 - y * 25e-3 + 8.0
    ey = np.full_like(theta, -5.0)
    if hidden == "backlash":
        ex = ex + np.where(sign * np.sin(theta) > 0, 3.0, -3.0)
    if hidden == "sister":
        ex = 16.0 - ex
    if hidden == "guide":
        # A guide that was ground unevenly: the same waves of the place at every feed, of no effect's form.
        knots = np.random.default_rng(11).standard_normal(60)
        ey = ey + 0.8 * np.interp(x, np.linspace(-160.0, 160.0, 60), knots)
    if hidden == "strange":
        # A wobble with five waves that grows with the feed: in nobody's library.
        ex = ex + 1.5 * feed_mm_min / 2000.0 * np.cos(5 * theta + 0.3) * np.cos(theta)
        ey = ey + 1.5 * feed_mm_min / 2000.0 * np.cos(5 * theta + 0.3) * np.sin(theta)
    return (np.hypot(x + ex / 1000, y + ey / 1000) - radius_mm) * 1000


def write_campaign(
    folder: Path,
    hidden: str,
    *,
    name: str = "mill-march",
    machine: str = "mill-a",
    feeds: tuple[float, ...] = (1000.0, 2000.0, 4000.0),
    radii: tuple[float, ...] = (100.0, 150.0),
    repeats: int = 3,
    directions: tuple[str, ...] = ("CCW", "CW"),
) -> Path:
    rng = np.random.default_rng(7)
    folder.mkdir(parents=True)
    lines = ["[campaign]", f'name = "{name}"', f'machine = "{machine}"', 'kind = "circular"']
    number = 0
    for radius in radii:
        for repeat in range(1, repeats + 1):
            for feed in feeds:
                for direction in directions:
                    number += 1
                    sign = 1.0 if direction == "CCW" else -1.0
                    angle = (np.linspace(0.0, 360.0, 721) + 0.13)[:: int(sign)]
                    theta = np.radians(angle)
                    clean = deviation_um(theta, radius, feed, sign, hidden)
                    wave = 0.2 * rng.standard_normal() + 0.2 * rng.standard_normal() * np.cos(
                        2 * theta + rng.uniform(0, 6)
                    )
                    noisy = clean + wave + NOISE_UM * rng.standard_normal(len(angle))
                    t_s = np.radians(np.arange(721) / 2.0) * radius / (feed / 60.0)
                    table = np.column_stack([t_s, angle, noisy])
                    file = f"r{number:03d}.csv"
                    np.savetxt(
                        folder / file,
                        table,
                        delimiter=",",
                        fmt="%.5f",
                        comments="",
                        header="t_s,angle_deg,deviation_um",
                    )
                    lines += [
                        "[[run]]",
                        f'id = "r{number:03d}"',
                        f'file = "{file}"',
                        'plane = "XY"',
                        f"radius_mm = {radius}",
                        f"feed_mm_min = {feed}",
                        f'direction = "{direction}"',
                        f"repeat = {repeat}",
                        f'setup = "s{radius:g}"',
                    ]
    (folder / "campaign.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Home:
    made = Home(tmp_path_factory.mktemp("twins") / "home")
    folder = write_campaign(made.root.parent / "mill", "backlash")
    load(made, str(folder))
    return made


@pytest.fixture
def twins(home: Home) -> Twins:
    shutil.rmtree(home.root / "twins", ignore_errors=True)
    return Twins(home)


def test_the_missing_effect_is_named_added_and_the_error_falls(twins: Twins, monkeypatch: pytest.MonkeyPatch) -> None:
    first = twins.fit("mill-march", KNOWN, "mill-a")
    assert first.figures["systematic_rms_um"] > 4 * first.figures["noise_floor_um"]
    by_name = {(e.effect, e.axis): e for e in first.estimates}
    assert by_name["scale_mismatch", "XY"].value == pytest.approx(30.0, abs=2.0)

    compared = twins.compare("mill-a").as_dict()
    assert "odd in direction" in compared["headline"]
    assert compared["noise_floor_um"] == pytest.approx(first.figures["noise_floor_um"], rel=0.15)

    _, found = twins.diagnose("mill-a")
    assert found.verdict == "missing_effect"
    (named,) = found.group
    assert (named.effect, named.axis, named.grade) == ("backlash", "X", "law-confirmed")
    assert named.rms_after_um < 1.2 * found.noise_floor_um
    assert named.cv_gain > 0.8
    assert named.p_value < 1e-4

    second = twins.add("mill-a", named.effect, named.axis)
    (play,) = [e for e in second.estimates if e.effect == "backlash"]
    # The backlash pulls against the motion in the library, with it in this mill.
    assert abs(play.value) == pytest.approx(6.0, abs=play.uncertainty + 0.05)
    assert second.figures["rms_after_um"] < 0.35 * first.figures["rms_after_um"]
    _, after = twins.diagnose("mill-a")
    assert after.verdict == "nothing_missing"

    history = twins.history("mill-a")
    assert [r["action"] for r in history] == ["fit", "add backlash X"]
    assert [r["verdict"] for r in history] == ["missing_effect", "nothing_missing"]
    assert history[0]["group"] == ["backlash X"]
    assert history[0]["found"] == [["backlash X"]]
    assert history[1]["found"] == []

    # What was found of a version is not added to what another process made of it meanwhile.
    found_out = twins.diagnose

    def while_another_goes_back(name: str, *, seed: int = 0) -> Any:
        said = found_out(name, seed=seed)
        twins.restore(name, 1)
        return said

    twins.remove("mill-a", "backlash")
    monkeypatch.setattr(twins, "diagnose", while_another_goes_back)
    with pytest.raises(InputError, match="another process changed the twin"):
        twins.discover("mill-a")
    assert twins.newest("mill-a").labels == first.labels


def test_every_rung_is_a_child_run_and_a_version_in_mlflow(twins: Twins) -> None:
    from dtwin.train.registry import Registry

    twins.fit("mill-march", KNOWN, "logged")
    twins.diagnose("logged")
    twins.add("logged", "backlash", "X")
    rungs = twins.history("logged")
    client = Registry(twins.home).client
    parents = set()
    for rung in rungs:
        run = client.get_run(rung["mlflow"]["run_id"])
        parents.add(run.data.tags["mlflow.parentRunId"])
        assert run.data.metrics["rms_after_um"] == pytest.approx(rung["rms_after_um"])
        version = client.get_model_version("twin-logged", rung["mlflow"]["model_version"])
        assert version.tags["twin_version"] == str(rung["version"])
    (parent,) = parents
    shown = client.get_metric_history(parent, "rms_after_um")
    assert [(m.step, m.value) for m in shown] == [(r["version"], pytest.approx(r["rms_after_um"])) for r in rungs]
    assert client.get_registered_model("twin-logged").tags == {"machine": "mill-a", "holds": "twin"}
    first = client.get_model_version("twin-logged", rungs[0]["mlflow"]["model_version"])
    assert (first.tags["verdict"], first.tags["group"]) == ("missing_effect", "backlash X")


def test_mlflow_follows_in_the_background_and_in_order(twins: Twins, monkeypatch: pytest.MonkeyPatch) -> None:
    from dtwin.train.registry import Registry
    from dtwin.twins import registration as twin_registration

    monkeypatch.setenv("DTWIN_MLFLOW", "later")
    twins.fit("mill-march", KNOWN, "fast")
    twins.add("fast", "backlash", "X")
    twins.remove("fast", "backlash", "X")
    assert [w.label for w in twin_registration.waiting(twins.home)][-1] == "fast v003"
    for child in twin_registration._children:
        assert child.wait() == 0
    assert twin_registration.waiting(twins.home) == []
    found = Registry(twins.home).client.search_model_versions("name='twin-fast'")
    shown = [v.tags["action"] for v in sorted(found, key=lambda v: int(v.version))]
    assert shown == ["fit", "add backlash X", "remove backlash"]
    numbers = [r["mlflow"]["model_version"] for r in twins.history("fast")]
    assert numbers == ["1", "2", "3"]
    # The newest version of that moment was diagnosed ahead, and MLflow was told of that too.
    told = {int(v.tags["twin_version"]) for v in found if "verdict" in v.tags}
    assert told
    assert told == {n for n in (1, 2, 3) if diagnosis_path(twins.newest_document("fast", n)[1]).exists()}


def test_a_diagnosis_is_read_again_until_something_changes(twins: Twins, monkeypatch: pytest.MonkeyPatch) -> None:
    twins.fit("mill-march", ["centre_offset"], "kept")
    _, first = twins.diagnose("kept")
    path = twins.newest_document("kept")[1]
    asked: list[int] = []

    def made(*args: Any, seed: int) -> Any:
        asked.append(seed)
        return first

    monkeypatch.setattr("dtwin.twins.verbs.diagnose", made)
    _, again = twins.diagnose("kept")
    assert not asked
    assert again.found == first.found
    assert finite(again.as_dict()) == finite(first.as_dict())
    twins.diagnose("kept", seed=1)
    assert asked == [1]
    diagnosis_path(path).write_text("{", encoding="utf-8")
    twins.diagnose("kept", seed=1)
    twins.diagnose("kept", seed=1)
    assert asked == [1, 1]
    run = str(Lake(twins.home.lake).runs("mill-march")[0]["run_id"])
    leave_out(Lake(twins.home.lake), "mill-march", [run], "a cable touched the bar")
    twins.diagnose("kept", seed=1)
    assert asked == [1, 1, 1]
    monkeypatch.setattr("dtwin.twins._kept_diagnosis.diagnosing_code", lambda: "another version")
    twins.diagnose("kept", seed=1)
    assert asked == [1, 1, 1, 1]
    monkeypatch.setattr("dtwin.twins.verbs._PATIENCE_S", 0.1)
    stages: list[str] = []
    with path.open() as held, telling(stages.append):
        # Another process that hangs while it diagnoses.
        assert take(held)
        twins.diagnose("kept", seed=2)
    assert asked[-1] == 2
    assert stages[0].startswith("twin kept version 1: waiting for another process that diagnoses it")


def test_discover_goes_down_to_the_floor_and_remove_goes_back(twins: Twins) -> None:
    twins.fit("mill-march", ["centre_offset"], "mill-a")
    made, groups, said = twins.discover("mill-a")
    names = {label for twin in made for label in twin.labels}
    assert names == {"scale_mismatch XY", "squareness XY", "backlash X"}
    assert len(made) == len(groups) == 3
    assert said.verdict == "nothing_missing"
    before = made[-1].figures["rms_after_um"]
    assert twins.remove("mill-a", "backlash").figures["rms_after_um"] > 2 * before
    with pytest.raises(InputError, match="does not have"):
        twins.remove("mill-a", "backlash")
    with pytest.raises(InputError, match="has this effect already"):
        twins.add("mill-a", "squareness")


@pytest.mark.long
def test_an_unknown_effect_is_said_to_be_unknown_until_a_law_or_a_file_explains_it(home: Home, tmp_path: Path) -> None:
    folder = write_campaign(tmp_path / "odd", "strange", name="odd-mill", machine="odd")
    twins = Twins(home)
    twins.fit(str(folder), KNOWN, "odd")
    _, found = twins.diagnose("odd")
    assert found.verdict == "unknown_effect"
    assert not found.group
    assert (found.laws[0].harmonic, found.laws[0].odd, found.laws[0].feed) == (5, False, 1.0)

    learned = learn_law(twins, "odd")
    assert learned.twin.labels[-1] == "learned_even_h5_f1_r0"
    assert learned.gain > 0.5
    _, after = twins.diagnose("odd")
    assert after.verdict == "nothing_missing"
    with pytest.raises(GateRefusal):
        learn_law(twins, "odd")

    own = tmp_path / "wobble.py"
    own.write_text(
        (Path(__file__).parents[2] / "docs" / "tutorials" / "wobble.py").read_text("utf-8"), encoding="utf-8"
    )
    mine = Twins(home, Library([own]))
    mine.fit("odd-mill", KNOWN, "own")
    _, named = mine.diagnose("own")
    assert [s.label for s in named.group] == ["wobble"]
    added = mine.add("own", "wobble")
    assert added.figures["rms_after_um"] < 1.1 * added.figures["noise_floor_um"]
    with pytest.raises(InputError, match="not known here"):
        Twins(home).newest("own")


def test_poor_data_get_an_honest_verdict(home: Home, tmp_path: Path) -> None:
    twins = Twins(home)
    folder = write_campaign(tmp_path / "once", "backlash", name="once", repeats=1)
    twins.fit(str(folder), KNOWN, "once")
    _, once = twins.diagnose("once")
    assert once.verdict == "need_repeats"
    assert once.next_experiment is not None
    assert once.next_experiment["repeats"] >= 2
    assert np.isnan(twins.newest("once").estimates[0].uncertainty)

    folder = write_campaign(
        tmp_path / "one-way", "none", name="one-way", feeds=(2000.0,), radii=(100.0,), directions=("CCW",)
    )
    twins.fit(str(folder), ["scale_mismatch"], "one-way")
    _, group = twins.diagnose("one-way")
    assert group.verdict == "ambiguous"
    assert {"squareness XY", "servo_mismatch XY"} <= {s.label for s in group.group}
    assert group.next_experiment is not None
    assert "direction" in json.dumps(group.next_experiment)

    both = twins.fit("one-way", ["squareness", "servo_mismatch"], "aliased")
    assert len(both.aliases) == 1
    assert not any(e.identifiable for e in both.estimates)
    assert "Reverse the direction" in both.aliases[0]["separate_by"]


def test_copies_are_no_repeats(home: Home, tmp_path: Path) -> None:
    folder = write_campaign(tmp_path / "copied", "none", name="copied", feeds=(2000.0,), radii=(100.0,), repeats=2)
    shutil.copy(folder / "r001.csv", folder / "r003.csv")
    twin = Twins(home).fit(str(folder), KNOWN, "copied")
    assert list(twin.data["left_out"]) == ["r003"]
    assert "samples are those of run r001" in twin.data["left_out"]["r003"]


def test_what_was_left_out_or_stated_anew_is_told_by_twin_and_diagnosis(home: Home, tmp_path: Path) -> None:
    folder = write_campaign(tmp_path / "told", "none", name="told", feeds=(2000.0,), radii=(100.0,), repeats=3)
    twins = Twins(home)
    before = twins.fit(str(folder), KNOWN, "told")
    leave_out(Lake(home.lake), "told", ["r001"], "the magnet slipped")
    amend(Lake(home.lake), "told", ["instrument.calibrated_mm=100.015"], "another master")
    twin = twins.fit("told", KNOWN, "told")
    assert twin.data["n_runs"] == before.data["n_runs"] - 1
    assert twin.data["left_out"] == {"r001": "the magnet slipped"}
    assert twin.data["amendments"] == Lake(home.lake).versions()["amendments"]
    _, found = twins.diagnose("told")
    assert "left out, r001: the magnet slipped" in found.told
    assert "another master" in found.told[-1]


def test_a_twin_stays_on_its_machine_and_says_where_it_is_outside(twins: Twins, home: Home, tmp_path: Path) -> None:
    twins.fit("mill-march", KNOWN, "mill-a")
    other = write_campaign(tmp_path / "b", "none", name="other", machine="mill-b")
    with pytest.raises(InputError, match="another machine"):
        twins.compare("mill-a", str(other))
    fast = write_campaign(tmp_path / "f", "backlash", name="fast", feeds=(8000.0,), repeats=2)
    found = twins.compare("mill-a", str(fast))
    assert "outside the conditions of the fit" in found.warnings[0]


def test_a_warmer_day_is_foretold_from_the_temperature_of_the_fit(home: Home, tmp_path: Path) -> None:
    for name, warm_c in (("cold", 0.0), ("warm", 5.0)):
        folder = write_campaign(tmp_path / name, "none", name=name, feeds=(2000.0,), radii=(150.0,), repeats=3)
        told = (folder / "campaign.toml").read_text(encoding="utf-8").split("[[run]]")
        for number in range(1, len(told)):
            rise_c = warm_c + 0.25 * number
            told[number] += f"[run.covariates]\ntemperature_c = {20.0 + rise_c}\n"
            file = folder / f"r{number:03d}.csv"
            table = np.loadtxt(file, delimiter=",", skiprows=1)
            table[:, 2] += 12.0 * 0.15 * rise_c * np.cos(np.radians(table[:, 1])) ** 2
            np.savetxt(file, table, delimiter=",", fmt="%.5f", comments="", header="t_s,angle_deg,deviation_um")
        (folder / "campaign.toml").write_text("[[run]]".join(told), encoding="utf-8")
    twins = Twins(home)
    twin = twins.fit(str(tmp_path / "cold"), [*KNOWN, "thermal_growth:X"], "t")
    left = twins.compare("t", str(tmp_path / "warm")).as_dict()
    assert left["systematic_rms_um"] < 0.5, "5 K make an oval of 3.2 µm RMS"
    assert twins.budget(twin, "warm")[0].left_um < 0.6
    # In one twin the machine has not changed: it was warmer.
    both = twins.fit(["cold", "warm"], [*KNOWN, "thermal_growth:X"], "both")
    assert isinstance(both, SeveralTwin)
    assert both.contradictions == ()
    (growth,) = (e for e in both.estimates if e.effect == "thermal_growth")
    assert growth.value == pytest.approx(12.0, abs=0.2)
    assert all(twins.compare("both", name).as_dict()["systematic_rms_um"] < 0.5 for name in ("cold", "warm"))


def test_mistakes_are_named(twins: Twins, home: Home) -> None:
    with pytest.raises(InputError, match="no such effect"):
        twins.fit("mill-march", ["backlush"], "mill-a")
    with pytest.raises(InputError, match="cannot act"):
        twins.fit("mill-march", ["backlash:Z"], "mill-a")
    with pytest.raises(InputError, match="cannot act"):
        twins.fit("mill-march", ["thermal_growth"], "mill-a")
    with pytest.raises(InputError, match="no such twin"):
        twins.compare("mill-z")
    with pytest.raises(InputError):
        twins.fit("mill-march", KNOWN, "../escape")
    assert not (home.root / "twins" / "mill-a").exists(), "half a twin was left"
    twins.fit("mill-march", KNOWN, "damaged")
    (home.root / "twins" / "damaged" / "v001.json").write_text("{", encoding="utf-8")
    with pytest.raises(StoreError):
        twins.compare("damaged")


@pytest.mark.long
def test_the_command_line_says_the_same(
    home: Home, twins: Twins, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(home.root))
    assert "noise floor" in printed("twin", "fit", "mill-march", "--effects", ",".join(KNOWN), "--name", "cli")
    result = said("twin", "diagnose", "cli")
    assert {
        "twin",
        "version",
        "campaign",
        "verdict",
        "residual_rms_um",
        "noise_floor_um",
        "lack_of_fit_p",
        "candidates",
        "where",
        "next_experiment",
    } <= set(result)
    assert {"effect", "axis", "rms_after_um", "cv_gain", "p_value", "in_group", "grade", "confounded_with"} <= set(
        result["candidates"][0]
    )
    page = tmp_path / "twin.html"
    printed("twin", "show", "cli", "--html", page)
    content = page.read_text(encoding="utf-8")
    for heading in ("ISO 230-4", "G(b)", "The twin", "Measured against predicted", "What is missing"):
        assert heading in content
    assert 'src="http' not in content, "the page needs the network"
    code, _, err = command_here("twin", "add", "cli", "warp_drive")
    assert code == 1
    assert "effect.unknown" in err


def test_runs_with_errors_are_left_out_and_said_so(home: Home, tmp_path: Path) -> None:
    folder = write_campaign(tmp_path / "mill", "none", name="with-a-bad-run", radii=(100.0,))
    spoilt = folder / "r001.csv"
    table = np.loadtxt(spoilt, delimiter=",", skiprows=1)
    table[100:400, 2] = table[100, 2]
    np.savetxt(spoilt, table, delimiter=",", header="t_s,angle_deg,deviation_um", comments="")
    load(home, str(folder))
    twins = Twins(home)
    twin = twins.fit("with-a-bad-run", KNOWN, "mill-b")
    assert list(twin.data["left_out"]) == ["r001"]
    assert "warning: left out, r001" in twin_text(twin)
    assert any("stuck sensor" in warning for warning in twins.compare("mill-b").warnings)


def test_an_effect_that_went_when_it_was_mended_is_intervention_confirmed(twins: Twins, tmp_path: Path) -> None:
    twins.fit("mill-march", [*KNOWN, "backlash:X"], "mill-a")
    mended = write_campaign(tmp_path / "mended", "none", name="mill-mended")
    found = confirm(twins, "mill-a", "backlash:X", [str(mended)], "ball nut preloaded")
    (play,) = [c for c in found.changes if c.name == "backlash"]
    assert found.confirmed
    assert (abs(play.before), play.after) == (pytest.approx(6.0, abs=0.3), pytest.approx(0.0, abs=0.3))
    # The scales were not touched.
    kept = confirm(twins, "mill-a", "scale_mismatch:XY", ["mill-mended"], "ball nut preloaded")
    assert not kept.confirmed
    assert [i["grade"] for i in interventions(twins, "mill-a")] == ["intervention-confirmed", None]
    with pytest.raises(InputError, match="other measurements of the same machine"):
        confirm(twins, "mill-a", "backlash:X", ["mill-march"], "")


def test_measurements_of_a_sister_machine_confirm_no_repair(twins: Twins, tmp_path: Path) -> None:
    twins.fit("mill-march", [*KNOWN, "backlash:X"], "mill-a")
    sister = write_campaign(tmp_path / "sister", "sister", name="mill-of-the-sister", feeds=(1000.0,), radii=(100.0,))
    found = confirm(twins, "mill-a", "backlash:X", [str(sister)], "ball nut preloaded")
    assert all(change.went for change in found.changes)
    assert not found.confirmed
    assert {change.name for change in found.others} == {"scale_mismatch XY", "squareness XY"}


def test_a_home_that_can_only_be_read_gives_a_diagnosis_and_says_that_it_is_not_kept(
    twins: Twins, monkeypatch: pytest.MonkeyPatch
) -> None:
    twins.fit("mill-march", KNOWN, "mill-a")
    monkeypatch.setenv("DTWIN_HOME", str(twins.home.root))
    # Whoever tests as root may write everywhere.
    monkeypatch.setattr("dtwin.twins.shelf.os.access", lambda *_: False)
    told = CliRunner().invoke(app, ["twin", "diagnose", "mill-a", "--json"], catch_exceptions=False)
    assert json.loads(told.stdout)["verdict"] == "missing_effect"
    assert "nothing is kept" in told.stderr
    assert not list((twins.home.root / "twins").rglob("*.diagnosis.json"))


def test_an_older_version_can_be_restored_as_a_new_one(twins: Twins) -> None:
    first = twins.fit("mill-march", KNOWN, "mill-a")
    twins.add("mill-a", "backlash", "X")
    third = twins.restore("mill-a", 1)
    assert (third.version, third.action, third.labels) == (3, "restore v1", first.labels)
    assert third.figures["rms_after_um"] == pytest.approx(first.figures["rms_after_um"])
    # The comparison states the same noise floor as the fit.
    floor = twins.compare("mill-a").as_dict()["noise_floor_um"]
    assert floor == pytest.approx(third.figures["noise_floor_um"])


@pytest.mark.long
def test_a_formula_is_learned_where_nothing_in_the_library_helps(home: Home, tmp_path: Path) -> None:
    load(home, str(write_campaign(tmp_path / "odd", "strange", name="strange-mill", machine="mill-c")))
    twins = Twins(home)
    first = twins.fit("strange-mill", KNOWN, "strange")
    learned = learn_formula(twins, "strange", OperonEngine())
    second = learned.twin
    assert learned.gain > 0.7
    assert second.figures["rms_after_um"] < 0.5 * first.figures["rms_after_um"]
    (factor,) = [e for e in second.estimates if e.effect.startswith("learned_formula_")]
    assert factor.value == pytest.approx(1.0, abs=0.1)
    # Another process reads the formula back from its file.
    again = Twins(home).newest("strange")
    assert again.labels == second.labels
    assert Twins(home).compare("strange").as_dict()["residual_rms_um"] == pytest.approx(
        second.figures["rms_after_um"], rel=0.02
    )
    kept = home.root / "formulas" / f"{factor.effect}.json"
    kept.write_text(json.dumps({"text": "__import__('os').system('true')"}))
    with pytest.raises(StoreError, match="learned effect cannot be read"):
        Twins(home).newest("strange")


def test_a_map_of_what_is_left_foretells_a_feed_that_it_never_saw(home: Home, tmp_path: Path) -> None:
    twins = Twins(home)
    train = write_campaign(tmp_path / "guide", "guide", name="guide", machine="ground", feeds=(1000.0, 4000.0))
    held = write_campaign(tmp_path / "held", "guide", name="guide-held", machine="ground", feeds=(2000.0,))
    for folder in (train, held):
        load(home, str(folder))
    twins.fit("guide", KNOWN, "guide")
    twins.discover("guide")
    before = twins.compare("guide", "guide-held").as_dict()
    learned = learn_map(twins, "guide")
    assert learned.gain > 0.3
    assert learned.left_out == "a plane and radius, 2, and each feed"
    after = twins.compare("guide", "guide-held").as_dict()
    assert after["systematic_rms_um"] < 0.5 * before["systematic_rms_um"]
    page = TestClient(application(Bench(home, Access("127.0.0.1", 8765))), base_url="http://127.0.0.1:8765")
    assert "Learned map" in page.get("/twins/guide/versions").text
    # Nothing is foretold of a circle that was not measured, and no machine is moved by a description.
    assert not learned.twin.terms[-1].instance.effect.correctable
    other = load(home, str(write_campaign(tmp_path / "far", "guide", name="far", machine="ground", radii=(120.0,)))).obs
    assert not other.regressors(learned.twin.terms[-1].instance, {}).any()
    # Another process reads it back; what was changed is refused.
    (name,) = {e.effect for e in learned.twin.estimates if e.effect.startswith("learned_map_")}
    assert Twins(home).newest("guide").labels == learned.twin.labels
    shown = CliRunner().invoke(app, ["effects", "show", name], env={"DTWIN_HOME": str(home.root)})
    assert "Learned map" in shown.output
    (home.root / "formulas" / f"{name}.json").write_text(json.dumps({"text": "[]"}))
    with pytest.raises(StoreError, match="learned effect cannot be read"):
        Twins(home).newest("guide")


def test_a_map_needs_two_places_and_what_agrees_at_every_feed(home: Home, tmp_path: Path) -> None:
    obs = load(home, "mill-march").obs
    rng = np.random.default_rng(3)
    circles = sorted({(c.radius_mm, c.direction) for c in obs.conditions})
    waves = rng.standard_normal((len(obs.conditions), 360))
    own = place_map(obs, waves[obs.condition_of])
    assert own.gain < 0.02
    assert own.groups == 2
    for text in ('[["XY", 100.0, 1.0, [1.0, 2.0]]]', '[["XY", 100.0, 1.0, "a"]]', "[[1]]"):
        with pytest.raises(ValueError, match=r"errors instead|convert|unpack"):
            place_map_effect("learned_map_00000000", text)
    circle = [circles.index((c.radius_mm, c.direction)) for c in obs.conditions]
    assert place_map(obs, waves[circle][obs.condition_of]).gain > 0.98
    load(home, str(write_campaign(tmp_path / "one", "guide", name="one-place", machine="one", radii=(100.0,))))
    twins = Twins(home)
    twins.fit("one-place", KNOWN, "one")
    with pytest.raises(GateRefusal, match="cannot be tested on places"):
        learn_map(twins, "one")


def test_nothing_is_learned_from_what_is_known(twins: Twins) -> None:
    twins.fit("mill-march", KNOWN, "known")
    with pytest.raises(GateRefusal, match="no unknown structure"):
        learn_formula(twins, "known", OperonEngine())
