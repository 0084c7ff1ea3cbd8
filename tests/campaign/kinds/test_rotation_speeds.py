"""A turning axis at several speeds: what its run-out follows is told apart, and what cannot be told is said."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from campaign.kinds.turning_target import Target, turned
from typer.testing import CliRunner

from dtwin.cli import app
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.kinds.rotation._heads import column_of
from dtwin.kinds.rotation._laws import law_of
from dtwin.kinds.rotation._simulate import TRUTHS, simulate_rotation
from dtwin.report.checking import check_source
from dtwin.schema import Finding, Floats, Run, RunMeta

KIND = kind_named("rotation")
SPEEDS = (1000.0, 6000.0, 3000.0, 8000.0, 2000.0, 5000.0, 1000.0)
SEEDS = range(20)


@dataclass(frozen=True)
class Story:
    """What changes with speed n in rpm or with time in h, in µm.

    ``once``: is added to what comes once per turn, amplitude and phase as a number. ``mean_um``: is added to all readings.
    ``late_ms``: how late the angle is. ``orders``: at a speed.
    """

    once: Callable[[float, float], complex] = lambda n, h: 0.0
    mean_um: Callable[[float, float], float] = lambda n, h: 0.0
    late_ms: float = 0.0
    orders: Callable[[float], float] = lambda n: 0.0


def measured(
    story: Story,
    seed: int,
    speeds: Sequence[float] = SPEEDS,
    sense: str = "radial",
    clock: bool = True,
    forward: bool = True,
    noise_um: float = 0.05,
) -> list[Run]:
    runs = []
    for k, rpm in enumerate(speeds):
        rng = np.random.default_rng([seed, k])
        angle, hour = turned(12.2, readings=120) * (1.0 if forward else -1.0), 0.2 * k
        # From run to run a mounting gives a little, more than turns of one run differ by.
        mounted = (
            8.0 * np.exp(1j * np.radians(30.0)) + story.once(rpm, hour) + noise_um / 5.0 * complex(*rng.normal(size=2))
        )
        order = story.orders(rpm)
        target = Target(
            once=(abs(mounted), float(np.degrees(np.angle(mounted)))),
            others={order: (0.1, 5.0)} if order else {},
            dips=((250.0, 6.0, 3.0),),
            noise_um=noise_um,
        )
        um = target.read(angle, 1000 * seed + k) + story.mean_um(rpm, hour) + 0.02 * rng.normal()
        condition: dict[str, float | str] = {"probe": "p", "sense": sense, "angle": "encoder", "speed_rpm": rpm}
        started = (datetime(2026, 3, 2, tzinfo=UTC) + timedelta(hours=hour)).isoformat() if clock else ""
        told = angle - 6e-3 * story.late_ms * rpm
        samples = {"t_s": np.abs(angle - angle[0]) / 6.0 / rpm, "angle_deg": told, "displacement_um": um}
        runs.append(Run(RunMeta(f"r{k}", "rotation", condition=condition, started=started), samples))
    return runs


@cache
def found_in(story: Story, seed: int) -> tuple[Finding, ...]:
    """Return what is found in the usual speeds of a story; several tests look at the same one."""
    return tuple(KIND.judge_campaign(measured(story, seed)))


def codes(findings: Sequence[Finding]) -> set[str]:
    return {f.code for f in findings} - {"rotation.order"}


def unbalance(n: float, h: float) -> complex:
    return 0.02 * (n / 1000.0) ** 2 * np.exp(1j)


def resonance(n: float, h: float) -> complex:
    """Return the high spot of a mass on springs, 0.05 of critical damping: it falls behind as the speed rises."""
    r = n / 9000.0
    size, lag = 0.5 * r**2 / np.hypot(1.0 - r**2, 0.1 * r), np.arctan2(0.1 * r, 1.0 - r**2)
    return complex(size * np.exp(1j * (2.0 + lag)))


@pytest.mark.parametrize(
    ("story", "named"),
    [
        (Story(), {"rotation.once_constant"}),
        (Story(once=unbalance), {"rotation.unbalance"}),
        (Story(late_ms=0.1), {"rotation.delay", "rotation.once_constant"}),
        (Story(once=unbalance, late_ms=-0.1), {"rotation.delay", "rotation.unbalance"}),
        (Story(once=lambda n, h: 0.4 * h), {"rotation.once_moves"}),
        (Story(mean_um=lambda n, h: 0.02 * (n / 1000.0) ** 2), {"rotation.once_constant", "rotation.centrifugal"}),
        (Story(mean_um=lambda n, h: 2.0 * h), {"rotation.once_constant", "rotation.drift"}),
    ],
)
def test_what_changes_with_the_speed_is_told_apart(story: Story, named: set[str]) -> None:
    found = [codes(found_in(story, seed)) for seed in SEEDS]
    assert sum(one == named for one in found) >= 19, found


def test_a_resonance_is_named_where_speeds_held_out_show_it() -> None:
    dense = (1000.0, 6000.0, 3000.0, 8000.0, 2000.0, 7000.0, 5000.0, 7500.0, 1000.0)
    found = [KIND.judge_campaign(measured(Story(once=resonance), seed, dense)) for seed in SEEDS]
    named = [f for one in found for f in one if f.code == "rotation.resonance"]
    assert len(named) >= 19
    assert all(abs(float(np.asarray(f.numbers["critical_rpm"])) - 9000.0) < 300.0 for f in named)
    # A spindle that turns backwards has its high spot on the other side.
    back = Story(once=lambda n, h: resonance(n, h).conjugate())
    told = [f for f in KIND.judge_campaign(measured(back, 0, dense, forward=False)) if f.code == "rotation.resonance"]
    assert [abs(float(np.asarray(f.numbers["critical_rpm"])) - 9000.0) < 300.0 for f in told] == [True]
    # With fewer it is said that one looks so.
    for seed in SEEDS:
        told = " ".join(f.message for f in KIND.judge_campaign(measured(Story(once=resonance), seed)))
        assert "resonance" in told


def test_the_delay_is_that_of_the_angle() -> None:
    for seed in range(10):
        (told,) = (f for f in found_in(Story(late_ms=0.1), seed) if f.code == "rotation.delay")
        assert told.numbers["delay_ms"] == pytest.approx(0.1, abs=0.005)


@pytest.mark.parametrize("clock", [True, False])
def test_speed_and_time_that_rise_together_are_not_told_apart(clock: bool) -> None:
    rising = (1000.0, 1400.0, 1700.0, 2000.0, 2200.0, 2400.0)
    for seed in range(10):
        for story in (
            Story(mean_um=lambda n, h: 2.0 * (n / 1000.0) ** 2),
            Story(mean_um=lambda n, h, s=seed: 2.0 * h + 0.05 * np.sin(n + s)),  # type: ignore[misc]
        ):
            (told,) = (
                f for f in KIND.judge_campaign(measured(story, seed, rising, clock=clock)) if "mean" in f.message
            )
            assert told.code == "rotation.mean_ambiguous"
            assert "measure the lowest speed again at the end" in told.message


def test_three_speeds_tell_no_law_and_a_fourth_is_asked_for() -> None:
    for seed in range(10):
        told = KIND.judge_campaign(measured(Story(once=unbalance), seed, (1000.0, 4000.0, 8000.0)))
        assert codes(told) == {"rotation.few_speeds"}
        assert "cannot be told with these speeds: measure 6320 rpm" in told[0].message


def test_speeds_that_lie_near_each_other_tell_of_no_unbalance_that_it_is_not_there() -> None:
    near = (5000.0, 5200.0, 5400.0, 5600.0, 5800.0, 5000.0)
    for seed in range(10):
        assert codes(KIND.judge_campaign(measured(Story(), seed, near))) <= {"rotation.few_speeds"}


def test_an_axial_fundamental_is_not_called_unbalance() -> None:
    told = KIND.judge_campaign(measured(Story(once=unbalance), 0, sense="axial"))
    assert codes(told) == {"rotation.once_moves"}


@pytest.mark.parametrize(
    ("story", "code"),
    [
        (Story(orders=lambda n: 3.57), "rotation.order"),
        (Story(orders=lambda n: 230.0 / (n / 60.0)), "rotation.frequency"),
        (Story(), None),
    ],
)
def test_an_order_of_the_axis_and_a_frequency_of_its_own(story: Story, code: str | None) -> None:
    right = 0
    for seed in SEEDS:
        found = found_in(story, seed)
        told = {f.code for f in found} & {"rotation.order", "rotation.frequency"}
        right += told == ({code} if code else set())
    assert right >= 19


def runout(um: Callable[[Floats, Floats], Floats], seed: int, repeats: int = 3, noise_um: float = 0.2) -> Run:
    speeds = np.tile((1000.0, 2000.0, 3000.0, 4000.0, 5000.0, 6000.0), repeats)
    rows = np.arange(speeds.size, dtype=float)
    read = 6.0 + um(speeds, rows) + np.random.default_rng(seed).normal(0.0, noise_um, speeds.size)
    condition: dict[str, float | str] = {"probe": "p", "sense": "", "form": "run-out over speed"}
    return Run(RunMeta("t", "rotation", condition=condition), {"t_s": rows, "speed_rpm": speeds, "runout_um": read})


@pytest.mark.parametrize(
    ("um", "allowed"),
    [
        (lambda n, k: 0.0 * n, {"rotation.runout_constant"}),
        (lambda n, k: 0.1 * (n / 1000.0) ** 2, {"rotation.runout_speed"}),
        (lambda n, k: 0.15 * k, {"rotation.runout_time"}),
        (lambda n, k: 4.0 * (n == 4000.0), {"rotation.runout_peak"}),
    ],
)
def test_a_table_of_run_outs_tells_what_repeats_allow(
    um: Callable[[Floats, Floats], Floats], allowed: set[str]
) -> None:
    right = sum({f.code for f in KIND.judge_campaign([runout(um, seed)])} == allowed for seed in SEEDS)
    assert right >= 19


def test_a_warm_up_at_one_speed_is_told() -> None:
    run = runout(lambda n, k: 0.15 * k, 0)
    run = replace(run, samples={**run.samples, "speed_rpm": np.full(run.n_samples, 8000.0)})
    assert "rotation.runout_time" in {f.code for f in KIND.judge_campaign([run])}
    assert column_of("minutes").factor == 60.0


def test_a_table_of_run_outs_never_names_its_cause() -> None:
    (told,) = KIND.judge_campaign([runout(lambda n, k: 0.1 * (n / 1000.0) ** 2, 0)])
    assert "neither phase nor mean" in told.message
    (once,) = KIND.judge_campaign([runout(lambda n, k: 0.0 * n, 0, repeats=1)])
    assert once.code == "rotation.runout_unknown"


@pytest.mark.parametrize(
    ("truth", "named", "never"),
    [
        ("unbalance", "unbalance", "resonance"),
        ("sound", "once_constant", "unbalance"),
        ("resonance", "resonance", "centrifugal"),
        ("balls", "order", "unbalance"),
        ("warming", "drift", "centrifugal"),
    ],
)
def test_the_virtual_rotor_is_told_by_its_mechanism(tmp_path: Path, truth: str, named: str, never: str) -> None:
    simulate_rotation(tmp_path / "rotor", lambda *a: None, truth=truth, seed=5, quick=True)
    found = {f["code"].removeprefix("rotation.") for f in check_source(tmp_path / "rotor")["findings"]}
    assert named in found
    assert never not in found


def test_the_virtual_rotor_moves_as_a_mass_on_springs_does(tmp_path: Path) -> None:
    p = TRUTHS["unbalance"]
    simulate_rotation(tmp_path / "rotor", lambda *a: None, truth="unbalance", seed=2, quick=True)
    runs = {run["run"]: run["rotation"] for run in check_source(tmp_path / "rotor")["runs"]}
    for probe, stiffer, at in (("radial_x", 1.0, 0.0), ("radial_y", 1.0 + 1.0 / 12.0, 90.0)):
        for speed, name in ((600.0, "1-600rpm"), (6000.0, "4-6000rpm"), (4800.0, "2-4800rpm")):
            r = speed / p.critical_rpm / stiffer
            # The target off the axis by itself, and by what the unbalance bends the springs: of one phase far below resonance.
            target = p.target_um * np.exp(-1j * np.radians(p.target_deg - at))
            bent = p.unbalance_um * r**2 / (1.0 - r**2 + 2j * p.damping * r) * np.exp(1j * np.radians(at))
            found = runs[f"{name}-{probe}"]
            assert found["once_um"]["value"] == pytest.approx(abs(target + bent), abs=0.06)


def test_a_rotor_that_there_is_not_and_a_folder_that_is_taken_are_refused(tmp_path: Path) -> None:
    assert TRUTHS
    with pytest.raises(InputError) as refused:
        simulate_rotation(tmp_path, lambda *a: None, truth="x")
    assert refused.value.code == "simulate.truth"
    (tmp_path / "campaign.toml").touch()
    with pytest.raises(InputError) as refused:
        simulate_rotation(tmp_path, lambda *a: None)
    assert refused.value.code == "simulate.exists"


def test_a_table_of_run_outs_alone_is_checked(tmp_path: Path) -> None:
    path = tmp_path / "spindle.csv"
    rows = [
        f"{n},{0.004 + n / 1e6 + 2e-4 * ((n // 1000 + r) % 2):.5f},{0.003 + 1e-4 * r:.5f}"
        for r in range(3)
        for n in (1000, 2000, 3000)
    ]
    path.write_text("\n".join(["speed [rpm],radial run-out [mm],axial TIR [mm]", *rows]), encoding="utf-8")
    done = CliRunner().invoke(app, ["check", str(path)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "radial_run-out, 1000 rpm" in done.output
    assert "spindle-axial_tir: 3 speeds" in done.output


@pytest.mark.parametrize("shape", [lambda k: 0.17 * k, lambda k: 3.0 * (1.0 - np.exp(-k / 6.0))])
def test_time_beside_speed_is_told_in_a_table_of_run_outs(shape: Callable[[Floats], Floats]) -> None:
    right = 0
    for seed in SEEDS:
        told = KIND.judge_campaign([runout(lambda n, k: 0.1 * (n / 1000.0) ** 2 + shape(k), seed)])
        right += {f.code for f in told} == {"rotation.runout_time", "rotation.runout_speed"}
    assert right >= 19


@pytest.mark.parametrize("grows", [0.0, 0.1])
def test_a_spoilt_run_out_is_left_out_and_told(grows: float) -> None:
    right = 0
    for seed in SEEDS:
        run = runout(lambda n, k: grows * (n / 1000.0) ** 2 + 40.0 * (k == 7), seed)
        told = KIND.judge_run(run)
        law = {f.code for f in KIND.judge_campaign([run])}
        right += [f.code for f in told] == ["rotation.spoilt"] and law == {
            "rotation.runout_speed" if grows else "rotation.runout_constant"
        }
    assert right >= 19
    assert not any(KIND.judge_run(runout(lambda n, k: 0.15 * k, seed)) for seed in SEEDS)


def test_a_peak_of_many_speeds_is_told_without_repeats() -> None:
    speeds = np.array([1000, 2000, 3000, 4000, 5000, 5500, 6000, 6500, 7000, 8000, 9000, 10000.0])
    r = speeds / 6000.0
    peak = 2.0 + 0.5 * r**2 / np.hypot(1.0 - r**2, 0.1 * r)
    found = {"peak": 0, "nothing": 0}
    for seed in SEEDS:
        noise = np.random.default_rng(seed).normal(0.0, 0.1, speeds.size)
        for name, um in (("peak", peak + noise), ("nothing", 3.0 + noise)):
            samples = {"t_s": np.arange(12.0), "speed_rpm": speeds, "runout_um": um}
            run = Run(RunMeta("t", "rotation", condition={"probe": "p", "form": "run-out over speed"}), samples)
            found[name] += any(f.code == "rotation.runout_peak" for f in KIND.judge_campaign([run]))
    assert found["peak"] >= 19
    assert found["nothing"] <= 1


def test_a_display_of_whole_micrometres_shows_neither_delay_nor_resonance() -> None:
    runs = []
    for k, rpm in enumerate(SPEEDS):
        angle = turned(30.0)
        at = 10.0 * np.exp(1j * np.radians(30.0)) + 6.0 * (rpm / 1e4) ** 2 * np.exp(1j * np.radians(120.0))
        um = np.round(Target(once=(abs(at), float(np.degrees(np.angle(at)))), noise_um=0.15).read(angle, k))
        condition: dict[str, float | str] = {"probe": "p", "sense": "radial", "angle": "encoder", "speed_rpm": rpm}
        samples = {"t_s": np.abs(angle - angle[0]) / 6.0 / rpm, "angle_deg": angle, "displacement_um": um}
        runs.append(Run(RunMeta(f"r{k}", "rotation", condition=condition), samples))
    assert codes(KIND.judge_campaign(runs)) == {"rotation.unbalance"}


def runs_of(target: Callable[[int, float], Target], late_ms: float = 0.0, seed: int = 0) -> list[Run]:
    """Return a run at each usual speed; ``target`` of the number of the run and its speed."""
    runs = []
    for k, rpm in enumerate(SPEEDS):
        angle = turned(30.0)
        samples = {"t_s": (angle - angle[0]) / 6.0 / rpm, "angle_deg": angle - 6e-3 * late_ms * rpm}
        samples["displacement_um"] = target(k, rpm).read(angle, 100 * seed + k)
        condition: dict[str, float | str] = {"probe": "p", "sense": "radial", "angle": "encoder", "speed_rpm": rpm}
        runs.append(Run(RunMeta(f"r{k}", "rotation", condition=condition), samples))
    return runs


def test_a_force_that_lags_in_the_structure_is_no_delay_of_the_angle() -> None:
    def lags(k: int, rpm: float) -> Target:
        lag = float(np.degrees(np.arctan2(0.6 * rpm / 1e4, 1.0 - (rpm / 1e4) ** 2)))
        return Target((5.0 + 0.002 * (k % 2), 30.0), {2: (0.1, 10.0), 3: (0.1, 80.0), 8: (0.5, lag)})

    for late_ms, named in ((0.0, set()), (0.1, {"rotation.delay"})):
        told = KIND.judge_campaign(runs_of(lags, late_ms))
        assert codes(told) == {"rotation.odd_wave", "rotation.once_constant", *named}
        assert all(f.numbers["delay_ms"] == pytest.approx(0.1, abs=0.02) for f in told if f.code == "rotation.delay")
        assert [f.numbers["per_turn_1"] for f in told if f.code == "rotation.odd_wave"] == [8.0]


def test_a_wave_that_grows_with_the_speed_is_no_form_and_a_small_form_turns_by_no_chance() -> None:
    def grows(k: int, rpm: float) -> Target:
        return Target((5.0 + 0.002 * (k % 2), 30.0), {2: (0.1, 10.0), 8: (0.05 + rpm / 2e4, 20.0)})

    (told,) = (f for f in KIND.judge_campaign(runs_of(grows)) if f.code == "rotation.wave_changes")
    assert (told.numbers["per_turn_1"], told.numbers["most_um"]) == (8.0, pytest.approx(0.45, abs=0.01))
    small = Target(lobes={2: (0.02, 10.0), 3: (0.02, 80.0)})
    for seed in range(6):
        assert codes(KIND.judge_campaign(runs_of(lambda k, rpm: small, seed=seed))) == {"rotation.once_constant"}


def test_what_no_mounting_holds_is_no_unbalance() -> None:
    found = KIND.judge_campaign(measured(Story(once=lambda n, h: 1e-4 * (n / 1000.0) ** 2), 3, noise_um=1e-4))
    assert "rotation.once_constant" in codes(found)


def test_mains_are_told_with_their_frequency_and_where_they_count_as_synchronous() -> None:
    found = KIND.judge_campaign(measured(Story(orders=lambda n: 3000.0 / n), 1, (1000.0, 2100.0, 3300.0, 4700.0)))
    (told,) = (f for f in found if f.code == "rotation.frequency")
    assert told.numbers["frequency_hz"] == pytest.approx(50.0, abs=0.3)
    assert "at 1000 rpm it comes a whole number of times a turn" in told.message
    # At the highest speed it is a whole order, and no line.
    high = KIND.judge_campaign(measured(Story(orders=lambda n: 3000.0 / n), 1, (700.0, 1100.0, 1900.0, 3000.0)))
    assert [f.numbers["frequency_hz"] for f in high if f.code == "rotation.frequency"] == [pytest.approx(50.0, abs=0.3)]


def test_a_mean_that_moves_with_speed_and_time_is_told_by_both() -> None:
    right = 0
    for seed in SEEDS:
        found = KIND.judge_campaign(measured(Story(mean_um=lambda n, h: 0.05 * (n / 1000.0) ** 2 + 1.5 * h), seed))
        told = [f for f in found if f.code.startswith(("rotation.mean", "rotation.drift", "rotation.centri"))]
        right += [f.code for f in told] == ["rotation.mean_both"] and "square of the speed and the time" in told[
            0
        ].message
    assert right >= 19


def test_drift_and_growth_are_told_by_both_where_one_of_them_alone_predicts_well() -> None:
    found = {"square+time": 0, "time": 0}
    for seed in range(40):
        rng = np.random.default_rng(seed)
        rpm = rng.permutation(np.repeat(np.linspace(1000.0, 6000.0, 6), 2))
        hours = 0.06 * np.arange(rpm.size)
        for named, growth in (("square+time", 3.0), ("time", 0.0)):
            mean = 4.0 * hours - growth * (rpm / 6000.0) ** 2 + rng.normal(0.0, 0.03, rpm.size)
            law = law_of(mean[:, None], rpm, hours, 1e-6, pairs=True)
            found[named] += law is not None and law.name == named
    assert min(found.values()) >= 38, found


def test_a_target_that_moves_with_time_is_not_asked_for_what_was_measured() -> None:
    (told,) = KIND.judge_campaign(measured(Story(once=lambda n, h: 1.5 * h), 2))
    assert told.code == "rotation.once_moves"
    assert "no unbalance does so" in told.message
    assert "measure" not in told.message


def test_repeats_that_follow_each_other_at_once_tell_nothing_of_the_whole_time() -> None:
    speeds = np.repeat((1000.0, 2000.0, 3000.0, 4000.0), 5)
    settles = np.tile((0.0, 0.5, 0.8, 1.0, 1.1), 4)
    samples = {"t_s": np.arange(20.0), "speed_rpm": speeds, "runout_um": 3.0 + settles}
    run = Run(RunMeta("t", "rotation", condition={"probe": "p", "form": "run-out over speed"}), samples)
    assert {f.code for f in KIND.judge_campaign([run])} == {"rotation.runout_constant"}
