"""Campaigns of tones and of ball arrays planned: rules, order, advice."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from dtwin.cli import app
from dtwin.errors import InputError
from dtwin.features.sine import fit_tone
from dtwin.features.tone_window import _WINDOW_S, HORIZON_S
from dtwin.kinds.sinusoidal._plan import FORETOLD_S, LEARNED_S, duration_s, tone_advice, tone_plan
from dtwin.kinds.sinusoidal._simulate import _planned_runs, virtual_slide
from dtwin.kinds.volumetric._plan import _ball_plan, ball_advice
from dtwin.machines.turning import RoomDrift
from dtwin.plan_file import planned_campaign

TONES: dict[str, Any] = {
    "name": "tones",
    "machine": "slide",
    "frequencies_hz": [10, 20, 40],
    "amplitudes_um": [2, 6, 11],
    "repeats": 3,
    "bandwidth_hz": 50,
}
BALLS: dict[str, Any] = {"name": "balls", "machine": "mill", "hours": 100, "drift_um_h": 6.0}


def told(**changes: Any) -> set[str]:
    return {f.code for f in tone_advice(tone_plan(TONES | changes, "test"))}


def said(**changes: Any) -> set[str]:
    return {f.code for f in ball_advice(_ball_plan(BALLS | changes, "test"))}


def test_every_repeat_is_a_pass_over_all_tones_in_an_order_of_its_own() -> None:
    plan = tone_plan(TONES, "test")
    groups = plan.groups
    assert len(groups) == plan.count == 27
    passes = [[(g.frequency_hz, g.amplitude_um) for g in groups if g.repeat == n] for n in (1, 2, 3)]
    assert groups[:9] == tuple(g for g in groups if g.repeat == 1)
    assert set(passes[0]) == set(passes[1]) == set(passes[2])
    assert passes[0] != passes[1]
    assert groups == tone_plan(TONES, "again").groups
    assert groups != tone_plan(TONES | {"seed": 2}, "test").groups
    assert duration_s(plan) == pytest.approx(27 * 8.5)


def test_advice_on_tones_names_what_harms_and_what_cannot_be_told() -> None:
    assert told() == set()
    assert told(frequencies_hz=[10, 20, 41]) == {"plan.beyond_safe"}
    assert told(bandwidth_hz=0) == {"plan.bandwidth_unknown"}
    assert told(sample_hz=300) == {"plan.too_few_samples"}
    assert told(repeats=1) == {"plan.no_repeats"}
    assert told(amplitudes_um=[5, 6]) == {"plan.too_few_tones"}
    assert told(seconds=4) == {"plan.too_short"}
    assert told(repeats=99) == {"plan.long"}
    assert told(frequencies_hz=[0.5, 10, 20]) == {"plan.too_slow", "plan.weak"}
    # What the plan calls long enough is what the window of the features takes.
    assert (LEARNED_S, FORETOLD_S) == (_WINDOW_S + HORIZON_S, HORIZON_S)


def test_advice_on_balls_follows_the_heat_and_the_unknowns() -> None:
    assert said() == {"plan.one_campaign"}
    assert said(drift_um_h=0) == {"plan.one_campaign", "plan.drift_unknown"}
    # A cycle of 126 balls lasts 57 minutes, in which 6.5 um/h are more than 6 um.
    assert said(drift_um_h=6.5) == {"plan.one_campaign", "plan.cycle_too_long"}
    assert said(drift_um_h=6.5, poses=7) == {"plan.one_campaign"}
    assert "plan.too_few_balls" in said(balls=5)
    assert "plan.too_few_balls" in said(poses=3)
    assert "plan.table_balls" in said(table_balls=2)
    assert "plan.too_few_cycles" in said(hours=18)


@pytest.mark.parametrize(
    ("plan", "table", "name"),
    [
        (tone_plan, TONES | {"frequencies_hz": [10, 10]}, "frequencies_hz"),
        (tone_plan, TONES | {"frequencies_hz": [10, 0]}, "frequencies_hz"),
        (tone_plan, TONES | {"amplitudes_um": []}, "amplitudes_um"),
        (tone_plan, TONES | {"amplitudes_um": [1, float("nan")]}, "amplitudes_um"),
        (tone_plan, TONES | {"repeats": 0}, "repeats"),
        (tone_plan, TONES | {"repeats": 1.5}, "repeats"),
        (tone_plan, TONES | {"axis": "B"}, "axis"),
        (tone_plan, TONES | {"spindle": 3}, "setting"),
        (_ball_plan, {"name": "balls", "machine": "mill"}, "setting"),
        (_ball_plan, BALLS | {"every_h": 0.5}, "every_h"),
        (_ball_plan, BALLS | {"hours": "long"}, "hours"),
    ],
)
def test_plans_that_break_a_rule_are_refused(plan: Any, table: dict[str, Any], name: str) -> None:
    with pytest.raises(InputError) as refused:
        plan(table, "test")
    assert name in refused.value.render()


def test_the_command_reads_both_kinds_and_writes_no_program(tmp_path: Path) -> None:
    head = '[plan]\nname = "p"\nmachine = "m"\n'
    tones, balls, other = (tmp_path / f"{n}.toml" for n in ("tones", "balls", "other"))
    tones.write_text(head + 'kind = "sinusoidal"\nfrequencies_hz = [10, 45]\namplitudes_um = [1]\nbandwidth_hz = 50\n')
    balls.write_text(head + 'kind = "volumetric"\nhours = 30\n')
    other.write_text(head + 'kind = "hope"\n')
    assert planned_campaign(tones).summary["groups"] == 2
    assert planned_campaign(balls).summary["cycles"] == 30
    for path, expected in ((tones, "45 Hz lie beyond the safe limit of 40 Hz"), (balls, "57 min")):
        done = CliRunner().invoke(app, ["plan", str(path)])
        assert done.exit_code == 0
        assert expected in done.stdout
        with pytest.raises(InputError, match="programs is not offered"):
            CliRunner().invoke(app, ["plan", str(path), "--out", "x"], catch_exceptions=False)
    with pytest.raises(InputError, match="no plan is known for this kind"):
        CliRunner().invoke(app, ["plan", str(other)], catch_exceptions=False)


def test_repeats_on_the_virtual_slide_differ_because_the_room_does() -> None:
    table = TONES | {"frequencies_hz": [40], "amplitudes_um": [11], "repeats": 4, "seconds": 1.0}
    plan = tone_plan(table, "test")
    spread = {}
    rooms = {"still": RoomDrift(room_c=0.0), "usual": RoomDrift(), "draughty": RoomDrift(3.0, 1.0)}
    for name, room in rooms.items():
        runs = list(_planned_runs(plan, virtual_slide("linear"), 3, drift=room))
        assert [run.meta.repeat for run in runs] == [1, 2, 3, 4]
        tones = [fit_tone(r.samples["t_s"], 1e3 * r.samples["tool_z_mm"], 40.0) for r in runs]
        size = [tone.amplitude for tone in tones]
        spread[name] = max(size) - min(size)
    assert spread["usual"] > 5.0 * spread["still"]
    # A warmer structure is softer and its oil thinner: the tool goes further.
    warmth = [run.meta.covariates["room_c"] for run in runs]
    assert sorted(range(4), key=lambda i: size[i]) == sorted(range(4), key=lambda i: warmth[i])
    with pytest.raises(InputError, match="cannot do this"):
        next(_planned_runs(tone_plan(TONES | {"axis": "X"}, "t"), virtual_slide("linear"), 1))


def test_the_order_is_not_that_of_the_list() -> None:
    first = Counter(tone_plan(TONES | {"seed": s}, "t").groups[0].frequency_hz for s in range(30))
    assert len(first) == 3
