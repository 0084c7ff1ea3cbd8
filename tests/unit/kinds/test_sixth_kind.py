"""A sixth kind of others goes through every verb; nothing of dtwin knows it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command_here import said
from starlette.testclient import TestClient

from dtwin.config import Home
from dtwin.errors import GateRefusal, StoreError
from dtwin.fleet.jobs import TRAIN, recheck_job
from dtwin.kinds import registry
from dtwin.kinds.kind import NotOffered
from dtwin.lifecycle.train import registered
from dtwin.physics import library
from dtwin.serve.bundle_file import load_bundle
from dtwin.serve.pointer import resolve
from dtwin.serve.runtime import CompiledBundle
from dtwin.train.registry import Registry, model_name
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application

POINTS = {
    "dtwin.kinds": [EntryPoint("turntable", "sixth_kind.kind:KIND", "dtwin.kinds")],
    library._ENTRY_POINTS: [
        EntryPoint("off_centre", "sixth_kind.effects:OFF_CENTRE", library._ENTRY_POINTS),
        EntryPoint("worm_error", "sixth_kind.effects:WORM_ERROR", library._ENTRY_POINTS),
    ],
}


@pytest.fixture(autouse=True)
def _sixth(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))
    for module in (registry, library):
        monkeypatch.setattr(module, "entry_points", lambda group: POINTS.get(group, []))
        module._of_others.cache_clear()
    registry.kind_named.cache_clear()
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    yield
    for module in (registry, library):
        module._of_others.cache_clear()
    registry.kind_named.cache_clear()


def test_a_rotary_table_goes_from_plan_to_champion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text('[plan]\nkind = "turntable"\nrepeats = 3\n', encoding="utf-8")
    assert said("plan", plan)["total_s"] == pytest.approx(3 * 72.0)
    assert said("simulate", "--machine", "table", "--out", "turns", "--plan", plan)["runs"] == 6
    checked = said("check", "turns")
    assert min(checked["span_um"].values()) > 20.0
    (ingested,) = said("ingest", "turns")["campaigns"]
    assert len(ingested["added"]) == 6
    said("twin", "fit", "table", "--effects", "off_centre", "--name", "c-axis")
    found = said("twin", "diagnose", "c-axis")
    assert found["headline"].startswith("worm_error C is missing: 24 waves a turn")
    assert said("twin", "discover", "c-axis")["added"] == ["worm_error C"]
    # Triangles have thrice as many waves, too, which nothing in the library knows.
    assert said("twin", "compare", "c-axis")["headline"].startswith("72 waves a turn")
    said("twin", "show", "c-axis", "--html", "page.html")
    assert "worm_error" in (tmp_path / "page.html").read_text(encoding="utf-8")
    ((unit,), _) = TRAIN.units(Home(tmp_path / "home"), ())
    # Two computers see at the same moment that nobody trained on these runs.
    home = Home(tmp_path / "home")
    result = TRAIN.work(str(home.root), unit, 0)
    with monkeypatch.context() as at_once:
        at_once.setattr("dtwin.lifecycle.train.registered", lambda *of: (registered(*of), registered(*of))[1])
        with pytest.raises(GateRefusal, match="meanwhile"):
            TRAIN.keep(home, unit, result)
    models = Registry(home)
    assert [(v.version, v.aliases) for v in models.versions("table-1")] == [("1", ("candidate",))]
    models.client.delete_registered_model(model_name("table-1"))
    trained = said("fleet", "train", "--workers", "1")["done"]["table"]
    assert (trained["gates_passed"], trained["against_champion"]) == (True, None)
    assert said("fleet", "train", "--workers", "1")["passed"] == {"table": "every run was trained on already"}
    # What another computer trained on the same, and comes late with.
    late = SimpleNamespace(report=SimpleNamespace(campaign=unit.name, machine=unit.machine))
    with pytest.raises(GateRefusal, match="meanwhile"):
        TRAIN.keep(Home(tmp_path / "home"), unit, late)
    promoted = said("promote", trained["version"], "--machine", "table-1")
    assert promoted["champion"], promoted["reason"]
    assert all(condition["better"] for condition in promoted["evidence"]["conditions"])
    ((unit,), _) = recheck_job(0.0).units(Home(tmp_path / "home"), ())
    with pytest.raises(StoreError, match="other models"):
        recheck_job(0.0).work(str(tmp_path / "home"), replace(unit, stamp=unit.stamp[:-1]), 0)
    assert said("fleet", "recheck", "--workers", "1")["done"]["table-1"]["verdict"] == "helps"
    assert said("fleet", "recheck", "--workers", "1")["passed"]["table-1"].startswith("checked 20")
    served = load_bundle(resolve("latest", "table-1", home).path, "table-1").bundle
    predicted = CompiledBundle(served).run(np.array([[45.0], [90.0]]))
    assert abs(predicted).max() > 1.0
    browser = TestClient(application(Bench(home, Access("127.0.0.1", 8765))), base_url="http://127.0.0.1:8765")
    assert "Error over the turn" in browser.get("/campaigns/table/runs/r001").text
    drawn = browser.get("/api/campaigns/table/runs/r001/turn").json()
    assert len(drawn["data"]) == 1


def test_what_the_sixth_kind_lacks_is_refused_by_its_name(tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text('[plan]\nkind = "turntable"\n', encoding="utf-8")
    with pytest.raises(NotOffered, match="what a plan could detect is not offered for turntable"):
        said("plan", plan, "--check")
