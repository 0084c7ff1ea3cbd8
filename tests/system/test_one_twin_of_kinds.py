"""One twin of a cobot's circles, poses and drift: as a user would, on command and page."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from command_here import printed, refused, said
from one_cobot import write_circles, write_drift, write_poses
from starlette.testclient import TestClient

from dtwin.acquire.ingest import ingest
from dtwin.config import Home
from dtwin.kinds.drift._twins import DriftTwins
from dtwin.kinds.poses._twins import PoseTwins
from dtwin.lake.store import Lake
from dtwin.physics.several_twin import SeenTwin
from dtwin.twins._background import _diagnose
from dtwin.twins.of_kind import twins_with
from dtwin.twins.seen import seen_on
from dtwin.twins.term_twins import TermTwins
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application

pytestmark = pytest.mark.system

OFF = np.array([0.0, 0.6, -0.3, 0.0, 0.2, 0.0])
LATER = np.array([0.0, 0.9, -0.3, 0.0, 0.2, 0.0])
TRUTH = {"joint_offset 2": 600.0, "joint_offset 3": -300.0, "joint_offset 5": 200.0, "thermal_growth": 15.0}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Home:
    """Return a home with tests of one cobot, whose joint 2 is turned in June."""
    root = tmp_path_factory.mktemp("one-cobot")
    write_circles(root / "bar", OFF, day="2026-03-01", growth_um_m_k=15.0, n=60)
    write_poses(root / "tracker", OFF, day="2026-03-05", growth_um_m_k=15.0, n=80)
    write_poses(root / "june", LATER, day="2026-06-05", growth_um_m_k=15.0, n=80, seed=4)
    write_drift(root / "room", day="2026-03-07")
    for name in ("bar", "tracker", "june", "room"):
        ingest(root / name, Lake(root / "home" / "lake"))
    return Home(root / "home")


@pytest.fixture(autouse=True)
def at_home(home: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(home.root))


def client(home: Home) -> TestClient:
    return TestClient(application(Bench(home, Access("127.0.0.1", 8765))), base_url="http://127.0.0.1:8765")


def test_a_cause_that_several_kinds_show_has_one_name_and_the_true_size(home: Home) -> None:
    effects = "joint_zero@J2+J3+J5,thermal_growth,follows"
    printed("twin", "fit", "bar", "tracker", "room", "--effects", effects, "--name", "found")
    shown = said("twin", "show", "found")
    shared = {f"{one['effect']} {one['axis']}".strip(): one for one in shown["shared"]}
    assert set(shared) == set(TRUTH)
    for label, truth in TRUTH.items():
        one = shared[label]
        assert one["value"] == pytest.approx(truth, abs=1.5 * one["uncertainty"]), label
        assert one["uncertainty"] <= 1.01 * min(own["uncertainty"] for own in one["alone"])
    names = {e["label"]: e["names"] for e in shown["effects"]}
    assert names["thermal_growth"] == ["thermal_growth", "ambient_growth"]
    assert shown["contradictions"] == []
    page = client(home).get("/twins/found").text
    assert "Sizes that several campaigns tell" in page
    assert all(f"/campaigns/{name}" in page for name in ("bar", "tracker", "room"))
    open_page = client(home).get
    for address in ("/twins/found?on=june", "/twins/found/report.html", "/api/twins/found/overlay/angle?on=bar"):
        assert open_page(address).status_code == 200, address
    assert "One twin of several tests" in open_page("/machines/cobot-1").text
    assert "correct-title" in page
    # What is corrected has the sizes of all, and is as certain as they are.
    seen = seen_on(twins_with(home, None, "found"), "found", "bar")
    again = seen.refit(lambda obs: np.arange(obs.n_rows))
    assert {e.axis: e.value for e in again.estimates} == pytest.approx({e.axis: e.value for e in seen.twin.estimates})
    assert isinstance(seen.twin, SeenTwin)
    stated = [e.uncertainty for e in seen.twin.estimates]
    assert 2.0 * np.sqrt(np.diag(seen.twin.covariance)) == pytest.approx(stated, rel=0.2)
    # Poses name the growth again and nothing in its place; a zero of a joint looks like the length of its link to them.
    by_axis = {term.label: term for term in seen.twin.terms}
    assert seen.elsewhere(by_axis["thermal_growth"], 0) == ["tracker"]
    assert seen.elsewhere(by_axis["joint_offset 2"], 0) == []
    turned = said("twin", "confirm", "found", "joint_offset:2", "--after", "june")
    assert turned["grade"] is None
    assert turned["changes"][0]["after"] == pytest.approx(900.0, abs=30.0)
    assert refused("twin", "confirm", "found", "follows@frame", "--after", "june").code == "twin.not_told"
    rows = printed("export", "found", "--as", "dh", "--out", str(home.root / "arm.csv"))
    assert "left out, ambient_growth" in rows


def test_each_kind_finds_what_it_can_show(home: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as later:
        later.setattr(
            "dtwin.twins.shelf.log_soon", lambda home, name, *, at_once, ahead=False: ahead and _diagnose(home, name)
        )
        printed("twin", "fit", "tracker", "room", "--name", "each")
    assert twins_with(home, None, "each").kept_diagnosis("each", 1), "found out ahead"
    found = said("twin", "discover", "each")
    assert found["final"]["verdict"] == "nothing_missing"
    added = " ".join(found["added"])
    assert added.count("joint_zero") == 3
    assert all(name in added for name in ("ambient_growth", "follows@frame", "follows@motor"))
    asked: list[str] = []

    def anew(twins: TermTwins[Any, Any, Any, Any], loaded: Any, terms: Any) -> Any:
        asked.append(twins.named)
        return diagnosed[type(twins)](twins, loaded, terms)

    diagnosed = {kind: kind.diagnosed for kind in (PoseTwins, DriftTwins)}
    for kind in diagnosed:
        monkeypatch.setattr(kind, "diagnosed", anew)
    kept = said("twin", "diagnose", "each")
    assert ([m["kind"] for m in kept["members"]], kept["verdict"]) == (["poses", "drift"], "nothing_missing")
    assert asked == [], "it was found out before"
    # Of other rows, or told otherwise, it is found out anew, and is the same.
    printed("amend", "room", "--set", "instrument.note=probe 2", "--because", "it was another")
    assert said("twin", "diagnose", "each") == kept
    assert asked == ["poses", "drift"]


def test_the_loop_takes_a_cause_everywhere_and_names_who_contradicts(home: Home) -> None:
    made = said("twin", "fit", "bar", "tracker", "june", "--effects", "joint_zero,thermal_growth", "--name", "loop")
    (told,) = made["contradictions"]
    assert (told["effect"], told["axis"], told["campaigns"]) == ("joint_offset", "2", ["june"])
    assert told["difference"] == pytest.approx(300.0, abs=told["k2"])
    assert told["since"].startswith("2026-06-05")
    loop = seen_on(twins_with(home, None, "loop"), "loop", "bar")
    assert [t.label for t in loop.twin.terms if loop.disagreed_on(t)] == ["joint_offset 2"]
    printed("machine", "event", "cobot-1", "crash", "--on", "2026-05-20")
    assert "since the crash of 2026-05-20" in printed("twin", "compare", "loop")
    page = client(home).get("/twins/loop").text
    assert "since the crash of 2026-05-20" in page
    assert "What the twin knows of cobot-1" in page
    assert "add joint_" not in page
    removed = said("twin", "remove", "loop", "ambient_growth")
    assert "thermal_growth" not in {name for effect in removed["effects"] for name in effect["names"]}
    added = said("twin", "add", "loop", "thermal_growth")
    (growth,) = (e for e in added["effects"] if e["effect"] == "thermal_growth")
    assert growth["campaigns"] == ["bar", "tracker", "june"]
    assert refused("twin", "add", "loop", "joint_offset:2").code == "twin.has_effect"
    back = said("twin", "restore", "loop", "--version", "2")
    assert [e["label"] for e in back["effects"]] == [e["label"] for e in removed["effects"]]
    assert len(said("twin", "history", "loop")["rungs"]) == 4
    assert said("twin", "compare", "loop", "--on", "tracker")["campaign"] == "tracker"


def test_mistakes_are_refused_with_the_reason() -> None:
    printed("twin", "fit", "tracker", "room", "--effects", "follows", "--name", "wrong")
    assert refused("twin", "compare", "wrong", "--on", "bar").code == "twin.kind"
    assert refused("twin", "add", "wrong", "backlash:X").code == "effect.unknown"
    assert refused("twin", "add", "wrong", "joint_zer").meant == "joint_zero"
    nowhere = refused("twin", "add", "wrong", "lag@spindle")
    assert (nowhere.code, nowhere.got) == ("effect.axis", "lag@spindle")
    assert refused("twin", "remove", "wrong", "joint_zero").code == "twin.no_effect"
    refusal = refused("twin", "correct", "wrong", "--on", "tracker")
    assert (refusal.code, refusal.got) == ("kind.not_offered", "poses")
    assert "dtwin export" in str(refusal.hint)
    assert refused("twin", "fit", "bar", "tracker", "--name", "no", "--robust").code == "twin.robust"
