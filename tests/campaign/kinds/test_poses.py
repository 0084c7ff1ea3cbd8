"""Poses of a robot: the generator shares no formula with the fit, it multiplies exponentials of screws."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from dtwin.acquire._tabular import kind_of_table
from dtwin.acquire.ingest import ingest, open_source
from dtwin.acquire.quality import judge_run
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.poses._axis_rows import joined, lines_for
from dtwin.kinds.poses._chain import KNOWN, chain_of, frames
from dtwin.kinds.poses._check import judge_poses
from dtwin.kinds.poses._diagnosis import _idle_terms, diagnose, nested_mean_mm, selected
from dtwin.kinds.poses._effects import EFFECTS, Term, terms_of
from dtwin.kinds.poses._fit import Grams, Parameter, dof_of, held_out_mm, parameters_with, solve
from dtwin.kinds.poses._iso9283 import measured_of
from dtwin.kinds.poses._read import _read_poses, is_pose_table
from dtwin.kinds.poses._series import series_of
from dtwin.kinds.poses._twins import PoseTwin, PoseTwins, _without
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.report.checking import check_source
from dtwin.schema import Campaign, Finding, Floats, Run
from dtwin.statistics import t_quantile

# Axes of a UR10 at rest, and a point on each, mm: read off the maker's drawing.
_AXES = np.array([[0, 0, 1], [0, -1, 0], [0, -1, 0], [0, -1, 0], [0, 0, -1], [0, -1, 0]], dtype=float)
_POINTS = np.array(
    [
        [0, 0, 0],
        [0, 0, 127.3],
        [-612, 0, 127.3],
        [-1184.3, 0, 127.3],
        [-1184.3, -163.941, 127.3],
        [-1184.3, -163.941, 11.6],
    ],
    dtype=float,
)
_TOOL = np.array([-1184.3, -163.941 - 92.2 - 80.0, 11.6 + 30.0])


def parameters(grams: Grams, terms: Sequence[Term]) -> list[Parameter]:
    value, covariance = solve(grams, grams.told(grams.series.chosen(terms)))
    return parameters_with(grams, terms, value, t_quantile(0.975, dof_of(grams)) * np.sqrt(np.diag(covariance)))


def _measured(joints: Floats, sag_mrad_m: float = 0.0) -> Floats:
    """Return tool points (n, 3): screws one after the other; joint 2 gives way to the weight of the forearm."""
    out = []
    for angles in joints:
        bent = angles.copy()
        reach = 0.612 * np.cos(angles[1]) + 0.5723 * np.cos(angles[1] + angles[2])
        bent[1] += 1e-3 * sag_mrad_m * -reach
        here = np.eye(4)
        for axis, point, angle in zip(_AXES, _POINTS, bent, strict=True):
            x, y, z = axis
            screw = np.zeros((4, 4))
            screw[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
            screw[:3, 3] = -np.cross(axis, point)
            here = here @ expm(screw * angle)
        out.append((here @ [*_TOOL, 1.0])[:3])
    turn = Rotation.from_euler("xyz", [20, -30, 110], degrees=True).as_matrix()
    return np.array(out) @ turn.T + [2000.0, -1500.0, 300.0]


def _joints(n: int, seed: int) -> Floats:
    rng = np.random.default_rng(seed)
    one = rng.uniform([-2, -2.2, -2.0, -2.5, -2.5, -2.5], [2, -0.6, 2.0, 2.5, 2.5, 2.5], (n, 6))
    return np.concatenate([one, one[: n // 5]])


def _grams(error: Floats, sag: float = 0.0, seed: int = 0) -> Grams:
    joints, rng = _joints(300, seed), np.random.default_rng(100 + seed)
    measured = _measured(joints + error, sag) + rng.normal(0.0, 0.03, (len(joints), 3))
    return Grams(series_of(np.degrees(joints), measured, KNOWN["ur10"], None))


def test_screws_and_chain_tell_the_same_robot() -> None:
    grams = _grams(np.zeros(6))
    assert np.abs(grams.series.error_mm).max() < 0.2
    assert grams.series.floor_mm == pytest.approx(0.03 * np.sqrt(3.0), rel=0.25)
    assert grams.series.repeats == 60
    at = frames(np.zeros((1, 6)), KNOWN["ur10"])
    assert at.origin_mm[-1, 0] == pytest.approx([-1184.3, -256.141, 11.6])


def test_a_zero_of_a_joint_is_named_and_nothing_else() -> None:
    grams = _grams(np.array([0, 0, 1.2e-3, 0, 0, 0]))
    said = diagnose(grams, ())
    assert (said.verdict, said.additions[0]) == ("missing_effect", "joint_zero@J3")
    assert said.additions == ("joint_zero@J3",)
    after = diagnose(grams, (Term("joint_zero", 3),))
    assert after.verdict == "nothing_missing"
    told = parameters(grams, [Term("joint_zero", 3)])[0]
    assert told.value == pytest.approx(1.2, abs=2.0 * told.k2)


def test_a_sound_robot_lacks_nothing() -> None:
    for seed in range(4):
        assert diagnose(_grams(np.zeros(6), seed=seed), ()).verdict == "nothing_missing"


def _twice(
    seed: int, n: int = 40, *, sag_of_wrist_mrad: float = 0.0, lost_mrad: float = 0.0, zero_mrad: float = 0.0
) -> Grams:
    """Poses that were measured twice, the second time in another order."""
    rng = np.random.default_rng(seed)
    once = _joints(n, seed)[:n]
    joints = np.concatenate([once, once[rng.permutation(n)] if lost_mrad else once])
    actual = joints.copy()
    actual[:, 3] += 1e-3 * sag_of_wrist_mrad * np.cos(joints[:, 1:4].sum(axis=1))
    actual[:, 1] -= 0.5e-3 * lost_mrad * np.sign(np.diff(joints[:, 1], prepend=0.0))
    actual[:, 2] += 1e-3 * zero_mrad
    measured = _measured(actual) + rng.normal(0.0, 0.02, (len(joints), 3))
    return Grams(series_of(np.degrees(joints), measured, KNOWN["ur10"], None))


@pytest.mark.parametrize("seed", [158, 223, 224])
def test_nothing_is_missing_below_the_scatter_of_repeats(seed: int) -> None:
    # Chance alone gains 1 to 2 % with a joint of these.
    assert diagnose(_twice(seed), ()).verdict == "nothing_missing"


def test_a_zero_is_named_below_a_floor_that_lost_motion_made() -> None:
    chosen = {term.label for term in selected(_twice(1, lost_mrad=0.6, zero_mrad=0.05))}
    assert {"joint_reversal@J2", "joint_zero@J3"} <= chosen


def test_sag_of_the_wrist_is_not_looked_for_and_not_said_to_be_nothing() -> None:
    said = diagnose(_twice(6, 100, sag_of_wrist_mrad=0.2), ())
    ratio = said.figures["held_out_rms_um"] / said.figures["noise_floor_um"]
    assert 1.0 < ratio < 1.5
    assert said.verdict == "unknown_effect"
    assert "sag of the wrist, J4 to J6, is not looked for" in said.headline


@pytest.mark.parametrize("zero_mrad", [0.004, 0.4])
def test_an_effect_that_is_small_beside_what_no_effect_explains_is_doubtful(zero_mrad: float) -> None:
    zero = Term("joint_zero", 3)
    said = diagnose(_twice(6, 100, sag_of_wrist_mrad=0.4, zero_mrad=zero_mrad), [zero])
    assert said.verdict == "unknown_effect"
    assert said.doubtful == ((zero,) if zero_mrad < 0.1 else ())


def test_a_floor_that_lost_motion_lifted_falls_with_it() -> None:
    grams = _twice(6, 100, lost_mrad=2.0, sag_of_wrist_mrad=0.2)
    before, after = diagnose(grams, ()), diagnose(grams, [Term("joint_reversal", 2)])
    assert before.figures["noise_floor_um"] > 45.0
    assert after.figures["noise_floor_um"] == pytest.approx(20.0 * np.sqrt(3.0), rel=0.15)
    assert after.verdict == "unknown_effect"


@pytest.mark.parametrize(("wrist", "told"), [(0.0, False), (4.0, True)])
def test_sag_of_the_elbow_that_leaves_much_may_be_that_of_the_wrist(wrist: float, told: bool) -> None:
    sound = _twice(0, 90)
    poses, setup = sound.series.poses, sound.series.setup
    point = poses.at.tool_mm(setup.tool_mm)
    bent = [EFFECTS["gravity_sag"].columns(poses, point, joint)[:, :, 0] for joint in (3, 4)]
    measured = poses.measured_mm + (2.0 * bent[0] + wrist * bent[1]) @ setup.rotation.T
    said = diagnose(Grams(series_of(np.degrees(poses.joints_rad), measured, KNOWN["ur10"], None)), ())
    assert said.additions[0] == "gravity_sag@J3"
    assert ("may look like that of J3" in said.headline) is told


def test_sag_is_named_where_it_was_put() -> None:
    said = diagnose(_grams(np.zeros(6), sag=1.0), ())
    assert "gravity_sag@J2" in said.additions


def test_all_that_is_missing_is_chosen_from_nothing_and_the_choice_is_judged_without_its_poses() -> None:
    grams = _grams(np.array([0, 0.8e-3, 0, -1.5e-3, 0, 0]), sag=1.0)
    chosen = selected(grams)
    assert {t.label for t in chosen} >= {"joint_zero@J4", "gravity_sag@J2"}
    assert len(chosen) <= 4
    own = float(np.linalg.norm(held_out_mm(grams, chosen), axis=1).mean())
    assert 0.98 * own < nested_mean_mm(grams) < 1.3 * own
    assert _idle_terms(grams, [*chosen, Term("joint_reversal", 5)]) == [Term("joint_reversal", 5)]


def test_what_is_missing_once_idle_effects_are_out_is_chosen_too() -> None:
    joints, rng = _joints(60, 6), np.random.default_rng(106)
    actual = joints + np.array([0.0, 0.0, 4.7e-4, 6.8e-4, 0.0, 0.0])
    actual[:, 2] += 2e-4 * np.sin(joints[:, 2] + 1.0)
    measured = _measured(actual, 1.0) + rng.normal(0.0, 0.03, (len(joints), 3))
    grams = Grams(series_of(np.degrees(joints), measured, KNOWN["ur10"], None))
    chosen = selected(grams)
    assert {"joint_zero@J3", "gravity_sag@J2", "joint_cyclic_1@J3"} <= {term.label for term in chosen}
    assert not diagnose(grams, chosen).group


@pytest.mark.parametrize("poses", [24, 60, 120])
def test_few_poses_tell_a_zero_ten_times_their_noise_and_no_joint_besides(poses: int) -> None:
    for seed in range(3):
        joints, rng = _joints(poses, seed), np.random.default_rng(seed)
        measured = _measured(joints + np.array([0, 0.5e-3, 0, 0, 0, 0])) + rng.normal(0.0, 0.02, (len(joints), 3))
        grams = Grams(series_of(np.degrees(joints), measured, KNOWN["ur10"], None))
        assert [t.label for t in selected(grams)] == ["joint_zero@J2"]
        size = np.linalg.norm(held_out_mm(grams, [Term("joint_zero", 2)]), axis=1).mean()
        assert nested_mean_mm(grams) < 1.5 * size


def test_what_a_few_blocks_hold_most_of_is_told() -> None:
    # Eccentricity of the base's encoder: poses near its nodes gain nothing.
    joints, rng = _joints(60, 2), np.random.default_rng(2)
    wave = np.zeros_like(joints)
    wave[:, 0] = 0.4e-3 * np.cos(joints[:, 0])
    measured = _measured(joints + wave) + rng.normal(0.0, 0.02, (len(joints), 3))
    grams = Grams(series_of(np.degrees(joints), measured, KNOWN["ur10"], None))
    assert [t.label for t in selected(grams)] == ["joint_cyclic_1@J1"]


def test_what_the_fit_leaves_of_a_block_is_what_a_fit_without_it_leaves() -> None:
    grams = _grams(np.array([0, 0, 1.2e-3, 0, 0, 0]))
    terms = terms_of(["joint_zero@J2+J3"], 6)
    told, block = grams.told(grams.series.chosen(terms)), 2
    rows = grams.series.block == block
    design, error = grams.series.design[:, :, told], grams.series.error_mm
    value = np.linalg.lstsq(design[~rows].reshape(-1, len(told)), error[~rows].ravel(), rcond=None)[0]
    left = error[rows] - design[rows] @ value
    assert held_out_mm(grams, terms)[rows] == pytest.approx(left, abs=1e-6)
    assert grams.left_out(told)[block] == pytest.approx((left**2).sum(), rel=1e-6)


def test_what_frame_and_tool_hide_has_no_number() -> None:
    told = {(p.term.label, p.name): p.value for p in parameters(_grams(np.zeros(6)), terms_of(["joint_zero"], 6))}
    hidden = {label for (label, _), value in told.items() if np.isnan(value)}
    assert hidden == {"joint_zero@J1", "joint_zero@J6"}


def test_the_uncertainty_covers_what_was_put_in() -> None:
    put = np.array([0, 0.5e-3, 0, 0, 0, 0])
    found = [parameters(_grams(put, seed=s), [Term("joint_zero", 2)])[0] for s in range(12)]
    assert sum(abs(p.value - 0.5) < p.k2 for p in found) >= 10


def _campaign(folder: Path, scale: float = 1.0, *, decimal: str = ",") -> Path:
    joints = _joints(60, 3)
    measured = _measured(joints + np.array([0, 0, 2e-3, 0, 0, 0]))
    folder.mkdir()
    rows = [";".join([*(f"J{j}" for j in range(1, 7)), "X", "Y", "Z", "stamp"])]
    for n, (angles, point) in enumerate(zip(joints, measured * scale, strict=True)):
        cells = [f"{v:.9f}".replace(".", decimal if n % 2 else ".") for v in (*angles, *point)]
        rows.append(";".join([*cells, "2,02011E+13"]))
    (folder / "poses.csv").write_text("\n".join(rows), encoding="utf-8")
    names = [f'J{j} = "joint_{j}_rad"' for j in range(1, 7)] + [f'{a} = "measured_{a.lower()}_mm"' for a in "XYZ"]
    head = (
        '[campaign]\nname = "tracker"\nmachine = "arm"\nkind = "poses"\n[campaign.machine_geometry]\nchain = "ur10"\n'
    )
    recipe = "[campaign.instrument.columns]\n" + "\n".join([*names, 'stamp = "t_s"'])
    runs = '\n[[run]]\nid = "r"\nfile = "poses.csv"\n'
    (folder / "campaign.toml").write_text(head + recipe + runs, encoding="utf-8")
    return folder


def _codes(folder: Path) -> set[str]:
    _, runs = open_source(folder)[:2]
    return {f.code for found, _ in runs for run in found for f in (*run.findings, *kind_named("poses").judge_run(run))}


def test_mixed_decimals_and_dead_stamps_are_read_and_said(tmp_path: Path) -> None:
    # Its repeats agree in every digit, and nobody says when they were read.
    assert _codes(_campaign(tmp_path / "c")) == {"poses.times", "poses.repeats", "poses.copies"}


def test_metres_under_a_name_of_millimetres_are_an_error(tmp_path: Path) -> None:
    assert "poses.chain" in _codes(_campaign(tmp_path / "c", 1e-3))


def test_the_verbs_of_a_twin_work_on_poses(tmp_path: Path) -> None:
    twins = PoseTwins(Home(tmp_path / "home"))
    first = twins.fit(str(_campaign(tmp_path / "c")), ["joint_zero@J2"], "arm")
    second = twins.add("arm", "joint_zero", "J3")
    assert second.figures["mean_after_mm"] < 0.1 * first.figures["mean_after_mm"]
    found = twins.compare("arm").as_dict()
    assert found["mean_same_mounting_mm"] == pytest.approx(second.figures["mean_after_mm"], rel=0.05)
    assert twins.remove("arm", "joint_zero@J3").labels == ("joint_zero@J2",)
    with pytest.raises(InputError, match="unknown effect"):
        twins.add("arm", "rust")


def _warming(folder: Path, head: str, cell: str = "{:g}") -> list[Finding]:
    """Return the findings of five poses that drift while they are measured again; ``cell``: form of seconds under the head."""
    rng, lines = (
        np.random.default_rng(0),
        [f"{head};Soll X [mm];Soll Y [mm];Soll Z [mm];Ist X [mm];Ist Y [mm];Ist Z [mm]"],
    )
    targets = rng.uniform(-400.0, 400.0, (5, 3))
    for n in range(150):
        measured = targets[n % 5] + rng.normal(0.0, 0.01, 3) + [0.2 * n / 150.0, 0.0, 0.0]
        stamp = datetime(2026, 1, 13, 8) + timedelta(seconds=12 * n)
        row = [
            stamp.isoformat() if cell == "stamp" else cell.format(12.5 * n),
            *map(str, targets[n % 5]),
            *map(str, measured),
        ]
        lines.append(";".join(row))
    (folder / "poses.csv").write_text("\n".join(lines).replace(".", ","), encoding="utf-8")
    campaign = Campaign("c", "m", "poses")
    (run,), _ = _read_poses(folder / "poses.csv", campaign, {})
    return [*run.findings, *judge_poses(run)]


@pytest.mark.parametrize("head", ["Time [s]", "Zeit [s]", "t [s]", "time_s", "Zeit [min]", "timestamp [s]", "t_s"])
def test_drift_is_told_under_every_head_of_times_that_a_log_may_have(tmp_path: Path, head: str) -> None:
    codes = {f.code for f in _warming(tmp_path, head)}
    assert "poses.drift" in codes
    assert "poses.times" not in codes


def test_stamps_are_times_of_poses_and_numbers_without_a_unit_are_asked_for_one(tmp_path: Path) -> None:
    assert "poses.drift" in {f.code for f in _warming(tmp_path, "Zeitstempel", "stamp")}
    (said,) = [f.message for f in _warming(tmp_path, "Time") if f.code == "poses.times"]
    assert "write Time [s]" in said


def logs(folder: Path, *, later_s: float = 0.0, joints_log: str = "joint_states.csv") -> np.ndarray:
    """Write the log of an arm that goes to 30 poses and stands there, and what a tracker reads all the time; return the poses."""
    rng = np.random.default_rng(6)
    poses = rng.uniform(-1.0, 1.0, (30, 6))
    t, q = [], []
    for n, pose in enumerate(poses):
        before = poses[n - 1] if n else pose
        for k in range(150):
            t.append(3.0 * n + 0.02 * k)
            q.append(before + (pose - before) * min(1.0, k / 50.0))
    joints, t_s = np.array(q) + 1e-6 * rng.standard_normal((len(q), 6)), np.array(t)
    heads = ["header.stamp.sec", "header.stamp.nanosec", *(f"position[{n}]" for n in range(6))]
    stamps = 1_790_000_000 + t_s
    rows = zip(stamps.astype(int), np.round(1e9 * (t_s - np.floor(t_s))).astype(int), *joints.T, strict=True)
    (folder / joints_log).write_text(
        "\n".join([",".join(heads), *(",".join(map(repr, map(float, r))) for r in rows)]), "utf-8"
    )
    seen = t_s[::5]
    point = frames(joints[::5], KNOWN["ur10"]).origin_mm[-1] + rng.normal(0.0, 0.01, (len(seen), 3))
    rows = zip(1_790_000_000 + seen + later_s, *(0.001 * point).T, strict=True)
    (folder / "tracker.csv").write_text(
        "\n".join(["time,x,y,z", *(",".join(map(repr, map(float, r))) for r in rows)]), "utf-8"
    )
    recipe = "\n".join(f'"position[{n}]" = "joint_{n + 1}_rad"' for n in range(6))
    (folder / "campaign.toml").write_text(
        '[campaign]\nname = "c"\nmachine = "m"\nkind = "poses"\n[campaign.machine_geometry]\nchain = "ur10"\n'
        f'[campaign.instrument.columns]\n{recipe}\n"header.stamp.sec" = "t_s"\n"header.stamp.nanosec" = "t_ns"\n'
        '"time" = "t_s"\n"x" = "measured_x_m"\n"y" = "measured_y_m"\n"z" = "measured_z_m"\n'
        f'[[run]]\nid = "r"\nfile = "tracker.csv"\ncondition = {{ joints_log = "{joints_log}" }}\n',
        encoding="utf-8",
    )
    return poses


def test_joints_that_were_logged_beside_a_tracker_are_taken_at_stops(tmp_path: Path) -> None:
    poses = logs(tmp_path)
    ((run,), (rejected,)) = next(iter(open_source(tmp_path)[1]))
    # One reading a stop, whatever the tracker wrote meanwhile: those are no repeats.
    assert run.n_samples == 30
    joints = np.stack([run.samples[f"joint_{n}_deg"] for n in range(1, 7)], axis=1)
    np.testing.assert_allclose(joints, np.degrees(poses), atol=1e-3)
    assert {row["reason"] for row in rejected.rows} == {"the robot moved"}
    assert "poses.times" not in {f.code for f in run.findings}
    error = series_of(joints, measured_of(run), KNOWN["ur10"], None).error_mm
    # Eight readings of 0.01 mm each.
    assert np.linalg.norm(error, axis=1).mean() < 0.01


def test_logs_of_two_clocks_are_refused(tmp_path: Path) -> None:
    logs(tmp_path, later_s=3600.0)
    with pytest.raises(InputError, match="while the robot stood") as caught:
        next(iter(open_source(tmp_path)[1]))
    assert "1790003600" in str(caught.value.got)
    text = (tmp_path / "campaign.toml").read_text("utf-8")
    (tmp_path / "campaign.toml").write_text(text.replace('= "t_s"', '= "when"'), encoding="utf-8")
    with pytest.raises(InputError, match="cannot be brought together"):
        next(iter(open_source(tmp_path)[1]))


DEGREE = np.pi / 180.0
STAMPED = "U(95)  [mm],q1,q2,q3,q4,Target,Time Stamp"


def beside(folder: Path, joints: str, places: str, *, unit: float = 1.0, lost: int = 0) -> Path:
    """Write what calibrations of arms leave: a file of joints with these heads, and one of a tracker, a row for a row."""
    q = np.random.default_rng(8).uniform(-1.5, 1.5, (40, 6))
    point = frames(q, KNOWN["ur10"]).origin_mm[-1]
    rows = [" ".join(map(repr, pose)) for pose in (q / unit).tolist()][lost:]
    (folder / "joints.txt").write_text("\n".join([joints, *rows] if joints else rows), "utf-8")
    extra = [f",0.004,0.5,0.5,0.5,0.5,TMC 30-B #5320,'20.10.2022 16:{n // 6:02}:{n % 6}0.092" for n in range(len(q))]
    lines = [f"{x!r},{y!r},{z!r}{more}" for (x, y, z), more in zip(point.tolist(), extra, strict=True)]
    (folder / "tracker.csv").write_text("\n".join([f"{places},{STAMPED}", *lines]), "utf-8")
    (folder / "campaign.toml").write_text(
        '[campaign]\nname = "c"\nmachine = "m"\nkind = "poses"\n[campaign.machine_geometry]\nchain = "ur10"\n'
        '[[run]]\nid = "r"\nfile = "tracker.csv"\ncondition = { joints_log = "joints.txt" }\n',
        encoding="utf-8",
    )
    return folder


@pytest.mark.parametrize(
    ("joints", "unit"),
    [
        ("j1 j2 j3 j4 j5 j6", DEGREE),
        (" ".join(f"joint_{n}" for n in range(1, 7)), DEGREE),
        (" ".join(f"q_{n}" for n in range(6)), DEGREE),
        ("A1[deg] A2[deg] A3[deg] A4[deg] A5[deg] A6[deg]", DEGREE),
        ("theta_1_rad theta_2_rad theta_3_rad theta_4_rad theta_5_rad theta_6_rad", 1.0),
    ],
)
def test_joints_in_a_file_without_times_are_those_of_the_trackers_rows(
    tmp_path: Path, joints: str, unit: float
) -> None:
    ((run,), _) = next(iter(open_source(beside(tmp_path, joints, "X  [mm],Y  [mm],Z  [mm]", unit=unit))[1]))
    error = series_of(
        np.stack([run.samples[f"joint_{n}_deg"] for n in range(1, 7)], axis=1), measured_of(run), KNOWN["ur10"], None
    ).error_mm
    assert len(error) == 40
    assert np.abs(error).max() < 1e-6
    # Stamps behind an apostrophe are times.
    assert run.samples["t_s"][1] == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("joints", "places", "given", "code", "said"),
    [
        ("j1 j2 j3 j4 j5 j6", "X [mm],Y [mm],Z [mm]", {"unit": DEGREE, "lost": 1}, "poses.joints_log", "in 39 rows"),
        ("j1 j2 j3 j4 j5 j6", "x,y,z", {"unit": DEGREE}, "columns.missing", "X [mm], Y [mm], Z [mm]"),
        ("j1 j2 j3 j4 j5 j6", "X [mm],Y [mm],Z [mm]", {}, "poses.unit", "J1 [rad]"),
        ("", "X [mm],Y [mm],Z [mm]", {}, "columns.heads", "write the heads"),
    ],
)
def test_files_that_are_not_row_for_row_are_refused(
    tmp_path: Path, joints: str, places: str, given: dict[str, float], code: str, said: str
) -> None:
    with pytest.raises(InputError) as refused:
        next(iter(open_source(beside(tmp_path, joints, places, **given))[1]))  # type: ignore[arg-type]
    assert refused.value.code == code
    assert said in str(refused.value.as_dict())


def test_what_a_tracker_wrote_alone_is_asked_for_the_joints(tmp_path: Path) -> None:
    table = beside(tmp_path, "j1 j2 j3 j4 j5 j6", "X  [mm],Y  [mm],Z  [mm]") / "tracker.csv"
    with pytest.raises(InputError, match="table of poses") as refused:
        next(iter(open_source(table, {"machine": "m"})[1]))
    assert "joints_log" in str(refused.value.hint)


@pytest.mark.parametrize(("encoding", "mark"), [("utf-16", ";"), ("cp1252", ";"), ("utf-8", "\t")])
def test_a_pose_table_of_another_encoding_or_mark_is_read(tmp_path: Path, encoding: str, mark: str) -> None:
    folder = _campaign(tmp_path / "c")
    table = folder / "poses.csv"
    recipe = (folder / "campaign.toml").read_text("utf-8").replace("J1 =", '"Gelenk 1 [°]" =')
    (folder / "campaign.toml").write_text(recipe, encoding="utf-8")
    text = table.read_text("utf-8").replace("J1", "Gelenk 1 [°]").replace(";", mark)
    table.write_bytes(text.encode(encoding))
    assert _codes(folder) == {"poses.times", "poses.repeats", "poses.copies"}


@pytest.mark.parametrize(("name", "code"), [("joint_1_rad", "poses.twice"), ("joint_9_rad", "columns.missing")])
def test_joints_that_are_told_twice_or_with_a_gap_are_refused(tmp_path: Path, name: str, code: str) -> None:
    folder = _campaign(tmp_path / "c")
    told = (folder / "campaign.toml").read_text("utf-8")
    (folder / "campaign.toml").write_text(told.replace('"joint_2_rad"', f'"{name}"'), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        _codes(folder)
    assert refused.value.code == code


def without_joints(folder: Path, form: str, *, scalar: float = 1.0) -> Path:
    """Thirty poses, thirty times, with an error of 0.3 mm in a direction of each pose's own, a scatter of 10 µm, another frame, and a tool."""
    rng = np.random.default_rng(5)
    place = np.tile(np.arange(30), 30)
    target, turned = rng.uniform(-400.0, 400.0, (30, 3)), Rotation.random(30, rng=rng)
    away = rng.standard_normal((30, 3))
    error = (0.3 * away / np.linalg.norm(away, axis=1)[:, None])[place] + 0.01 * rng.standard_normal((900, 3))
    tool = np.zeros(3) if form == "position" else np.array([0.0, 20.0, 90.0])
    frame = Rotation.from_euler("xyz", [20.0, -40.0, 100.0], degrees=True)
    measured = frame.apply(target[place] + turned[place].apply(tool) + error) + np.array([2000.0, -300.0, 900.0])
    columns = {f"cmd {a}": target[place, i] for i, a in enumerate("xyz")}
    columns |= {f"pose.position.{a}": measured[:, i] / 1e3 for i, a in enumerate("xyz")}
    names = {f"cmd {a}": f"target_{a}_mm" for a in "xyz"}
    names |= {f"pose.position.{a}": f"measured_{a}_m" for a in "xyz"}
    if form == "matrix":
        for i, a in enumerate("xyz"):
            del names[f"cmd {a}"]
            for j in range(3):
                columns[f"r{i}{j}"], names[f"r{i}{j}"] = turned.as_matrix()[place, i, j], f"target_m{i + 1}{j + 1}"
            names[f"cmd {a}"] = f"target_m{i + 1}4_mm"
    if form == "rotvec":
        for i, a in enumerate("xyz"):
            columns[f"r{a}"], names[f"r{a}"] = scalar * turned.as_rotvec()[place, i], f"target_rotvec_{a}_rad"
    if form == "rpy":
        for i, a in enumerate(("roll", "pitch", "yaw")):
            angles = turned.as_euler("xyz", degrees=True)
            columns[a], names[a] = angles[place, i], f"target_{a}_deg"
    if form == "quaternion":
        for i, a in enumerate("xyzw"):
            factor = scalar if a == "w" else 1.0
            columns[f"cmd q{a}"], names[f"cmd q{a}"] = factor * turned.as_quat()[place, i], f"target_q{a}"
            columns[f"pose.orientation.{a}"] = turned.as_quat()[place, i]
            names[f"pose.orientation.{a}"] = f"measured_q{a}"
    folder.mkdir()
    rows = [",".join(f"{v:.9f}" for v in row) for row in zip(*columns.values(), strict=True)]
    (folder / "poses.csv").write_text("\n".join([",".join(columns), *rows]), encoding="utf-8")
    head = '[campaign]\nname = "mocap"\nmachine = "arm"\nkind = "poses"\n[campaign.instrument.columns]\n'
    told = "".join(f'"{head}" = "{name}"\n' for head, name in names.items())
    (folder / "campaign.toml").write_text(f'{head}{told}[[run]]\nid = "r"\nfile = "poses.csv"\n', encoding="utf-8")
    return folder


def first_run(folder: Path) -> Run:
    (run,) = next(iter(open_source(folder)[1]))[0]
    return run


@pytest.mark.parametrize("form", ["position", "quaternion", "matrix", "rotvec", "rpy"])
def test_poses_without_joints_have_the_figures_of_the_standard(tmp_path: Path, form: str) -> None:
    run = first_run(without_joints(tmp_path / "c", form))
    told = {f.code for f in (*run.findings, *judge_run(run))}
    assert told == {"poses.times", "poses.repeats"} | ({"poses.orientation"} if form == "quaternion" else set())
    found = kind_named("poses").campaign_figures([run])["iso9283"][run.meta.run_id]
    assert (found["poses"], found["readings"]) == (30, 900)
    assert found["taken_away"] == ("frame" if form == "position" else "frame and tool")
    # A frame of six numbers, and a tool of three, take a part of the error of thirty poses.
    assert found["pose_accuracy_mm"]["mean"] == pytest.approx(0.3, rel=0.12)
    # Mean and three times the spread of the length of three normal directions of 10 µm.
    assert found["pose_repeatability_mm"]["median"] == pytest.approx(0.0160 + 3 * 0.0067, rel=0.1)
    home = Home(tmp_path / "home")
    ingest(tmp_path / "c", Lake(home.lake))
    with pytest.raises(InputError, match="needs joints"):
        PoseTwins(home).fit("mocap", ["joint_zero@J2"], "arm")


@pytest.mark.parametrize(
    ("name", "other", "said"),
    [("measured_z_m", "measured_z_mm", ""), ("target_x_mm", "target_x_m", "in another unit"), ("", "", "left-handed")],
)
def test_what_keeps_commanded_and_measured_places_apart_is_said(
    tmp_path: Path, name: str, other: str, said: str
) -> None:
    folder = without_joints(tmp_path / "c", "position")
    told = (folder / "campaign.toml").read_text("utf-8")
    (folder / "campaign.toml").write_text(told.replace(f'"{name}"', f'"{other}"'), encoding="utf-8")
    table = folder / "poses.csv"
    lines = table.read_text("utf-8").splitlines()
    if not name:
        turned = (",".join([*row.split(",")[:5], str(-float(row.split(",")[5]))]) for row in lines[1:])
        lines = [lines[0], *turned]
    table.write_text("\n".join(["a title", *lines]), encoding="utf-8")
    (found,) = (f.message for f in judge_run(first_run(folder)) if f.severity == "error")
    assert said in found


@pytest.mark.parametrize(("size", "severity"), [(0.2, "warning"), (2.0, "error")])
def test_a_reflector_beside_the_commanded_point_without_orientations_is_said(
    tmp_path: Path, size: float, severity: str
) -> None:
    whole = first_run(without_joints(tmp_path / "c", "quaternion"))
    # As if the tool were shorter or longer: what it adds turns with the pose.
    measured = np.stack([whole.samples[f"measured_{a}_mm"] for a in "xyz"], axis=1)
    turned = Rotation.from_quat(np.stack([whole.samples[f"target_q{a}_1"] for a in "xyzw"], axis=1))
    frame = Rotation.from_euler("xyz", [20.0, -40.0, 100.0], degrees=True)
    measured += frame.apply(turned.apply([0.0, 20.0 * (size - 1.0), 90.0 * (size - 1.0)]))
    samples = {name: column for name, column in whole.samples.items() if not name.startswith("target_q")}
    run = replace(whole, samples=samples | {f"measured_{a}_mm": measured[:, i] for i, a in enumerate("xyz")})
    (found,) = (f for f in judge_run(run) if "target_qx" in f.message)
    assert (found.severity, found.code == "poses.reflector") == (severity, severity == "warning")


def test_a_quaternion_that_is_none_is_refused_with_its_pose(tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        first_run(without_joints(tmp_path / "c", "quaternion", scalar=1.5))
    assert refused.value.code == "poses.orientation"
    assert "pose 1" in str(refused.value.where)


def test_angles_without_a_convention_are_asked_for_it_and_degrees_are_no_radians(tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        first_run(without_joints(tmp_path / "a", "rotvec", scalar=180.0 / np.pi))
    assert "degrees in columns of radians" in str(refused.value.got)
    folder = without_joints(tmp_path / "b", "rotvec")
    told = (folder / "campaign.toml").read_text("utf-8")
    (folder / "campaign.toml").write_text(told.replace("target_rotvec_", "target_r"), encoding="utf-8")
    (said,) = (f for f in first_run(folder).findings if f.code == "poses.orientation")
    assert said.severity == "warning"
    assert "target_rotvec_x_rad" in said.message
    assert "target_roll_deg" in said.message


@pytest.mark.parametrize(
    ("text", "line", "first"),
    [
        (
            "Format Version,1.23,Length Units,Meters\n\n,,Rigid Body,Rigid Body,Rigid Body,Rigid Body\n,,tool,tool,tool,tool\n"
            ",,1,1,1,1\n,,Rotation,Position,Position,Position\nFrame,Time (Seconds),W,X,Y,Z\n0,0.0,1,0.1,0.2,0.3\n",
            '"tool Position.X" = "measured_x_m"',
            "0.1",
        ),
        (
            "Format Version,1.25,Length Units,Millimeters\n\n,Type,Rigid Body,Rigid Body\n,Name,tool,tool\n,ID,a,a\n,Parent,,\n"
            ",,Rotation,Position\nFrame,Time (Seconds),W,X\n0,0.0,1,0.1\n",
            '"tool Position.X" = "measured_x_mm"',
            "0.1",
        ),
        (
            "Segments\n100\n,,arm:tool,,,,,\nFrame,Sub Frame,RX,RY,RZ,TX,TY,TZ\n,,deg,deg,deg,mm,mm,mm\n1,0,0,0,0,7,8,9\n",
            '"arm:tool TX" = "measured_x_mm"',
            "7",
        ),
    ],
)
def test_exports_of_cameras_say_how_their_columns_are_named(tmp_path: Path, text: str, line: str, first: str) -> None:
    found = joined([row.split(",") for row in text.splitlines() if row])
    assert found is not None
    heads, body, unit = found
    assert line in lines_for(heads, unit)
    assert lines_for(["t", "actual_q_0", "target_q_0"], "m") == ['"target_q_0" = "joint_1_rad"']
    assert body[0][heads.index(line.split('"')[1])] == first
    table = tmp_path / "take.csv"
    table.write_text(text, encoding="utf-8")
    assert kind_named("poses").takes_alone(table)
    head = '[campaign]\nname = "mocap"\nmachine = "arm"\nkind = "poses"\n[[run]]\nid = "r"\nfile = "take.csv"\n'
    (tmp_path / "campaign.toml").write_text(head, encoding="utf-8")
    with pytest.raises(InputError) as refused:
        first_run(tmp_path)
    assert line in str(refused.value.hint)


def test_a_table_that_lies_alone_needs_no_campaign_file(tmp_path: Path) -> None:
    rows = [f"{n};{n % 5 * 100},0;{n % 3 * 50},0;{n % 5},0;{n % 5 * 100},1;{n % 3 * 50},0;{n % 5},0" for n in range(30)]
    table = tmp_path / "posen.csv"
    table.write_text("\n".join(["Nr;Soll X [mm];Soll Y [mm];Soll Z [mm];Ist X [mm];Ist Y [mm];Ist Z [mm]", *rows]))
    campaign, runs, _ = open_source(table, {"machine": "cell-3"})
    assert (campaign.kind, campaign.machine) == ("poses", "cell-3")
    assert len(list(runs)) == 1


XYZ = "{0} X,{0} Y,{0} Z,{1} X,{1} Y,{1} Z"


@pytest.mark.parametrize(
    ("heads", "per_unit"),
    [
        (XYZ.format("指令", "測定"), 1.0),
        (XYZ.format("Commanded", "Actual"), 1.0),
        (XYZ.format("Command", "Attained"), 1.0),
        ("X consigne [mm],Y consigne [mm],Z consigne [mm],X mesuré [mm],Y mesuré [mm],Z mesuré [mm]", 1.0),
        ("Cell 3\n\n" + XYZ.format("Target", "Measured"), 1.0),
        (XYZ.format("Soll", "Ist") + "\nm,m,m,m,m,m", 1000.0),
        ("Soll,,,Ist,,\nX,Y,Z,X,Y,Z", 1.0),
        (XYZ.format("Target", "Actual").replace(",", " [in],") + " [in]", 25.4),
        ("Unit: inch\n" + XYZ.format("Target", "Actual"), 25.4),
        (XYZ.format("Soll", "Ist") + "\ninch,inch,inch,inch,inch,inch", 25.4),
    ],
)
def test_heads_of_poses_of_many_languages_below_titles_and_above_units(
    tmp_path: Path, heads: str, per_unit: float
) -> None:
    rows = [f"{n % 5 * 100},{n % 3 * 50},{n % 5},{n % 5 * 100 + 1},{n % 3 * 50},{n % 5}" for n in range(30)]
    table = tmp_path / "poses.csv"
    table.write_text("\n".join([heads, *rows]), encoding="utf-8")
    _, runs, _ = open_source(table, {})
    ((run,), _) = next(iter(runs))
    assert run.samples["target_x_mm"][1] == pytest.approx(100.0 * per_unit)
    assert run.samples["measured_x_mm"][1] == pytest.approx(101.0 * per_unit)
    # A minus before a number with an exponent is no way back.
    far = [
        ",".join(f"{sign * float(cell):.3E}" for cell in row.split(","))
        for n, row in enumerate(rows)
        for sign in (1 - n % 3,)
    ]
    table.write_text("\n".join([XYZ.format("Target", "Actual"), *far]), encoding="utf-8")
    assert kind_of_table(table) == "poses"
    robots = ["Robot," + XYZ.format("Target", "Actual"), *(f"R{n % 2},{row}" for n, row in enumerate(rows))]
    table.write_text("\n".join(robots), encoding="utf-8")
    with pytest.raises(InputError, match="several machines"):
        next(iter(open_source(table, {})[1]))
    bare = XYZ.format("Target", "Error")
    table.write_text("\n".join([bare, *rows]), encoding="utf-8")
    with pytest.raises(InputError, match="errors do not say their unit"):
        next(iter(open_source(table, {})[1]))
    table.write_text(
        "\n".join(["Error = target - actual", re.sub(r"(Error .)", r"\1 [mm]", bare), *rows]), encoding="utf-8"
    )
    with pytest.raises(InputError, match="target minus actual"):
        next(iter(open_source(table, {})[1]))
    table.write_text("\n".join([re.sub(r"(Error .)", r"\1 [mm]", bare), *rows]), encoding="utf-8")
    ((run,), _) = next(iter(open_source(table, {})[1]))
    assert run.samples["error_x_mm"][1] == pytest.approx(101.0)


@pytest.mark.parametrize("lost", ["{x},{y},1e300", "0.0,0,0.000"])
def test_a_number_beyond_all_reason_and_a_lost_beam_are_no_readings(tmp_path: Path, lost: str) -> None:
    folder = without_joints(tmp_path / "c", "position")
    lines = (folder / "poses.csv").read_text("utf-8").splitlines()
    cells = lines[3].split(",")
    lines[3] = ",".join([*cells[:3], lost.format(x=cells[3], y=cells[4])])
    (folder / "poses.csv").write_text("\n".join(lines), encoding="utf-8")
    (run,), (rejected,) = next(iter(open_source(folder)[1]))
    assert ([row["row"] for row in rejected.rows], run.n_samples) == ([2], 899)
    assert not any(f.severity == "error" for f in judge_run(run))


def _seven(joints: Floats) -> Floats:
    """Return tool points (n, 3) of seven joints that turn about z and y by turns, links of 0.36, 0.42, 0.4 and 0.2 m."""
    out = []
    for angles in joints:
        here, at = np.eye(3), np.zeros(3)
        for n, angle in enumerate(angles):
            here = here @ Rotation.from_rotvec(angle * np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]][n % 2])).as_matrix()
            at = at + here @ [0.0, 0.0, {0: 360.0, 2: 420.0, 4: 400.0, 6: 126.0}.get(n, 0.0)]
        out.append(at + here @ [40.0, 15.0, 120.0])
    return np.array(out)


_SEVEN = [
    {"d_mm": d, "alpha_deg": a} for d, a in ((360, -90), (0, 90), (420, -90), (0, 90), (400, -90), (0, 90), (126, 0))
]


def test_the_elbow_of_seven_joints_sags() -> None:
    rng = np.random.default_rng(4)
    joints = np.concatenate([one := rng.uniform(-1.5, 1.5, (120, 7)), one[:30]])
    bent = joints.copy()
    for row in bent:
        # The wrist's weight about the elbow's axis, which lies 0.4 m beneath it; the fourth turn is about y.
        lower = Rotation.from_euler("ZYZ", row[:3]) * Rotation.from_euler("Y", row[3])
        axis = lower.apply([0.0, 1.0, 0.0])
        row[3] += 1e-3 * 0.8 * np.cross(lower.apply([0.0, 0.0, 0.4]), [0.0, 0.0, -1.0]) @ axis
    measured = _seven(bent) + rng.normal(0.0, 0.02, (150, 3))
    grams = Grams(series_of(np.degrees(joints), measured, chain_of({"dh": _SEVEN}, "c"), None))
    assert [t.label for t in selected(grams)] == ["gravity_sag@J4"]
    with pytest.raises(InputError) as caught:
        terms_of(["gravity_sag@J5"], 7)
    assert caught.value.allowed == "gravity_sag of J1, J2, J3, J4"


def test_a_row_of_the_chain_under_another_name_is_no_zero() -> None:
    with pytest.raises(InputError) as caught:
        chain_of({"dh": [{"a": 325.0, "d_mm": 220.0}, {"a_mm": 275.0}]}, "c")
    assert caught.value.got == "dh with a"
    with pytest.raises(InputError, match="not known"):
        chain_of({"dh": [{"a_mm": float("nan")}, {"a_mm": 275.0}]}, "c")


def test_a_joint_that_stays_behind_has_lost_motion_above_zero() -> None:
    joints, rng = _joints(100, 5), np.random.default_rng(5)
    behind = joints.copy()
    behind[1:, 1] -= 0.25e-3 * np.sign(np.diff(joints[:, 1]))
    measured = _measured(behind) + rng.normal(0.0, 0.02, (len(joints), 3))
    grams = Grams(series_of(np.degrees(joints), measured, KNOWN["ur10"], None))
    (found,) = parameters(grams, [Term("joint_reversal", 2)])
    assert (found.name, found.value) == ("lost", pytest.approx(0.5, abs=0.03))


def test_stored_twins_of_before_tell_lost_motion_by_the_sign_of_today(tmp_path: Path) -> None:
    twins, document = _fitted(tmp_path, ["joint_reversal@J2"])
    old = {**document.document, "parameters": [{**document.document["parameters"][0], "name": "width", "value": -0.5}]}
    told = twins.stored(old).document["parameters"][0]
    assert (told["name"], told["value"]) == ("lost", 0.5)


def _written(folder: Path, joints: Floats, measured: Floats, *, head: str = "", timed: bool = True) -> Path:
    folder.mkdir()
    heads = [
        *(f"joint_{n}_deg" for n in range(1, 7)),
        *(f"measured_{a}_mm" for a in "xyz"),
        *(["t_s"] if timed else []),
    ]
    rows = np.column_stack([np.degrees(joints), measured, *([20.0 * np.arange(len(joints))] if timed else [])])
    lines = [",".join(heads), *(",".join(map(repr, map(float, row))) for row in rows)]
    (folder / "poses.csv").write_text("\n".join(lines), "utf-8")
    (folder / "campaign.toml").write_text(
        f'[campaign]\nname = "{folder.name}"\nmachine = "m"\nkind = "poses"\n[campaign.machine_geometry]\nchain = "ur10"\n'
        f'[[run]]\nid = "r"\nfile = "poses.csv"\n{head}',
        encoding="utf-8",
    )
    return folder


def _fitted(tmp_path: Path, effects: list[str]) -> tuple[PoseTwins, PoseTwin]:
    joints, rng = _joints(40, 6), np.random.default_rng(6)
    folder = _written(tmp_path / "c", joints, _measured(joints) + rng.normal(0.0, 0.02, (len(joints), 3)))
    twins = PoseTwins(Home(tmp_path / "home"))
    return twins, twins.fit(str(folder), effects, "arm")


def test_an_effect_without_its_column_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no column") as caught:
        _fitted(tmp_path, ["ambient_growth"])
    assert "ambient_c" in str(caught.value.allowed)


@pytest.mark.parametrize(
    ("chain", "mirror", "why"), [("ur5", 1.0, "is the chain that of this robot"), ("ur10", -1.0, "left-handed")]
)
def test_a_twin_of_an_arm_says_what_is_wrong_with_its_run(tmp_path: Path, chain: str, mirror: float, why: str) -> None:
    joints = _joints(30, 0)
    folder = _written(tmp_path / "c", joints, _measured(joints) * [1.0, 1.0, mirror])
    told = folder / "campaign.toml"
    told.write_text(told.read_text().replace('"ur10"', f'"{chain}"'))
    with pytest.raises(InputError, match="not sound") as caught:
        PoseTwins(Home(tmp_path / "home")).fit(str(folder), [], "arm")
    assert caught.value.code == "poses.chain"
    assert why in str(caught.value.got)


@pytest.mark.parametrize("poses", [1, 5])
def test_repeats_of_a_few_poses_make_no_twin(tmp_path: Path, poses: int) -> None:
    rng = np.random.default_rng(8)
    joints = np.tile(rng.uniform(-1.5, 1.5, (poses, 6)), (30 // poses, 1))
    folder = _written(tmp_path / "c", joints, _measured(joints) + rng.normal(0.0, 0.02, (len(joints), 3)))
    with pytest.raises(InputError, match="too few different poses"):
        PoseTwins(Home(tmp_path / "home")).fit(str(folder), [], "arm")


def test_what_moves_meanwhile_is_told_by_repeats_and_is_no_noise(tmp_path: Path) -> None:
    joints, rng = _joints(100, 7), np.random.default_rng(7)
    moved = np.linspace(0.0, 0.4, len(joints))[:, None] * [0.6, 0.0, 0.8]
    measured = _measured(joints) + moved + rng.normal(0.0, 0.02, (len(joints), 3))
    folder = _written(tmp_path / "c", joints, measured)
    ((run,), _) = next(iter(open_source(folder)[1]))
    (said,) = [f for f in judge_run(run) if f.code == "poses.drift"]
    assert said.numbers["moved_mm"] == pytest.approx(0.4, abs=0.03)
    twins = PoseTwins(Home(tmp_path / "home"))
    twins.fit(str(folder), [], "arm")
    made, groups, last = twins.discover("arm")
    assert groups == [("setup_drift",)]
    assert last.verdict == "nothing_missing"
    assert last.figures["noise_floor_um"] == pytest.approx(20.0 * np.sqrt(3.0), rel=0.3)
    # Another day it moves otherwise.
    again = _written(tmp_path / "again", joints, _measured(joints) + rng.normal(0.0, 0.02, (len(joints), 3)))
    assert twins.compare("arm", str(again)).as_dict()["residual_rms_um"] < 45.0
    assert made


def test_spoilt_rows_are_numbered_as_in_the_file_and_can_be_left_out(tmp_path: Path) -> None:
    joints, rng = _joints(100, 9), np.random.default_rng(9)
    measured = _measured(joints) + rng.normal(0.0, 0.02, (len(joints), 3))
    # A gap before, and two rows whose points were exchanged.
    measured[4, 1] = np.nan
    measured[[29, 30]] = measured[[30, 29]]
    folder = _written(tmp_path / "c", joints, measured)
    ((run,), _) = next(iter(open_source(folder)[1]))
    (said,) = [f for f in judge_run(run) if f.code == "poses.spoilt"]
    assert said.message.startswith("rows 30, 31 lie")
    assert "30 and 31 look exchanged" in said.message
    folder = _written(tmp_path / "less", joints, measured, head='condition = { leave_out = "30, 31" }')
    ((run,), (out,)) = next(iter(open_source(folder)[1]))
    assert "poses.spoilt" not in {f.code for f in judge_run(run)}
    assert {(row["row"], row["reason"]) for row in out.rows} == {
        (4, "not finite, or nothing was read"),
        (29, "left out in campaign.toml"),
        (30, "left out in campaign.toml"),
    }
    folder = _written(tmp_path / "wrong", joints, measured, head='condition = { leave_out = "0" }')
    with pytest.raises(InputError, match="by their numbers"):
        next(iter(open_source(folder)[1]))


def test_rows_that_were_written_twice_are_no_repeats(tmp_path: Path) -> None:
    joints, rng = _joints(40, 9), np.random.default_rng(9)
    measured = _measured(joints) + rng.normal(0.0, 0.02, (len(joints), 3))
    folder = _written(tmp_path / "c", joints, measured)
    told = check_source(folder)
    (once,) = told["runs"]
    table = folder / "poses.csv"
    head, *rows = table.read_text("utf-8").splitlines()
    table.write_text("\n".join([head, *(row for row in rows for _ in range(2))]), "utf-8")
    again = check_source(folder)
    (twice,) = again["runs"]
    assert again["sheet"] == told["sheet"]
    assert twice["samples"] == once["samples"] == len(joints)
    assert twice["rejected_rows"] == len(rows)
    (said,) = [f["message"] for f in twice["findings"] if f["code"] == "rows.rejected"]
    assert said.startswith(f"rows that are not used: {len(rows)}; a copy of row 1: 2; a copy of row 3: 4")
    # Without times nobody knows, and it is said.
    both = np.repeat(np.arange(len(joints)), 2)
    untimed = _written(tmp_path / "untimed", joints[both], measured[both], timed=False)
    assert "poses.copies" in _codes(untimed)


@pytest.mark.parametrize("in_a_row", [True, False])
def test_readings_of_one_stop_may_be_no_repeats(tmp_path: Path, in_a_row: bool) -> None:
    joints = np.unique(_joints(40, 3), axis=0)
    order = np.repeat(np.arange(len(joints)), 3) if in_a_row else np.tile(np.arange(len(joints)), 3)
    noise = np.random.default_rng(3).normal(0.0, 0.01, (len(order), 3))
    folder = _written(tmp_path / "c", joints[order], _measured(joints)[order] + noise, timed=False)
    assert ("poses.one_stop" in _codes(folder)) is in_a_row


def test_a_table_in_craigs_convention_is_one_of_denavit_and_hartenberg_whose_a_and_alpha_stand_a_row_further_up() -> (
    None
):
    # a, d, alpha, theta of a row Rx(alpha) Tx(a) Rz(theta + q) Tz(d).
    rng = np.random.default_rng(3)
    craig = rng.uniform(-1.0, 1.0, (6, 4)) * [300.0, 200.0, 1.5, 1.5]
    q = rng.uniform(-2.0, 2.0, (5, 6))

    def last(joints: np.ndarray) -> np.ndarray:
        pose = np.eye(4)
        for (a, d, alpha, theta), angle in zip(craig, joints, strict=True):
            for turn, shift in ((("x", alpha), [a, 0, 0]), (("z", theta + angle), [0, 0, d])):
                step = np.eye(4)
                step[:3, :3] = Rotation.from_euler(*turn).as_matrix()
                step[:3, 3] = step[:3, :3] @ shift
                pose = pose @ step
        return pose[:3, 3]

    rows = craig.copy()
    rows[:-1, [0, 2]], rows[-1, [0, 2]] = craig[1:, [0, 2]], 0.0
    of_base = Rotation.from_euler("x", craig[0, 2]).as_matrix()
    ours = frames(q, rows).origin_mm[-1] @ of_base.T + of_base @ [craig[0, 0], 0.0, 0.0]
    assert ours == pytest.approx(np.array([last(joints) for joints in q]), abs=1e-9)


def test_a_diagnosis_names_the_row_that_holds_most_of_what_is_left(tmp_path: Path) -> None:
    joints, rng = _joints(100, 10), np.random.default_rng(10)
    measured = _measured(joints) + rng.normal(0.0, 0.02, (len(joints), 3))
    measured[70] += [4.0, 2.0, -3.0]
    twins = PoseTwins(Home(tmp_path / "home"))
    twins.fit(str(_written(tmp_path / "c", joints, measured)), [], "arm")
    assert "most of it is in row 71" in twins.diagnose("arm")[1].headline


def test_what_was_taken_out_again_was_not_found() -> None:
    group = ("joint_zero@J2+J3", "gravity_sag@J2")
    assert _without(group, [Term("joint_zero", 3)]) == ("joint_zero@J2", "gravity_sag@J2")
    assert _without(group, [Term("joint_zero", 3), Term("joint_zero", 2)]) == ()
    assert _without(("setup_drift",), [Term("setup_drift")]) == ()


def test_half_widths_cover_the_truth_of_few_poses() -> None:
    covered = []
    for seed in range(40):
        joints, rng = _joints(30, 50 + seed), np.random.default_rng(seed)
        measured = _measured(joints + np.array([0, 0.5e-3, 0, 0, 0, 0])) + rng.normal(0.0, 0.02, (len(joints), 3))
        grams = Grams(series_of(np.degrees(joints), measured, KNOWN["ur10"], None))
        for one in parameters(grams, [Term("joint_zero", 2), Term("joint_zero", 4), Term("link_geometry", 3)]):
            if np.isfinite(one.value):
                covered.append(abs(one.value - (0.5 if one.term.joint == 2 else 0.0)) <= one.k2)
    assert len(covered) > 100
    assert np.mean(covered) > 0.9


def test_repeats_that_never_differ_and_an_arm_without_error_are_judged() -> None:
    joints = _joints(60, 11)
    measured = _measured(joints + np.array([0, 0.5e-3, 0, 0, 0, 0]))
    grams = Grams(series_of(np.degrees(joints), measured, KNOWN["ur10"], None))
    assert grams.series.floor_mm == pytest.approx(1e-4)
    assert diagnose(grams, ()).additions[0] == "joint_zero@J2"
    at = frames(joints, KNOWN["ur10"]).origin_mm[-1]
    assert diagnose(Grams(series_of(np.degrees(joints), at, KNOWN["ur10"], None)), ()).verdict == "nothing_missing"


def test_all_places_in_metres_under_names_of_millimetres_decide_nothing(tmp_path: Path) -> None:
    folder = without_joints(tmp_path / "c", "position")
    told = (folder / "campaign.toml").read_text("utf-8").replace('_m"', '_mm"')
    (folder / "campaign.toml").write_text(told, encoding="utf-8")
    heads, *rows = (folder / "poses.csv").read_text("utf-8").splitlines()
    small = [",".join(f"{float(v) / 1e3:.9f}" if i < 3 else v for i, v in enumerate(row.split(","))) for row in rows]
    (folder / "poses.csv").write_text("\n".join([heads, *small]), encoding="utf-8")
    (found,) = (f for f in judge_run(first_run(folder)) if f.severity == "error")
    assert found.code == "poses.units"


def test_a_test_within_a_few_millimetres_is_judged_and_the_unit_is_asked_for(tmp_path: Path) -> None:
    folder = without_joints(tmp_path / "c", "position")
    told = (folder / "campaign.toml").read_text("utf-8").replace('_m"', '_mm"')
    (folder / "campaign.toml").write_text(told, encoding="utf-8")
    rng = np.random.default_rng(0)
    heads = (folder / "poses.csv").read_text("utf-8").splitlines()[0]
    names = [told.partition('"' + head + '" = "')[2].partition('"')[0] for head in heads.split(",")]
    target = np.tile(rng.uniform(0.0, 4.0, (30, 3)), (30, 1))
    held = {"target": target, "measured": target + rng.normal(0.0, 0.02, target.shape)}
    columns = [held[n.partition("_")[0]][:, "xyz".index(n.split("_")[1])] if n else target[:, 0] for n in names]
    rows = [",".join(f"{v:.6f}" for v in row) for row in np.stack(columns, axis=1)]
    (folder / "poses.csv").write_text("\n".join([heads, *rows]), encoding="utf-8")
    found = judge_run(first_run(folder))
    assert [f.severity for f in found if f.code == "poses.units"] == ["warning"]
    assert "error" not in {f.severity for f in found}


@pytest.mark.parametrize(
    ("commanded", "measured", "per_mm"),
    [
        ("Soll {a} [mm]", "Ist {a} [m]", 1e-3),
        ("{a}-Soll", "{a}-Ist", 1.0),
        ("Sollposition {a} in mm", "Istposition {a} in mm", 1.0),
        ("soll_{a}_mm", "ist_{a}_um", 1e3),
        ("Soll{a}", "{a}_Istwert (mm)", 1.0),
    ],
)
def test_german_heads_need_no_map(tmp_path: Path, commanded: str, measured: str, per_mm: float) -> None:
    rng = np.random.default_rng(1)
    target = np.tile(rng.uniform(-400.0, 400.0, (30, 3)), (2, 1))
    at = target + rng.normal(0.0, 0.1, target.shape)
    heads = [form.format(a=a) for form in (commanded, measured) for a in "XYZ"]
    rows = [";".join(f"{v:.6f}".replace(".", ",") for v in row) for row in np.hstack([target, at * per_mm])]
    path = tmp_path / "posen.csv"
    path.write_text("\n".join([";".join(heads), *rows]), encoding="utf-8")
    assert is_pose_table(path)
    (run,), rejects = _read_poses(path, Campaign("c", "m", "poses"), {})
    assert rejects == []
    assert run.samples["target_y_mm"] == pytest.approx(target[:, 1], abs=1e-5)
    assert run.samples["measured_z_mm"] == pytest.approx(at[:, 2], abs=1e-2)


def test_places_without_a_unit_below_a_title_of_inches_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "posen.csv"
    rows = [f"{n};{n * n % 7};{n % 3};{n};{n * n % 7};{n % 3}" for n in range(30)]
    for title in ("Alle Angaben in Zoll", "# all in inches", "Positions in meters"):
        path.write_text("\n".join([title, "Soll X;Soll Y;Soll Z;Ist X;Ist Y;Ist Z", *rows]), encoding="utf-8")
        with pytest.raises(InputError, match="title tells a unit"):
            _read_poses(path, Campaign("c", "m", "poses"), {})


def test_a_row_that_sums_up_the_others_is_no_reading(tmp_path: Path) -> None:
    folder = without_joints(tmp_path / "c", "position")
    heads, *rows = (folder / "poses.csv").read_text("utf-8").splitlines()
    numbered = [f"P{i % 30},{row}" for i, row in enumerate(rows)]
    (folder / "poses.csv").write_text("\n".join([f"pose,{heads}", *numbered, f"mean,{rows[3]}"]), encoding="utf-8")
    assert first_run(folder).n_samples == 900


def test_coordinates_with_units_below_merged_heads_are_poses_and_no_positions_of_an_axis(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{100 * n},{n * n},{7 * n},{100 * n + 0.1},{n * n},{7 * n}" for n in range(12)]
    heads = ["Target,,,Actual,,", "X [mm],Y [mm],Z [mm],X [mm],Y [mm],Z [mm]"]
    path.write_text("\n".join([*heads, *rows]), encoding="utf-8")
    assert kind_of_table(path) == "poses"
    (run,), _ = _read_poses(path, Campaign("a", "m", "poses"), {})
    assert run.samples["measured_x_mm"] - run.samples["target_x_mm"] == pytest.approx([0.1] * 12)


@pytest.mark.parametrize("heads", ["pose,repeat,x_mm,y_mm,z_mm", "Punkt,Messung,X [mm],Y [mm],Z [mm]"])
def test_measured_places_alone_are_refused_with_how_they_repeat(tmp_path: Path, heads: str) -> None:
    path = tmp_path / "a.csv"
    rng = np.random.default_rng(4)
    points = {p: rng.normal(0.0, 0.01 * (p == "P2") + 0.005, (10, 3)) for p in ("P1", "P2")}
    rows = [f"{p},{n},{x[0] + 300:.6f},{x[1]:.6f},{x[2]:.6f}" for p, read in points.items() for n, x in enumerate(read)]
    path.write_text("\n".join([heads, *rows]), encoding="utf-8")
    assert kind_of_table(path) == "poses"
    with pytest.raises(InputError) as refused:
        _read_poses(path, Campaign("a", "m", "poses"), {})
    off = {p: np.linalg.norm(x - x.mean(axis=0), axis=1) for p, x in points.items()}
    p1, p2 = (off[p].mean() + 3.0 * off[p].std(ddof=1) for p in ("P1", "P2"))
    assert refused.value.code == "poses.commanded"
    assert refused.value.got == f"RP {p2:.3g} mm of 10 readings of P2; RP {p1:.3g} mm of 10 readings of P1"
    path.write_text("\n".join([f"t_s,{heads}", *(f"0,{row}" for row in rows)]), encoding="utf-8")
    assert not is_pose_table(path)
    # A name that comes again says it, too.
    named = [f"{p},{','.join(row)}" for p, _, *row in (line.split(",") for line in rows)]
    path.write_text("\n".join([re.sub(",(repeat|Messung),", ",", heads), *named]), encoding="utf-8")
    with pytest.raises(InputError) as again:
        _read_poses(path, Campaign("a", "m", "poses"), {})
    assert again.value.got == refused.value.got


@pytest.mark.parametrize(
    "heads", ["Nom X [mm],Nom Y [mm],Meas X [mm],Meas Y [mm]", "Desired_X,Desired_Y,err_x_mm,err_y_mm"]
)
def test_points_of_a_plane_are_poses_without_a_height(tmp_path: Path, heads: str) -> None:
    path = tmp_path / "a.csv"
    target = np.random.default_rng(4).uniform(-300.0, 300.0, (30, 2))
    read = target @ Rotation.from_euler("z", 0.1, degrees=True).as_matrix()[:2, :2].T + [0.3, -0.1]
    told = np.hstack([target, read - target if "err" in heads else read])
    path.write_text("\n".join([heads, *(",".join(f"{v:.6f}" for v in row) for row in told)]), encoding="utf-8")
    assert "poses.plane" in str(check_source(path, told={"kind": "poses"}))
    (run,), _ = _read_poses(path, Campaign("a", "m", "poses"), {})
    assert measured_of(run) == pytest.approx(np.hstack([read, np.zeros((30, 1))]), abs=1e-6)


@pytest.mark.parametrize("path_of_a_motion", [False, True])
def test_points_of_a_laser_tracker_program_tell_how_they_repeat_and_a_path_does_not(
    tmp_path: Path, path_of_a_motion: bool
) -> None:
    path = tmp_path / "a.txt"
    x = np.random.default_rng(4).normal(0.0, 0.01, (40, 3)) + 2.0 * path_of_a_motion * np.arange(40)[:, None]
    heads = [
        "// SpatialAnalyzer SA 2024.2 ( x64 )",
        "// Points Relative to 'A::WORLD'",
        "// AXES = CARTESIAN: X,  Y,  Z (mm)",
    ]
    rows = [f"Pose1,  Main,  {n},  {p[0]:.6f},  {p[1]:.6f},  {p[2]:.6f},  02/12/25 16:38:29" for n, p in enumerate(x)]
    path.write_text("\n".join(heads + rows), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        next(iter(open_source(path)[1]))
    off = np.linalg.norm(x - x.mean(axis=0), axis=1)
    rp = f"RP {off.mean() + 3.0 * off.std(ddof=1):.3g} mm of 40 readings of Main"
    assert refused.value.got == (", point, reading, X [mm], Y [mm], Z [mm], " if path_of_a_motion else rp)
    assert path_of_a_motion == ("only measured places are told" in (refused.value.hint or ""))


def test_commanded_places_beside_an_approach_are_poses_and_no_positions_of_one_axis(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    heads = "approach,Target X [mm],Target Y [mm],Target Z [mm],Actual X [mm],Actual Y [mm],Actual Z [mm]"
    rows = [f"{w},{100 * n},{n * n},{7 * n},{100 * n},{n * n},{7 * n}" for w in "+-" for n in range(12)]
    path.write_text("\n".join([heads, *rows]), encoding="utf-8")
    assert kind_of_table(path) == "poses"


@pytest.mark.parametrize("column", ["velocity [%]", "Payload [kg]", "speed_mm_s", "arm"])
def test_poses_under_several_speeds_or_loads_are_no_repeats(tmp_path: Path, column: str) -> None:
    path = tmp_path / "a.csv"
    heads = f"{column},Target X [mm],Target Y [mm],Target Z [mm],Actual X [mm],Actual Y [mm],Actual Z [mm]"
    rows = [f"{v},{100 * n},{n * n},{7 * n},{100 * n + v},{n * n},{7 * n}" for v in (10, 100) for n in range(12)]
    path.write_text("\n".join([heads, *rows]), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        _read_poses(path, Campaign("a", "m", "poses"), {})
    assert (refused.value.code, refused.value.got) == ("table.several", "10, 100")
    path.write_text("\n".join([heads, *rows[:12]]), encoding="utf-8")
    assert len(_read_poses(path, Campaign("a", "m", "poses"), {})[0]) == 1


@pytest.mark.parametrize(
    "heads", ["pose,repeat,axis,target [mm],measured [mm]", "Pose;Lauf;Achse;Soll;Abweichung [µm]"]
)
@pytest.mark.parametrize("by_axis", [False, True])
def test_the_three_rows_of_a_pose_become_one(tmp_path: Path, heads: str, by_axis: bool) -> None:
    rng = np.random.default_rng(5)
    target = np.repeat(rng.uniform(-300.0, 300.0, (1, 12, 3)).round(3), 2, axis=0)
    error = rng.normal(0.0, 0.05, target.shape).round(4)
    mark, errors = (";" if ";" in heads else ","), "µm" in heads
    rows = [
        mark.join(
            [
                f"P{p + 1}",
                str(n + 1),
                "XYZ"[a],
                f"{t:.3f}",
                f"{1e3 * error[n, p, a] if errors else t + error[n, p, a]:.4f}",
            ]
        )
        for (n, p, a), t in np.ndenumerate(target)
    ]
    rows = sorted(rows, key=lambda row: row.split(mark)[2]) if by_axis else rows
    path = tmp_path / "poses.csv"
    path.write_text("\n".join([heads, *rows]), encoding="utf-8")
    assert kind_of_table(path) == "poses"
    ((run,), _) = _read_poses(path, Campaign("c", "m", "poses"), {})
    assert np.column_stack([run.samples[f"target_{a}_mm"] for a in "xyz"]) == pytest.approx(target.reshape(-1, 3))
    what = "error" if errors else "measured"
    told = np.column_stack([run.samples[f"{what}_{a}_mm"] for a in "xyz"])
    assert told == pytest.approx((error if errors else target + error).reshape(-1, 3), abs=1e-6)
    path.write_text("\n".join([heads, *rows[:-1]]), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        _read_poses(path, Campaign("c", "m", "poses"), {})
    assert caught.value.code == "poses.axes"
