"""Turning axes: figures of a known target, what stands out of them, and what a single run refuses."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from campaign.kinds.turning_target import Target, table, turned
from hypothesis import given, settings
from hypothesis import strategies as st
from starlette.testclient import TestClient
from typer.testing import CliRunner

from dtwin.cli import app
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named, kinds
from dtwin.kinds.rotation._features import features_of
from dtwin.kinds.rotation._files import is_rotation_file
from dtwin.kinds.rotation._read import _read_rotation
from dtwin.kinds.rotation._turns import figures_of, turns_of
from dtwin.lake.store import Lake
from dtwin.report.language import _german_of
from dtwin.schema import Campaign, Finding, Floats, Run, RunMeta
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application

ROOT = Path(__file__).parents[3]
RPM = 60.0


def run_of(angle: Floats, um: Floats, sense: str = "radial", rpm: float = RPM) -> Run:
    condition: dict[str, float | str] = {"probe": "p", "sense": sense, "angle": "encoder"}
    t_s = np.arange(angle.size) * abs(angle[1] - angle[0]) / 6.0 / rpm
    return Run(RunMeta("r", "rotation", condition=condition), {"t_s": t_s, "angle_deg": angle, "displacement_um": um})


def judged(run: Run) -> list[Finding]:
    return kind_named("rotation").judge_run(run)


def read(
    folder: Path, text: str, recipe: Mapping[str, str] | None = None, name: str = "a.csv", **condition: Any
) -> list[Run]:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    campaign = Campaign("c", "m", "rotation", instrument={"columns": dict(recipe or {})})
    return _read_rotation(path, campaign, {"condition": condition})[0]


@pytest.mark.parametrize(("sense", "once"), [("radial", False), ("axial", True), ("", False)])
def test_the_figures_are_those_of_the_target(sense: str, once: bool) -> None:
    target = Target()
    inside = 0
    for seed in range(20):
        angle = turned(24.3)
        turns = turns_of(run_of(angle, target.read(angle, seed), sense))
        assert turns is not None
        found = figures_of(turns)
        assert found.turns == 24
        assert abs(found.once) == pytest.approx(8.0, abs=0.02)
        assert np.degrees(np.angle(found.once)) == pytest.approx(30.0, abs=0.2)
        assert found.residual.um == pytest.approx(target.synchronous_um(), abs=0.1)
        inside += abs(found.synchronous.um - target.synchronous_um(once)) < found.synchronous.expanded_um + 0.03
    assert inside >= 18


def test_the_uncertainty_of_asynchronous_motion_is_that_of_a_largest_range() -> None:
    """80 tests of 24 turns whose three lobes differ from turn to turn: the RMS scatters less than the range."""
    rng = np.random.default_rng(8)
    angle = np.arange(0.0, 24.1 * 360.0, 4.0)
    turn, a = (angle // 360.0).astype(int), np.radians(angle)
    told = []
    for _ in range(80):
        lobes = rng.normal(0.0, 0.3, (2, 25))
        moved = lobes[0, turn] * np.cos(3.0 * a) + lobes[1, turn] * np.sin(3.0 * a) + rng.normal(0.0, 0.05, a.size)
        turns = turns_of(run_of(angle, moved + 5.0 * np.cos(a)))
        assert turns is not None
        told.append(figures_of(turns).asynchronous)
    value = np.array([one.um for one in told])
    assert np.mean([one.expanded_um for one in told]) > 1.7 * value.std(ddof=1)


def test_the_uncertainty_of_what_comes_once_per_turn_is_that_of_turns() -> None:
    # The vector of each turn is drawn: neighbours are alike, as turns of a warm bearing are.
    rng, inside = np.random.default_rng(1), 0
    for seed in range(100):
        own = np.zeros(60)
        for n in range(1, 60):
            own[n] = 0.5 * own[n - 1] + rng.normal(0.0, 0.2)
        angle = turned(60.0, begin=0.0)
        um = Target(noise_um=0.01).read(angle, seed) + np.repeat(own, 200) * np.cos(np.radians(angle - 30.0))
        turns = turns_of(run_of(angle, um))
        assert turns is not None
        value = figures_of(turns).once_amplitude
        inside += abs(value.um - 8.0) < value.expanded_um
    # Blocks of ten turns still are a little alike.
    assert 0.84 <= inside / 100 <= 0.99


def test_asynchronous_motion_is_what_differs_from_turn_to_turn() -> None:
    angle = turned(40.1, begin=0.0)
    steady = turns_of(run_of(angle, Target(noise_um=0.02).read(angle, 3)))
    loose = turns_of(run_of(angle, Target(noise_um=0.02, each_turn_um=0.5).read(angle, 3)))
    assert steady is not None
    assert loose is not None
    assert figures_of(loose).asynchronous_rms.um == pytest.approx(0.5, rel=0.15)
    # What the target drew for each turn: two numbers, and the widest that they span in any phase.
    drawn = 0.5 * np.random.default_rng(3).normal(0.0, 1.0, (2, 41))[:, :40]
    phase = np.linspace(0.0, np.pi, 181)
    widest = np.ptp(drawn.T @ np.array([np.cos(phase), np.sin(phase)]), axis=0).max()
    assert figures_of(loose).asynchronous.um == pytest.approx(widest, abs=0.1)
    assert figures_of(steady).asynchronous_rms.um < 0.03


@pytest.mark.parametrize("order", [0.43, 2.37, 7.6])
def test_asynchronous_motion_of_an_order_between_whole_ones_does_not_ring_where_turns_meet(order: float) -> None:
    angle = np.arange(0.0, 30.1 * 360.0)
    turns = turns_of(run_of(angle, 5.0 * np.cos(np.radians(angle)) + 0.4 * np.cos(np.radians(order * angle))))
    assert turns is not None
    widest = np.ptp(turns.moved_um - turns.moved_um.mean(axis=0), axis=0).max()
    assert figures_of(turns).asynchronous.um == pytest.approx(widest, rel=0.01)


def test_a_drift_is_told_beside_and_changes_no_figure() -> None:
    angle = turned(20.0)
    target = Target(drift_um_turn=2.0)
    turns = turns_of(run_of(angle, target.read(angle, 1)))
    assert turns is not None
    found = figures_of(turns)
    assert turns.drift_um == pytest.approx(2.0 * 18, rel=0.01)
    assert abs(found.once) == pytest.approx(8.0, abs=0.02)
    assert found.asynchronous_rms.um < 0.1


@pytest.mark.parametrize("depth", [5.0, -3.0])
def test_a_groove_is_form_of_the_surface_and_no_error_motion(depth: float) -> None:
    named = 0
    for seed in range(20):
        target = Target(dips=((200.0, 5.0, depth),))
        angle = turned(20.0, readings=360)
        run = run_of(angle, target.read(angle, seed))
        told = [f for f in judged(run) if f.code == "rotation.feature"]
        turns = turns_of(run)
        assert turns is not None
        right = len(told) == 1 and abs(float(np.asarray(told[0].numbers["angle_deg"])) - 200.0) < 3.0
        named += right and ("dip" if depth > 0 else "bump") in told[0].message
        assert figures_of(turns).synchronous.um == pytest.approx(target.synchronous_um(), abs=0.15)
        assert figures_of(turns).total.um > 12.0 + (0.5 * depth if depth < 0 else 0.0)
    assert named >= 19


def test_slots_all_round_are_an_interrupted_surface() -> None:
    target = Target(dips=tuple((10.0 * k + 2.0, 4.0, 300.0 + 7.0 * (k % 5)) for k in range(36)))
    angle = turned(12.0, readings=720)
    run = run_of(angle, target.read(angle, 2))
    assert "rotation.interrupted" in {f.code for f in judged(run)}
    turns = turns_of(run)
    assert turns is not None
    assert abs(figures_of(turns).once) == pytest.approx(8.0, abs=0.3)


def test_nothing_is_named_where_nothing_is() -> None:
    quiet = 0
    for seed in range(20):
        angle = turned(24.0)
        quiet += not judged(run_of(angle, Target(each_turn_um=0.1).read(angle, seed)))
    assert quiet >= 19


@pytest.mark.parametrize("order", [0.42, 3.57, 7.31])
def test_an_order_that_is_no_whole_number_is_named(order: float) -> None:
    named = 0
    for seed in range(20):
        angle = turned(30.0)
        told = [f for f in judged(run_of(angle, Target(others={order: (0.05, 7.0)}).read(angle, seed)))]
        lines = [f.numbers["order_1"] for f in told if f.code == "rotation.orders"]
        named += any(isinstance(found, list) and len(found) == 1 and abs(found[0] - order) < 0.02 for found in lines)
    assert named >= 19


def test_what_the_grid_of_angles_leaves_of_a_wave_is_no_order() -> None:
    angle = 17.0 + 1.08 * np.arange(9700)
    assert not judged(run_of(angle, np.round(Target(lobes={}, noise_um=0.0).read(angle, 0), 5)))


def test_a_groove_is_found_beside_lobes_that_are_finer_than_the_smooth_form() -> None:
    angle, found = 2.0 * np.pi * (np.arange(120) + 0.5) / 120, 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        lobes = sum(
            rng.uniform(0.05, 0.4) / h**0.5 * np.cos(h * angle + rng.uniform(0.0, 6.3)) for h in (2, 3, 4, 5, 7, 11)
        )
        turns = 4.0 * np.cos(angle) + lobes + rng.normal(0.0, 0.02, (25, 120))
        assert not features_of(turns, 3.0)
        grooved = turns - 5.0 * np.exp(-(((angle - 2.0) / 0.05) ** 2))
        found += any(f.height_um < -2.0 and f.width_deg <= 15.0 for f in features_of(grooved, 3.0))
    assert found >= 48


def test_a_feature_of_one_turn_alone_is_no_form() -> None:
    angle = turned(20.0, readings=360)
    um = Target().read(angle, 5)
    um[360 * 7 + 100 : 360 * 7 + 103] += 9.0
    codes = {f.code for f in judged(run_of(angle, um))}
    assert "rotation.single" in codes
    assert "rotation.feature" not in codes


def test_what_makes_a_run_useless_is_said() -> None:
    angle = turned(20.0)
    um = Target().read(angle, 0)

    def codes(a: Floats, x: Floats) -> set[str]:
        return {f.code for f in judged(run_of(a, x)) if f.severity != "info"}

    assert codes(angle, um) == set()
    assert codes(angle[:150], um[:150]) == {"rotation.no_turn"}
    assert codes(angle[::20], um[::20]) == {"rotation.coarse"}
    assert codes(angle, np.full(um.size, 3.0)) == {"rotation.stuck"}
    assert codes(angle, np.minimum(um, 4.0)) == {"rotation.clipped"}
    assert codes(angle, 1e-4 * um) == {"rotation.size"}
    assert codes(angle, 1e4 * um) == {"rotation.size"}
    # Of micrometres under a head of millimetres all is evaluated.
    assert codes(angle, 1e3 * um) == {"rotation.size"}
    (found,) = (f for f in judged(run_of(angle, 1e3 * um)) if f.code == "rotation.size")
    assert found.severity == "warning"
    assert _german_of(found.message, str) is not None
    assert codes(angle[:700], um[:700]) == {"rotation.few_turns"}
    back = np.concatenate([angle, angle[-1] - (angle[:1000] - angle[0])])
    assert codes(back, Target().read(back, 0)) == {"rotation.turned_back"}
    # A clock that goes on, and an axis that gets faster.
    run = run_of(angle, um)
    faster = {**run.samples, "t_s": np.sqrt(1.0 + run.samples["t_s"])}
    assert {f.code for f in judged(Run(run.meta, faster))} == {"rotation.unsteady"}
    stopped = {**run.samples, "t_s": np.zeros(um.size)}
    assert {f.code for f in judged(Run(run.meta, stopped))} == {"clock.backwards"}


def test_turns_with_lost_readings_are_left_out() -> None:
    angle = turned(20.1, begin=0.0)
    keep = np.ones(angle.size, bool)
    keep[5 * 200 + 20 : 5 * 200 + 60] = False
    run = run_of(angle, Target().read(angle, 0))
    lost = Run(run.meta, {name: values[keep] for name, values in run.samples.items()})
    turns = turns_of(lost)
    assert turns is not None
    assert (turns.n, turns.whole) == (19, 20)
    assert [f.code for f in judged(lost)] == ["rotation.lost"]


def test_a_gap_of_more_than_a_turn_leaves_the_angle_right(tmp_path: Path) -> None:
    keep = np.ones(ANGLE.size, bool)
    keep[900:1170] = False
    (run,) = read(tmp_path, table({"t_s": TIME[keep], "angle_deg": ANGLE[keep] % 360.0, "radial_um": UM[keep]}))
    assert np.ptp(run.samples["angle_deg"]) == pytest.approx(np.ptp(ANGLE), abs=0.01)
    turns = turns_of(run)
    assert turns is not None
    assert (turns.n, turns.whole) == (9, 11)
    assert abs(figures_of(turns).once) == pytest.approx(8.0, abs=0.05)


def test_readings_with_one_stamp_are_spread(tmp_path: Path) -> None:
    coarse = np.floor(TIME * 50.0) / 50.0
    (run,) = read(tmp_path, table({"t_s": coarse, "angle_deg": ANGLE % 360.0, "radial_um": UM}))
    assert (np.diff(run.samples["t_s"]) > 0.0).all()
    assert not [f for f in judged(run) if f.severity == "error"]


def test_turning_backwards_gives_the_same_figures() -> None:
    angle = turned(20.0)
    um = Target().read(angle, 4)
    there, back = turns_of(run_of(angle, um)), turns_of(run_of(angle[::-1].copy(), um[::-1].copy()))
    assert there is not None
    assert back is not None
    assert figures_of(back).once == pytest.approx(figures_of(there).once, abs=1e-6)
    assert figures_of(back).synchronous.um == pytest.approx(figures_of(there).synchronous.um, abs=1e-6)


ANGLE = turned(12.0)
TIME = ANGLE / 6.0 / RPM
UM = Target().read(ANGLE, 9)


@pytest.mark.parametrize(
    "text",
    [
        table({"t_s": TIME, "angle_deg": ANGLE % 360.0, "radial_x_um": UM}),
        table(
            {"t_s": TIME, "angle_deg": (ANGLE + 180.0) % 360.0 - 180.0, "radial_x_mm": UM / 1000.0},
            form=lambda v: f"{v:.9f}",
        ),
        table({"Zeit [ms]": 1000.0 * TIME, "Winkel [rad]": np.radians(ANGLE), "radial x [µm]": UM}, ";").replace(
            ".", ","
        ),
        table({"Zeit [ms]": 1000.0 * TIME, "Winkel [Grad]": ANGLE, "radial x [µm]": UM}, ";"),
        table(
            {"time (s)": TIME, "angle [rev]": ANGLE / 360.0, "radial x [mm]": UM / 1000.0}, "\t", lambda v: f"{v:.9f}"
        ),
        table({"time": TIME, "spindle angle": ANGLE, "radial x [in]": UM / 25400.0}, form=lambda v: f"{v:.12f}"),
        "spindle 3\n"
        + table({"time": TIME, "angle": ANGLE, "radial x": UM}).replace("radial x\n", "radial x\ns,deg,µm\n"),
    ],
)
def test_every_way_to_write_a_run_is_read(tmp_path: Path, text: str) -> None:
    (run,) = read(tmp_path, text)
    assert is_rotation_file(tmp_path / "a.csv")
    turns = turns_of(run)
    assert turns is not None
    assert abs(figures_of(turns).once) == pytest.approx(8.0, abs=0.05)
    assert run.meta.condition["sense"] == "radial"
    assert run.meta.condition["speed_rpm"] == pytest.approx(RPM, rel=1e-3)


@pytest.mark.parametrize("probe", ["Sonde 1", "Taster 2", "ch1", "Kanal 1", "変位"])
def test_probes_under_other_names(tmp_path: Path, probe: str) -> None:
    (run,) = read(tmp_path, table({"Zeit [s]": TIME, "回転角度 [°]": ANGLE, f"{probe} [µm]": UM}))
    assert is_rotation_file(tmp_path / "a.csv")
    assert run.samples["displacement_um"] == pytest.approx(UM, abs=1e-3)


@pytest.mark.parametrize("heads", ["t_s,angle_deg,ch1 [µm],ch2 [°C]", "t,angle,ch1,sensor 2\ns,deg,µm,℃"])
def test_channels_of_temperatures_are_no_probes(tmp_path: Path, heads: str) -> None:
    rows = table({"t_s": TIME, "angle_deg": ANGLE, "a": UM, "b": 0.0 * UM + 20.0}).split("\n", 1)[1]
    (run,) = read(tmp_path, f"{heads}\n{rows}")
    assert run.samples["displacement_um"] == pytest.approx(UM, abs=1e-3)


@pytest.mark.parametrize(
    "beside",
    [
        *(
            "Tolerance [µm]",
            "X limit [µm]",
            "X mean [µm]",
            "X fit [µm]",
            "ideal [µm]",
            "X residual [µm]",
            "Z position [mm]",
        ),
        *(
            "X once per turn [µm]",
            "Master form [µm]",
            "X filtered [µm]",
            "X diameter [µm]",
            "Tiefpass [µm]",
            "async [µm]",
            "Summe [µm]",
        ),
        *("torque [Nm]", "X-Y [µm]", "X LSC [µm]"),
    ],
)
def test_what_no_probe_read_is_no_run(tmp_path: Path, beside: str) -> None:
    text = table({"time [s]": TIME, "angle [deg]": ANGLE, beside: 3.0 + 0.01 * UM, "ch1 [µm]": UM})
    (run,) = read(tmp_path, text)
    assert run.samples["displacement_um"] == pytest.approx(UM, abs=1e-3)


def test_a_unit_that_is_not_told_is_said_to_be_assumed(tmp_path: Path) -> None:
    (run,) = read(tmp_path, table({"time": TIME, "angle [deg]": ANGLE, "radial x [µm]": UM}))
    assert [f.message for f in run.findings if f.code == "rotation.unit_assumed"] == [
        "columns tell no unit, and are taken: time in s"
    ]


def test_pulses_give_the_angle_between_them(tmp_path: Path) -> None:
    pulse = (ANGLE % 360.0 < 20.0).astype(float)
    (run,) = read(tmp_path, table({"t_s": TIME, "index pulse": pulse, "radial_um": UM}))
    turns = turns_of(run)
    assert turns is not None
    assert run.meta.condition["angle"] == "pulses"
    assert abs(figures_of(turns).once) == pytest.approx(8.0, abs=0.05)


def test_a_speed_alone_tells_no_angle_of_readings_that_are_turns_apart(tmp_path: Path) -> None:
    seldom = table({"t_s": 60.0 * np.arange(TIME.size), "speed [rpm]": np.full(TIME.size, 3000.0), "radial_um": UM})
    with pytest.raises(InputError, match="turns too far") as refused:
        read(tmp_path, seldom)
    assert refused.value.got == "a reading every 60 s at 3000 rpm: 3000 turns"


def test_a_speed_alone_is_made_exact_by_what_repeats_and_has_no_phase(tmp_path: Path) -> None:
    off = 1.004
    for text, told in (
        (table({"t_s": TIME, "speed [rpm]": np.full(TIME.size, RPM * off), "radial_um": UM}), {}),
        (table({"t_s": TIME, "radial_um": UM}), {"speed_rpm": RPM * off}),
    ):
        (run,) = read(tmp_path, text, **told)
        assert [f.code for f in run.findings] == ["rotation.nominal"]
        turns = turns_of(run)
        assert turns is not None
        assert abs(figures_of(turns).once) == pytest.approx(8.0, abs=0.1)
        assert figures_of(turns).asynchronous_rms.um < 0.2
        figures = kind_named("rotation").run_figures(run)["rotation"]
        assert figures["once_deg"] is None


def log_of(delay_s: float = 0.0, jitter: bool = False) -> str:
    """One line a reading: an angle at 50 Hz, whose stamps may come in bursts, and two probes at 200 and 100 Hz."""
    from datetime import datetime, timedelta

    begin, rng, lines = datetime(2026, 3, 2, 8, 0), np.random.default_rng(3), []
    for name, rate, value in (
        ("AX:PosAct", 50.0, lambda t: 6.0 * RPM * t % 360.0),
        ("S1:Enc", 200.0, lambda t: (40000.0 + Target().read(6.0 * RPM * t, 1)) / 1000.0),
        ("S2:Enc", 100.0, lambda t: (20000.0 + Target(once=(3.0, 0.0)).read(6.0 * RPM * t, 2)) / 1000.0),
    ):
        t = np.arange(0.0, 30.0, 1.0 / rate)
        late = (
            delay_s + (np.ceil(t / 0.1) * 0.1 - t if jitter else 0.0) * (name == "AX:PosAct")
            if name == "AX:PosAct"
            else 0.0
        )
        for at, v in zip(t + late, value(t), strict=True):
            lines.append((at, f"{name} {begin + timedelta(seconds=float(at)):%Y-%m-%d %H:%M:%S.%f} {v:.6f}"))
    rng.shuffle(lines)
    return "\n".join(line for _, line in sorted(lines)) + "\nS1:Enc <disconnected>\n"


CHANNELS = {"AX:PosAct": "angle_deg", "S1:Enc": "radial_top_mm", "S2:Enc": "axial_mm"}


@pytest.mark.parametrize("jitter", [False, True])
def test_a_log_of_one_line_a_reading_is_read_by_the_names_of_its_channels(tmp_path: Path, jitter: bool) -> None:
    runs = read(tmp_path, log_of(jitter=jitter), CHANNELS, "a.log")
    assert [run.meta.run_id for run in runs] == ["radial_top", "axial"]
    assert [f.code for f in runs[0].findings] == (["rotation.stamps"] if jitter else [])
    for run, once in zip(runs, (8.0, 3.0), strict=True):
        turns = turns_of(run)
        assert turns is not None
        assert turns.n == 29
        assert abs(figures_of(turns).once) == pytest.approx(once, abs=0.1)


def test_a_log_without_names_says_which_channels_it_has(tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        read(tmp_path, log_of(), {}, "a.log")
    assert refused.value.code == "rotation.channels"
    assert "S1:Enc (6001)" not in str(refused.value.got)
    assert "S1:Enc (6000)" in str(refused.value.got)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (table({"t_s": TIME, "angle_deg": np.radians(ANGLE) % (2.0 * np.pi), "radial_um": UM}), "rotation.unit"),
        (table({"t_s": TIME, "angle_deg": ANGLE, "radial": UM}), "rotation.unit"),
        (table({"t_s": TIME, "angle_deg": ANGLE, "axial_um": UM, "radial [V]": UM}), "rotation.unit"),
        (table({"speed [m/s]": TIME, "run-out [µm]": UM}), "rotation.unit"),
        (table({"t_s": TIME, "angle_deg": ANGLE / 360.0 % 1.0, "radial_um": UM}), "rotation.unit"),
        (table({"t_s": TIME, "angle_deg": ANGLE / 0.9 % 400.0, "radial_um": UM}), "rotation.unit"),
        (table({"speed [1000 rpm]": TIME, "run-out [µm]": UM}), "rotation.unit"),
        (table({"t_s": TIME, "angle_deg": ANGLE, "temperature_c": UM}), "columns.missing"),
        (table({"t_s": TIME, "radial_um": UM}), "rotation.angle"),
        (table({"angle_deg": ANGLE, "radial_um": UM}), "rotation.angle"),
        (table({"t_s": TIME, "pulse_1": 0.0 * UM, "radial_um": UM}), "rotation.pulses"),
        (table({"t_s": TIME, "angle_deg": ANGLE, "radial_um": UM}, form=lambda v: "x"), "rotation.time"),
        ("t_s,angle_deg,radial_um\n1,2,x\n2,3,x\n3,4,x\n", "table.no_rows"),
        ("t_s,angle_deg,angle_rad,radial_um\n" + "1,2,3,4\n" * 9, "rotation.twice"),
        ("speed_rpm,runout_um\n100,-4\n", "rotation.negative"),
        ("speed [rpm],run-out ± [µm]\n100,4\n", "rotation.part"),
        ("speed [rpm],half run-out [µm]\n100,4\n", "rotation.part"),
        ("speed [rpm],run-out/2 [µm]\n100,4\n", "rotation.part"),
        ("speed [rpm],run-out tolerance [µm]\n100,4\n", "columns.missing"),
        (table({"t_s": TIME[::-1], "angle_deg": ANGLE, "radial_um": UM}), "rotation.clock"),
        (table({"t_s": 0.0 * TIME, "angle_deg": ANGLE, "radial_um": UM}), "rotation.clock"),
        ("radial_um,axial_um\n1,2\n", "columns.missing"),
        ("", "file.empty"),
    ],
)
def test_what_cannot_be_read_is_refused(tmp_path: Path, text: str, code: str) -> None:
    with pytest.raises(InputError) as refused:
        read(tmp_path, text)
    assert refused.value.code == code


def test_rows_without_a_number_are_rejected_and_the_rest_is_used(tmp_path: Path) -> None:
    lines = table({"t_s": TIME, "angle_deg": ANGLE % 360.0, "radial_um": UM, "axial_um": UM}).splitlines()
    lines[50] = "nan,nan,nan,nan"
    lines[60] = ",".join([*lines[60].split(",")[:2], "12 mm", "inf"])
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    runs, rejects = _read_rotation(path, Campaign("c", "m", "rotation"), {})
    assert [run.n_samples for run in runs] == [len(TIME) - 2] * 2
    assert {str(next(iter(r["values"].values()))) for r in rejects} >= {"12 mm", "inf"}
    assert all(turns_of(run) is not None for run in runs)


@settings(max_examples=100, deadline=None)
@given(
    st.binary(max_size=300),
    st.sampled_from(["t_s,angle_deg,radial_um\n", "speed_rpm,runout_um\n", "A 2026-03-02 08:00:00 1\n"]),
)
def test_no_file_ends_in_anything_but_a_refusal(
    tmp_path_factory: pytest.TempPathFactory, content: bytes, head: str
) -> None:
    path = tmp_path_factory.mktemp("any") / "a.csv"
    path.write_bytes(head.encode() + content)
    is_rotation_file(path)
    with suppress(InputError):
        campaign = Campaign("c", "m", "rotation", instrument={"columns": {"A": "radial_mm"}})
        for run in _read_rotation(path, campaign, {"condition": {"speed_rpm": 60.0}})[0]:
            judged(run)


def test_no_table_of_another_kind_is_taken_for_a_turning_axis(tmp_path: Path) -> None:
    files = [
        p
        for folder in ("data", "tests")
        for p in (ROOT / folder).rglob("*")
        if p.suffix in (".csv", ".txt", ".log", ".xlsx")
    ]
    assert files
    assert [p.name for p in files if is_rotation_file(p)] == []
    for heads in (
        "t_s,angle_deg,deviation_um,probe_x_um",
        "time [s],x [mm],y [mm],speed [rpm]",
        "angle [deg],target [mm],radial [mm],time",
        "t_s,displacement_um,temperature_a_c",
    ):
        path = tmp_path / "a.csv"
        path.write_text(f"{heads}\n1,2,3,4\n", encoding="utf-8")
        assert not is_rotation_file(path)
    for kind in kinds():
        if kind.name != "rotation":
            assert {"angle_deg", "displacement_um"} - set(kind.columns)


def test_a_table_alone_is_checked_by_the_command(tmp_path: Path) -> None:
    path = tmp_path / "spindle.csv"
    path.write_text(
        table({"t_s": TIME, "angle_deg": ANGLE % 360.0, "radial_x_um": UM, "axial_um": UM}), encoding="utf-8"
    )
    done = CliRunner().invoke(app, ["check", str(path), "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)
    symbols = [[c["symbol"] for c in part["characteristics"]] for part in result["sheet"]["parts"]]
    assert symbols == [["TIR", "e", "S", "A"], ["TIR", "e", "S", "R", "A"]]
    said = CliRunner().invoke(app, ["check", str(path)], catch_exceptions=False).output
    # Nothing of positioning is said of a turning axis.
    assert not re.search(r"backlash|positioning|accuracy", said)
    assert "S holds the form of the target" in said


def test_error_motion_over_speed_stands_under_its_own_name(tmp_path: Path) -> None:
    path = tmp_path / "analyser.csv"
    heads = "Spindle speed (RPM),TIR X (um),Fundamental X (um),Synchronous error X (um),Asynchronous error X (um),Total error motion X (um)"
    rows = [f"{1000 * n},{2 + 0.3 * n**2},1.5,{0.3 + 0.1 * n},0.2,0.5" for n in (1, 2, 3, 4, 5) * 3]
    path.write_text("\n".join([heads, *rows]), encoding="utf-8")
    result = CliRunner().invoke(app, ["check", str(path), "--json"])
    assert result.exit_code == 0, result.output
    told = json.loads(result.output)
    symbols = {c["symbol"] for part in told["sheet"]["parts"] for c in part["characteristics"]}
    assert symbols == {"TIR", "e", "S", "A", "T"}
    said = " ".join(f["message"] for f in told["findings"])
    assert "synchronous_error_x: synchronous error motion changes" in said
    assert "synchronous_error_x: run-out" not in said


def test_the_page_is_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    page = (ROOT / "docs/how-to/rotation.md").read_text(encoding="utf-8")
    runout, command, told = re.findall(r"```(?:csv title=\"spindle.csv\"|sh|text)\n(.*?)```", page, re.S)[:3]
    (tmp_path / "spindle.csv").write_text(runout, encoding="utf-8")
    done = CliRunner().invoke(app, command.split()[1:], catch_exceptions=False)
    assert done.exit_code == 0
    assert told.strip() in done.output
    first, second = re.findall(r"```toml title=\"campaign.toml\"\n(.*?)```", page, re.S)
    wheel, spindle = tmp_path / "wheel", tmp_path / "spindle"
    for folder, document in ((spindle, first), (wheel, second)):
        folder.mkdir()
        (folder / "campaign.toml").write_text(document, encoding="utf-8")
    (spindle / "3000rpm.csv").write_text(
        table({"t_s": TIME, "angle_deg": ANGLE, "CH1": UM, "CH2": UM, "CH3": UM}), encoding="utf-8"
    )
    names = {"AX:PosAct": "WHEEL:PosAct", "S1:Enc": "PROBE1:Value", "S2:Enc": "PROBE2:Value"}
    text = log_of()
    for ours, theirs in names.items():
        text = text.replace(ours, theirs)
    (wheel / "20rpm.log").write_text(text, encoding="utf-8")
    for folder, parts in ((spindle, ["n3000-radial_x", "n3000-axial"]), (wheel, ["n20-radial", "n20-axial_top"])):
        result = json.loads(CliRunner().invoke(app, ["check", str(folder), "--json"], catch_exceptions=False).stdout)
        assert [part["runs"][0] for part in result["sheet"]["parts"]] == parts
    codes = set(re.findall(r"`(rotation\.\w+)`", page))
    source = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "dtwin/kinds/rotation").glob("*.py"))
    # What is refused stands in the refusal; what is found stands on the page.
    found = set(re.findall(r'"(rotation\.\w+)"', source)) - set(re.findall(r'code="(rotation\.\w+)"', source))
    assert codes == found


def test_an_angle_in_a_file_of_its_own_is_taken_by_the_clock(tmp_path: Path) -> None:
    lines = log_of().splitlines()
    (tmp_path / "angle.log").write_text("\n".join(line for line in lines if line.startswith("AX")), encoding="utf-8")
    probes = "\n".join(line for line in lines if not line.startswith("AX"))
    whole = read(tmp_path, "\n".join(lines), CHANNELS, "whole.log")
    apart = read(tmp_path, probes, CHANNELS, "probes.log", angle_log="angle.log")
    for one, other in zip(whole, apart, strict=True):
        assert other.samples["angle_deg"] == pytest.approx(one.samples["angle_deg"], abs=1e-6)
    with pytest.raises(InputError) as refused:
        read(tmp_path, probes, CHANNELS, "probes.log", angle_log="../angle.log")
    assert refused.value.code == "campaign.escape"


@pytest.mark.parametrize(
    ("speed", "per_rpm", "runout"),
    [
        ("n [min⁻¹]", 1.0, "Rundlauffehler [µm]"),
        ("Drehzahl in U/min", 1.0, "Rundlaufabweichung in µm"),
        ("vitesse de rotation [tr/min]", 1.0, "faux-rond [µm]"),
        ("velocità [giri/min]", 1.0, "oscillazione radiale [µm]"),
        ("转速 [r/min]", 1.0, "径向跳动 [µm]"),
        ("omega [rad/s]", np.pi / 30.0, "TIR [um]"),
        ("speed [krpm]", 1e-3, "TIR [micron]"),
        ("Frequency [Hz]", 1.0 / 60.0, "TIR [micron]"),
        ("Frequenz [Hz]", 1.0 / 60.0, "Rundlauf [µm]"),
        ("krpm", 1e-3, "TIR [micron]"),
        ("krpm", 1e-3, "error motion [um]"),
        ("Speed (RPM)", 1.0, "TIR (0.0001 in)"),
        ("Speed (RPM)", 1.0, "runout (tenths)"),
        ("n [1/min]", 1.0, "Rundlauf in 1/100 mm"),
    ],
)
def test_speeds_of_many_names_and_units_are_read(tmp_path: Path, speed: str, per_rpm: float, runout: str) -> None:
    rpm = np.tile([1000.0, 2000.0, 4000.0], 3)
    path = tmp_path / "a.csv"
    path.write_text(table({speed: rpm * per_rpm, runout: 3.0 + 0.0 * rpm}, ";"), encoding="utf-8")
    assert is_rotation_file(path)
    (run,) = read(tmp_path, path.read_text(encoding="utf-8"))
    assert run.samples["speed_rpm"] == pytest.approx(rpm, rel=1e-5)
    parts = {"TIR (0.0001 in)": 2.54, "runout (tenths)": 2.54, "Rundlauf in 1/100 mm": 10.0}
    assert ("Freq" in speed) == ("rotation.frequency" in {finding.code for finding in run.findings})
    assert ("tenths" in runout) == ("rotation.tenths" in {finding.code for finding in run.findings})
    assert run.samples["runout_um"] == pytest.approx(3.0 * parts.get(runout, 1.0) + 0.0 * rpm)


@pytest.mark.parametrize(
    ("column", "names"),
    [
        ("Tool", "12"),
        ("Position", "FR"),
        ("Machine no.", ("M1", "M2")),
        ("spindle no", "12"),
        ("chuck", ("hydraulic", "shrink")),
        ("state", ("cold", "warm")),
        ("Ort", ("Nase", "300 mm")),
        ("Datum", ("1.2.2026", "2.2.2026")),
        ("load [N]", ("0", "100")),
    ],
)
def test_run_outs_of_several_tools_or_places_are_no_repeats(tmp_path: Path, column: str, names: str) -> None:
    rows = [f"{name},{1000 * n},{n}" for name in names for n in (1, 2, 3)]
    with pytest.raises(InputError) as refused:
        read(tmp_path, "\n".join([f"{column},Speed [rpm],Runout [µm]", *rows]))
    assert refused.value.code == "table.several"
    assert len(read(tmp_path, "\n".join([f"{column},Speed [rpm],Runout [µm]", *rows[:3]]))) == 1


def test_run_outs_at_several_distances_are_no_repeats(tmp_path: Path) -> None:
    rows = [f"{z}.0,{1000 * n},{n + z / 100}" for z in (0, 300) for n in (1, 2, 3)]
    with pytest.raises(InputError, match="several machines, tools, places or conditions") as refused:
        read(tmp_path, "\n".join(["distance from nose [mm],Speed [rpm],Runout [µm]", *rows]))
    assert refused.value.got == "0.0, 300.0"
    assert len(read(tmp_path, "\n".join(["distance from nose [mm],Speed [rpm],Runout [µm]", *rows[:3]]))) == 1


def test_speeds_side_by_side_below_a_cell_that_names_the_run_out_are_read(tmp_path: Path) -> None:
    (run,) = read(tmp_path, "TIR [µm],1000 rpm,2000 rpm,4000 rpm\nrun 1,3,4,6\nrun 2,3.1,4.1,6.1\n")
    assert run.samples["speed_rpm"].tolist() == [1000.0, 2000.0, 4000.0] * 2
    assert run.samples["runout_um"].tolist() == [3.0, 4.0, 6.0, 3.1, 4.1, 6.1]


@pytest.mark.parametrize(
    "heads",
    [
        "Speed [rpm],Runout at 300 mm",
        "Speed,Runout\nrpm x1000,µm",
        "Speed,Runout\n1000 rpm,µm",
        "Speed [rpm],Runout [µm x 10]",
    ],
)
def test_a_multiple_of_a_unit_and_that_of_a_place_are_no_unit(tmp_path: Path, heads: str) -> None:
    with pytest.raises(InputError) as refused:
        read(tmp_path, f"{heads}\n1,5\n2,6\n3,7\n")
    assert refused.value.code == "rotation.unit"


def test_units_in_a_row_below_the_heads_are_read_though_the_words_alone_are_known(tmp_path: Path) -> None:
    (run,) = read(tmp_path, "Protokoll\nDrehzahl;Rundlauf\n1/min;mm\n1000;0,003\n2000;0,004\n")
    assert run.samples["runout_um"].tolist() == pytest.approx([3.0, 4.0])


def test_heads_below_merged_ones_are_joined(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    heads = ["Drehzahl;Rundlauf;;Planlauf;", ";vorn;hinten;vorn;hinten", "1/min;µm;µm;µm;µm"]
    path.write_text("\n".join([*heads, *(f"{1000 * n};{n};2;3;4" for n in range(1, 6))]), encoding="utf-8")
    assert is_rotation_file(path)
    runs, _ = _read_rotation(path, Campaign("a", "m", "rotation", "", {}), {})
    told = {run.meta.run_id: run.samples["runout_um"][0] for run in runs}
    assert told == {"rundlauf_vorn": 1.0, "rundlauf_hinten": 2.0, "planlauf_vorn": 3.0, "planlauf_hinten": 4.0}


@pytest.mark.parametrize(
    ("heads", "probes"),
    [
        ("speed [rpm];TIR run 1 [µm];TIR run 2 [µm]", {"tir": 10}),
        ("speed [rpm];Run-out, trial 1 (µm);Run-out, trial 2 (µm)", {"run-out": 10}),
        ("speed [rpm];run-out 1 [µm];run-out 2 [µm]", {"run-out_1": 5, "run-out_2": 5}),
        ("speed [rpm];run-out front [µm];run-out rear [µm]", {"run-out_front": 5, "run-out_rear": 5}),
    ],
)
def test_columns_of_runs_are_repeats_and_others_are_probes(tmp_path: Path, heads: str, probes: dict[str, int]) -> None:
    path = tmp_path / "a.csv"
    path.write_text("\n".join([heads, *(f"{1000 * n};{n},1;{n},2" for n in range(1, 6))]), encoding="utf-8")
    runs, rejects = _read_rotation(path, Campaign("a", "m", "rotation", "", {}), {})
    assert {run.meta.run_id: run.n_samples for run in runs} == probes
    assert rejects == []
    speeds = runs[0].samples["speed_rpm"]
    assert runs[0].samples["runout_um"] == pytest.approx(
        speeds / 1000.0 + np.where(np.arange(len(speeds)) < 5, 0.1, 0.2)
    )


def test_run_out_beside_an_angle_is_a_displacement(tmp_path: Path) -> None:
    (run,) = read(tmp_path, table({"t [s]": TIME, "Drehwinkel [Umdrehungen]": ANGLE / 360.0, "Rundlauf [µm]": UM}))
    assert np.ptp(run.samples["angle_deg"]) == pytest.approx(np.ptp(ANGLE), abs=0.01)
    assert "displacement_um" in run.samples


@pytest.mark.parametrize("turn_deg", [360.0, 1e9])
def test_angle_and_displacement_need_no_time_where_the_speed_is_told(tmp_path: Path, turn_deg: float) -> None:
    heads = {"angle [deg]": ANGLE % turn_deg, "radial [um]": UM}
    (timed,) = read(tmp_path, table({"t_s": TIME, **heads}))
    rpm = np.ptp(ANGLE) / 6.0 / np.ptp(TIME)
    path = tmp_path / "a.csv"
    path.write_text(table({**heads, "speed [krpm]": 0.0 * UM + rpm / 1000.0}), encoding="utf-8")
    assert is_rotation_file(path)
    (run,) = read(tmp_path, path.read_text(encoding="utf-8"))
    assert run.samples["angle_deg"] == pytest.approx(timed.samples["angle_deg"], abs=0.01)
    assert np.ptp(run.samples["t_s"]) == pytest.approx(np.ptp(TIME), rel=1e-3)
    assert "clock.assumed" in {finding.code for finding in run.findings}
    path.write_text(table(heads), encoding="utf-8")
    assert not is_rotation_file(path)
    (stated,), _ = _read_rotation(path, Campaign("c", "m", "rotation"), {"condition": {"speed_rpm": rpm}})
    assert np.ptp(stated.samples["t_s"]) == pytest.approx(np.ptp(TIME), rel=1e-3)
    path.write_text(table({**heads, "speed [krpm]": 0.0 * UM + rpm / 1000.0}), encoding="utf-8")
    shown = CliRunner().invoke(app, ["check", str(path)])
    assert "a.csv: machine unknown, 1 run\n" in shown.stdout


def test_a_code_for_no_reading_is_left_out_and_a_keyway_is_not(tmp_path: Path) -> None:
    far = UM.copy()
    far[[500, 501]] = 9999.0
    (run,) = read(tmp_path, table({"t_s": TIME, "angle_deg": ANGLE, "radial_um": far}))
    assert [f.code for f in run.findings] == ["rotation.far"]
    assert run.samples["displacement_um"].size == UM.size - 2
    keyway = Target(dips=((200.0, 6.0, 2000.0),)).read(ANGLE, 9)
    (run,) = read(tmp_path, table({"t_s": TIME, "angle_deg": ANGLE, "radial_um": keyway}))
    assert not run.findings
    assert run.samples["displacement_um"].size == UM.size


def test_few_readings_a_turn_do_not_flatten_the_form() -> None:
    angle = turned(30.0, readings=20)
    run = run_of(angle, Target().read(angle, 3))
    turns = turns_of(run)
    assert turns is not None
    figures = figures_of(turns)
    assert abs(figures.once) == pytest.approx(8.0, abs=0.05)
    assert figures.synchronous.um == pytest.approx(Target().synchronous_um(), rel=0.05)
    assert [f.code for f in judged(run)] == ["rotation.sparse"]


def test_the_steps_of_a_display_are_no_spikes() -> None:
    angle = turned(30.0)
    run = run_of(angle, np.round(Target(noise_um=0.15).read(angle, 3)))
    assert "rotation.single" not in {f.code for f in judged(run)}


def test_the_share_of_slots_is_theirs() -> None:
    angle = turned(20.0)
    um = Target().read(angle, 4) - 50.0 * ((angle % 15.0) < 6.75)
    (told,) = (f for f in judged(run_of(angle, um)) if f.code == "rotation.interrupted")
    assert 35.0 < told.numbers["share_pct"] < 60.0


@pytest.mark.parametrize(("stated", "others", "code"), [(1.2, {}, "other_speed"), (1.0, {0.4: (0.5, 0.0)}, "orders")])
def test_a_speed_that_was_stated_wrongly_is_told(
    tmp_path: Path, stated: float, others: dict[float, tuple[float, float]], code: str
) -> None:
    angle = turned(25.0)
    um = Target(others=others).read(angle, 1)
    t_s = np.arange(angle.size) / 2000.0
    rpm = float(np.ptp(angle)) / 6.0 / float(np.ptp(t_s))
    columns = {"t_s": t_s, "speed [rpm]": np.full(angle.size, rpm / stated), "radial_um": um}
    (run,) = read(tmp_path, table(columns))
    (found,) = [f for f in judged(run) if f.code in ("rotation.other_speed", "rotation.orders")]
    assert found.code == f"rotation.{code}"
    if code == "other_speed":
        assert found.numbers["speed_rpm"] == pytest.approx(rpm, rel=0.01)


def test_run_outs_below_their_speeds_are_read(tmp_path: Path) -> None:
    for head in ("Speed [rpm],1000,2000,3000", "Probe,1000 rpm,2000 rpm,3000 rpm"):
        path = tmp_path / "a.csv"
        path.write_text(f"{head}\nradial TIR [um],2.1,2.2,2.5\naxial TIR [um],1,1.1,1.2\n", encoding="utf-8")
        assert is_rotation_file(path)
        radial, axial = read(tmp_path, path.read_text(encoding="utf-8"))
        assert radial.samples["speed_rpm"].tolist() == [1000.0, 2000.0, 3000.0]
        assert axial.samples["runout_um"].tolist() == pytest.approx([1.0, 1.1, 1.2])


@pytest.mark.parametrize("places", [4, 8, 12])
def test_a_dial_indicator_at_rest_tells_run_out_and_eccentricity_alone(tmp_path: Path, places: int) -> None:
    path, rng = tmp_path / "bar.csv", np.random.default_rng(places)
    angle = np.arange(0.0, 360.0 + 1.0, 360.0 / places)
    once = 20.0 * np.cos(np.radians(angle - 40.0))
    rows = [[f"{a:g}", *(f"{(u + rng.normal()) / 1000:.4f}" for _ in "123")] for a, u in zip(angle, once, strict=True)]
    heads = "Angle [deg],Indicator turn 1 [mm],Indicator turn 2 [mm],Indicator turn 3 [mm]"
    path.write_text("\n".join([heads, *(",".join(row) for row in rows)]), encoding="utf-8")
    done = CliRunner().invoke(app, ["check", str(path), "--json"], catch_exceptions=False)
    told = json.loads(done.stdout)
    (part,) = told["sheet"]["parts"]
    total, eccentricity = part["characteristics"]
    assert (total["symbol"], eccentricity["symbol"], total["repeats"]) == ("TIR", "e", 3)
    assert eccentricity["value_um"] == pytest.approx(20.0, abs=1.5)
    assert eccentricity["expanded_um"] > 0.0
    (said,) = [f["message"] for run in told["runs"] for f in run["findings"] if f["code"] == "rotation.at_rest"]
    assert "no error motion" in said


def test_an_indicator_that_does_not_come_back_is_told(tmp_path: Path) -> None:
    rows = [f"{45 * n},{0.02 * np.cos(np.pi * n / 4):.3f}" for n in range(8)]
    text = "\n".join(["Angle,Indicator [mm]", *rows, "360,0.030"])
    (run,) = read(tmp_path, text)
    assert "rotation.not_back" in {f.code for f in judged(run)}
    (run,) = read(tmp_path, text.replace("0.030", "0.020"))
    assert "rotation.not_back" not in {f.code for f in judged(run)}


@pytest.mark.parametrize("timed", [True, False])
def test_several_speeds_in_a_file_are_a_run_each(tmp_path: Path, timed: bool) -> None:
    angle = turned(9.0)
    um = [Target(once=(size, 30.0)).read(angle, 1) for size in (5.0, 7.0)]
    at = [np.full(angle.size, rpm) for rpm in (1000.0, 3000.0)]
    t_s = [np.arange(angle.size) * 360.0 / 200 / 6.0 / rpm[0] for rpm in at]
    columns = {"t_s": np.concatenate([t_s[0], t_s[1] + t_s[0][-1] + 10.0])} if timed else {}
    columns |= {"speed [rpm]": np.concatenate(at), "angle [deg]": np.concatenate([angle, angle]) % 360.0}
    runs = read(tmp_path, table(columns | {"radial [um]": np.concatenate(um)}))
    assert [run.meta.run_id for run in runs] == ["radial-1000rpm", "radial-3000rpm"]
    for run, size in zip(runs, (5.0, 7.0), strict=True):
        turns = turns_of(run)
        assert turns is not None
        assert abs(figures_of(turns).once) == pytest.approx(size, abs=0.05)


def test_angles_and_probes_stand_below_titles_where_the_speed_is_told(tmp_path: Path) -> None:
    text = "Analyser\nRev;32\n\n" + table({"Angle (deg)": ANGLE % 360.0, "X (µm)": UM, "Y (µm)": UM}, ";")
    runs = read(tmp_path, text, speed_rpm=6000.0)
    assert [run.meta.condition["probe"] for run in runs] == ["x", "y"]


@pytest.mark.parametrize("title", ["Speed: {:g} rpm", "Drehzahl;{:g} 1/min;", "n = {:g} 1/min", "主軸回転数 {:g} rpm"])
def test_blocks_below_their_speeds_are_a_run_each(tmp_path: Path, title: str) -> None:
    blocks = ["Max. speed: 8000 rpm", "Station 3"]
    for rpm in (1000.0, 2000.0):
        blocks += [title.format(rpm), table({"Time [s]": ANGLE / 6.0 / rpm, "Radial X [µm]": UM + rpm / 1000.0}, ";")]
    runs = read(tmp_path, "\n".join(blocks))
    assert is_rotation_file(tmp_path / "a.csv")
    assert [run.meta.condition["speed_rpm"] for run in runs] == pytest.approx([1000.0, 2000.0], rel=1e-3)
    assert [run.n_samples for run in runs] == [len(UM), len(UM)]


def test_run_outs_below_their_speeds_are_repeats_and_their_means_are_none(tmp_path: Path) -> None:
    lines = []
    for rpm in ("1.000", "4.000"):
        lines += [f"Drehzahl: {rpm} 1/min", "Lauf;Rundlauf [µm]", "1;5,1", "2;5,3", "Mittelwert;5,2"]
    (run,) = read(tmp_path, "\n".join(lines))
    assert run.samples["speed_rpm"].tolist() == [1000.0, 1000.0, 4000.0, 4000.0]
    assert run.samples["runout_um"].tolist() == [5.1, 5.3, 5.1, 5.3]


def test_speeds_that_change_from_row_to_row_need_a_time(tmp_path: Path) -> None:
    columns = {"speed [rpm]": np.linspace(100.0, 900.0, ANGLE.size), "angle [deg]": ANGLE % 360.0, "radial [um]": UM}
    with pytest.raises(InputError) as refused:
        read(tmp_path, table(columns))
    assert (refused.value.code, refused.value.got) == ("rotation.speed", "100 to 900 rpm")


@pytest.mark.parametrize(("pulses", "code"), [(4, "rotation.several_pulses"), (1, "")])
def test_pulses_that_come_several_times_a_turn_are_told(tmp_path: Path, pulses: int, code: str) -> None:
    angle = turned(25.0)
    pulse = ((pulses * angle) % 360.0 < 20.0).astype(float)
    um = Target(others={} if pulses > 1 else {0.25: (1.0, 0.0)}).read(angle, 1)
    (run,) = read(tmp_path, table({"t_s": np.arange(angle.size) / 200.0, "pulse": pulse, "radial_um": um}))
    assert [f.code for f in judged(run) if f.code in ("rotation.several_pulses", "rotation.orders")] == [
        code or "rotation.orders"
    ]


def test_the_page_of_a_run_draws_its_turns_once(tmp_path: Path) -> None:
    home = Home(tmp_path)
    angle = turned(24.3)
    Lake(home.lake).commit(Campaign("c", "m", "rotation"), [run_of(angle, Target().read(angle, 1))])
    browser = TestClient(application(Bench(home, Access("127.0.0.1", 8765))), base_url="http://127.0.0.1:8765")
    said = browser.get("/campaigns/c/runs/r").text
    assert [name for name in ("sheet/0", "runs/r/polar", "runs/r/angle") if f"/api/campaigns/c/{name}" in said] == [
        "sheet/0",
        "runs/r/angle",
    ]
    # Of a table of speeds there is one picture.
    columns = {"t_s": [0.0, 1.0], "speed_rpm": [1e3, 2e3], "runout_um": [1.0, 2.0]}
    over_speed = Run(RunMeta("s", kind="rotation"), {name: np.array(values) for name, values in columns.items()})
    Lake(home.lake).commit(Campaign("d", "m", "rotation"), [over_speed])
    said = browser.get("/campaigns/d/runs/s").text
    assert said.count('data-figure="/api/campaigns/d/') == 1
    assert "no picture" not in said
