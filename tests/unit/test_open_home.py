"""An open home on a small lake: what its verbs return, and what they refuse."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from threadpoolctl import threadpool_info, threadpool_limits
from typer.testing import CliRunner

import dtwin
from dtwin.cli import app
from dtwin.documents import read_document, write_document
from dtwin.kinds.kind import NotOffered
from dtwin.lake.store import Lake
from dtwin.notebook import open_home
from dtwin.notebook.open_home import OpenHome
from dtwin.schema import Campaign, Run, RunMeta, SignalGroup

T_S = np.arange(200) / 100.0


def group(name: str) -> SignalGroup:
    return SignalGroup(name, 1000.0, {f"{name}_g": np.arange(50.0)}, start_s=2.0)


def circle(run_id: str, *groups: SignalGroup) -> Run:
    meta = RunMeta(
        run_id,
        plane="XY",
        direction="CCW",
        radius_mm=100.0,
        feed_mm_min=18850.0,
        sample_rate_hz=100.0,
        covariates={"temperature_c": 21.5},
    )
    angle = 180.0 * T_S
    samples = {"t_s": T_S, "angle_deg": angle, "deviation_um": len(run_id) * np.cos(np.radians(2 * angle))}
    return Run(meta, samples, signals=groups)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> OpenHome:
    opened = dtwin.open_home(tmp_path_factory.mktemp("workshop"))
    lake = Lake(opened.home.lake)
    runs = [circle("a"), circle("bb", group("wrist")), circle("ccc", group("wrist"), group("base"))]
    lake.commit(Campaign("rounds", "cell-3"), runs)
    put = {"t_s": T_S, "error_x_um": T_S, "error_y_um": T_S}
    placed = Run(RunMeta("p1", kind="placement", condition={"part": "lid"}), put)
    lake.commit(Campaign("parts", "cell-3", kind="placement"), [placed])
    return opened


def test_verbs_compute_in_one_thread(home: OpenHome, monkeypatch: pytest.MonkeyPatch) -> None:
    """A notebook has loaded numpy before it opens a home: the environment is read too late to hold its threads."""
    threads: list[int] = []

    class Asked(Exception):
        pass

    def twins(*_: object, **__: object) -> None:
        threads.extend(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")
        raise Asked

    monkeypatch.setattr(open_home, "twins_with", twins)
    monkeypatch.setattr(open_home, "fit_twin", twins)
    with threadpool_limits(2):
        for verb in (
            lambda: home.fit("rounds", "backlash", "t"),
            lambda: home.compare("t"),
            lambda: home.diagnose("t"),
            lambda: home.add("t", "backlash"),
            lambda: home.remove("t", "backlash"),
            lambda: home.discover("t"),
        ):
            with pytest.raises(Asked):
                verb()
        assert {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"} == {2}
    assert set(threads) == {1}


def test_opening_makes_nothing_and_shows_what_is_there(tmp_path: Path, home: OpenHome) -> None:
    dtwin.open_home(tmp_path / "other")
    assert not (tmp_path / "other").exists()
    assert repr(home) == f"home {home.home.root}, campaigns: parts, rounds"


def test_a_home_that_is_not_named_is_that_of_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "set"))
    assert dtwin.open_home().home.root == tmp_path / "set"


def test_runs_have_their_conditions_and_covariates_as_columns(home: OpenHome) -> None:
    assert home.runs().groupby("campaign").size().to_dict() == {"parts": 1, "rounds": 3}
    rounds = home.runs("rounds")
    assert rounds.run_id.tolist() == ["a", "bb", "ccc"]
    assert rounds.temperature_c.tolist() == [21.5] * 3
    assert rounds.radius_mm.tolist() == [100.0] * 3
    assert home.runs("parts").part.tolist() == ["lid"]


def test_an_empty_home_has_the_columns_of_runs(tmp_path: Path) -> None:
    runs = dtwin.open_home(tmp_path / "new").runs()
    assert runs.empty
    assert {"campaign", "run_id", "left_out"} <= set(runs)


def test_samples_and_signals_are_what_was_measured(home: OpenHome) -> None:
    samples = home.samples("rounds", "bb")
    assert samples.deviation_um.to_numpy() == pytest.approx(2.0 * np.cos(2.0 * np.pi * T_S))
    signals = home.signals("rounds", "bb")
    pd.testing.assert_frame_equal(signals, home.signals("rounds", "bb", "wrist"))
    assert signals.t_s.iloc[[0, -1]].tolist() == pytest.approx([2.0, 2.049])
    assert signals.wrist_g.tolist() == list(range(50))


def test_a_run_is_drawn_as_its_page_draws_it(home: OpenHome) -> None:
    angle = home.plot("rounds", "ccc", "angle")
    assert max(angle.data[0].y) == pytest.approx(3.0, abs=0.05)
    assert home.plot("rounds", "ccc").data[0].type == "scatterpolar"


def test_what_cannot_be_is_refused_with_what_can(home: OpenHome, tmp_path: Path) -> None:
    refusals = {
        "campaign.unknown": (lambda: home.runs("squares"), "parts, rounds"),
        "run.unknown": (lambda: home.samples("rounds", "z"), "a, bb, ccc"),
        "notebook.signals": (lambda: home.signals("rounds", "ccc"), "wrist, base"),
        "notebook.figure": (lambda: home.plot("rounds", "a", "histogram"), "polar, angle, time, spectrum"),
        "simulate.option": (lambda: home.simulate("mill", tmp_path / "m", truth="published"), "--plan, --hidden"),
        "twin.unknown": (lambda: home.compare("nobody"), "none yet"),
        "twin.campaigns": (lambda: home.fit([], ["backlash"], "t"), "one, or several of one machine"),
        "notebook.seed": (lambda: home.simulate("mill", tmp_path / "m", seed=-1), "a whole number from 0"),
    }
    for code, (verb, allowed) in refusals.items():
        with pytest.raises(dtwin.InputError) as refused:
            verb()
        assert (refused.value.code, refused.value.allowed) == (code, allowed)
    with pytest.raises(dtwin.InputError) as none:
        home.signals("rounds", "a")
    assert none.value.allowed == "it has none"
    with pytest.raises(dtwin.InputError) as told:
        home.ingest(tmp_path / "x.csv", radius=100.0)
    assert (told.value.code, told.value.got) == ("ingest.told", "radius")
    (tmp_path / "x.csv").write_text("a,b\n1,2\n")
    with pytest.raises(dtwin.InputError) as told:
        home.ingest(tmp_path / "x.csv", kind="circles", started="2026-03-02")
    assert told.value.got == "circles"
    # A frame's own numbers are numbers.
    (tmp_path / "c.csv").write_text("angle_deg,deviation_um\n" + "".join(f"{k},{k % 7}\n" for k in range(360)))
    told_of = {"plane": "XY", "radius_mm": np.int64(100), "feed_mm_min": np.float32(1000.0), "repeat": np.int64(2)}
    assert dtwin.open_home(tmp_path / "h").ingest(tmp_path / "c.csv", **told_of).added == ("c-ccw1",)
    with pytest.raises(NotOffered):
        home.plot("parts", "p1")
    with pytest.raises(NotOffered):
        home.fit("parts", ["backlash"], name="p")


@pytest.mark.parametrize("value", [None, 1.5, b"x", ["a", 2], pd.Series([1.0]), pd.DataFrame({"a": [1]}), {"a"}])
def test_what_is_of_another_type_is_refused_in_words(home: OpenHome, tmp_path: Path, value: Any) -> None:
    verbs: list[Callable[[], object]] = [
        lambda: dtwin.open_home(tmp_path / "h", effects=[value]),
        lambda: dtwin.open_home(tmp_path / "h", effects=""),
        lambda: home.simulate(value, tmp_path / "m"),
        lambda: home.simulate("mill", value),
        lambda: home.ingest(value),
        lambda: home.ingest(tmp_path / "x.csv", machine=[value]),
        lambda: home.fit(value, ["backlash"], "t"),
        lambda: home.fit("rounds", value, "t"),
        lambda: home.fit("rounds", ["backlash"], value),
        lambda: home.show(value),
        lambda: home.fit("rounds", ["backlash"], "t", robust=value),
        lambda: home.simulate("mill", tmp_path / "m", quick=value),
        lambda: home.show("t", value if value is not None else 1.5),
        lambda: home.compare("t", value if value is not None else 1),
        lambda: home.add("t", value),
        lambda: home.remove("t", "backlash", value),
        lambda: home.plot("rounds", "a", value if value is not None else 1),
    ]
    for verb in verbs:
        with pytest.raises(dtwin.InputError):
            verb()


def test_a_home_that_is_another_folder_or_a_file_is_left_as_it_is(tmp_path: Path) -> None:
    folder, file = tmp_path / "share", tmp_path / "file"
    folder.mkdir(mode=0o755)
    (folder / "theirs.txt").write_text("")
    file.write_text("")
    file.chmod(0o644)
    for other, said in (
        (folder, "holds other things"),
        (file, "this is a file"),
        (tmp_path / "a%41", "cannot be used"),
    ):
        with pytest.raises(dtwin.InputError, match=said):
            dtwin.open_home(other)
    with pytest.raises(dtwin.InputError, match="the folder of nobody"):
        dtwin.open_home("~nobody-has-this-name/home")
    assert [path.stat().st_mode & 0o777 for path in (folder, file)] == [0o755, 0o644]
    (folder / "lake").mkdir()
    dtwin.open_home(folder)
    assert folder.stat().st_mode & 0o777 == 0o700


def test_a_covariate_named_like_a_condition_does_not_take_its_place(tmp_path: Path) -> None:
    opened = dtwin.open_home(tmp_path / "new")
    run = circle("a")
    run = dataclasses.replace(run, meta=dataclasses.replace(run.meta, covariates={"feed_mm_min": 1.0}))
    Lake(opened.home.lake).commit(Campaign("rounds", "cell-3"), [run])
    runs = opened.runs()
    assert (runs.feed_mm_min[0], runs.covariate_feed_mm_min[0]) == (18850.0, 1.0)


def test_results_without_rows_or_figures_have_their_columns(tmp_path: Path) -> None:
    opened = dtwin.open_home(tmp_path / "new")
    lake = Lake(opened.home.lake)
    lake.commit(Campaign("rounds", "cell-3"), [circle("a")])
    bare = opened.fit("rounds", [], "bare")
    assert {"effect", "axis", "name", "value", "uncertainty", "unit"} <= set(bare.parameters)
    assert math.isnan(bare.noise_floor_um)
    nothing = dtwin.DiagnosisResult({"candidates": []}, "", list).candidates
    assert nothing.query("in_group").effect.tolist() == []
    # A log has no conditions.
    t_s = np.arange(0.0, 14400.0, 60.0)
    air = 20.0 + np.sin(t_s / 3000.0)
    log = Run(
        RunMeta("log", kind="drift", condition={"axis": "Z"}), {"t_s": t_s, "air_c": air, "displacement_um": 3 * air}
    )
    lake.commit(Campaign("drifts", "cell-3", kind="drift"), [log])
    opened.fit("drifts", [], "log")
    assert opened.compare("log").conditions.empty
    lake.commit(Campaign("others", "cell-4"), [circle("a")])
    with pytest.raises(dtwin.InputError, match="another machine"):
        opened.fit("others", [], "bare")
    for name in ("bare", "log"):
        path = opened.home.root / "twins" / name / "v001.json"
        write_document(path, read_document(path) | {"format": "dtwin-twin/9"}, "a twin of a version to come")
        with pytest.raises(dtwin.DtwinError, match="another version of dtwin") as newer:
            opened.show(name)
        assert "install the newest" in str(newer.value.hint)
        told = CliRunner().invoke(app, ["twin", "history", name], env={"DTWIN_HOME": str(opened.home.root)})
        assert "another version of dtwin" in told.stdout


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (lambda home: home.runs(3), "a campaign is named"),
        (lambda home: home.samples("rounds", 0), "a run is named"),
        (lambda home: home.signals(None, "a"), "a campaign is named"),
        (lambda home: home.ingest(pd.DataFrame()), "is a path"),
        (lambda home: home.diagnose("none", seed="a"), "not a seed"),
        (lambda home: dtwin.open_home(__file__), "a home is a folder"),
    ],
)
def test_what_is_no_name_no_path_and_no_seed_is_refused(
    home: OpenHome, asked: Callable[[OpenHome], object], said: str
) -> None:
    with pytest.raises(dtwin.InputError, match=said):
        asked(home)
