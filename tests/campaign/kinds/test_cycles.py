"""What differs from cycle to cycle of a positioning test is told apart; each case on forty draws, and nothing where nothing moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dtwin.positioning._cycles import _MOST_JUMPS, _jumps, _products_of_steps, moving_zero, zero_of_each_cycle
from dtwin.positioning._moving_reversal import moving_reversal
from dtwin.positioning._spoilt import spoilt_readings
from dtwin.positioning.check import judge_positioning_campaign
from dtwin.positioning.matrix import LinearTest
from dtwin.positioning.position_table import read_position_runs
from dtwin.positioning.still import still
from dtwin.schema import Campaign, Finding, Run


def made(zero: Any, seed: int, noise_um: float = 0.5, cycles: int = 5) -> LinearTest:
    """Return a test; ``zero(x, time)`` is what moves, in µm, x in mm and time in cycles."""
    rng = np.random.default_rng(seed)
    x = np.linspace(0.0, 300.0, 11)
    fixed = 5.0 * np.cos(x / 40.0)[:, None] + np.zeros((1, cycles))
    # A reading after the other, forward and back again; time in cycles.
    time = np.arange(float(cycles))[None, :] + (np.arange(22.0)[:, None] + 0.5) / 22.0
    forward, reverse = time[:11], time[11:][::-1]
    ways = [
        fixed + play + zero(x[:, None], when) + rng.normal(0.0, noise_um, (11, cycles))
        for play, when in ((0.0, forward), (-6.0, reverse))
    ]
    return LinearTest(x, ways[0], ways[1], 0, None)


def moving(test: LinearTest) -> Finding | None:
    found = moving_zero(test)
    return None if found is None else found.finding


@pytest.mark.parametrize(
    ("zero", "codes"),
    [
        (lambda x, c: 0.0 * x * c, {None}),
        (lambda x, c: 0.0 * x - 1.5 * c, {"linear.slip"}),
        (lambda x, c: 0.0 * x - 1.5 * np.floor(c), {"linear.slip"}),
        (lambda x, c: 0.0 * x + 6.0 * (c >= 3.2), {"linear.jump"}),
        (lambda x, c: 0.0 * x + 3.0 * (c >= 1) + 4.0 * (c >= 3), {"linear.jumps"}),
        (lambda x, c: (3.0 + x / 40.0) * (1.0 - np.exp(-c / 1.3)), {"linear.warming"}),
        (lambda x, c: (90.0 - x) * (1.0 - np.exp(-c / 1.3)), {"linear.settling"}),
        # 20 K of steel: nobody knows without a thermometer.
        (lambda x, c: (20.0 - 0.23 * x) * (1.0 - np.exp(-c / 2.5)), {"linear.settling"}),
    ],
)
def test_what_moves_from_cycle_to_cycle_is_told_apart(zero: Any, codes: set[str | None]) -> None:
    found = [moving(made(zero, seed)) for seed in range(20)]
    right = sum((None if f is None else f.code) in codes for f in found)
    assert right >= 19
    assert all(spoilt_readings(made(zero, seed)) == [] for seed in range(20))
    # A zero that moves is no reversal error that does.
    assert all(moving_reversal(made(zero, seed)) is None for seed in range(20))


def test_warming_is_told_where_the_zero_wanders_a_little_beside_it() -> None:
    def zero(x: Any, c: Any) -> Any:
        return (3.0 + x / 40.0) * (1.0 - np.exp(-c / 1.3)) + 0.3 * np.sin(3.0 * c)

    found = [moving(made(zero, seed, 0.05)) for seed in range(10)]
    assert [f and f.code for f in found] == ["linear.warming"] * 10


@pytest.mark.parametrize("um", [0.05, 0.25])
def test_a_zero_that_wanders_as_air_and_heat_make_it_is_no_lost_step(um: float) -> None:
    def zero(x: Any, c: Any) -> Any:
        return 0.0 * x + um * (1.0 * (c >= 1) - 1.6 * (c >= 2) + 1.2 * (c >= 4))

    found = [f for seed in range(10) if (f := moving(made(zero, seed, um / 5.0))) is not None]
    assert len(found) >= 9
    assert {(f.code, f.severity) for f in found} == {("linear.zero_wanders", "info")}
    assert not any("lost" in f.message or "slips" in f.message for f in found)
    # The same of micrometres, and slip that adds up to one, are none of that.
    hard = [
        moving(made(lambda x, c: 30.0 * zero(x, c) * 0.25 / um, 1)),
        moving(made(lambda x, c: 0.0 * x + 0.4 * c, 1, 0.1)),
    ]
    assert [f.code for f in hard if f is not None] == ["linear.jumps", "linear.slip"]


def test_a_zero_that_is_set_in_each_cycle_is_a_datum() -> None:
    test = made(lambda x, c: 0.0 * x - 12.5 * np.floor(c), 0)
    assert zero_of_each_cycle(test) is None
    zeroed = replace(
        test, forward_um=test.forward_um - test.forward_um[0], reverse_um=test.reverse_um - test.forward_um[0]
    )
    found = zero_of_each_cycle(zeroed)
    assert found is not None
    assert "forward at 0 mm" in found.message
    # A display that shows whole steps reads 0 at many targets.
    coarse = replace(test, forward_um=np.zeros_like(test.forward_um))
    assert zero_of_each_cycle(coarse) is None


@pytest.mark.parametrize("way", ["forward", "reverse"])
@pytest.mark.parametrize(
    ("zero", "codes"),
    [
        (lambda x, c: 0.0 * x * c, {None}),
        (lambda x, c: 0.0 * x - 1.5 * c, {"linear.slip"}),
        (lambda x, c: 0.0 * x + 6.0 * (c >= 3.2), {"linear.jump", "linear.jumps"}),
        (lambda x, c: (3.0 + x / 40.0) * (1.0 - np.exp(-c / 1.3)), {"linear.warming"}),
    ],
)
def test_the_same_is_told_of_runs_in_one_direction(way: str, zero: Any, codes: set[str | None]) -> None:
    right = 0
    for seed in range(40):
        both = made(zero, seed)
        only = both.forward_um if way == "forward" else both.reverse_um
        found = moving(replace(both, forward_um=only, reverse_um=only, ways=(way, way), first=way))
        right += (None if found is None else found.code) in codes
    assert right >= 38


def jumping(seed: int, first: str, noise_um: float = 0.5) -> tuple[LinearTest, list[float]]:
    """Return a test of five cycles in which all readings move two to four times, and when; at any reading, up or down."""
    rng = np.random.default_rng([seed, 7])
    x = np.linspace(0.0, 300.0, 11)
    share = (np.arange(11.0) + 0.5) / 22.0
    begun, back = (share, 1.0 - share) if first == "forward" else (0.5 + share, 0.5 - share)
    many = int(rng.integers(2, 5))
    # At least a third of a cycle lies between two.
    at = np.sort(rng.choice(np.arange(0.5, 4.6, 0.35), many, replace=False)) + rng.uniform(-0.02, 0.02, many)
    sizes = rng.choice([-1.0, 1.0], many) * rng.uniform(5.0, 12.0, many)
    ways = []
    for play, when in ((0.0, begun), (-6.0, back)):
        time = when[:, None] + np.arange(5.0)
        moved = sum(size * (time >= when_it_jumps) for size, when_it_jumps in zip(sizes, at, strict=True))
        ways.append(5.0 * np.cos(x / 40.0)[:, None] + play + moved + rng.normal(0.0, noise_um, (11, 5)))
    return LinearTest(x, ways[0], ways[1], 0, None, first=first), list(at)


@pytest.mark.parametrize("first", ["forward", "reverse"])
@pytest.mark.parametrize("clock", [True, False])
def test_several_jumps_at_any_reading_are_told_as_jumps(first: str, clock: bool) -> None:
    right = counted = 0
    for seed in range(20):
        test, at = jumping(seed, first)
        found = moving(test if clock else replace(test, first=""))
        right += found is not None and found.code == "linear.jumps"
        counted += found is not None and found.message.count(" mm") == len(at)
    assert right >= 19
    assert counted >= 16


@pytest.mark.parametrize("shape", [(2, 4), (3, 5), (5, 5), (21, 4)])
def test_few_readings_that_only_scatter_are_not_described(shape: tuple[int, int]) -> None:
    x = np.linspace(0.0, 80.0, shape[0])
    for seed in range(20):
        up, down = np.random.default_rng([seed, *shape]).normal(0.0, 1.0, (2, *shape))
        assert moving(LinearTest(x, up, down, 0, None, first="")) is None
    still = np.zeros(shape)
    assert moving(LinearTest(x, still, still, 0, None)) is None


def test_a_test_of_many_cycles_ends() -> None:
    """It took hours: each of 150 cycles was tried as a jump, beside each of the others."""
    rng = np.random.default_rng(0)
    shape = (2, 3, _MOST_JUMPS + 20)
    within, told = np.arange(np.prod(shape)).reshape(shape[::-1]).T / 6.0, np.ones(shape, dtype=bool)
    assert len(list(_jumps(within, rng.normal(size=shape), told))) == _MOST_JUMPS


def test_the_search_for_jumps_makes_no_column_of_readings() -> None:
    """Four hundred columns of a million readings took minutes and gigabytes; what they multiply to is the same."""
    rng = np.random.default_rng(1)
    shape = (2, 40, 5)
    within = np.stack([(np.arange(40) + 0.5) / 80, 1.0 - (np.arange(40) + 0.5) / 80])[:, :, None] + np.arange(5.0)
    told, moved = rng.random(shape) > 0.1, rng.normal(size=shape)
    times = np.sort(within.ravel())[1::7]
    steps = (within[..., None] >= times).astype(float)
    columns = (steps - steps.mean(axis=2, keepdims=True))[told]
    products, along = _products_of_steps(times, within, moved, told)
    assert products == pytest.approx(columns.T @ columns, abs=1e-9)
    assert along == pytest.approx(columns.T @ moved[told], abs=1e-9)


def test_two_readings_that_are_off_are_no_jump_there_and_back() -> None:
    for seed in range(20):
        test = made(lambda x, c: 0.0 * x * c, seed)
        test.forward_um[4:6, 2] += 30.0
        assert moving(test) is None


@pytest.mark.parametrize("noise_um", [0.05, 0.5, 5.0])
@pytest.mark.parametrize("first", ["forward", ""])
def test_nothing_is_told_where_nothing_moves(noise_um: float, first: str) -> None:
    tests = [replace(made(lambda x, c: 0.0 * x * c, seed, noise_um), first=first) for seed in range(100, 130)]
    assert [found for test in tests if (found := moving(test)) is not None] == []


@pytest.mark.parametrize("cycles", [2, 3, 5])
def test_readings_that_are_spoilt_are_named_and_no_others(cycles: int) -> None:
    for seed in range(20):
        test = made(lambda x, c: 0.0 * x * c, seed, cycles=cycles)
        assert spoilt_readings(test) == []
        test.forward_um[0, 0] += 110.0
        test.forward_um[1, 0] += 40.0
        assert [(s.target, s.cycle, s.way) for s in spoilt_readings(test)] == [(0, 0, "forward"), (1, 0, "forward")]


@pytest.mark.parametrize(
    "zero", [lambda x, c: 0.0 * x - 2.0 * c, lambda x, c: (3.0 + x / 40.0) * (1.0 - np.exp(-c / 1.3))]
)
def test_a_spoilt_reading_is_named_where_cycles_move_as_wholes(zero: Any) -> None:
    found = 0
    for seed in range(20):
        test = made(zero, seed)
        test.reverse_um[6, 2] += 12.0
        found += [(s.target, s.cycle, s.way) for s in spoilt_readings(test)] == [(6, 2, "reverse")]
    assert found >= 17


def test_readings_that_are_rounded_are_not_called_spoilt_but_a_spoilt_one_is() -> None:
    for seed in range(20):
        test = made(lambda x, c: 0.0 * x * c, seed, noise_um=0.3)
        rounded = replace(test, forward_um=np.round(test.forward_um), reverse_um=np.round(test.reverse_um))
        assert spoilt_readings(rounded) == []
        rounded.forward_um[3, 1] += 30.0
        assert [(s.target, s.cycle, s.way) for s in spoilt_readings(rounded)] == [(3, 1, "forward")]


def test_a_spoilt_reading_of_a_test_in_one_direction_is_told_once_and_where() -> None:
    up = made(lambda x, c: 0.0 * x * c, 1).forward_um
    up[3, 1] += 30.0
    test = LinearTest(np.linspace(0.0, 300.0, 11), up, up, 0, None, ways=("reverse", "reverse"))
    assert [(s.target, s.cycle, s.way) for s in spoilt_readings(test)] == [(3, 1, "reverse")]


def table_of(test: LinearTest, path: Path) -> list[Run]:
    """Return the runs of a table without a clock."""
    lines = ["target_mm,cycle,direction,deviation [um]"]
    for way, readings in (("forward", test.forward_um), ("reverse", test.reverse_um)):
        lines += [f"{test.position_mm[i]:g},{c + 1},{way},{um:.4f}" for (i, c), um in np.ndenumerate(readings)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    runs, _ = read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "X"}})
    return runs


@pytest.mark.parametrize(
    "zero",
    [
        lambda x, c: 0.0 * x - 12.5 * c,
        lambda x, c: 0.0 * x + 30.0 * (c >= 1) - 40.0 * (c >= 3),
        lambda x, c: (0.0 * x + 90.0) * (1.0 - np.exp(-c / 1.3)),
    ],
)
def test_a_twin_of_a_table_without_a_clock_sees_what_stands_still(zero: Any, tmp_path: Path) -> None:
    test = made(zero, 3)
    found = still(table_of(test, tmp_path / "a.csv"))
    ways = [np.array([r.samples["error_um"][r.samples["direction"] == way] for r in found]) for way in test.ways]
    forward, reverse = ways[0], ways[1][:, ::-1]
    # Half a slip of 12.5 µm would make 12 µm of the play of 6 µm; and they scatter as without any slip.
    assert np.mean(reverse - forward) == pytest.approx(-6.0, abs=0.6)
    assert np.std(forward - forward.mean(axis=0)) < 0.8
    assert np.ptp(np.mean(forward, axis=0)) == pytest.approx(10.0, abs=2.0)


def test_runs_with_a_clock_keep_what_moves_with_time(tmp_path: Path) -> None:
    runs = table_of(made(lambda x, c: 0.0 * x - 12.5 * c, 3), tmp_path / "a.csv")
    timed = [replace(run, findings=()) for run in runs]
    assert all(a is b for a, b in zip(still(timed), timed, strict=True))
    quiet = table_of(made(lambda x, c: 0.0 * x * c, 3), tmp_path / "b.csv")
    assert all(a is b for a, b in zip(still(quiet), quiet, strict=True))


@pytest.mark.parametrize(
    ("cycles", "more", "said"),
    [
        (3, lambda c: 4.0 * c, "grows from 8 µm in cycle 1 to 16 µm in cycle 3"),
        (5, lambda c: 6.0 * ((c > 1.0) & (c < 3.0)), "lies between 5.4 and 12 µm"),
    ],
    ids=["grows", "comes and goes"],
)
def test_a_reversal_error_that_moves_is_told_and_a_twin_sees_its_mean(
    cycles: int, more: Any, said: str, tmp_path: Path
) -> None:
    test = made(lambda x, c: 0.0 * x * c, 2, cycles=cycles)
    when = np.arange(float(cycles)) + np.array([0.25, 0.75])[:, None]
    test = replace(
        test, forward_um=test.forward_um + more(when[0]) / 2.0, reverse_um=test.reverse_um - more(when[1]) / 2.0
    )
    runs = table_of(test, tmp_path / "a.csv")
    (found,) = judge_positioning_campaign(runs)
    assert found.code == "linear.reversal_moves"
    assert said in found.message
    ways = [np.array([r.samples["error_um"][r.samples["direction"] == way] for r in still(runs)]) for way in test.ways]
    reversal = ways[0] - ways[1][:, ::-1]
    assert np.ptp(reversal.mean(axis=1)) < 0.6
    assert np.mean(reversal) == pytest.approx(6.0 + float(np.mean(more(when))), abs=0.3)


@pytest.mark.parametrize(
    ("size", "said", "not_said"), [(0.2, "Ordinary air", "coupling"), (4.0, "coupling", "Ordinary air")]
)
def test_a_drift_is_called_slip_only_where_it_is_more_than_air_and_heat(
    size: float, said: str, not_said: str, tmp_path: Path
) -> None:
    test = made(lambda x, c: 0.0 * x + size * np.sin(1.3 * c**2), 2, size / 20.0)
    (found,) = [f for f in judge_positioning_campaign(table_of(test, tmp_path / "a.csv")) if f.code == "linear.drift"]
    assert said in found.message
    assert not_said not in found.message
