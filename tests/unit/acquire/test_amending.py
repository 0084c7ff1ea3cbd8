from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dtwin.acquire.amending import amend, amendment_findings, leave_out
from dtwin.acquire.campaign_name import in_lake
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.schema import Campaign, Run, RunMeta, SignalGroup

CAMPAIGN = Campaign("c", "mill-a", instrument={"calibrated_mm": 100.0, "model": "bar"})


def made(run_id: str, seed: int) -> Run:
    t_s = np.arange(400) / 200.0
    samples = {"t_s": t_s, "angle_deg": 180.0 * t_s, "deviation_um": np.random.default_rng(seed).normal(size=400)}
    meta = RunMeta(run_id, plane="XY", direction="CCW", radius_mm=100.0, feed_mm_min=18_850.0, sample_rate_hz=200.0)
    return Run(meta, samples)


@pytest.fixture
def lake(tmp_path: Path) -> Lake:
    lake = Lake(tmp_path / "lake")
    lake.commit(CAMPAIGN, [made("r1", 1), made("r2", 2)])
    return lake


def test_what_was_stated_wrongly_is_stated_anew_beside_the_raw_values(lake: Lake) -> None:
    before = lake.runs("c")
    amend(lake, "c", ["instrument.calibrated_mm=100.015"], "wrong master entered", who="anna")
    after = lake.runs("c")
    assert lake.campaign("c").instrument == {"calibrated_mm": 100.015, "model": "bar"}
    assert [row["metadata_version"] for row in after] == [1, 1]
    for old, new in zip(before, after, strict=True):
        assert new["raw_sha256"] == old["content_sha256"] != new["content_sha256"]
        assert new["samples_file"] == old["samples_file"]
    (told,) = amendment_findings(after)
    assert "anna" in told.message
    assert "wrong master entered" in told.message
    # As it was before can still be read.
    assert lake.runs("c", at={**lake.versions(), "amendments": -1}) == before


def test_the_corrected_campaign_file_and_the_first_one_are_both_unchanged(lake: Lake) -> None:
    amend(lake, "c", ["instrument.calibrated_mm=100.015"], "wrong master")
    corrected = replace(CAMPAIGN, instrument={"calibrated_mm": 100.015, "model": "bar"})
    for campaign in (corrected, CAMPAIGN):
        assert lake.commit(campaign, [made("r1", 1)]).unchanged == ("r1",)
    assert lake.commit(corrected, [made("r3", 3)]).added == ("r3",)
    with pytest.raises(InputError, match="another machine, kind, geometry or instrument"):
        lake.commit(CAMPAIGN, [made("r4", 4)])


def test_a_single_run_is_amended_and_judged_again(lake: Lake) -> None:
    amend(lake, "c", ["feed_mm_min=1000", "setup=s2", "covariates.load_kg=3.5"], "typo", runs=["r1"])
    one, two = lake.runs("c")
    assert (one["feed_mm_min"], one["setup"]) == (1000.0, "s2")
    assert json.loads(one["covariates_json"]) == {"load_kg": 3.5}
    assert one["n_errors"] == 1
    assert "feed.differs" in one["findings_json"]
    assert (two["feed_mm_min"], two["n_errors"], two["metadata_version"]) == (18_850.0, 0, 0)
    amend(lake, "c", ["feed_mm_min=18850", "covariates.load_kg="], "typo of the typo", runs=["r1"])
    one = lake.runs("c")[0]
    assert (one["n_errors"], one["metadata_version"], one["covariates_json"]) == (0, 2, "{}")


@pytest.mark.parametrize(
    ("setting", "code"),
    [
        ("content_sha256=0", "amend.setting"),
        ("run_id=x", "amend.setting"),
        ("instrument.sample_rate_hz=100", "amend.read_with"),
        ("samples_file=../x", "amend.setting"),
        ("machine=../x", "name.invalid"),
        ("radius_mm=-3", "campaign.value"),
        ("radius_mm=abc", "campaign.value"),
        ("plane=QQ", "run.plane"),
        ("direction=up", "amend.setting"),
        ("covariates.load=3.0", "units.unknown"),
        ("covariates.temperature_air_c=-400", "campaign.value"),
        ("instrument.a=[[[[[[[[1]]]]]]]]", "campaign.value"),
        ("radius_mm", "amend.setting"),
        ("radius_mm=100", "amend.same"),
    ],
)
def test_what_cannot_be_stated_is_refused_and_nothing_is_kept(lake: Lake, setting: str, code: str) -> None:
    with pytest.raises(InputError) as caught:
        amend(lake, "c", [setting], "because")
    assert caught.value.code == code
    assert lake.versions()["amendments"] == -1


def test_a_reason_is_needed(lake: Lake) -> None:
    for reason in ("", "  ", "x" * 501, "a\x1b[2J"):
        with pytest.raises(InputError, match="say why"):
            leave_out(lake, "c", ["r1"], reason)


def test_a_run_is_left_out_and_restored(lake: Lake) -> None:
    leave_out(lake, "c", ["r1"], "the magnet slipped", who="anna")
    assert [row["run_id"] for row in lake.runs("c")] == ["r2"]
    assert [run.meta.run_id for run in lake.iterate("c")] == ["r2"]
    told = {row["run_id"]: row["left_out"] for row in lake.runs("c", left_out=True)}
    assert told == {"r1": "the magnet slipped", "r2": None}
    with pytest.raises(InputError, match="left out already"):
        leave_out(lake, "c", ["r1"], "again")
    with pytest.raises(InputError, match="no such run"):
        leave_out(lake, "c", ["r9"], "not there")
    leave_out(lake, "c", ["r1"], "it was the other one", out=False)
    assert [row["run_id"] for row in lake.runs("c")] == ["r1", "r2"]
    messages = [f.message for f in amendment_findings(lake.runs("c", left_out=True))]
    assert ["left out" in messages[0], "taken in again" in messages[1]] == [True, True]
    assert lake.commit(CAMPAIGN, [made("r1", 1)]).unchanged == ("r1",)


def test_other_signals_of_an_amended_run_are_refused(lake: Lake) -> None:
    amend(lake, "c", ["instrument.calibrated_mm=100.015"], "wrong master")
    corrected = replace(CAMPAIGN, instrument={"calibrated_mm": 100.015, "model": "bar"})
    late = SignalGroup("accelerometers", 100.0, {"x_g": np.zeros(5)})
    with pytest.raises(InputError, match="other content") as caught:
        lake.commit(corrected, [replace(made("r1", 1), signals=(late,))])
    assert "the signals" in str(caught.value.got)


def test_a_rate_that_is_not_known_is_not_stated_anew_and_what_is_the_same_is_refused(tmp_path: Path) -> None:
    lake, run = Lake(tmp_path / "lake"), made("r1", 1)
    lake.commit(CAMPAIGN, [replace(run, meta=replace(run.meta, sample_rate_hz=float("nan")))])
    assert set(amend(lake, "c", ["setup=s2"], "typo")["r1"]) == {"setup"}
    with pytest.raises(InputError, match="nothing would change"):
        amend(lake, "c", ["setup=s2"], "typo")


def test_a_campaign_file_that_was_changed_is_told_with_the_amendment(lake: Lake) -> None:
    changed = replace(CAMPAIGN, instrument={"calibrated_mm": 100.015, "model": "bar"})
    lake.require_same_statements(CAMPAIGN)
    for refused in (lambda: lake.commit(changed, [made("r1", 1)]), lambda: lake.require_same_statements(changed)):
        with pytest.raises(InputError) as told:
            refused()
        assert "dtwin amend c --set 'instrument.calibrated_mm=100.015' --because WHY" in str(told.value.hint)
    amend(lake, "c", ["instrument.calibrated_mm=100.015"], "wrong master")
    for campaign in (CAMPAIGN, changed):
        lake.require_same_statements(campaign)


def test_a_folder_beside_that_was_changed_is_not_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    home = Home(tmp_path / "home")
    folder = tmp_path / "c"
    folder.mkdir()
    text = '[campaign]\nname = "c"\nmachine = "mill-a"\n[campaign.instrument]\ncalibrated_mm = 100.0\nmodel = "bar"\n'
    text += '[[run]]\nid = "r1"\nfile = "r1.csv"\nplane = "XY"\nradius_mm = 100.0\nfeed_mm_min = 18850.0\ndirection = "CCW"\n'
    (folder / "r1.csv").write_text("t_s,angle_deg,deviation_um\n", encoding="utf-8")
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    Lake(home.lake).commit(CAMPAIGN, [made("r1", 1)])
    assert in_lake(home, "c") == "c"
    (folder / "campaign.toml").write_text(text.replace("= 100.0\nmodel", "= 100.5\nmodel"), encoding="utf-8")
    with pytest.raises(InputError, match="was changed since it was ingested"):
        in_lake(home, "c")


def test_a_stroke_that_is_amended_takes_its_error_back(tmp_path: Path) -> None:
    lake = Lake(tmp_path / "lake")
    geometry = {"stroke_x_mm": [0.0, 900.0]}
    campaign = Campaign("v", "mill-a", "volumetric", machine_geometry=geometry)
    x_mm = np.linspace(-380.0, 380.0, 12)
    samples = {"t_s": np.arange(12.0), "pose_1": np.ones(12), "ball_1": np.arange(1.0, 13.0), "x_mm": x_mm}
    samples |= {name: x_mm + 400.0 for name in ("y_mm", "z_mm")}
    samples |= {f"error_{axis}_um": np.zeros(12) for axis in "xyz"}
    run = kind_named("volumetric").completed(Run(RunMeta("c0", "volumetric"), samples), campaign)
    lake.commit(campaign, [run])
    assert "balls.outside_stroke" in lake.runs("v")[0]["findings_json"]
    amend(lake, "v", ["machine_geometry.stroke_x_mm=[-400.0, 400.0]"], "another zero")
    assert "balls.outside_stroke" not in lake.runs("v")[0]["findings_json"]
