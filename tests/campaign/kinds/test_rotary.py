"""Positioning tables of rotary axes: every form and unit gives the figures of ISO 230-2, and what is not stated is refused or said."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from openpyxl import Workbook
from typer.testing import CliRunner

from dtwin.acquire.amending import amend
from dtwin.acquire.importing import understand
from dtwin.acquire.ingest import ingest, open_source
from dtwin.cli import app
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named, unit_of_limit
from dtwin.kinds.rotary._sheet import positioning_result
from dtwin.lake.store import Lake
from dtwin.pipeline.sheet_changes import sheet_changes
from dtwin.positioning.position_table import axis_turns
from dtwin.report.checking import check_source
from dtwin.report.sheet import judged
from dtwin.report.uncertainty import Circumstances
from dtwin.schema import Campaign, Floats, Run, RunMeta

ROTARY = kind_named("rotary")
TARGETS = np.arange(0.0, 361.0, 45.0)
_RNG = np.random.default_rng(3)
_ONCE = 6.0 * np.cos(np.radians(TARGETS) - 0.5)[:, None]
# Whole tenths of a second: every unit below holds them.
FORWARD = np.round(_ONCE + 1.5 + _RNG.normal(0.0, 0.4, (9, 3)), 1)
REVERSE = np.round(_ONCE - 1.5 + _RNG.normal(0.0, 0.4, (9, 3)), 1)
PER_ARCSEC = {
    "arcsec": 1.0,
    "″": 1.0,
    '"': 1.0,
    "''": 1.0,
    "arcmin": 1.0 / 60.0,
    "deg": 1.0 / 3600.0,
    "mdeg": 1.0 / 3.6,
    "µrad": np.pi / 0.648,
    "mrad": np.pi / 648.0,
}


def iso_230_2(forward: Floats, reverse: Floats) -> dict[str, float]:
    """Return the figures of readings (targets, runs), as the standard's clause 3 has them."""
    up, down = forward.mean(axis=1), reverse.mean(axis=1)
    s_up, s_down = forward.std(axis=1, ddof=1), reverse.std(axis=1, ddof=1)
    high = np.maximum(up + 2 * s_up, down + 2 * s_down)
    low = np.minimum(up - 2 * s_up, down - 2 * s_down)
    r = np.max([2 * s_up + 2 * s_down + np.abs(up - down), 4 * s_up, 4 * s_down], axis=0)
    return {
        "A": high.max() - low.min(),
        "A↑": (up + 2 * s_up).max() - (up - 2 * s_up).min(),
        "A↓": (down + 2 * s_down).max() - (down - 2 * s_down).min(),
        "R": r.max(),
        "R↑": 4 * s_up.max(),
        "R↓": 4 * s_down.max(),
        "E": max(up.max(), down.max()) - min(up.min(), down.min()),
        "E↑": np.ptp(up),
        "E↓": np.ptp(down),
        "B": np.abs(up - down).max(),
        "B̄": (up - down).mean(),
        "M": np.ptp((up + down) / 2),
    }


def wide(unit: str, head: str = "{way} {c} [{unit}]", target: str = "target [°]") -> str:
    heads = [head.format(way=way, c=c, unit=unit) for c in (1, 2, 3) for way in ("forward", "reverse")]
    rows = [
        ";".join([f"{t:g}", *(f"{v * PER_ARCSEC[unit]:.9g}" for c in range(3) for v in (FORWARD[i, c], REVERSE[i, c]))])
        for i, t in enumerate(TARGETS)
    ]
    return "\n".join([";".join([target, *heads]), *rows])


def positions(unit: str = "[°]") -> str:
    """Actual positions; below 0° they are those near 360°, and at 360° those near 0°, as a control shows them."""
    rows = []
    for i, t in enumerate(TARGETS):
        read = [(t + v / 3600.0) % 360.0 for c in range(3) for v in (FORWARD[i, c], REVERSE[i, c])]
        rows.append(";".join([f"{t:g}", *(f"{v:.7f}" for v in read)]))
    heads = [f"{way} {c} {unit}".strip() for c in (1, 2, 3) for way in ("forward", "reverse")]
    return "\n".join([";".join([f"target {unit}".strip(), *heads]), *rows])


def long(heads: str) -> str:
    rows = [
        f"{t:g},{way},{c + 1},{v[i, c]:g}"
        for c in range(3)
        for way, v in (("forward", FORWARD), ("reverse", REVERSE))
        for i, t in enumerate(TARGETS)
    ]
    return "\n".join([heads, *rows])


def blocks() -> str:
    lines = ["Rundtisch", ""]
    for c in range(3):
        for way, v in (("vorwärts", FORWARD), ("rückwärts", REVERSE)):
            lines += [f"Messreihe {c + 1} {way}", 'Winkel [°];Abweichung ["]']
            lines += [f"{t:g};{f'{v[i, c]:g}'.replace('.', ',')}" for i, t in enumerate(TARGETS)]
    return "\n".join(lines)


def aligned() -> str:
    return "\n".join(
        "".join(f"{cell:>20}" for cell in row.split(";"))
        for row in wide("arcsec", "{way}_{c}_{unit}", "target_deg").split("\n")
    )


def assigned() -> str:
    lines = ["UNIT=deg", *(f"TGT_DATA[{i + 1}]={t:g}" for i, t in enumerate(TARGETS))]
    for name, v in (("FWD", FORWARD), ("BWD", REVERSE)):
        lines += [
            f"REF_DATA_{name}[{i + 1},{c + 1}]={t + v[i, c] / 3600.0:.8f}"
            for i, t in enumerate(TARGETS)
            for c in range(3)
        ]
    return "\n".join(lines)


def turned(unit: str, degrees: float) -> str:
    """Return a table whose targets are in another unit."""
    heads, *rows = wide("arcsec", target=f"target [{unit}]").splitlines()
    pairs = (row.partition(";") for row in rows)
    return "\n".join([heads, *(f"{float(t) / degrees:.9g};{rest}" for t, _, rest in pairs)])


def sexagesimal(degrees: float) -> str:
    tenths = round(abs(degrees) * 36_000.0)
    return f"{'-' if degrees < 0.0 else ''}{tenths // 36_000}°{tenths // 600 % 60:02d}'{tenths % 600 / 10.0:04.1f}\""


def cells(head: str, target: str, of: Callable[[float, float], str]) -> str:
    """Return a table of targets in degrees and minutes; ``of`` target and deviation in degrees a cell is made."""
    rows = [
        ";".join([sexagesimal(t), *(of(t, x / 3600.0) for c in range(3) for x in (f[c], r[c]))])
        for t, f, r in zip(TARGETS, FORWARD, REVERSE, strict=True)
    ]
    return "\n".join([";".join([target, *(head.format(way=w, c=c) for c in (1, 2, 3) for w in ("fwd", "rev"))]), *rows])


FORMS = {
    **{
        f"in {unit}": wide(unit, "deviation {way} {c} [{unit}]" if unit == "deg" else "{way} {c} [{unit}]")
        for unit in PER_ARCSEC
    },
    "German": wide('"', "{way} {c} [{unit}]", "Winkel [°]").replace("forward", "vor").replace("reverse", "rück"),
    "Japanese": wide("arcsec", "{way}{c} [角秒]", "角度 [度]").replace("forward", "往路").replace("reverse", "復路"),
    "Japanese of turns": wide("″", "{way}{c}({unit})", "指令角度(°)")
    .replace("forward", "正転")
    .replace("reverse", "逆転"),
    "units below": wide("arcsec", "{way} {c}", "Angle").replace("\n", "\ndeg" + ";arcsec" * 6 + "\n", 1),
    "positions": positions(),
    "parts of degrees": cells("deviation {way} {c}", "target", lambda t, x: sexagesimal(x)),
    "positions in these": cells("actual {way} {c} [° ' \"]", "Soll [DMS]", lambda t, x: sexagesimal((t + x) % 360.0)),
    "these in Markdown": "# Rotary table\n\n"
    + "\n".join(
        f"| {' | '.join(row.split(';'))} |" + "\n|---|---|---|---|---|---|---|" * (n == 0)
        for n, row in enumerate(cells("error {way} {c}", "target", lambda t, x: sexagesimal(x)).splitlines())
    ),
    "these below seconds": cells('{way} {c} ["]', "target [°]", lambda t, x: sexagesimal(x)),
    "angles without a unit above these": cells('{way} {c} ["]', "Winkel", lambda t, x: f"{x * 3600.0:.1f}"),
    "seconds with their mark": cells("{way} {c}", "target", lambda t, x: f'{x * 3600.0:.1f}"'),
    "deviations near a turn": cells("deviation {way} {c} [°]", "target", lambda t, x: f"{x % 360.0:.7f}"),
    "degrees that no head calls deviations": wide("deg"),
    "runs below directions": "\n".join(
        [
            f'{way}\nWinkel [°];Lauf 1 ["];Lauf 2 ["];Lauf 3 ["]\n'
            + "\n".join(f"{t:g};" + ";".join(f"{x:g}" for x in row) for t, row in zip(TARGETS, v, strict=True))
            for way, v in (("Vorwärts", FORWARD), ("Rückwärts", REVERSE))
        ]
    ),
    "targets in gon": turned("gon", 0.9),
    "targets in rad": turned("rad", 180.0 / np.pi),
    "long": long("target [°],direction,cycle,deviation [arcsec]"),
    "long of angles": long("Angle [deg],Direction,Cycle,Error [arcsec]"),
    "blocks": blocks(),
    "aligned": aligned(),
    "assigned": assigned(),
}


def test_a_sheet_of_a_workbook_is_read_by_the_name_of_its_axis(tmp_path: Path) -> None:
    book = Workbook()
    for title, scale in (("A", 2.0), ("C", 1.0)):
        sheet = book.active if title == "A" else book.create_sheet()
        sheet.title = f"{title} axis"
        for number, row in enumerate(wide("arcsec").splitlines()):
            cells = row.split(";")
            sheet.append(cells if number == 0 else [float(cells[0]), *(scale * float(cell) for cell in cells[1:])])
    book.save(path := tmp_path / "table.xlsx")
    assert axis_turns(path) is True
    with pytest.raises(InputError, match="end of a turn is 360"):
        read(written(tmp_path, wide("arcsec").replace("360;", "0;"), "turn.csv"))
    (part,) = ROTARY.sheet(read(path), Circumstances()).parts
    assert {c.symbol: c.value_um for c in part.characteristics} == pytest.approx(iso_230_2(FORWARD, REVERSE))


def written(tmp_path: Path, text: str, name: str = "c.csv") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def read(path: Path, **condition: str) -> list[Run]:
    reader = ROTARY.reader_of(path)
    assert reader is not None
    return reader(path, Campaign("c", "m", kind="rotary"), {"condition": {"axis": "C", **condition}})[0]


def test_a_number_or_nothing_may_stand_above_parts_of_degrees(tmp_path: Path) -> None:
    text = "target;error fwd 1;error rev 1\n0;-;0°00'01\"\n12°30';0°00'02\";-\n45;-0°00'03\";0"
    (run,) = read(written(tmp_path, text))
    told = zip(run.samples["angle_deg"], run.samples["direction"], run.samples["error_arcsec"], strict=True)
    assert {(t, way): round(x, 6) for t, way, x in told} == {
        (12.5, "forward"): 2.0,
        (45.0, "forward"): -3.0,
        (45.0, "reverse"): 0.0,
        (0.0, "reverse"): 1.0,
    }
    for cell in ("12°60'", "0°0'75\"", "12.5°30'"):
        with pytest.raises(InputError, match="not a number"):
            read(written(tmp_path, text.replace("12°30'", cell)))


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_figures_of_the_standard(tmp_path: Path, form: str) -> None:
    path = written(tmp_path, FORMS[form])
    assert axis_turns(path) is True
    assert understand(path, Home(tmp_path / "home"), {}, {}).kind == "rotary"
    runs = read(path)
    assert [set(run.samples) >= set(ROTARY.columns) for run in runs] == [True] * 3
    (part,) = ROTARY.sheet(runs, Circumstances()).parts
    told = {c.symbol: c.value_um for c in part.characteristics}
    assert told == pytest.approx(iso_230_2(FORWARD, REVERSE), abs=2e-3)
    assert tuple(told) == ROTARY.figures
    codes = {f.code for run in runs for f in run.findings} - {"clock.assumed"}
    assert codes == set()


@pytest.mark.parametrize(
    ("text", "code", "hint"),
    [
        (wide("deg", "{way} {c} [°]", "Soll [Grad]"), "unit", "head"),
        (wide("arcsec", "deviation {way} {c}"), "unit", "head"),
        (wide("arcsec", "{way} {c} [µm]", "target [°]"), "unit", "--kind linear"),
        (wide("arcsec", "{way} {c} [sec]"), "unit", "head"),
        # Without a unit these are positions, and do not follow their targets.
        (wide("arcsec", "{way} {c}"), "unit", "deviations"),
        (positions().replace("°", "mm"), "unit", "--kind linear"),
    ],
)
def test_units_that_are_not_stated_or_of_another_axis_are_refused(
    tmp_path: Path, text: str, code: str, hint: str
) -> None:
    path = written(tmp_path, text)
    with pytest.raises(InputError) as refused:
        read(path)
    assert refused.value.code == f"position_table.{code}"
    assert hint in str(refused.value.hint)


def test_a_mark_of_inches_is_no_second_of_arc_where_no_angle_is_named(tmp_path: Path) -> None:
    path = written(tmp_path, wide('"', target='target ["]'))
    assert axis_turns(path) is False
    with pytest.raises(InputError, match="a unit that is not known"):
        check_source(path, told={"axis": "X", "machine": "m"})


def test_a_table_of_angles_is_none_of_a_linear_axis_and_the_refusal_names_the_kind(tmp_path: Path) -> None:
    path = written(tmp_path, wide("arcsec"))
    with pytest.raises(InputError, match="in angles") as refused:
        check_source(path, told={"axis": "C", "kind": "linear", "machine": "m"})
    assert "--kind rotary --axis C" in str(refused.value.hint)


def test_a_head_that_names_another_axis_and_a_title_in_gon_are_refused(tmp_path: Path) -> None:
    positions = "Winkel;vor 1;rück 1\n0;0.001;0.002\n90;90.001;90.002"
    for text, code in (
        (wide("arcsec", target="target A [°]"), "position_table.axes"),
        (f"Alle Winkel in gon\n{positions}", "position_table.unit"),
    ):
        with pytest.raises(InputError) as refused:
            read(written(tmp_path, text), axis="C")
        assert refused.value.code == code
    # The X of an autocollimator is no axis of the machine.
    assert len(read(written(tmp_path, wide("arcsec", "{way} {c} X [{unit}]")), axis="C")) == 3


def test_an_axis_that_moves_along_is_refused_of_files_and_afterwards(tmp_path: Path) -> None:
    path, lake = written(tmp_path, wide("arcsec")), Lake(tmp_path / "lake")
    with pytest.raises(InputError, match="moves along") as refused:
        check_source(path, told={"axis": "X", "machine": "m"})
    assert "--kind linear" in str(refused.value.hint)
    ingest(path, lake, told={"axis": "C", "machine": "m"})
    for setting, code in (("condition.axis=X", "rotary.axis"), ("radius_mm=150", "amend.kind")):
        with pytest.raises(InputError) as refused:
            amend(lake, "c", [setting], "typo")
        assert refused.value.code == code
    assert amend(lake, "c", ["condition.axis=B"], "typo")


@pytest.mark.parametrize(
    "text",
    [
        wide("arcsec").replace("forward", "CW").replace("reverse", "CCW"),
        long("target [°],direction,cycle,deviation [arcsec]").replace("forward", "CW").replace("reverse", "CCW"),
    ],
)
def test_a_sense_of_turning_is_no_direction_and_the_refusal_says_why(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match="which of CW and CCW is positive depends on from where one looks"):
        check_source(written(tmp_path, text), told={"axis": "C", "machine": "m"})


def test_tilts_along_an_axis_are_no_positions_of_one_that_turns(tmp_path: Path) -> None:
    path = written(tmp_path, wide("arcsec", target="target"))
    assert axis_turns(path) is False
    for axis in ("X", "C"):
        with pytest.raises(InputError, match="in angles"):
            check_source(path, told={"axis": axis, "machine": "m"})
    assert "rotary.unit_assumed" in str(check_source(path, told={"axis": "C", "machine": "m", "kind": "rotary"}))


def test_degrees_are_taken_only_where_the_kind_is_stated_and_that_is_said(tmp_path: Path) -> None:
    path = written(tmp_path, positions(""))
    with pytest.raises(InputError, match="in angles"):
        check_source(path, told={"axis": "C", "machine": "m"})
    assert "rotary.unit_assumed" in str(check_source(path, told={"axis": "C", "machine": "m", "kind": "rotary"}))
    assert [f.severity for f in read(path)[0].findings if f.code == "rotary.unit_assumed"] == ["warning"]


@pytest.mark.parametrize(
    "around", ['Winkel [°],forward 1 ["],reverse 1 ["]\n{}', 'Winkel {} [°],vor 1 ["],rück 1 ["]\n0,1,2\n9,1,2\n']
)
@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200))
@example(b"\\x")
def test_no_file_ends_in_anything_but_a_refusal(
    tmp_path_factory: pytest.TempPathFactory, around: str, content: bytes
) -> None:
    path = tmp_path_factory.mktemp("any") / "a.csv"
    begin, end = (part.encode() for part in around.split("{}"))
    path.write_bytes(begin + content + end)
    if axis_turns(path) is not None:
        with suppress(InputError):
            read(path)


def sweeps(targets: Floats, runs: int = 5, step: float = 0.0) -> list[Run]:
    """Return runs without scatter but of the last target, which moves by ``step`` from that a turn before."""
    place = np.concatenate([targets, targets[::-1]])
    way = np.repeat(np.array(["forward", "reverse"], dtype=object), targets.size)
    made = []
    for n in range(runs):
        error = np.sin(np.radians(place)) + 0.01 * n + step * (place == 360.0)
        samples = {"t_s": np.arange(place.size) * 1.0, "angle_deg": place, "direction": way, "error_arcsec": error}
        made.append(Run(RunMeta(f"r{n}", kind="rotary", condition={"axis": "C"}, repeat=n + 1), samples))
    return made


@pytest.mark.parametrize(
    ("travel", "fewest"), [(60.0, 3), (90.0, 3), (91.0, 5), (180.0, 5), (181.0, 8), (330.0, 8), (360.0, 8)]
)
def test_fewer_targets_than_the_standard_asks_for_are_a_finding(travel: float, fewest: int) -> None:
    few = ROTARY.judge_campaign(sweeps(np.linspace(0.0, travel, fewest - 1)))
    assert [f.message for f in few if f.code == "rotary.asked"] == [
        f"ISO 230-2 asks for {fewest} targets on this travel, these are {fewest - 1}"
    ]
    enough = ROTARY.judge_campaign(sweeps(np.linspace(0.0, travel, fewest)))
    assert "rotary.asked" not in {f.code for f in enough}
    three = ROTARY.judge_campaign(sweeps(np.linspace(0.0, travel, fewest), runs=3))
    assert "ISO 230-2 asks for five runs, these are 3" in {f.message for f in three}


def test_a_turn_closes_or_it_is_said_by_how_much_it_does_not() -> None:
    for step, severity in ((0.0, "info"), (2.5, "warning")):
        runs = sweeps(TARGETS, step=step)
        (closure,) = (f for f in ROTARY.judge_campaign(runs) if f.code == "rotary.closure")
        assert (closure.severity, closure.numbers["closure_arcsec"]) == (severity, pytest.approx(step, abs=1e-9))
        assert any("360° is the place of 0°" in note for note in ROTARY.sheet(runs, Circumstances()).notes)
    (several,) = (
        f for f in ROTARY.judge_campaign(sweeps(np.arange(0.0, 541.0, 45.0), step=2.5)) if "closure" in f.code
    )
    assert several.numbers["closure_arcsec"] == pytest.approx(2.5)
    (one,) = (f for f in ROTARY.judge_campaign(sweeps(TARGETS, runs=1, step=2.5)) if f.code == "rotary.closure")
    assert one.severity == "info"
    assert not [f for f in ROTARY.judge_campaign(sweeps(TARGETS[:-1])) if f.code == "rotary.closure"]


@pytest.mark.parametrize("last", [330.0, 360.0])
def test_what_comes_once_and_twice_a_turn_is_told_with_its_scatter(last: float) -> None:
    targets, rng = np.arange(0.0, last + 1.0, 30.0), np.random.default_rng(5)
    runs = sweeps(targets)
    for run in runs:
        angle, way = run.samples["angle_deg"], run.samples["direction"]
        wave = 6.0 * np.cos(np.radians(angle - 70.0)) + 2.0 * np.cos(2.0 * np.radians(angle - 25.0))
        run.samples["error_arcsec"][:] = wave + 3.0 * (way == "forward") + rng.normal(0.0, 0.2, run.n_samples)
    (told,) = ROTARY.campaign_figures(runs)["positioning"]
    for wave, (size, at) in zip(told["waves"], ((6.0, 70.0), (2.0, 25.0)), strict=True):
        assert wave["amplitude_arcsec"] == pytest.approx(size, abs=0.1)
        assert wave["largest_at_deg"] == pytest.approx(at, abs=1.5)
        assert 0.0 < wave["k95_arcsec"] < 0.15
    assert told["left_rms_arcsec"] < 0.1
    told["waves"][1]["amplitude_arcsec"] = 0.01
    lines = "\n".join(ROTARY.figure_lines({"positioning": [told]}))
    assert "once a turn" in lines
    assert "twice a turn no more than what runs differ by" in lines


def test_a_turn_that_does_not_close_is_no_wave() -> None:
    runs = sweeps(np.arange(0.0, 361.0, 30.0))
    for run in runs:
        angle = run.samples["angle_deg"]
        run.samples["error_arcsec"][:] = 2.0 * np.cos(np.radians(angle - 70.0)) + 12.0 * angle / 360.0
    (told,) = positioning_result(runs)
    assert [wave["amplitude_arcsec"] for wave in told["waves"]] == pytest.approx([2.0, 0.0], abs=1e-9)
    assert told["drift_arcsec"] == pytest.approx(12.0)
    assert "goes on by 12.00″ over a turn" in "\n".join(ROTARY.figure_lines({"positioning": [told]}))
    (open_turn,) = positioning_result(sweeps(np.arange(0.0, 331.0, 30.0)))
    assert "a drift over the turn would look like these" in "\n".join(ROTARY.figure_lines({"positioning": [open_turn]}))


def test_the_scatter_of_a_wave_covers_it_as_often_as_it_says() -> None:
    rng, runs, held, false = np.random.default_rng(6), sweeps(TARGETS[:-1]), 0, 0
    for _ in range(300):
        for run in runs:
            once = 4.0 * np.cos(np.radians(run.samples["angle_deg"]))
            run.samples["error_arcsec"][:] = once + rng.normal(0.0, 0.5, run.n_samples)
        wave, none = positioning_result(runs)[0]["waves"]
        held += abs(wave["amplitude_arcsec"] - 4.0) <= wave["k95_arcsec"]
        false += none["amplitude_arcsec"] > none["chance_arcsec"]
    assert 0.91 <= held / 300 <= 0.98
    assert false / 300 <= 0.05


@pytest.mark.parametrize("targets", [np.arange(0.0, 181.0, 15.0), np.arange(0.0, 316.0, 60.0)])
def test_a_part_of_a_turn_and_few_targets_have_no_waves(targets: Floats) -> None:
    (told,) = ROTARY.campaign_figures(sweeps(targets))["positioning"]
    assert "waves" not in told


def test_the_budget_is_in_seconds_and_knows_no_expansion() -> None:
    sheet = judged(ROTARY.sheet(sweeps(TARGETS), Circumstances({"uncertainty_arcsec": 0.6})), {}).as_dict()
    assert (sheet["unit"], ROTARY.unit) == ("arcsec", "arcsec")
    (part,) = sheet["parts"]
    for figure in part["characteristics"]:
        assert not [name for name in figure if name.endswith("_um")]
        (_, instrument) = figure["budget"]["contributions"]
        assert (instrument["source"], instrument["standard_arcsec"]) == ("instrument", 0.3)
        assert "″" in instrument["basis"]
    # What is stated in another unit is not taken for seconds.
    other = judged(ROTARY.sheet(sweeps(TARGETS), Circumstances({"uncertainty_um": 0.6})), {})
    assert "instrument" in other.basis


def test_a_machine_has_a_decision_a_history_and_a_certificate(tmp_path: Path) -> None:
    def said(*words: object) -> Any:
        done = CliRunner(env={"DTWIN_HOME": str(tmp_path / "home")}).invoke(
            app, [*map(str, words)], catch_exceptions=False
        )
        assert done.exit_code == 0, done.output
        return done.output

    figures = iso_230_2(FORWARD, REVERSE)
    said("machine", "add", "m5", "--tolerance", f"rotary:A={figures['A'] + 3:.0f}", "--tolerance", "A=0.1")
    assert "rotary:A ≤" in said("machine", "list") or unit_of_limit("rotary:A") == "arcsec"
    assert unit_of_limit("A") == unit_of_limit("rotation:A") == "um"
    for name, axis in (("spring", "C"), ("autumn", "c")):
        path = written(tmp_path, wide("mdeg"), f"{name}.csv")
        said("ingest", path, "--kind", "rotary", "--axis", axis, "--machine", "m5")
    (first, _) = json.loads(said("machine", "show", "m5", "--json"))["tests"]
    assert (first["kind"], first["figure"], first["decision"]) == ("rotary", "A", "inside")
    assert "A, axis C, 0 to 360 °, 9 targets" in said("machine", "show", "m5")
    assert first["value_arcsec"] == pytest.approx(figures["A"], abs=2e-3)
    changes = sheet_changes(Home(tmp_path / "home"), "autumn", "spring")
    assert {one["difference_arcsec"] for one in changes["figures"]} == {0.0}
    page = tmp_path / "c.html"
    said("certificate", "spring", "--out", page)
    assert "U&nbsp;(95&nbsp;%), ″" in page.read_text("utf-8")
    assert " µm" not in page.read_text("utf-8").partition("<table")[2].partition("plotly")[0]


def test_the_section_of_the_page_is_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    page = (Path(__file__).parents[3] / "docs/how-to/positioning-table.md").read_text(encoding="utf-8")
    section = page.partition("## Rotary axes")[2]
    table, command, told, *_ = re.findall(r"```(?:csv title=\"axis-c.csv\"|sh|text)\n(.*?)```", section, re.S)
    written(tmp_path, table, "axis-c.csv")
    done = CliRunner().invoke(app, command.split()[1:], catch_exceptions=False)
    assert told.strip() in done.output
    for listed in re.findall(r"`dtwin ((?:ingest|machine) [^`]*)`", section):
        assert CliRunner().invoke(app, listed.split(), catch_exceptions=False).exit_code == 0


def test_a_spoilt_reading_is_named_with_its_angle(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    runs = sweeps(TARGETS)
    for run in runs:
        run.samples["error_arcsec"][:] += rng.normal(0.0, 0.2, run.n_samples)
    runs[2].samples["error_arcsec"][3] += 30.0
    (spoilt,) = (f for f in ROTARY.judge_campaign(runs) if f.severity == "error")
    assert spoilt.code == "rotary.spoilt_readings"
    assert "cycle 3 forward at 135 °" in spoilt.message
    assert "µm" not in spoilt.message


def test_a_folder_of_the_house_says_directions_in_words(tmp_path: Path) -> None:
    (tmp_path / "campaign.toml").write_text(
        '[campaign]\nname = "c"\nmachine = "m"\nkind = "rotary"\n[[run]]\nid = "r1"\nfile = "r1.csv"\ncondition = { axis = "C" }\n'
    )
    written(tmp_path, "t_s,angle_deg,direction,error_arcsec\n0,0,hin,1\n1,90,hin,2\n2,90,her,3\n3,0,her,2\n", "r1.csv")
    _, sources, _ = open_source(tmp_path)
    (run,) = next(iter(sources))[0]
    assert list(run.samples["direction"]) == ["forward", "forward", "reverse", "reverse"]
