"""What is kept of a diagnosis gives the same diagnosis again."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from starlette.testclient import TestClient
from test_store import CAMPAIGN, make_run

from dtwin.config import Home
from dtwin.documents import finite, write_document
from dtwin.lake.store import Lake
from dtwin.physics._law_search import ScalingLaw
from dtwin.physics._laws import LawTest
from dtwin.physics._screen import Channel
from dtwin.physics.diagnosis import Diagnosis, Spread, Suspect, Unresolved
from dtwin.physics.fit import Estimate
from dtwin.twins import diagnosing_code as diagnosing_code_module
from dtwin.twins._kept_diagnosis import MADE_FROM, kept_diagnosis
from dtwin.twins.registration import diagnosis_path
from dtwin.twins.verbs import Twins
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application


def whole() -> Diagnosis:
    """Return a diagnosis that says everything that one may say."""
    suspect = Suspect(
        "backlash",
        "X",
        0.5,
        math.nan,
        1e-6,
        in_group=True,
        grade="law-confirmed",
        confounded_with=("friction X",),
        laws=(LawTest("feed", 0.4, 0.01, math.nan),),
        share=0.9,
        remedy="Preload the nut.",
        size_um=1.1,
        sizes=(Estimate("backlash", "X", "backlash", "um", 3.1, math.nan, True),),
        tested=("feed",),
        untested=("radius",),
        shape={"standstill_um": 3.3},
    )
    return Diagnosis(
        "missing_effect",
        "backlash X is missing",
        1.2,
        1.0,
        0.5,
        "repeats",
        math.nan,
        suspects=(suspect,),
        found=((suspect,),),
        unresolved=Unresolved(0.3, math.nan, 0.001, "odd in direction", ({"condition": "XY", "um": 0.4},)),
        where=({"condition": "XY R50", "um": 1.2},),
        channels=(Channel("humidity", 0.01, 0.4, ("time_h",)),),
        laws=(ScalingLaw(4, True, 0.0, 3.0, 1e-4, 20.0, 0.08),),
        places=({"effect": "learned_step", "axis": "X", "shape": {"place_of_travel": 0.4, "late_of_travel": 0.1}},),
        closest="friction X",
        invisible=("gravity_sag X",),
        untestable={"thermal_growth X": "temperature_c was not logged"},
        outlier_runs=("r7",),
        told=("r8: a cable touched the bar",),
        spread=Spread(("feed",), 0.02),
        next_experiment={"text": "halve the feed", "conditions": [{"radius_mm": 50.0}]},
        undecided=(("scale_mismatch XY", "servo_lag"),),
    )


def test_all_that_a_diagnosis_says_is_read_again(tmp_path: Path) -> None:
    version = tmp_path / "v001.json"
    said = whole()
    assert all(value for value in vars(said).values()), "a part that says nothing is not tried here"
    write_document(diagnosis_path(version), {MADE_FROM: "a1", **said.as_dict()}, "a diagnosis")
    again = kept_diagnosis(version, "a1")
    assert again is not None
    assert finite(again.as_dict()) == finite(said.as_dict())
    # What is no number in a file is none again, and no word.
    assert math.isnan(again.lack_of_fit_p)
    assert math.isnan(again.found[0][0].sizes[0].uncertainty)
    assert repr(again) == repr(said)
    assert kept_diagnosis(version, "b2") is None
    assert kept_diagnosis(version, "") is None
    assert kept_diagnosis(tmp_path / "v002.json", "a1") is None


def test_a_page_says_that_another_version_found_what_it_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It stood there as if today's rules had found it, until it was asked again."""
    monkeypatch.setenv("DTWIN_MLFLOW", "later")
    lake = Lake(Home(tmp_path).lake)
    lake.commit(CAMPAIGN, [make_run(f"r{k}", k) for k in range(2)])
    twins = Twins(Home(tmp_path))
    twins.fit(CAMPAIGN.name, [], "t")
    client = TestClient(application(Bench(Home(tmp_path), Access("127.0.0.1", 8765))), base_url="http://127.0.0.1:8765")
    twins.diagnose("t")
    assert "another version of dtwin" not in client.get("/twins/t/diagnose").text
    monkeypatch.setattr(diagnosing_code_module, "diagnosing_code", lambda: "of today")
    assert "found by another version of dtwin" in client.get("/twins/t/diagnose").text
