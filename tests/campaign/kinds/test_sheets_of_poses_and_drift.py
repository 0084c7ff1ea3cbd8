"""Test sheets of poses and of drift, of machines made here, and what a drift test says of other tests of its machine."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from starlette.testclient import TestClient
from typer.testing import CliRunner

from dtwin.acquire.ingest import ingest
from dtwin.cli import app
from dtwin.config import Home
from dtwin.kinds.poses._chain import left_by_setup
from dtwin.kinds.poses._series import series_of_targets
from dtwin.kinds.poses._sheet import _scatter_of
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.pipeline.kept import variation_of
from dtwin.report.checking import _sheet_of, check_source
from dtwin.schema import Campaign, Run, RunMeta
from dtwin.tolerances import limits_from
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application

ROOT = Path(__file__).parents[3]


def log(hours: float, per_hour_um: float, *, noise_um: float = 0.0, test: str = "", seed: int = 0) -> Run:
    """Return a log that rises steadily, two readings each minute, with a sensor that does nothing."""
    minute = np.repeat(np.arange(round(60 * hours) + 1.0), 2)
    noise = np.random.default_rng(seed).normal(0.0, noise_um, minute.size) if noise_um else 0.0
    samples = {
        "t_s": 60.0 * minute + np.tile([0.0, 1.0], minute.size // 2),
        "displacement_um": per_hour_um * minute / 60.0 + noise,
        "sample_1": minute,
        "temperature_room_c": 20.0 + 0.0 * minute,
    }
    return Run(RunMeta("night", kind="drift", condition={"test": test} if test else {}), samples)


def test_the_ranges_of_a_steady_drift_are_its_rate_times_the_time() -> None:
    sheet = _sheet_of(
        kind_named("drift"), Campaign("c", "m", "drift"), [log(3.0, 6.0)], limits_from({"d": 10.0}, "here")
    )
    found = {c["symbol"]: c["value_um"] for c in sheet["parts"][0]["characteristics"]}
    assert found == {"d": pytest.approx(18.0), "d(1 h)": pytest.approx(6.0)}
    assert sheet["verdict"] == "outside"


def test_readings_more_than_an_hour_apart_tell_no_range_in_one_hour() -> None:
    run = log(3.0, 6.0, test="environment")
    run.samples["t_s"][:] *= 100.0
    sheet = _sheet_of(kind_named("drift"), Campaign("c", "m", "drift"), [run], {})
    assert [c["symbol"] for c in sheet["parts"][0]["characteristics"]] == ["d"]
    assert any("no hour holds two readings" in note for note in sheet["notes"])
    assert kind_named("drift").variation([run], "c") is None


def of_drift(instrument: dict[str, float], run: Run) -> list[dict[str, Any]]:
    sheet = _sheet_of(kind_named("drift"), Campaign("c", "m", "drift", instrument=instrument), [run], {})
    return list(sheet["parts"][0]["characteristics"])


def test_the_uncertainty_of_a_drift_is_that_of_its_range() -> None:
    told = of_drift({"uncertainty_um": 0.0}, log(6.0, 5.0, noise_um=1.0))[0]
    # Of two means of two readings each at most: a level stretch has several that may be the highest.
    scatter = np.std([of_drift({}, log(6.0, 5.0, noise_um=1.0, seed=n))[0]["value_um"] for n in range(40)], ddof=1)
    assert told["expanded_um"] == pytest.approx(2.0 * scatter, rel=0.3)
    assert told["expanded_um"] < 2.2


def test_readings_that_follow_each_other_tell_the_uncertainty_where_none_was_taken_twice() -> None:
    def single(hours: float, seed: int) -> Run:
        run = log(hours, 5.0, noise_um=1.0, seed=seed)
        samples = {name: values[::2] for name, values in run.samples.items() if name != "sample_1"}
        return Run(run.meta, samples)

    told = of_drift({"uncertainty_um": 0.0}, single(6.0, 0))[0]
    scatter = np.std([of_drift({}, single(6.0, n))[0]["value_um"] for n in range(40)], ddof=1)
    assert told["expanded_um"] == pytest.approx(2.0 * scatter, rel=0.3)
    assert of_drift({}, single(1.0, 0))[0]["expanded_um"] is None


def test_a_probe_reads_a_share_of_the_figure_wrongly() -> None:
    run = log(6.0, 5.0, noise_um=0.01)
    d, in_an_hour = of_drift({"uncertainty_um": 0.0, "uncertainty_percent": 4.0}, run)
    assert d["expanded_um"] == pytest.approx(0.04 * d["value_um"], rel=0.1)
    assert in_an_hour["expanded_um"] == pytest.approx(0.04 * in_an_hour["value_um"], rel=0.1)
    assert [c["source"] for c in d["budget"]["contributions"]] == ["repeatability", "instrument", "probe's sensitivity"]


def test_only_a_machine_at_rest_tells_its_surroundings() -> None:
    kind = kind_named("drift")
    assert kind.variation([log(3.0, 6.0)], "c") is None
    found = kind.variation([log(3.0, 6.0, test="environment")], "c")
    assert found is not None
    assert (found.range_um, found.hours, found.campaign) == (pytest.approx(6.0), 1.0, "c")


def test_poses_with_repeats_are_decided_and_without_are_not() -> None:
    limits = limits_from({"AP": 5000.0, "AP mean": 500.0}, "here")
    known = check_source(ROOT / "data/poses/ur10-joint-configurations", tolerances=lambda machine: limits)["sheet"]
    assert {c["symbol"]: c["decision"] for c in known["parts"][0]["characteristics"]} == {
        "AP": "inside",
        "AP mean": "outside",
        # No limit is stated for distances.
        "AD": "",
        "AD rms": "",
    }
    alone = check_source(ROOT / "data/poses/ur5-random", tolerances=lambda machine: limits)["sheet"]
    assert alone["verdict"] == "cannot say"
    assert "not known, for nothing was repeated in sound data" in alone["basis"]


def poses(bend_um: float, *, repeats: int = 3, noise_um: float = 5.0, longer: float = 0.0) -> Run:
    """Return poses of an arm that turns its base and its shoulder only: on a sphere, by trigonometry of our own."""
    rng = np.random.default_rng(3)
    base, shoulder = np.repeat(rng.uniform(-1.5, 1.5, (2, 60)), repeats, axis=1)
    joints = np.zeros((base.size, 6))
    joints[:, 0], joints[:, 1], joints[:, 4] = np.degrees(base), np.degrees(shoulder), 90.0 * np.sin(3.0 * base)
    from dtwin.kinds.poses._chain import KNOWN, frames

    at = frames(np.radians(joints), KNOWN["ur5"])
    point = at.origin_mm[-1] + at.rotation[-1] @ [20.0, 0.0, 40.0]
    point = point * (1.0 + longer) + bend_um / 1000.0 * np.stack([np.sin(2 * base), 0 * base, 0 * base], axis=1)
    point = point + rng.normal(0.0, noise_um / 1000.0, point.shape)
    samples = {f"joint_{n + 1}_deg": joints[:, n] for n in range(6)}
    samples |= {f"measured_{axis}_mm": point[:, n] for n, axis in enumerate("xyz")}
    return Run(RunMeta("p", kind="poses", condition={"chain": "ur5"}), {"t_s": np.arange(base.size) * 1.0, **samples})


def characteristics(run: Run, **told: float) -> dict[str, dict[str, float]]:
    campaign = Campaign("c", "m", "poses", instrument=told, machine_geometry={"chain": "ur5"})
    sheet = _sheet_of(kind_named("poses"), campaign, [run], {})
    return {c["symbol"]: c for c in sheet["parts"][0]["characteristics"]}


def test_distances_have_an_uncertainty_and_a_longer_ruler_is_in_it() -> None:
    found = characteristics(poses(300.0), uncertainty_um=0.0, uncertainty_um_per_m=0.0)
    assert set(found) == {"AP", "AP mean", "AD", "AD rms", "RP"}
    # Two points that a wave of 300 um moves apart; the best frame takes a part of it.
    assert 200.0 < found["AD"]["value_um"] < 700.0
    assert found["AD rms"]["value_um"] < found["AD"]["value_um"]
    assert 0.0 < found["AD rms"]["expanded_um"] < found["AD"]["expanded_um"]
    # A ruler that is off by 100 um/m (k = 2) moves distances by 100 um a metre.
    doubted = characteristics(poses(0.0, noise_um=1.0), uncertainty_um=0.0, uncertainty_um_per_m=100.0)["AD rms"]
    longer = characteristics(poses(0.0, noise_um=1.0, longer=100e-6), uncertainty_um=0.0, uncertainty_um_per_m=0.0)
    assert doubted["expanded_um"] == pytest.approx(longer["AD rms"]["value_um"], rel=0.4)


def test_a_distance_is_between_the_means_of_two_poses() -> None:
    """ISO 9283 takes the mean of repeated distances: scatter alone is no error of distance, nor is a pose paired with itself."""
    found = characteristics(poses(0.0, repeats=30, noise_um=20.0), uncertainty_um=0.0)
    # Two means of thirty readings differ by 5 um, single readings by 28 um, and five times that at most.
    assert found["AD rms"]["value_um"] == pytest.approx(20.0 * np.sqrt(2.0 / 30.0), rel=0.25)
    assert found["AD"]["value_um"] < 30.0


def test_drift_is_of_ten_later_readings_against_the_first_ten() -> None:
    """A base that creeps by 4 um a cycle: means of the first and the last ten of forty cycles are 120 um apart."""
    rng = np.random.default_rng(5)
    target = rng.uniform(-500.0, 500.0, (30, 3))
    wild = np.where(np.arange(40) < 30, 1.0, 6.0)[:, None, None]
    noise = wild * rng.normal(0.0, 0.005, (40, 30, 3))
    creep = 0.004 * (np.arange(40.0) - 19.5)[:, None, None] * [1.0, 0.0, 0.0]
    given = 0.5 * np.stack([np.sin(target[:, 1] / 90.0), np.zeros(30), np.cos(target[:, 0] / 70.0)], axis=1)
    measured = target + given + noise + creep
    samples = {"t_s": np.arange(1200.0)}
    samples |= {f"target_{a}_mm": np.tile(target[:, n], 40) for n, a in enumerate("xyz")}
    samples |= {f"measured_{a}_mm": measured[..., n].ravel() for n, a in enumerate("xyz")}
    found = characteristics_of_points(samples)
    # A pose whose error points along the creep changes by all of it; no pose by more.
    assert found["dAP"]["value_um"] == pytest.approx(120.0, abs=15.0)
    # RP is about 3.6 times the scatter in one direction, 18 um, and 108 um of the last ten; the largest of thirty poses changes by more.
    assert 100.0 < found["dRP"]["value_um"] < 300.0
    # What creeps is no scatter: U is that of means of ten readings, of which the last scatter by 30 um.
    assert 10.0 < found["dAP"]["expanded_um"] < 25.0
    short = {name: column[: 19 * 30] for name, column in samples.items()}
    assert not {"dAP", "dRP"} & set(characteristics_of_points(short))


@pytest.mark.parametrize("creep_um", [0.0, 60.0])
def test_the_uncertainty_of_drift_covers_it_also_where_there_is_none(creep_um: float) -> None:
    rng = np.random.default_rng(7)
    held = []
    for _ in range(20):
        target = np.tile(rng.uniform(-500.0, 500.0, (12, 3)), (20, 1))
        # Away from the base, along the error of every pose, in the second ten of twenty cycles.
        outward = target / np.linalg.norm(target, axis=1)[:, None]
        later = (np.arange(240) >= 120)[:, None] * creep_um / 1000.0
        measured = target + (0.3 + later) * np.sign(target[:, :1]) * outward + rng.normal(0.0, 0.01, (240, 3))
        samples = {"t_s": np.arange(240.0)}
        samples |= {f"target_{a}_mm": target[:, n] for n, a in enumerate("xyz")}
        samples |= {f"measured_{a}_mm": measured[:, n] for n, a in enumerate("xyz")}
        found = characteristics_of_points(samples)
        truth = true_change_um(target[:12], creep_um)
        held.append([abs(found["dAP"]["value_um"] - truth) <= found["dAP"]["expanded_um"]])
        held[-1].append(found["dRP"]["value_um"] <= found["dRP"]["expanded_um"])
    assert np.mean(held, axis=0).min() >= 0.9


def true_change_um(target: np.ndarray, creep_um: float) -> float:
    """How AP of these poses changes by the creep: the best frame of all readings is taken from both halves, by Kabsch."""
    outward = target / np.linalg.norm(target, axis=1)[:, None] * np.sign(target[:, :1])
    first, second = target + 0.3 * outward, target + (0.3 + creep_um / 1000.0) * outward
    both, twice = np.concatenate([first, second]), np.concatenate([target, target])
    u, _, vt = np.linalg.svd((both - both.mean(axis=0)).T @ (twice - twice.mean(axis=0)))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    left = [
        np.linalg.norm((half - both.mean(axis=0)) @ turn + twice.mean(axis=0) - target, axis=1)
        for half in (first, second)
    ]
    return 1000.0 * float(np.abs(left[1] - left[0]).max())


def characteristics_of_points(samples: dict[str, np.ndarray]) -> dict[str, dict[str, float]]:
    campaign = Campaign("c", "m", "poses", instrument={"uncertainty_um": 0.0})
    sheet = _sheet_of(kind_named("poses"), campaign, [Run(RunMeta("p", kind="poses"), samples)], {})
    return {c["symbol"]: c for c in sheet["parts"][0]["characteristics"]}


def test_a_pose_that_scatters_more_than_others_has_its_own_uncertainty() -> None:
    """RP is of the worst pose: with the scatter of all poses for its own, U covered it in 7 of 10 tests."""
    rng = np.random.default_rng(11)
    place = np.repeat(np.arange(40), 10)
    target = rng.uniform(-500.0, 500.0, (40, 3))[place]
    scatter_mm = rng.uniform(0.008, 0.04, 40)[place, None]
    told = []
    for _ in range(30):
        measured = target + scatter_mm * rng.standard_normal(target.shape)
        samples = {"t_s": np.arange(400.0)}
        samples |= {f"target_{a}_mm": target[:, n] for n, a in enumerate("xyz")}
        samples |= {f"measured_{a}_mm": measured[:, n] for n, a in enumerate("xyz")}
        instrument = {"uncertainty_um": 0.0, "uncertainty_um_per_m": 0.0, "temperature_uncertainty_k": 0.0}
        instrument["expansion_uncertainty_um_per_m_k"] = 0.0
        campaign = Campaign("c", "m", "poses", instrument=instrument)
        sheet = _sheet_of(kind_named("poses"), campaign, [Run(RunMeta("p", kind="poses"), samples)], {})
        told.append(
            [(c["value_um"], c["expanded_um"]) for c in sheet["parts"][0]["characteristics"] if c["symbol"] == "RP"]
        )
    value, half = np.array(told)[:, 0].T
    assert np.mean(np.abs(value - value.mean()) <= half) >= 0.9


def test_poses_that_scatter_alike_share_their_scatter() -> None:
    rng = np.random.default_rng(12)
    place = np.repeat(np.arange(40), 5)
    alike = _scatter_of(rng.normal(0.0, 2.0, (200, 3)), place, 2.0)
    assert alike.of_reading == pytest.approx(2.0, rel=0.15)
    assert alike.dof == 160.0
    assert alike.dof_of_one > 40.0
    apart = _scatter_of(rng.normal(0.0, 2.0, (200, 3)) * np.where(place < 20, 1.0, 5.0)[:, None], place, 2.0)
    assert np.median(apart.of_reading[place >= 20]) == pytest.approx(10.0, rel=0.3)
    assert apart.dof_of_one < 20.0


@pytest.mark.parametrize(("away_mm", "said"), [(0.3, "as the file has its errors, AP is 300 µm"), (900.0, "")])
def test_accuracy_in_the_frame_of_the_robot_is_said(away_mm: float, said: str) -> None:
    """ISO 9283 has AP in the robot's frame; the best frame takes a shift away. An instrument's own frame is none of it."""
    target = np.random.default_rng(5).uniform(-500.0, 500.0, (30, 3))
    samples = {"t_s": np.arange(30.0)}
    samples |= {f"target_{a}_mm": target[:, n] for n, a in enumerate("xyz")}
    samples |= {f"measured_{a}_mm": target[:, n] + away_mm * (a == "x") for n, a in enumerate("xyz")}
    sheet = _sheet_of(kind_named("poses"), Campaign("c", "m", "poses"), [Run(RunMeta("p", kind="poses"), samples)], {})
    (note,) = sheet["notes"]
    assert said in note
    assert said or "as the file" not in note


def test_few_readings_of_a_pose_are_said() -> None:
    campaign = Campaign("c", "m", "poses", machine_geometry={"chain": "ur5"})
    none, few, enough = (
        " ".join(_sheet_of(kind_named("poses"), campaign, [poses(0.0, repeats=n)], {})["notes"]) for n in (2, 3, 30)
    )
    assert "RP is not told, for no pose was measured three times; ISO 9283 asks for thirty" in none
    assert "RP is of 3 readings a pose and more; ISO 9283 asks for thirty" in few
    assert "thirty" not in enough


def test_without_repeats_a_distance_has_no_uncertainty() -> None:
    found = characteristics(poses(300.0, repeats=1))
    assert not np.isfinite(found["AD"]["expanded_um"] or np.nan)


def test_a_drift_test_in_the_lake_is_in_the_budget_of_a_circle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    folder = tmp_path / "night"
    folder.mkdir()
    made = log(3.0, 30.0, noise_um=0.1)
    rows = zip(*(made.samples[name].tolist() for name in made.samples), strict=True)
    lines = [",".join(map(repr, row)) for row in rows]
    (folder / "night.csv").write_text("\n".join(["t_s,displacement_um,sample,temperature_room_c", *lines]))
    (folder / "campaign.toml").write_text(
        '[campaign]\nname = "night"\nmachine = "virtual-mill"\nkind = "drift"\nstarted = 2026-01-02T03:00:00Z\n'
        '[[run]]\nid = "night"\nfile = "night.csv"\ncondition = { test = "environment" }\n'
    )
    home = Home(tmp_path / "home")
    ingest(folder, Lake(home.lake))
    found = variation_of(home, "virtual-mill")
    assert found is not None
    assert found.range_um == pytest.approx(30.0, rel=0.05)
    assert variation_of(home, "another") is None
    said = CliRunner().invoke(app, ["check", str(ROOT / "data/examples/hidden-effect")]).stdout
    assert "drift test night; what goes beyond the repeatability" in said


def test_the_page_of_a_campaign_says_where_its_uncertainty_comes_from(tmp_path: Path) -> None:
    home = Home(tmp_path)
    ingest(ROOT / "data/examples/hidden-effect", Lake(home.lake))
    browser = TestClient(application(Bench(home, Access("127.0.0.1", 8765))), base_url="http://127.0.0.1:8765")
    said = browser.get("/campaigns/hidden-effect").text
    assert said.count("<caption>Budget of") == 9
    assert "calibrated length" in said


def test_the_sheet_of_poses_says_what_frame_and_tool_took_away() -> None:
    (note,) = check_source(ROOT / "data/poses/ur5-random", tolerances=lambda machine: {})["sheet"]["notes"]
    assert "left by the best frame and tool; as the file has its errors, AP is 3379 µm" in note
    few = _sheet_of(kind_named("poses"), Campaign("c", "m", "poses"), [_first(poses(300.0), 15)], {})
    assert "5 poses are few for the 9 numbers" in few["notes"][-1]


def _cube(poses: int) -> Run:
    """Thirty cycles of poses that are off by 100 µm each way, in the frame of the robot."""
    rng = np.random.default_rng(3)
    target, off = rng.uniform(-400.0, 400.0, (poses, 3)), rng.normal(0.0, 0.1, (poses, 3))
    measured = np.tile(target + off, (30, 1)) + rng.normal(0.0, 0.02, (30 * poses, 3))
    columns = [*np.tile(target, (30, 1)).T, *measured.T]
    names = [f"{what}_{a}_mm" for what in ("target", "measured") for a in "xyz"]
    samples = {"t_s": 12.0 * np.arange(30.0 * poses), **dict(zip(names, columns, strict=True))}
    return Run(RunMeta("cube", kind="poses"), samples)


def test_accuracy_that_a_frame_of_few_poses_made_small_is_not_inside() -> None:
    campaign = Campaign("c", "m", "poses")

    def sheet(poses: int, limit: float, symbol: str = "AP") -> dict[str, Any]:
        return _sheet_of(kind_named("poses"), campaign, [_cube(poses)], limits_from({symbol: limit}, "m"))

    few = sheet(5, 5000.0)
    assert few["verdict"] == "cannot say"
    (said,) = [note for note in few["notes"] if "cannot be decided" in note]
    assert "AP cannot be decided: the 6 numbers of frame, fitted to 5 poses" in said
    assert "measure 20 poses or more" in said
    assert sheet(5, 10.0)["verdict"] == "outside"
    assert sheet(30, 5000.0)["verdict"] == "inside"
    # A frame keeps distances, and what readings of a pose scatter by.
    assert sheet(5, 5000.0, "AD")["verdict"] == sheet(5, 5000.0, "RP")["verdict"] == "inside"


def _first(run: Run, rows: int) -> Run:
    return Run(run.meta, {name: values[:rows] for name, values in run.samples.items()})


def test_one_pose_tells_its_repeatability_and_no_accuracy() -> None:
    there = np.array([500.0, 0.0, 400.0]) + np.random.default_rng(0).normal(0.0, 0.02, (30, 3))
    samples = {f"measured_{a}_mm": there[:, i] + 0.3 for i, a in enumerate("xyz")}
    samples |= {f"target_{a}_mm": np.full(30, v) for a, v in zip("xyz", (500.0, 0.0, 400.0), strict=True)}
    run = Run(RunMeta("p1", kind="poses"), {"t_s": np.arange(30.0), **samples})
    sheet = _sheet_of(kind_named("poses"), Campaign("c", "m", "poses"), [run], {})
    # A frame takes the error of a single pose, and with it how AP changes.
    assert [c["symbol"] for c in sheet["parts"][0]["characteristics"]] == ["RP", "dRP"]
    assert {f.code for f in kind_named("poses").judge_run(run)} == {"poses.repeats"}


@pytest.mark.parametrize("repeats", [2, 5, 30])
def test_the_floor_is_the_scatter_of_a_reading_whatever_the_number_of_repeats(repeats: int) -> None:
    rng = np.random.default_rng(0)
    target = np.repeat(rng.uniform(-500.0, 500.0, (1500, 3)), repeats, axis=0)
    measured = target + rng.normal(0.0, 0.02, target.shape)
    series = series_of_targets(target, np.tile(np.eye(3), (len(target), 1, 1)), measured)
    assert series.floor_mm == pytest.approx(0.02 * 3.0**0.5, rel=0.06)


def test_frame_and_tool_take_from_what_is_added_what_they_take_when_fitted_again() -> None:
    rng = np.random.default_rng(3)
    target, turned = rng.uniform(-500.0, 500.0, (12, 3)), Rotation.random(12, random_state=3).as_matrix()
    measured = target + turned @ [10.0, 20.0, 30.0] + rng.normal(0.0, 0.1, (12, 3))
    added = rng.normal(0.0, 1e-4, (12, 3))
    before, after = (series_of_targets(target, turned, seen) for seen in (measured, measured + added))
    left = left_by_setup(before.design)(added @ before.setup.rotation)
    assert after.error_mm - before.error_mm == pytest.approx(left, abs=2e-7)
    # Nine numbers of 36: of pure scatter a quarter is taken.
    assert (left**2).sum() / (added**2).sum() == pytest.approx(0.75, abs=0.15)
