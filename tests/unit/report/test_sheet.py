"""Test sheets: the standard's figures, what their uncertainty covers, and what is decided."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dtwin.acquire.quality import judge_campaign
from dtwin.errors import InputError
from dtwin.kinds.circular._sheet import circular_sheet
from dtwin.kinds.registry import kind_named
from dtwin.report.checking import _sheet_of, check_source
from dtwin.report.sheet import Characteristic, Limits, judged, sheet_lines
from dtwin.report.uncertainty import Circumstances, Contribution, Variation, combined
from dtwin.schema import Campaign, Finding, Run, RunMeta
from dtwin.tolerances import limits_from

ROOT = Path(__file__).parents[3]
PERFECT = Circumstances(
    dict.fromkeys(
        (
            "uncertainty_um",
            "uncertainty_um_per_m",
            "calibration_um",
            "height_difference_mm",
            "alignment_mm",
            "temperature_uncertainty_k",
            "expansion_uncertainty_um_per_m_k",
        ),
        0.0,
    )
)
ANGLE = np.arange(1.0, 360.0, 2.0)


def circle(
    direction: str, repeat: int, noise: np.ndarray, *, oval_um: float = 4.0, play_um: float = 1.0, feed: float = 2000.0
) -> Run:
    """One run of a circle of 100 mm with an oval and a step between directions."""
    sign = 1.0 if direction == "CCW" else -1.0
    error = oval_um * np.cos(np.radians(2 * ANGLE)) / 2 + sign * play_um / 2 * np.sign(np.sin(np.radians(ANGLE)))
    samples = {"angle_deg": sign * ANGLE, "deviation_um": np.interp(sign * ANGLE % 360.0, ANGLE, error) + noise}
    meta = RunMeta(
        f"{direction}{feed:g}-{repeat}",
        plane="XY",
        direction=direction,
        radius_mm=100.0,
        feed_mm_min=feed,
        repeat=repeat,
    )
    return Run(meta=meta, samples=samples)


def test_runs_with_a_correction_are_no_repeats_of_runs_without() -> None:
    rng = np.random.default_rng(1)
    plain = [circle(way, n, 0.1 * rng.standard_normal(ANGLE.size)) for n in (1, 2) for way in ("CCW", "CW")]
    better = [circle(way, n, np.zeros(ANGLE.size), oval_um=0.2) for n in (1, 2) for way in ("CCW", "CW")]
    corrected = [
        replace(run, meta=replace(run.meta, run_id=f"{run.meta.run_id}-with", correction="f00d")) for run in better
    ]
    kind, stated = kind_named("circular"), Campaign("turns", "mill", "circular", "")
    alone, turns = (_sheet_of(kind, stated, runs, {}) for runs in (plain, [*plain, *corrected]))
    assert turns["parts"] == alone["parts"]
    (told,) = (f for f in judge_campaign([*plain, *corrected]) if f.code == "campaign.ways")
    assert told.message.startswith("4 of 8 runs")
    # A campaign that was measured with one correction throughout shows what that leaves.
    (part,) = _sheet_of(kind, stated, corrected, {})["parts"]
    assert set(part["runs"]) == {run.meta.run_id for run in corrected}
    assert not any(f.code == "campaign.ways" for f in judge_campaign(corrected))


def test_the_figures_of_a_circle_are_those_of_its_shape() -> None:
    nothing = np.zeros(ANGLE.size)
    (part,) = circular_sheet([circle("CCW", 1, nothing), circle("CW", 1, nothing)], PERFECT).parts
    figures = {c.symbol: c.value_um for c in part.characteristics}
    assert part.title == "XY R100 F2000"
    assert figures["H"] == pytest.approx(1.0, abs=0.05)
    assert figures["G(b)"] == pytest.approx(5.0, abs=0.1)
    assert figures["G(CCW)"] == pytest.approx(figures["G(CW)"], abs=0.05)
    assert figures["Fmax(CCW)"] - figures["Fmin(CCW)"] == pytest.approx(figures["G(CCW)"])


def test_the_uncertainty_covers_what_the_figure_is_on_average() -> None:
    """100 campaigns of 2 feeds and 3 repeats: U of D must cover its true value in about 95 of 100."""
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(100):
        offset = rng.normal(0.0, 0.3, (2, 3, 2))
        runs = [
            circle(way, n + 1, np.full(ANGLE.size, offset[f, n, w]), feed=feed)
            for f, feed in enumerate((1000.0, 2000.0))
            for n in range(3)
            for w, way in enumerate(("CCW", "CW"))
        ]
        sheet = judged(circular_sheet(runs, PERFECT), {})
        found = next(c for c in sheet.parts[0].characteristics if c.symbol == "D")
        covered += abs(found.value_um) <= found.expanded_um
    assert 89 <= covered <= 99


def test_a_decision_needs_its_uncertainty() -> None:
    limits = Limits(high_um=10.0)
    known = Characteristic("G(b)", "x", 8.0, 3, 1.0, 2.0, 1.5, limits)
    assert known.decision == "inside"
    assert replace(known, value_um=9.0).decision == "cannot say"
    assert replace(known, value_um=12.0).decision == "outside"
    assert replace(known, expanded_um=float("nan")).decision == "cannot say"
    assert replace(known, limits=None).decision == ""
    # What the interval touches is allowed.
    assert replace(known, value_um=8.5).decision == "inside"
    assert replace(known, value_um=11.5).decision == "cannot say"
    nothing = replace(known, value_um=0.0, expanded_um=0.0, limits=Limits(high_um=0.0))
    assert (nothing.decision, replace(nothing, expanded_um=0.5).decision) == ("inside", "cannot say")
    both = replace(known, value_um=-6.0, limits=Limits(-5.0, 5.0), expanded_um=0.5)
    assert both.decision == "outside"


@pytest.mark.parametrize(
    ("value", "low", "high", "decision"),
    [
        (5.0, None, 10.0, "cannot say"),
        (15.0, None, 10.0, "outside"),
        (5.0, 1.0, None, "inside"),
        (5.0, 8.0, None, "cannot say"),
    ],
)
def test_a_figure_that_is_too_small_is_never_within_a_largest_value(
    value: float, low: float | None, high: float | None, decision: str
) -> None:
    c = Characteristic("AP", "accuracy", value, expanded_um=1.0, limits=Limits(low, high), too_small="few poses")
    assert c.decision == decision
    # The reason is told where it alone keeps a figure from being decided.
    assert c.held_back is (decision == "cannot say")


def test_without_repeats_nothing_is_decided() -> None:
    nothing = np.zeros(ANGLE.size)
    sheet = judged(
        circular_sheet([circle("CCW", 1, nothing), circle("CW", 1, nothing)], PERFECT), {"H": Limits(None, 9.0)}
    )
    found = {c.symbol: c.decision for c in sheet.parts[0].characteristics}
    assert found["H"] == "cannot say"
    assert "not known" in sheet.basis


def test_repeats_that_are_not_sound_tell_nothing_of_other_conditions() -> None:
    """A sensor that is stuck never differs: pooled with others it had made them look too certain."""
    rng = np.random.default_rng(5)
    good = [circle(way, n, rng.normal(0, 0.1, ANGLE.size) + n) for n in (1, 2, 3) for way in ("CCW", "CW")]
    stuck = [
        replace(circle(way, n, np.zeros(ANGLE.size), feed=9000.0), findings=(Finding("x.y", "error", "stuck"),))
        for n in (1, 2, 3)
        for way in ("CCW", "CW")
    ]
    alone, beside = (judged(circular_sheet(runs, PERFECT), {}).parts[0] for runs in (good, [*good, *stuck]))
    assert [c.expanded_um for c in beside.characteristics] == [c.expanded_um for c in alone.characteristics]


def test_a_copy_of_a_run_is_no_repeat_of_a_check(tmp_path: Path) -> None:
    for name in ("a", "b"):
        rows = "\n".join(f"{0.1 * n},{a},{np.cos(np.radians(2 * a))}" for n, a in enumerate(ANGLE))
        (tmp_path / f"{name}.csv").write_text(f"t_s,angle_deg,deviation_um\n{rows}\n", encoding="utf-8")
    run = 'plane = "XY"\ndirection = "CCW"\nradius_mm = 100.0\nfeed_mm_min = 2094.0\n'
    told = "".join(f'[[run]]\nid = "{name}"\nfile = "{name}.csv"\n{run}' for name in ("a", "b"))
    (tmp_path / "campaign.toml").write_text(f'[campaign]\nname = "c"\nmachine = "m"\n{told}', encoding="utf-8")
    result = check_source(tmp_path)
    assert any(n.startswith("b is not evaluated: ") for n in result["sheet"]["notes"])
    assert all(c["expanded_um"] is None for c in result["sheet"]["parts"][0]["characteristics"])
    assert [[f["code"] for f in run["findings"]].count("run.copy") for run in result["runs"]] == [0, 1]


def test_an_arc_decides_nothing_of_radii() -> None:
    """The least-squares centre of 100 degrees of an oval is off by more than anything that repeats show."""
    rng = np.random.default_rng(4)
    runs = [circle(way, n, rng.normal(0, 0.05, ANGLE.size)) for n in (1, 2, 3) for way in ("CCW", "CW")]
    whole = judged(circular_sheet(runs, PERFECT), {"D": Limits(-9.0, 9.0)})
    assert whole.notes == ()
    cut = []
    for run in runs:
        inside = (run.samples["angle_deg"] % 360.0 > 20.0) & (run.samples["angle_deg"] % 360.0 < 120.0)
        cut.append(replace(run, samples={name: values[inside] for name, values in run.samples.items()}))
    sheet = judged(circular_sheet(cut, PERFECT), {"D": Limits(-9.0, 9.0), "G(b)": Limits(None, 9.0)})
    (note,) = sheet.notes
    assert note.startswith("XY R100 F2000: arcs of 98°")
    found = {c.symbol: c for c in sheet.parts[0].characteristics}
    assert abs(found["D"].value_um) > 1.0
    assert {s for s, c in found.items() if not np.isfinite(c.expanded_um)} == {
        "D",
        *(f"F{end}({way})" for end in ("max", "min") for way in ("CCW", "CW")),
    }
    assert (found["D"].decision, found["G(b)"].decision) == ("cannot say", "inside")


def test_a_spoilt_run_is_left_out_where_there_are_others() -> None:
    rng = np.random.default_rng(2)
    runs = [circle(way, n, rng.normal(0, 0.1, ANGLE.size)) for n in (1, 2, 3) for way in ("CCW", "CW")]
    spoilt = replace(
        circle("CCW", 4, np.full(ANGLE.size, 0.0), oval_um=80.0), findings=(Finding("x.y", "error", "it slipped"),)
    )
    sheet = circular_sheet([*runs, spoilt], PERFECT)
    assert sheet.notes == ("CCW2000-4 is not evaluated: it slipped.",)
    assert sheet.parts[0].characteristics[0].value_um < 10.0
    alone = judged(circular_sheet([spoilt, runs[1], runs[3]], PERFECT), {"G(CW)": Limits(None, 99.0)})
    assert "though not sound" in alone.notes[0]
    assert {c.decision for c in alone.parts[0].characteristics} == {"", "cannot say"}


def test_an_axis_is_told_after_iso_230_2() -> None:
    """Sixty tests of an axis whose mean and scatter are known: U covers the mean of each figure."""
    rng = np.random.default_rng(3)
    targets = np.arange(0.0, 501.0, 50.0)
    told: dict[str, list[tuple[float, float]]] = {}
    for _ in range(60):
        runs = []
        for n in range(5):
            way = np.repeat(["forward", "reverse"], targets.size)
            place = np.concatenate([targets, targets[::-1]])
            error = 0.01 * place + np.where(way == "reverse", -2.0, 0.0) + rng.normal(0.0, 0.5, place.size)
            samples = {"t_s": np.arange(place.size) * 1.0, "position_mm": place, "direction": way, "error_um": error}
            runs.append(Run(RunMeta(f"r{n}", kind="linear", condition={"axis": "X"}, repeat=n + 1), samples))
        sheet = judged(kind_named("linear").sheet(runs, PERFECT), {})
        for c in sheet.parts[0].characteristics:
            told.setdefault(c.symbol, []).append((c.value_um, c.expanded_um))
    assert np.mean([v for v, _ in told["B̄"]]) == pytest.approx(2.0, abs=0.1)
    for symbol in ("B̄", "M", "E↑"):
        values, expanded = np.array(told[symbol]).T
        assert np.mean(np.abs(values - values.mean()) <= expanded) >= 0.87, symbol
        assert expanded.mean() == pytest.approx(2.0 * values.std(), rel=0.5), symbol


def test_a_check_begins_with_the_sheet_of_its_campaign() -> None:
    result = check_source(
        ROOT / "data/examples/spoilt-run", tolerances=lambda machine: limits_from({"G(b)": 2.0}, machine)
    )
    lines = sheet_lines(result["sheet"])
    assert lines[0].startswith("ISO 230-4, circular test: outside")
    assert len(result["sheet"]["parts"]) == len({line.split("  ")[0] for line in lines if line.startswith("XY R")})


@pytest.mark.parametrize(
    "stated", [{"G": "ten"}, {"G": {"low": 3.0, "high": 1.0}}, {"G": {}}, {"G": True}, {"G": {"x": 1}}]
)
def test_a_tolerance_that_is_none_is_refused(stated: dict[str, object]) -> None:
    with pytest.raises(InputError, match="tolerance"):
        limits_from(stated, "here")


def test_one_number_limits_the_size_of_a_figure_that_has_a_sign() -> None:
    limits = limits_from({"D": 10.0, "B̄": 3.0, "Fmin(CW)": -5.0, "Fmax(CW)": 5.0, "G(b)": 8.0}, "here")
    assert (limits["D"], limits["B̄"]) == (Limits(-10.0, 10.0), Limits(-3.0, 3.0))
    assert (limits["Fmin(CW)"], limits["Fmax(CW)"]) == (Limits(low_um=-5.0), Limits(high_um=5.0))
    assert limits["G(b)"] == Limits(high_um=8.0)
    assert limits_from({"Fmin(CW)": 5.0, "D": {"high": 4.0}}, "here") == {
        "Fmin(CW)": Limits(low_um=-5.0),
        "D": Limits(high_um=4.0),
    }
    for symbol, one in {**limits, "H": Limits(high_um=2.0)}.items():
        assert limits_from({symbol: one.stated(symbol)}, "here") == {symbol: one}
    assert limits_from({"D": Limits(high_um=4.0).stated("D")}, "here") == {"D": Limits(high_um=4.0)}
    small = Characteristic("D", "x", -30.0, 3, 1.0, 2.0, 1.5, limits["D"])
    assert small.decision == "outside"


def test_a_tolerance_that_a_test_does_not_tell_keeps_it_from_being_inside() -> None:
    """One direction tells no G(b): that its own G is inside does not prove what was asked for (ISO 14253-1)."""
    rng = np.random.default_rng(6)
    runs = [circle("CCW", n, rng.normal(0, 0.1, ANGLE.size)) for n in (1, 2, 3)]
    campaign, kind = Campaign("c", "m"), kind_named("circular")
    asked = limits_from({"G(CCW)": 50.0, "G(b)": 50.0, "A": 1.0}, "here")
    sheet = _sheet_of(kind, campaign, runs, asked)
    assert (sheet["verdict"], sheet["parts"][0]["verdict"]) == ("cannot say", "inside")
    # A is of another kind of test.
    assert sheet["notes"] == ["G(b) has a tolerance, and this test does not tell it."]
    assert _sheet_of(kind, campaign, runs, limits_from({"G(CCW)": 50.0}, "here"))["verdict"] == "inside"


def test_a_symbol_of_two_standards_is_that_of_positioning_unless_its_kind_is_told() -> None:
    """A of ISO 230-2 is the accuracy of an axis, A of a turning one its asynchronous error motion."""
    stated = limits_from({"A": 10.0, "rotation:A": 1.0, "R": 5.0, "S": 2.0, "circular:Fmin(CW)": 4.0}, "here")
    assert kind_named("rotation").limits(stated) == {"A": Limits(high_um=1.0), "S": Limits(high_um=2.0)}
    assert {s: kind_named("linear").limits(stated)[s].high_um for s in "AR"} == {"A": 10.0, "R": 5.0}
    assert kind_named("circular").limits(stated)["Fmin(CW)"] == Limits(low_um=-4.0)


def test_the_uncertainty_of_the_instrument_is_added_and_checked() -> None:
    runs = [circle(way, n, np.full(ANGLE.size, 0.01 * n)) for n in (1, 2, 3) for way in ("CCW", "CW")]
    kind = kind_named("circular")
    plain, stated = (
        _sheet_of(kind, Campaign("c", "m", instrument=instrument), runs, {})["parts"][0]["characteristics"][0]
        for instrument in ({"uncertainty_um": 0.0}, {"uncertainty_um": 3.0})
    )
    (scatter, _), own = plain["budget"]["contributions"], stated["budget"]["contributions"][1]
    assert (own["source"], own["standard_um"], own["assumed"]) == ("instrument", 1.5, False)
    assert stated["budget"]["standard_um"] == pytest.approx(np.hypot(scatter["standard_um"], 1.5))
    with pytest.raises(InputError, match="uncertainty of the instrument"):
        _sheet_of(kind, Campaign("c", "m", instrument={"uncertainty_um": "small"}), runs, {})


def test_contributions_are_combined_as_the_gum_says() -> None:
    plain = combined([Contribution("a", 3.0, ""), Contribution("b", 4.0, "")])
    assert plain.expanded_um == pytest.approx(10.0, rel=1e-3)
    few = combined([Contribution("a", 3.0, "", dof=2.0), Contribution("b", 4.0, "")])
    assert few.dof == pytest.approx(5.0**4 / (3.0**4 / 2.0))
    assert few.factor > plain.factor


@pytest.mark.parametrize(("range_um", "counted"), [(1.0, 0.0), (12.0, np.sqrt(144.0 / 6.0 - 4.0))])
def test_surroundings_count_where_they_go_beyond_what_repeats_show(range_um: float, counted: float) -> None:
    under = Circumstances(variation=Variation(range_um, 1.0, "night"))
    budget = combined([Contribution("repeatability", 2.0, ""), *under.environment(1)])
    assert budget.contributions[1].standard_um == pytest.approx(counted)


def test_what_nobody_stated_is_said() -> None:
    runs = [circle(way, n, np.full(ANGLE.size, 0.01 * n)) for n in (1, 2, 3) for way in ("CCW", "CW")]
    sheet = judged(circular_sheet(runs, Circumstances({"uncertainty_um": 0.4}, 23.0)), {}).as_dict()
    assert "Assumed, for nobody stated it: calibrated length, set-up, temperature, expansion." in sheet["basis"]
    of_symbol = {c["symbol"]: c["budget"]["contributions"] for c in sheet["parts"][0]["characteristics"]}
    assert [c["source"] for c in of_symbol["H"]] == ["repeatability", "instrument"]
    assert of_symbol["D"][-1]["standard_um"] == pytest.approx(0.1 * 3.0 * 1.0)
    assert "Budget of G(b), XY R100 F2000" in "\n".join(sheet_lines(sheet))


def test_the_tolerance_of_the_machine_goes_before_that_of_the_file(real_recording: Path) -> None:
    def shown(limits: dict[str, Limits]) -> dict[str, str]:
        sheet = check_source(real_recording, tolerances=lambda machine: limits)["sheet"]
        return {c["symbol"]: c["shown"]["limit"] for c in sheet["parts"][0]["characteristics"]}

    assert shown({})["D"] == "-50 to 50"
    assert shown({"D": Limits(None, 9.0), "H": Limits(None, 3.0)}) == {**shown({}), "D": "≤ 9", "H": "≤ 3"}


def test_a_tolerance_of_a_campaign_that_is_none_is_refused() -> None:
    runs = [circle(way, n, np.full(ANGLE.size, 0.01 * n)) for n in (1, 2) for way in ("CCW", "CW")]
    for wrong in (3.0, {"H": "much"}, {"circular:H": 3.0}):
        with pytest.raises(InputError, match="tolerance"):
            _sheet_of(kind_named("circular"), Campaign("c", "m", instrument={"tolerances": wrong}), runs, {})
