"""Ball arrays that went wrong: what is left out, and what heat does is not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.kinds.volumetric._identify import Balls
from dtwin.kinds.volumetric._session import _require_poses, _temperatures, hours_of
from dtwin.kinds.volumetric._spoilt import spoilt_in
from dtwin.schema import Campaign, Finding, Floats, Run, RunMeta, SignalGroup

KIND = kind_named("volumetric")
GRID = np.array([[110.0 * i, 110.0 * j, 0.0] for i in range(4) for j in range(3)])
POSES = {
    k: GRID + np.array(at)
    for k, at in enumerate([(100, 100, 500), (900, 100, 500), (400, 700, 1100), (300, 300, 800)], 1)
}
PLACES = {**POSES, 0: np.array([[60.0, 80.0, 480.0], [1400.0, 90.0, 480.0], [700.0, 1150.0, 480.0]])}
Spoil = Callable[[int, Balls, np.random.Generator], Balls]


def measured(spoil: Spoil = lambda n, balls, rng: balls, heat: float = 1.0, scale: float = 1.0) -> list[Balls]:
    """Return 40 cycles, three hours apart, of a machine whose Y axis grows in bursts, as a spindle that goes on and off makes it."""
    rng = np.random.default_rng(3)
    place = np.vstack(list(PLACES.values()))
    pose = np.concatenate([np.full(len(v), k) for k, v in PLACES.items()])
    ball = np.concatenate([np.arange(1, len(v) + 1) for v in PLACES.values()])
    array, warm, out = rng.normal(0.0, 15.0, place.shape), 0.0, []
    for n in range(40):
        warm += 0.85 * (12.0 * heat * (np.sin(2.0 * np.pi * n / 17.0) > 0.0) - warm)
        error = array + rng.normal(0.0, 1.0, place.shape)
        error[:, 1] += 0.011 * (place[:, 1] - 50.0) * warm
        out.append(spoil(n, Balls(place, scale * error, pose, ball), rng))
    return out


def runs_of(cycles: Sequence[Balls]) -> list[Run]:
    runs = []
    for n, cycle in enumerate(cycles):
        samples = {"t_s": np.arange(len(cycle.pose), dtype=float), "pose_1": cycle.pose.astype(float)}
        samples |= {"ball_1": cycle.ball.astype(float)}
        samples |= {f"{a}_mm": cycle.position_mm[:, i] for i, a in enumerate("xyz")}
        samples |= {f"error_{a}_um": cycle.error_um[:, i] for i, a in enumerate("xyz")}
        runs.append(Run(RunMeta(f"c{n:03d}", "volumetric", condition={"time_h": 3.0 * n}), samples))
    return runs


def told(cycles: Sequence[Balls]) -> list[Finding]:
    return KIND.judge_campaign(runs_of(cycles))


@pytest.mark.parametrize(
    ("column", "change", "codes"),
    [
        ("t_s", lambda v: v, []),
        ("t_s", lambda v: v * np.where(v > 20.0, 5.0, 1.0), []),  # the array was turned
        ("t_s", lambda v: v[::-1], [("clock.backwards", "error")]),
        ("t_s", lambda v: 0.0 * v, [("clock.backwards", "error")]),
        ("x_mm", lambda v: 0.0 * v + 400.0, [("balls.one_place", "warning")]),
        ("error_y_um", lambda v: 0.0 * v, [("balls.axis_still", "error")]),
    ],
)
def test_a_clock_that_runs_back_and_a_place_that_stands_still_are_told(
    column: str, change: Callable[[Floats], Floats], codes: list[tuple[str, str]]
) -> None:
    run = runs_of(measured())[0]
    found = KIND.judge_run(replace(run, samples=dict(run.samples) | {column: change(run.samples[column])}))
    assert [(f.code, f.severity) for f in found] == codes


def test_actual_places_in_place_of_errors_are_told() -> None:
    run = runs_of(measured())[0]
    at = run.samples["x_mm"] + 1e-3 * run.samples["error_x_um"]
    found = KIND.judge_run(replace(run, samples=dict(run.samples) | {"error_x_um": at}))
    assert [(f.code, f.severity) for f in found] == [("balls.positions", "error")]


@pytest.mark.parametrize(
    ("hour", "said"),
    [
        (lambda n: 3.0 * n, ""),
        (lambda n: 5.0, "c000, c001, c002, c003 … began at the same hour"),
        (None, "one an hour"),
    ],
)
def test_cycles_that_do_not_say_when_they_began_are_told(hour: Callable[[int], float] | None, said: str) -> None:
    runs = [
        replace(run, meta=replace(run.meta, condition={} if hour is None else {"time_h": hour(n)}))
        for n, run in enumerate(runs_of(measured()))
    ]
    found = [f.message for f in KIND.judge_campaign(runs) if f.code == "cycle.hours"]
    assert len(found) == bool(said)
    assert said in "".join(found)


def touch(n: int, balls: Balls, rng: np.random.Generator) -> Balls:
    error = balls.error_um.copy()
    error[30] += np.array([0.0, 200.0, 0.0]) * (n == 20)
    return replace(balls, error_um=error)


def exchanged(n: int, balls: Balls, rng: np.random.Generator) -> Balls:
    ball = balls.ball.copy()
    if n == 20:
        ball[[16, 17]] = ball[[17, 16]]
    return replace(balls, ball=ball)


def wild(n: int, balls: Balls, rng: np.random.Generator) -> Balls:
    return replace(balls, error_um=balls.error_um + (n == 20) * rng.normal(0.0, 60.0, balls.error_um.shape))


def crash(n: int, balls: Balls, rng: np.random.Generator) -> Balls:
    return replace(balls, error_um=balls.error_um + (n >= 20) * np.where(balls.pose == 2, 80.0, 0.0)[:, None])


@pytest.mark.parametrize("spoil", [lambda n, balls, rng: balls, crash])
def test_heat_that_comes_and_goes_and_a_step_that_stays_spoil_nothing(spoil: Spoil) -> None:
    assert told(measured(spoil)) == []


@pytest.mark.parametrize(
    ("spoil", "code", "named"),
    [
        (touch, "balls.spoilt", "c020 pose 3 ball 7 (19"),
        (exchanged, "balls.spoilt", "c020 pose 2 ball"),
        (wild, "cycle.spoilt", "c020:"),
    ],
)
def test_what_went_wrong_is_named_and_left_out(spoil: Spoil, code: str, named: str) -> None:
    cycles = measured(spoil)
    (finding,) = told(cycles)
    assert finding.code == code
    assert named in finding.message
    kept = spoilt_in(cycles).kept(cycles, 4)
    gone = {"balls.spoilt": {touch: 1, exchanged: 2}.get(spoil), "cycle.spoilt": len(cycles[20].pose)}[code]
    assert sum(len(c.pose) for c in cycles) - sum(len(c.pose) for _, c in kept) == gone


def test_a_broken_wire_is_no_temperature_and_a_short_gap_spoils_none() -> None:
    def run(**columns: Floats) -> Run:
        return Run(RunMeta("c", "volumetric"), {}, signals=(SignalGroup("thermocouples", 1.0, columns, 0.0),))

    steady = np.full(20, 21.0)
    gap = np.where(np.arange(20) < 3, np.nan, 21.0)
    found, dropped = _temperatures(
        [run(a_c=steady, b_c=gap, d_c=steady), run(a_c=steady, b_c=steady, d_c=steady + 800.0)]
    )
    assert (set(found), dropped) == ({"a_c", "b_c"}, ("d_c",))
    assert found["b_c"][1].tolist() == [21.0, 21.0]


def test_millimetres_under_heads_of_micrometres_are_an_error() -> None:
    cycle = measured(scale=1e-3)[0]
    samples = {"pose_1": cycle.pose.astype(float), "ball_1": cycle.ball.astype(float)}
    samples |= {f"error_{a}_um": cycle.error_um[:, i] for i, a in enumerate("xyz")}
    assert [f.code for f in KIND.judge_run(Run(RunMeta("c", "volumetric"), samples))] == ["balls.small"]


def test_cycles_without_a_stated_hour_are_ordered_by_their_begin() -> None:
    runs = [
        Run(RunMeta(name, "volumetric", started=f"2026-03-0{day}T08:00:00Z"), {}) for name, day in (("b", 1), ("a", 3))
    ]
    assert hours_of(runs) == {"b": 0.0, "a": 48.0}


@pytest.mark.parametrize(("scale", "said"), [(1.0, ""), (1e-3, "metres"), (1.3, "another zero")])
def test_places_beyond_the_stroke_are_an_error(scale: float, said: str) -> None:
    strokes = {"stroke_x_mm": [30.0, 1460.0], "stroke_y_mm": [50.0, 1200.0], "stroke_z_mm": [460.0, 1490.0]}
    place = scale * np.vstack(list(PLACES.values()))
    run = Run(RunMeta("c0", kind="volumetric"), {f"{a}_mm": place[:, i] for i, a in enumerate("xyz")})
    found = KIND.completed(run, Campaign("c", "m", "volumetric", machine_geometry=strokes)).findings
    assert [f.code for f in found] == ["balls.outside_stroke"] * bool(said)
    assert all(said in f.message for f in found)


@pytest.mark.parametrize(
    "told",
    [{"held_out_poses": v} for v in (["x"], "x", 3, [3.5], [True], [1e400])]
    + [{"pose_repeat_um": v} for v in (0, "x")],
    ids=str,
)
def test_poses_that_are_none_are_refused_before_the_lake_has_them(told: dict[str, object]) -> None:
    with pytest.raises(InputError) as refused:
        KIND.completed(
            Run(RunMeta("c0", kind="volumetric"), {}), Campaign("c", "m", "volumetric", machine_geometry=told)
        )
    assert (refused.value.code, refused.value.where) == (
        "volumetric.poses",
        f"campaign c machine_geometry.{next(iter(told))}",
    )


def test_a_pose_to_hold_out_that_no_ball_has_is_refused() -> None:
    _require_poses((2, 4), measured(), "c")
    with pytest.raises(InputError) as refused:
        _require_poses((2, 99), measured(), "c")
    assert (refused.value.got, refused.value.allowed) == ("99", "0, 1, 2, 3, 4")


def test_a_stroke_that_is_one_number_is_refused_before_the_lake_has_it() -> None:
    (run, *_) = runs_of(measured())
    with pytest.raises(InputError, match="stroke") as refused:
        KIND.completed(run, Campaign("c", "m", "volumetric", machine_geometry={"stroke_x_mm": 800.0}))
    assert refused.value.code == "volumetric.stroke"
    assert "[-400.0, 400.0]" in str(refused.value.allowed)
    whole = Campaign(
        "c", "m", "volumetric", machine_geometry={"stroke_x_mm": [0, 1600], "stroke_z_mm": [400.0, 1200.0]}
    )
    assert KIND.completed(run, whole).findings == ()
