"""Tables of positioning tests: read in every form, and what differs from cycle to cycle is told apart."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from dtwin.acquire._tabular import kind_of_table
from dtwin.acquire.amending import amend
from dtwin.acquire.axis_titles import part_of_axis
from dtwin.acquire.importing import understand
from dtwin.acquire.ingest import ingest
from dtwin.acquire.spreadsheet import table_bytes
from dtwin.acquire.table_dialect import decoded, rows_of
from dtwin.cli import app
from dtwin.config import Home
from dtwin.errors import InputError, StoreError
from dtwin.kinds.linear._grid import stroke_rows
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.positioning.matrix import linear_test
from dtwin.positioning.position_runs import PositionTable, runs_of, said_of
from dtwin.positioning.position_table import _table_in, is_position_table, read_position_runs
from dtwin.positioning.ways import way_of
from dtwin.report.checking import check_source
from dtwin.schema import Campaign, Run, RunMeta

ROOT = Path(__file__).parents[3]
TARGETS = np.array([0.0, 50.0, 100.0])
FORWARD = np.array([[1.0, 1.5], [2.0, 2.5], [-3.0, -3.5]])
REVERSE = FORWARD + 4.0


def read_position_table(path: Path) -> PositionTable:
    text = part_of_axis(decoded(table_bytes(path, 2**24)), "", path)
    return _table_in(text, rows_of(text), path)


def refusal(path: Path) -> InputError:
    with pytest.raises(InputError) as refused:
        read_position_table(path)
    return refused.value


def wide(head: str, scale: float, by_position: bool, part: str = ",", comma: str = ".") -> str:
    ways = [w for c in (1, 2) for w in (head.format(way="forward", c=c), head.format(way="reverse", c=c))]
    lines = [part.join(["target [mm]", *ways])]
    for i, target in enumerate(TARGETS):
        cells = [(FORWARD[i, c], REVERSE[i, c]) for c in range(2)]
        values = [(target if by_position else 0.0) * scale / 1000.0 + v * scale / 1e6 for pair in cells for v in pair]
        lines.append(part.join([f"{target:g}", *(f"{v:.7g}" for v in values)]).replace(".", comma))
    return "\n".join(lines)


def long() -> str:
    lines = ["# by hand", "Sollposition_mm\tRichtung\tZyklus\tAbweichung [µm]"]
    for c in range(2):
        for way, values in (("hin", FORWARD), ("rück", REVERSE)):
            lines += [f"{t:g}\t{way}\t{c + 1}\t{values[i, c]:g}".replace(".", ",") for i, t in enumerate(TARGETS)]
    return "\n".join(lines)


def assigned() -> str:
    lines = ["UNIT=um"] + [f"TGT_DATA[{i + 1}]={1000 * t:g}" for i, t in enumerate(TARGETS)]
    for name, values in (("FWD", FORWARD), ("BWD", REVERSE)):
        for (i, c), v in np.ndenumerate(values):
            lines.append(f"REF_DATA_{name}[{i + 1},{c + 1}]={1000 * TARGETS[i] + v!r}".replace("np.float64", ""))
    return "\n".join(re.sub(r"[()]", "", line) for line in lines)


def by_reading(heads: str, row: str, part: str = ",") -> str:
    """One row a reading; ``row`` is formatted with target, cycle, direction, deviation in µm and position in mm."""
    lines = [heads]
    for way, values in (("forward", FORWARD), ("reverse", REVERSE)):
        for (i, c), um in np.ndenumerate(values):
            lines.append(row.format(t=TARGETS[i], c=c + 1, way=way, um=um, at=TARGETS[i] + um / 1000.0, s=part))
    return "\n".join(lines)


def aligned(text: str) -> str:
    """As laser software prints it: right below the heads, with a rule between."""
    first, *lines = ["".join(f"{cell:>16}" for cell in line.split(";")) for line in text.split("\n")]
    return "\n".join([first, "-" * len(first), *lines])


def heads_in_two_rows() -> str:
    """As a spreadsheet with merged cells is read."""
    lines = [
        "Test of 3 May;;;;",
        ";;;;",
        "Position [mm];forward [µm];;reverse [µm];",
        ";1;2;1;2",
        *(f"{t:g};{FORWARD[i, 0]};{FORWARD[i, 1]};{REVERSE[i, 0]};{REVERSE[i, 1]}" for i, t in enumerate(TARGETS)),
    ]
    return "\n".join(lines)


def beside(above: str, heads: str) -> str:
    """A half for each direction, with targets of its own, in the order in which they were approached."""
    lines = [above, heads]
    for i, j in zip(range(len(TARGETS)), range(len(TARGETS))[::-1], strict=True):
        lines.append(f"{TARGETS[i]};{FORWARD[i, 0]};{FORWARD[i, 1]};;{TARGETS[j]};{REVERSE[j, 0]};{REVERSE[j, 1]}")
    return "\n".join([*lines, "Mean;1;2;;Mean;3;4"])


def on_its_side() -> str:
    """As ISO 230-2 prints it: targets and directions above, a row for each cycle."""
    lines = [["Test of 3 May"], ["Position i"], ["Target position [mm]"], ["Direction"], ["j=1 [µm]"], ["j=2 [µm]"]]
    for i, target in enumerate(TARGETS):
        for way, values in (("↑", FORWARD), ("↓", REVERSE)):
            # Merged over both directions.
            cells = [str(i + 1), f"{target:g}" if way == "↑" else "", way, *map(str, values[i])]
            for line, cell in zip(lines[1:], cells, strict=True):
                line.append(cell)
    lines += [["Mean [µm]", *"123456"], ["2s [µm]", *"123456"]]
    return "\n".join(";".join(line) for line in lines)


def report_by_direction() -> str:
    """Two tables in Markdown; the heading says the direction, and other tables stand around them."""
    lines = ["# Test", "Setting | Value", "--- | --- |", "Cycles | 2", ""]
    for way, values in (("forward", FORWARD), ("backward", REVERSE)):
        lines += [
            f"### Data {way} direction",
            "",
            "i |tgt_pos(i) [mm]|ref_pos(i,1) [mm]|ref_pos(i,2) [mm]|",
            "--- |--- |--- |--- |",
        ]
        lines += [
            f"{i + 1}|{t}|{t + values[i, 0] / 1000:.5f}|{t + values[i, 1] / 1000:.5f}|" for i, t in enumerate(TARGETS)
        ]
        lines += ["", f"#### Deviation {way}", "i |x(i,1) [mm]|x(i,2) [mm]|", "---|---|---|", "1|9|9|", "2|9|9|", ""]
    return "\n".join(lines)


def report_by_target(instruments: tuple[str, ...] = ("Laser",)) -> str:
    """A table for each target, which the heading says; rows below it sum up."""
    lines = []
    for (i, target), name in ((place, name) for place in enumerate(TARGETS) for name in instruments):
        lines += [
            f"## Target position {target:g}, both directions",
            f"Test | {name} 20 Pos [mm] | {name} 20 Neg [mm] | Diff [mm]",
        ]
        lines += ["--- | --- | --- | ---"]
        lines += [
            f"{c + 1} | {target + FORWARD[i, c] / 1000:.5f} | {target + REVERSE[i, c] / 1000:.5f} | 0" for c in range(2)
        ]
        lines += ["AVG | 1 | 2 | 3", ""]
    return "\n".join(lines)


def by_cycle() -> str:
    lines = ["target_mm;cycle;forward;reverse"]
    for (i, c), um in np.ndenumerate(FORWARD):
        lines.append(f"{TARGETS[i]};{c + 1};{TARGETS[i] + um / 1000.0:.6f};{TARGETS[i] + REVERSE[i, c] / 1000.0:.6f}")
    return "\n".join(lines)


@pytest.mark.parametrize(
    "text",
    [
        report_by_direction(),
        report_by_target(),
        by_cycle(),
        by_cycle().replace("cycle;", ";").replace(";1;", ";;").replace(";2;", ";;").replace(";;", ";"),
        by_reading("target_mm,cycle,direction,position_mm", "{t},{c},{way},{at:.6f}"),
        by_reading("direction,position_mm,cycle,target_mm", "{way},{at:.6f},{c},{t}"),
        by_reading("target_mm,cycle,direction,error_um", "{t},{c},{way},{um}"),
        by_reading("Richtung,Messreihe,Sollposition [mm],Istposition [mm]", "{way},{c},{t},{at:.6f}"),
        by_reading("sens,Position mesurée [mm],série,Position [mm]", "{way},{at:.6f},{c},{t}"),
        # A head that says position, in a unit that elsewhere says deviation.
        wide("actual {way} {c} um", 1e6, True),
        wide("{way} {c} mm", 1000.0, False),
        heads_in_two_rows(),
        beside("Forward;;;;Backward;;", "Target [mm];Run 1 [µm];Run 2 [µm];;Target [mm];Run 1 [µm];Run 2 [µm]"),
        beside("Test", "Soll hin;Abw. hin 1;Abw. hin 2;;Soll rück;Abw. rück 1;Abw. rück 2\nmm;µm;µm;;mm;µm;µm"),
        on_its_side(),
        "target;direction;dev 1 [µm];dev 2 [µm]\n"
        + "\n".join(
            f"{t:g};{way};{values[i, 0]};{values[i, 1]}"
            for i, t in enumerate(TARGETS)
            for way, values in (("+", FORWARD), ("-", REVERSE))
        ),
        "Soll Zoll;Richtung;dev 1 [µm];dev 2 [µm]\n"
        + "\n".join(
            f"{t / 25.4:.15g};{way};{values[i, 0]};{values[i, 1]}"
            for i, t in enumerate(TARGETS)
            for way, values in (("+", FORWARD), ("-", REVERSE))
        ),
        "target;direction;dev 1;dev 2\nµm;;mm;mm\n"
        + "\n".join(
            f"{1000 * t:g};{way};{values[i, 0] / 1000};{values[i, 1] / 1000}"
            for i, t in enumerate(TARGETS)
            for way, values in (("+", FORWARD), ("-", REVERSE))
        ),
        "Soll-Ist-Vergleich: Müller\n\n" + wide("{way} {c} um", 1e6, False, ";", ","),
        wide("{way} {c} um", 1e6, False, ";", ",").replace("\n", "\n;;;;\n"),
        wide("{way} {c} [mm]", 1000.0, True),
        wide("dev {way} {c} 1/100 mm", 1e5, False),
        wide("Abw. {way} {c} in 0.0001 in", 1e7 / 25.4, False),
        wide("{way}_{c}", 1000.0, True, ";", ","),
        aligned(wide("{way} {c} [µm]", 1e6, False, ";", ",")),
        aligned(wide("{way} {c} [µm]", 1e6, False, ";")).replace("    ", "\t"),
        wide("{way}{c}_um", 1e6, False, " ").replace("target [mm]", "target_mm"),
        "Laser 4711\n\n"
        + aligned(by_reading("target [mm];cycle;direction;error [µm]", "{t};{c};{way};{um}"))
        + "\n\nend",
        wide("deviation {way} {c} (mm)", 1000.0, False),
        wide("cycle {c} {way} [µm]", 1e6, False),
        wide("run{c} {way} um", 1e6, False, "\t", ","),
        by_reading("target,cycle,direction,error\nmm,,,µm", "{t},{c},{way},{um}"),
        wide("{way} {c} [µm]", 1e6, False, ";") + "\n\nStandardabweichung;1;2;1;2\nReversal B;4\nRemark: cold",
        wide("{way} {c} [µm]", 1e6, False).replace("[µm]\n", "[µm],2s forward [µm],mean rev. 2 [µm]\n"),
        wide("error {way} {c} [microns]", 1e6, False),
        wide("dev [㎛] {way} {c}", 1e6, False),
        wide("Abw. {way} {c} (µin)", 1e9 / 25.4, False),
        long(),
        assigned(),
    ],
)
def test_every_form_gives_the_same_test(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8")
    assert is_position_table(path)
    found = read_position_table(path)
    assert found.target_mm == pytest.approx(TARGETS)
    assert found.forward_um == pytest.approx(FORWARD, abs=2e-3)
    assert found.reverse_um == pytest.approx(REVERSE, abs=2e-3)


@pytest.mark.parametrize(
    "text",
    [
        # A cell is missing; one blank may part digits or words; a row is longer than its heads.
        "Target [mm]   Fwd 1 [um]   Rev 1 [um]\n 0.0   1.0   2.0\n 100.0   1.0\n",
        "Target [mm]   Fwd 1 [um]   Rev 1 [um]\n900   1.0   2.0\n1 000   2.0\n",
        "Target [mm] Fwd 1 [um] Rev 1 [um]\n0.0 1.0 2.0\n100.0 1.0 2.0\n",
        "Target   Fwd   Rev\n0.0   1.0   2.0   3.0\n100.0   1.0   2.0   3.0\n",
    ],
)
def test_columns_that_blanks_do_not_part_without_doubt_are_none(text: str) -> None:
    assert {len(row) for row in rows_of(text)} == {1}


def test_commas_with_blanks_beside_them_part_the_columns() -> None:
    for text in ("Target [mm],Fwd [um]\n1 000,1.5\n2 000,2.5\n", "a , b , c\n0 ,1 ,2\n3 ,4 ,5\n", "a, b\n0, 1\n2, 3\n"):
        assert [len(row) for row in rows_of(text)] == [text.count(",") // 3 + 1] * 3


@pytest.mark.parametrize(
    ("text", "largest", "first"),
    [
        ("Soll [mm];F1 [µm];R1 [µm]\n800;0,5;3,1\n1.000;1,5;3\n1.200;2;4,5\n", 1200.0, 0.5),
        ("Soll [mm];F1;R1\n800;800,0005;800,003\n1.000;1000,0015;1000,003\n1.200;1200,002;1200,005\n", 1200.0, 0.5),
        ("Target [mm]\tF1 [µm]\tR1 [µm]\n800\t0.5\t3.1\n1,000\t1.5\t3\n1,200\t2\t4.5\n", 1200.0, 0.5),
        ("Soll [mm];F1 [µm];R1 [µm]\n1.000;0,5;3,1\n2.500;1,5;3\n3.000;2;4,5\n", 3000.0, 0.5),
        # Three decimals are no group where whole numbers have none beside them.
        ("Target [mm]\tF1 [µm]\tR1 [µm]\n0.5\t0.5\t3.1\n1.125\t1.5\t3\n1.200\t2\t4.5\n", 1.2, 0.5),
        ("Soll [mm];F1 [µm];R1 [µm]\n1.125;0,5;3,1\n1.200;2;4,5\n", 1.2, 0.5),
    ],
)
def test_whole_numbers_in_groups_are_told_from_decimals(
    tmp_path: Path, text: str, largest: float, first: float
) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8")
    found = read_position_table(path)
    assert found.target_mm[-1] == pytest.approx(largest)
    assert found.forward_um[0, 0] == pytest.approx(first)


@pytest.mark.parametrize(
    ("text", "got"),
    [
        ("target,forward 1,reverse 1\n0,1,2\n10,x,3\n", "x"),
        ("target,forward 1,reverse 1\n0,1,2\n5,1,2\n0,1,3\n", "forward, cycle 1, 0 mm"),
        ("target,forward 1,reverse 1\n0,1,2\n", "1 targets"),
        ("target,direction,actual\n0,sideways,2\n", "sideways"),
        ("TGT_DATA[1]=0\nREF_DATA_FWD[2,1]=3\n", "number 2"),
        ("target,forward 1,reverse 999999\n0,1,2\n1,1,2\n", "reverse 999999"),
        ("axis,target,direction,actual\nX,0,+,0\nX,1,+,1\nY,0,+,0\nY,1,+,1\n", "X, Y"),
        # What is a unit, and not one that is known, is not millimetres; deviations may be in any.
        ("target [mm],error forward 1 [1/10 µm],error reverse 1 [1/10 µm]\n0,1,2\n10,3,4\n", "[1/10 µm]"),
        ('target ("),forward 1 ("),reverse 1 (")\n0,1,2\n10,11,12\n', 'target (")'),
        ("target [Grad],forward 1 [mrad],reverse 1 [mrad]\n0,1,2\n10,11,12\n", "[Grad]"),
        ("all in µm\ntarget,deviation forward 1,deviation reverse 1\n0,1,2\n10,3,4\n", "deviation forward 1"),
        ("target,direction,cycle,deviation\n0,+,1,2\n10,+,1,3\n", "deviation"),
        # Deviations in µm, of which nothing says so.
        ("target,F1,R1\n0,0.1,4\n100,1,5\n200,2,6.2\n300,3,7\n", "5 mm at a target of 300 mm"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_place(tmp_path: Path, text: str, got: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8")
    assert got in str(refusal(path).got)


def test_targets_below_zero_on_their_side_are_no_way_back(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("Ziel;-10;-5;0\nhin 1 [µm];1;2;3\nrück 1 [µm];4;5;6\n", encoding="utf-8")
    found = read_position_table(path)
    assert (found.target_mm.tolist(), found.reverse_um[:, 0].tolist()) == ([-10.0, -5.0, 0.0], [4.0, 5.0, 6.0])


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=300))
def test_no_file_ends_in_anything_but_a_refusal(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.mktemp("any") / "a.csv"
    path.write_bytes(b"target,forward 1,reverse 1\n" + content)
    if is_position_table(path):
        with suppress(InputError):
            read_position_table(path)


def test_the_page_is_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    page = (ROOT / "docs/how-to/positioning-table.md").read_text(encoding="utf-8")
    table, command, told, *_ = re.findall(r"```(?:csv title=\"axis-x.csv\"|sh|text)\n(.*?)```", page, re.S)
    (tmp_path / "axis-x.csv").write_text(table, encoding="utf-8")
    done = CliRunner().invoke(app, command.split()[1:], catch_exceptions=False)
    assert done.exit_code == 0
    assert told.strip() in done.output
    assert "R is" in done.output
    (listed,) = re.findall(r"`dtwin (ingest axis-x.csv [^`]*)`", page)
    assert CliRunner().invoke(app, listed.split(), catch_exceptions=False).exit_code == 0
    assert "5 runs" in CliRunner().invoke(app, ["check", "axis-x"], catch_exceptions=False).output


@pytest.mark.parametrize(
    ("cells", "part"),
    [(("1.000,0000", "1.200,0100", "1.400,0200"), ";"), (('"1,000.0000"', '"1,200.0100"', '"1,400.0200"'), ",")],
)
def test_digits_in_groups_are_told_by_both_signs_in_one_number(
    tmp_path: Path, cells: tuple[str, ...], part: str
) -> None:
    path = tmp_path / "a.csv"
    heads = part.join(("target mm", "cycle", "direction", "actual mm"))
    rows = [part.join((cell, "1", way, cell)) for way in ("forward", "reverse") for cell in cells]
    path.write_text("\n".join([heads, *rows]), encoding="utf-8")
    found = read_position_table(path)
    assert found.target_mm == pytest.approx([1000.0, 1200.01, 1400.02])
    assert np.abs(found.forward_um).max() < 1e-6


def test_what_was_not_read_is_left_out_and_what_is_no_number_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    text = by_reading("target_mm,cycle,direction,error_um", "{t},{c},{way},{um}")
    for word in ("", "NaN", "-", "n/a"):
        path.write_text(text.replace(",2.5\n", f",{word}\n"), encoding="utf-8")
        assert np.isnan(read_position_table(path).forward_um[1, 1])
    for word in ("inf", "fehlt", "1e99"):
        path.write_text("Axis X\n\n" + text.replace(",2.5\n", f",{word}\n"), encoding="utf-8")
        with pytest.raises(InputError, match="not a number") as refused:
            read_position_table(path)
        assert "row 4 below the heads" in str(refused.value.where)
    path.write_text("Target [mm],Direction,Error [µm]\n0,+,1\n,-,2\n9,+,1\n,-,2\n", encoding="utf-8")
    with pytest.raises(InputError, match="merged cells"):
        read_position_table(path)


@pytest.mark.parametrize("sign", ["correction", "Korrektur", "nominal-actual", "soll - ist"])
def test_a_column_of_the_opposite_sign_is_no_deviation(tmp_path: Path, sign: str) -> None:
    path = tmp_path / "x.csv"
    heads = ",".join(f"{way} {n} {sign} [µm]" for n in (1, 2) for way in ("forward", "reverse"))
    path.write_text(f"target [mm],{heads}\n" + "".join(f"{t},1,2,3,4\n" for t in (0, 100, 200)), encoding="utf-8")
    assert refusal(path).code == "position_table.sign"


@pytest.mark.parametrize(
    "head", ["deviation {n} {way}, temperature compensated [µm]", "error {way} {n} after compensation [µm]"]
)
def test_what_was_compensated_is_a_deviation_still(tmp_path: Path, head: str) -> None:
    path = tmp_path / "x.csv"
    heads = ";".join(head.format(n=n, way=way) for n in (1, 2) for way in ("forward", "reverse"))
    rows = "".join(f"{t};1;2;3;4\n" for t in (0, 100, 200))
    path.write_text(f"Ball screw pitch 10 mm\ntarget [mm];{heads}\n{rows}", encoding="utf-8")
    assert read_position_table(path).forward_um[0].tolist() == [1.0, 3.0]


def test_a_table_whose_title_is_of_another_test_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    table = (
        "target [mm],forward 1 [µm],reverse 1 [µm],forward 2 [µm],reverse 2 [µm]\n0,1,2,3,4\n100,1,2,3,4\n200,1,2,3,4\n"
    )
    path.write_text(f"Straightness test\n{table}", encoding="utf-8")
    assert refusal(path).code == "position_table.test"
    path.write_text(f"Linear positioning test\n{table}", encoding="utf-8")
    assert read_position_table(path).target_mm.tolist() == [0.0, 100.0, 200.0]


def test_angles_are_not_taken_for_lengths(tmp_path: Path) -> None:
    path = tmp_path / "c-axis.csv"
    for heads in ("target_deg,cycle,direction,position_deg", "target [°],cycle,direction,error [arcsec]"):
        path.write_text(by_reading(heads, "{t},{c},{way},{at:.6f}"), encoding="utf-8")
        assert refusal(path).code == "position_table.unit"


def test_targets_that_not_every_run_read_are_said_to_be_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    lines = by_reading("target_mm,cycle,direction,error_um", "{t},{c},{way},{um}").splitlines()
    path.write_text("\n".join(line for line in lines if not line.startswith("100.0,2,")), encoding="utf-8")
    said = CliRunner().invoke(app, ["check", str(path), "--axis", "X", "--machine", "m"])
    assert "1 target is not evaluated" in said.output


@pytest.mark.parametrize(("shift_um", "told"), [(250.0, True), (-4000.0, True), (3.0, False)])
def test_a_zero_that_is_off_is_a_datum_and_changes_no_figure(tmp_path: Path, shift_um: float, told: bool) -> None:
    def checked(shift: float) -> dict[str, Any]:
        rng = np.random.default_rng(8)
        lines = ["target_mm,cycle,direction,error_um"]
        for c, way, target in ((c, w, t) for c in range(5) for w in ("forward", "reverse") for t in (0, 40, 80)):
            lines.append(f"{target},{c + 1},{way},{shift + 0.5 * rng.standard_normal() - 2.0 * (way == 'reverse'):.4f}")
        path = tmp_path / f"a{shift:g}.csv"
        path.write_text("\n".join(lines), encoding="utf-8")
        said = CliRunner().invoke(app, ["check", str(path), "--axis", "X", "--machine", "m", "--json"])
        found: dict[str, Any] = json.loads(said.stdout)
        return found

    plain, off = checked(0.0), checked(shift_um)
    assert [f["code"] for f in off["findings"]] == (["linear.datum"] if told else [])
    figures = off["positioning"]["iso_230_2"]
    assert figures == pytest.approx(plain["positioning"]["iso_230_2"], abs=1e-3)


def test_a_datum_is_told_of_a_test_in_one_direction_too(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("target [mm],actual [mm]\n" + "\n".join(f"{t},{t - 0.2 + t / 1e6}" for t in range(0, 100, 10)))
    found = check_source(path, told={"axis": "X", "machine": "m"})["findings"]
    (datum,) = (f for f in found if f["code"] == "linear.datum")
    assert datum["numbers"]["shift_um"] == pytest.approx(-199.955)


def test_directions_that_share_no_target_are_told_as_that_and_not_as_readings_that_are_missing(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{t + 0.2 * (way == '-')},{way},1.0" for _ in range(3) for way in "+-" for t in (15, 25, 35)]
    path.write_text("\n".join(["target [mm],direction,deviation [µm]", *rows]), encoding="utf-8")
    (run, *_) = check_source(path, told={"axis": "X", "machine": "m"})["runs"]
    (told,) = (f for f in run["findings"] if f["severity"] == "error")
    assert told["code"] == "linear.other_targets"
    assert "forward 15, 25 … mm, reverse 15.2, 25.2 … mm" in told["message"]


def test_a_report_of_two_instruments_is_refused_with_a_way_out(tmp_path: Path) -> None:
    path = tmp_path / "report.md"
    path.write_text(report_by_target(("Laser", "Encoder")), encoding="utf-8")
    refused = refusal(path)
    assert (refused.code, refused.got) == ("position_table.instruments", "Encoder, Laser")


@pytest.mark.parametrize(
    ("stated", "severity", "said"),
    [
        ("", None, ""),
        ("**B = 0.004 [mm]**\n\n**M = 0.0055 [mm]**", "info", "B, M as here"),
        ("E = 5.50 µm", "info", "E 5.5 µm is of another formula than the standard's, which gives 9.5 µm"),
        ("B = 0.0047 [mm]", "warning", "B is stated as 4.7 µm, and its readings give 4 µm"),
    ],
)
def test_figures_that_a_report_states_are_compared(
    tmp_path: Path, stated: str, severity: str | None, said: str
) -> None:
    path = tmp_path / "report.md"
    path.write_text(f"{report_by_direction()}\n{stated}\n", encoding="utf-8")
    runs, _ = read_position_runs(path, Campaign("a", "m", "linear", "", {}), {})
    found = [finding for finding in runs[0].findings if finding.code == "linear.stated_figures"]
    assert [finding.severity for finding in found] == ([severity] if severity else [])
    if found:
        assert said in found[0].message
        checked = CliRunner().invoke(app, ["check", str(path), "--axis", "X", "--machine", "m"])
        assert said in checked.output


def test_what_was_read_is_no_channel_of_its_own_error(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(by_cycle(), encoding="utf-8")
    runs, _ = read_position_runs(path, Campaign("a", "m", "linear", "", {}), {})
    targets = np.linspace(0.0, 80.0, 5)
    samples = {
        "position_mm": np.tile(targets, 2),
        "direction": np.repeat(np.array(["forward", "reverse"], dtype=object), 5),
        "error_um": np.arange(10.0),
        "read_mm": np.tile(targets, 2),
        "oil_c": np.full(10, 20.0),
    }
    run = Run(RunMeta("1", kind="linear", condition={"axis": "X"}), samples)
    _, rows = stroke_rows([run], [0.0])
    assert "read_mm" in runs[0].samples
    assert "oil_c" in rows[0].columns
    assert "read_mm" not in rows[0].columns


@pytest.mark.parametrize(
    ("target", "forward", "reverse"),
    [
        ("Posizione [mm]", "Andata {} [µm]", "Ritorno {} [µm]"),
        ("Cible (mm)", "Écart aller {} (µm)", "Écart retour {} (µm)"),
        ("Posición [mm]", "Ida {} [µm]", "Vuelta {} [µm]"),
        ("目标位置(mm)", "正向{}(μm)", "反向{}(μm)"),
        ("目標位置[mm]", "往路{}[μm]", "復路{}[μm]"),
        ("Target [mm]", "Run {} + [µm]", "Run {} - [µm]"),
    ],
)
def test_directions_in_other_languages_and_signs_before_units(
    tmp_path: Path, target: str, forward: str, reverse: str
) -> None:
    path = tmp_path / "a.csv"
    heads = [target, *(form.format(n) for n in (1, 2) for form in (forward, reverse))]
    path.write_text("\n".join([",".join(heads), *(f"{100 * n},{n},5,{n},5" for n in range(5))]), encoding="utf-8")
    found = read_position_table(path)
    assert found.forward_um.T.tolist() == [[0, 1, 2, 3, 4]] * 2
    assert set(found.reverse_um.ravel()) == {5.0}


@pytest.mark.parametrize(
    "heads", ["i,Xi [mm]", "#,Target [mm]", "Pos No.,Nominal (mm)", "Point Nr,P_i [mm]", "Nr.,Position"]
)
def test_a_column_that_counts_is_no_target(tmp_path: Path, heads: str) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{n + 1},{100 * n},{n},5,{n},5" for n in range(5)]
    path.write_text("\n".join([f"{heads},fwd 1 [µm],rev 1 [µm],fwd 2 [µm],rev 2 [µm]", *rows]), encoding="utf-8")
    assert read_position_table(path).target_mm.tolist() == [0, 100, 200, 300, 400]
    rows = [f"{n + 1},{100 * n},{way},5" for way in ("+", "-") for n in range(5)]
    path.write_text("\n".join([f"{heads},Direction,Error [µm]", *rows]), encoding="utf-8")
    assert read_position_table(path).target_mm.tolist() == [0, 100, 200, 300, 400]


def test_heads_of_another_test_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("Position [mm],Straightness 1 + [µm],Straightness 1 - [µm]\n0,1,2\n100,1,2\n", encoding="utf-8")
    with pytest.raises(InputError, match="no test of positioning"):
        read_position_table(path)


@pytest.mark.parametrize(("one", "point"), [("1", "."), ("1.0000", "."), ("1,0", ",")])
def test_directions_as_one_and_minus_one(tmp_path: Path, one: str, point: str) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{100 * n};{way};1;{n if way == one else 5}{point}0" for way in (one, f"-{one}") for n in range(5)]
    path.write_text("\n".join(["Target;Direction;Cycle;Deviation [µm]", *rows]), encoding="utf-8")
    found = read_position_table(path)
    assert found.forward_um.ravel().tolist() == [0, 1, 2, 3, 4]
    path.write_text(path.read_text("utf-8").replace(f";-{one};", ";2;"), encoding="utf-8")
    with pytest.raises(InputError, match="without a direction"):
        read_position_table(path)


def test_temperatures_beside_readings_are_neither_angles_nor_readings(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    heads = "Target [mm],Fwd 1 [µm],Rev 1 [µm],Fwd temp 1 [°C],Temp 2 [°C]"
    path.write_text("\n".join([heads, *(f"{100 * n},{n},5,20,21" for n in range(5))]), encoding="utf-8")
    found = read_position_table(path)
    assert (found.forward_um.ravel().tolist(), found.reverse_um.ravel().tolist()) == ([0, 1, 2, 3, 4], [5] * 5)


@pytest.mark.parametrize("heads", ["Target,Fwd,Rev,Fwd,Rev\nmm,µm,µm,µm,µm", "Target [mm],+ [µm],- [µm],+ [µm],- [µm]"])
def test_cycles_that_are_not_numbered_are_counted(tmp_path: Path, heads: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text("\n".join([heads, *(f"{100 * n},{n},5,{n + 1},6" for n in range(5))]), encoding="utf-8")
    found = read_position_table(path)
    assert found.forward_um.T.tolist() == [[0, 1, 2, 3, 4], [1, 2, 3, 4, 5]]
    assert found.reverse_um[0].tolist() == [5, 6]
    # A place and a deviation of each way are no two cycles, and the first row is no second row of heads.
    path.write_text("Target,Place fwd,Dev fwd,Place rev,Dev rev\n-5,0,1,0,2\n100,100,1,100,2\n", encoding="utf-8")
    with pytest.raises(InputError, match="no known form"):
        read_position_table(path)


@pytest.mark.parametrize(
    "heads",
    [
        "Position;Zyklus 1;;Zyklus 2;\n;hin;rück;hin;rück\nmm;µm;µm;µm;µm",
        "Zeit;Luft;Soll;hin 1;rück 1;hin 2;rück 2\nhh:mm:ss;°C;mm;µm;µm;µm;µm",
    ],
)
def test_a_row_of_units_below_merged_heads_and_of_more_than_lengths(tmp_path: Path, heads: str) -> None:
    path = tmp_path / "a.csv"
    before = "08:00:01;20,5;" if heads.startswith("Zeit") else ""
    path.write_text("\n".join([heads, *(f"{before}{100 * n};{n};5;{n + 1};6" for n in range(5))]), encoding="utf-8")
    found = read_position_table(path)
    assert found.forward_um.T.tolist() == [[0, 1, 2, 3, 4], [1, 2, 3, 4, 5]]
    assert found.reverse_um[0].tolist() == [5, 6]


UP, DOWN = [0.0, 50.0, 100.0], [100.0, 50.0, 0.0]


@pytest.mark.parametrize(
    ("targets", "ways"),
    [
        ([*UP, *DOWN, *UP, *DOWN], "forward reverse"),
        ([*UP, *UP], "forward"),
        ([*DOWN, *DOWN, *DOWN], "reverse"),
        ([0.0, 100.0, 0.0, 100.0], ""),
        ([0.0, 0.0, 0.0, 50.0, 50.0, 50.0], ""),
        ([100.0] * 8, ""),
    ],
)
@pytest.mark.parametrize("order", [1, -1], ids=["oldest first", "newest first"])
def test_directions_that_are_not_named_are_told_by_the_order_of_targets(
    tmp_path: Path, targets: list[float], ways: str, order: int
) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{n};{t:g};{t + 0.001:g};6000" for n, t in enumerate(targets)][::order]
    path.write_text("\n".join(["Time [s];Commanded [mm];Measured [mm];Feed [mm/min]", *rows]), encoding="utf-8")
    campaign = Campaign(name="c", machine="m", kind="linear")
    if not ways:
        with pytest.raises(InputError, match=r"from which side|one target"):
            read_position_runs(path, campaign, {})
        return
    runs, _ = read_position_runs(path, campaign, {})
    assert {str(way) for run in runs for way in run.samples["direction"]} == set(ways.split())
    assert sum(run.n_samples for run in runs) == len(targets)
    assert all("linear.direction_assumed" in [f.code for f in run.findings] for run in runs)


@pytest.mark.parametrize("step_s", [0.02, 20.0])
def test_a_motion_that_a_control_recorded_is_no_positioning_test(tmp_path: Path, step_s: float) -> None:
    path = tmp_path / "a.csv"
    rows = [
        f"{step_s * n:.2f},{z:.3f},{z - 0.01:.3f}" for n, z in enumerate(map(float, [*range(15), *range(14, -1, -1)]))
    ]
    path.write_text("\n".join(["time [s],target [mm],actual [mm]", *rows]), encoding="utf-8")
    if step_s > 1.0:
        assert len(read_position_runs(path, Campaign(name="c", machine="m", kind="linear"), {})[0]) == 1
        return
    refused = refusal(path)
    assert (refused.code, refused.got) == ("position_table.recorded", "30 rows, one each 0.02 s")


@pytest.mark.parametrize("head", ["Messung 1 [mm]", "1 [mm]"])
def test_columns_of_cycles_without_a_direction_are_asked_for_it(tmp_path: Path, head: str) -> None:
    path = tmp_path / "a.csv"
    heads = f"Soll [mm];{head};{head.replace('1', '2')}"
    path.write_text(f"{heads}\n0;0,001;0,002\n9;9,001;9,002\n", encoding="utf-8")
    assert is_position_table(path)
    refused = refusal(path)
    assert (refused.code, refused.got) == ("position_table.direction", head)


def test_deviations_go_before_the_positions_beside_them(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    heads = "Soll [mm],Ist hin 1 [mm],Ist rück 1 [mm],Abw. hin 1 [µm],Abw. rück 1 [µm]"
    path.write_text("\n".join([heads, *(f"{100 * n},{100 * n},{100 * n},{n},5" for n in range(5))]), encoding="utf-8")
    found = read_position_table(path)
    assert (found.by_position, found.forward_um.ravel().tolist()) == (False, [0, 1, 2, 3, 4])


def test_what_is_written_between_and_below_the_targets_is_none(tmp_path: Path) -> None:
    heads, *rows = wide("{way} {c} [µm]", 1e6, False, ";").splitlines()
    path = tmp_path / "axis.csv"
    path.write_text("\n".join([heads, rows[0], heads, ";;;;", *rows[1:], "A;;7,5", "E;6,5;;;", "checked by nobody;;"]))
    table = read_position_table(path)
    assert table.target_mm.tolist() == TARGETS.tolist()
    assert np.allclose(table.forward_um, FORWARD)


def in_blocks(title: str, heads: str, once: bool = False) -> str:
    """As VDI/DGQ 3441 prints: a block for each sweep; ``once``: heads stand above all of them."""
    lines = ["Positioniergenauigkeit", *([heads] if once else [])]
    for c in range(2):
        for way, values, order in (("vorwärts", FORWARD, 1), ("rückwärts", REVERSE, -1)):
            lines += [title.format(c=c + 1, way=way), *([] if once else ["20,1 °C", heads])]
            lines += [f"{TARGETS[i]:g};{values[i, c]:g}".replace(".", ",") for i in range(3)[::order]]
            lines += [f"Mittelwert;{values[:, c].mean():g}".replace(".", ","), ""]
    return "\n".join(lines)


def marked(row: str, heads: str, up: str, down: str) -> str:
    """Targets that tell their direction themselves."""
    lines = [
        row.format(t=f"{TARGETS[i]:g}{up if values is FORWARD else down}", a=values[i, 0], b=values[i, 1])
        for values in (FORWARD, REVERSE)
        for i in range(3)
    ]
    return "\n".join([heads, *lines])


def in_cycles(title: str) -> str:
    """A block a cycle, both directions beside each other."""
    lines = []
    for c in range(2):
        lines += [title.format(c + 1), "Zielpunkt Nr.;Soll [mm];hin [µm];rück [µm]"]
        lines += [f"{i + 1};{TARGETS[i]:g};{FORWARD[i, c]};{REVERSE[i, c]}" for i in range(3)]
    return "\n".join(lines)


def by_direction() -> str:
    """A table for each direction, a column of positions for each run."""
    lines = []
    for way, values in (("Forward", FORWARD), ("Reverse", REVERSE)):
        lines += [way, "Target [mm],Run 1 [mm],Run 2 [mm]"]
        lines += [f"{t:g},{t + um[0] / 1e3:.4f},{t + um[1] / 1e3:.4f}" for t, um in zip(TARGETS, values, strict=True)]
    return "\n".join(lines)


BY_SWEEP = {
    "blocks of a cycle": in_cycles("Messreihe {}"),
    "runs below directions": by_direction(),
    "blocks": in_blocks("Messreihe {c} {way}", "Sollposition [mm];Abweichung [µm]"),
    "units below": in_blocks("Series {c} {way};", "Soll;Abweichung\nmm;µm"),
    "without numbers": in_blocks("{way}", "Sollposition [mm];Abweichung [µm]"),
    "heads once": in_blocks("Messreihe {c} {way}", "Sollposition [mm];Abweichung [µm]", once=True),
    "signs": marked("{t},{a}\n{t},{b}", "Target [mm],Deviation [µm]", "+", "-"),
    "arrows": marked("{t};{a};{b}", "Soll [mm];Messung 1 [µm];Messung 2 [µm]", " ↑", " ↓"),
    "words": marked("{t};{a};{b}", "Soll;Messung 1 [µm];Messung 2 [µm]", " mm vor", " mm rück"),
}


@pytest.mark.parametrize("text", BY_SWEEP.values(), ids=BY_SWEEP.keys())
def test_titles_of_blocks_and_targets_may_tell_the_direction(tmp_path: Path, text: str) -> None:
    path = tmp_path / "axis.csv"
    path.write_text(text, encoding="utf-8")
    assert is_position_table(path)
    table = read_position_table(path)
    assert table.target_mm.tolist() == TARGETS.tolist()
    assert np.allclose(table.forward_um, FORWARD)
    assert np.allclose(table.reverse_um, REVERSE)
    assert [rows for _, rows in understand(path, Home(tmp_path / "home"), {"axis": "X"}, {}).runs] == [6, 6]


@pytest.mark.parametrize("title", ["Before compensation,After compensation", "Forward before,Forward after"])
def test_blocks_before_and_after_a_change_are_not_cycles_of_one_test(tmp_path: Path, title: str) -> None:
    rows = [f"{t:g},{um[0]},{um[1]}" for t, um in zip(TARGETS, FORWARD, strict=True)]
    for heads in ("Target [mm],fwd [µm],rev [µm]", "Target [mm],Deviation [µm],Air [°C]"):
        lines = [line for name in title.split(",") for line in (name, heads, *rows)]
        path = tmp_path / "axis.csv"
        path.write_text("\n".join(lines), encoding="utf-8")
        with pytest.raises(InputError):
            read_position_table(path)


def test_readings_above_the_first_title_of_a_direction_are_not_dropped(tmp_path: Path) -> None:
    text = in_blocks("Messreihe {c} {way}", "Sollposition [mm];Abweichung [µm]")
    path = tmp_path / "axis.csv"
    path.write_text(text.split("°C\n", 1)[1], encoding="utf-8")
    with pytest.raises(InputError):
        read_position_table(path)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("Axis: C\nTarget,fwd 1,rev 1\n0,0.001,0.002\n90,90.001,90.002", "position_table.axes"),
        ("Einheit: µm\nSoll;hin 1;rück 1\n0;1;2\n50000;50001;50002", "position_table.unit"),
        ("Soll;hin 1;rück 1\n0;1;2\n500000;500001;500002", "position_table.unit"),
        ("Target [mm],Target - measured fwd 1 [µm],Target - measured rev 1 [µm]\n0,1,2\n9,2,3", "position_table.sign"),
        ("Target [mm],from + 1 [µm],from - 1 [µm]\n0,1,2\n9,2,3", "position_table.side"),
        ("target_mm,direction,error_um,error_um\n0,forward,1,5\n9,forward,2,7", "position_table.twice"),
        ("target_mm,target_mm,direction,error_um\n0,0,forward,1\n8,9,forward,2", "position_table.twice"),
        ("Error = target - actual\nTarget [mm],fwd 1 [µm],rev 1 [µm]\n0,1,2\n9,2,3", "position_table.sign"),
        ("Error = target - laser\nTarget [mm],fwd 1 [µm],rev 1 [µm]\n0,1,2\n9,2,3", "position_table.sign"),
        ("Error = machine - laser\nTarget [mm],fwd 1 [µm],rev 1 [µm]\n0,1,2\n9,2,3", "position_table.sign"),
        ("Target [mm],encoder-laser fwd 1 [µm],encoder-laser rev 1 [µm]\n0,1,2\n9,2,3", "position_table.sign"),
        ("Target Ø [mm],fwd 1 [µm],rev 1 [µm]\n0,1,2\n9,2,3", "position_table.diameter"),
        ("Soll-Durchmesser [mm],hin 1 [µm],rück 1 [µm]\n0,1,2\n9,2,3", "position_table.diameter"),
        ("Target,fwd 1 (arc sec),rev 1 (arc sec)\n0,1,2\n90,2,3", "position_table.unit"),
        ("All dimensions in inches\nTarget,fwd 1,rev 1\n0,0.001,0.002\n9,9.001,9.002", "position_table.unit"),
        ("Accuracy of the Y axis\nTarget,fwd 1,rev 1\n0,0.001,0.002\n9,9.001,9.002", "position_table.axes"),
        ("# error: commanded minus measured\nTarget [mm],fwd 1 [µm],rev 1 [µm]\n0,1,2\n9,2,3", "position_table.sign"),
        ("consigne - mesure\nCible [mm],aller 1 [µm],retour 1 [µm]\n0,1,2\n9,2,3", "position_table.sign"),
        ("Target [mm],corr fwd 1 [µm],corr rev 1 [µm]\n0,1,2\n9,2,3", "position_table.sign"),
        ("Target [mm],torque fwd 1 [Nm],torque rev 1 [Nm]\n0,1,2\n9,2,3", "position_table.unit"),
        ("Target,fwd 1,rev 1\nmm,Nm,Nm\n0,1,2\n9,2,3", "position_table.unit"),
        ("Soll counts;hin 1;rück 1\n0;1;2\n9;10;11", "position_table.unit"),
        ("Alle Werte in 1/100 mm\nSoll;hin 1;rück 1\n0;1;2\n9;10;11", "position_table.unit"),
        ("Achse;Y\nSoll [mm];hin 1 [µm];rück 1 [µm]\n0;1;2\n9;2;3", "position_table.axes"),
        ("Soll Y [mm];hin 1 [µm];rück 1 [µm]\n0;1;2\n9;2;3", "position_table.axes"),
        ("Vorzeichen;invertiert\nSoll [mm];hin 1 [µm];rück 1 [µm]\n0;1;2\n9;2;3", "position_table.sign"),
        ("Target [mm],cmd-act fwd 1 [µm],cmd-act rev 1 [µm]\n0,1,2\n9,2,3", "position_table.sign"),
        ("Target [mm],|fwd 1| [µm],|rev 1| [µm]\n0,1,2\n9,2,3", "position_table.form"),
        ("Target [mm],fwd 1 [µm],rev 1 [µm]\n0,1_5,2\n9,2,3", "position_table.number"),
        # The targets stand below heads of directions, and what was measured below ones of positions.
        (
            "Andata: target [mm],Posizione misurata 1 [mm],Ritorno: target [mm],Posizione misurata 1 [mm]\n0,1,0,2\n9,10,9,11",
            "position_table.form",
        ),
    ],
)
def test_what_would_be_read_as_millimetres_of_another_axis_or_unit_is_refused(
    tmp_path: Path, text: str, code: str
) -> None:
    path = tmp_path / "axis.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as refused:
        read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "X"}})
    assert refused.value.code == code


def test_targets_in_groups_of_digits_and_signs_in_brackets(tmp_path: Path) -> None:
    path = tmp_path / "axis.csv"
    heads = "Soll [mm];Lauf 1 (+) [µm];Lauf 2 (-) [µm];Lauf 3 (+) [µm];Lauf 4 (-) [µm]"
    path.write_text(f"Unit: mm\n{heads}\n0;1;5;2;6\n500;1;5;2;6\n1.000;1;5;2;6\n1.500;1;5;2;6", encoding="utf-8")
    table = read_position_table(path)
    assert table.target_mm.tolist() == [0.0, 500.0, 1000.0, 1500.0]
    assert (table.forward_um[0].tolist(), table.reverse_um[0].tolist()) == ([1.0, 2.0], [5.0, 6.0])
    path.write_text('target [mm],fwd 1 [µm],rev 1 [µm]\n0,"1,5","2,25"\n100,"1,500","2"', encoding="utf-8")
    assert read_position_table(path).forward_um.tolist() == [[1.5], [1.5]]


def test_a_minus_behind_every_target_is_no_direction(tmp_path: Path) -> None:
    path = tmp_path / "axis.csv"
    path.write_text("Target [mm],Deviation [um]\n0-,1\n100-,2\n200-,3\n0-,2\n100-,2\n200-,1")
    with pytest.raises(InputError):
        read_position_table(path)


def test_numbers_of_targets_are_no_targets(tmp_path: Path) -> None:
    rows = [f"{i},{t:g},{FORWARD[i, 0]},{REVERSE[i, 0]}" for i, t in enumerate(TARGETS, start=0)]
    upright = ["Target i,Position [mm],forward 1 [µm],reverse 1 [µm]", *rows]
    lying = [",".join(cells) for cells in zip(*(row.split(",") for row in upright), strict=True)]
    for lines in (upright, lying):
        path = tmp_path / "axis.csv"
        path.write_text("\n".join(lines))
        assert read_position_table(path).target_mm.tolist() == TARGETS.tolist()


def test_the_table_of_the_standard_lies_on_its_side_with_targets_over_both_directions(tmp_path: Path) -> None:
    cells = [f"{REVERSE[i, c]},{FORWARD[i, c]}" for c in range(2) for i in range(3)]
    lines = [
        "i,1,,2,,3,",
        "Target position Pi (mm)," + ",".join(f"{t:g}," for t in TARGETS),
        "Approach direction" + ",↓,↑" * 3,
    ]
    lines += [f"Positional deviation (µm) j={c + 1}," + ",".join(cells[3 * c : 3 * c + 3]) for c in range(2)]
    path = tmp_path / "axis.csv"
    path.write_text("\n".join([*lines, "Mean deviation (µm),1,2,3,4,5,6"]))
    table = read_position_table(path)
    assert np.allclose(table.forward_um, FORWARD)
    assert np.allclose(table.reverse_um, REVERSE)


def test_sweeps_that_are_numbered_through_make_cycles(tmp_path: Path) -> None:
    sweeps = [
        ("forward", FORWARD[:, 0]),
        ("reverse", REVERSE[:, 0]),
        ("forward", FORWARD[:, 1]),
        ("reverse", REVERSE[:, 1]),
    ]
    lines = [
        f"{n},{way},{t:g},{um}" for n, (way, of) in enumerate(sweeps, 1) for t, um in zip(TARGETS, of, strict=True)
    ]
    path = tmp_path / "axis.csv"
    path.write_text("\n".join(["Run,Direction,Target (mm),Error (µm)", *lines]))
    table = read_position_table(path)
    assert np.allclose(table.forward_um, FORWARD)
    assert np.allclose(table.reverse_um, REVERSE)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("machine,target [mm],direction,deviation [µm]\nM1,0,+,1\nM1,9,+,2\nM2,0,+,3\nM2,9,+,1", "position_table.axes"),
        (
            "target [mm],Axis 1 fwd [µm],Axis 1 rev [µm],Axis 2 fwd [µm],Axis 2 rev [µm]\n0,1,2,1,2\n9,2,3,2,3",
            "position_table.axes",
        ),
        (
            "target [mm];SN7;;SN8;\n;fwd 1 [µm];rev 1 [µm];fwd 1 [µm];rev 1 [µm]\n0;1;2;1;2\n9;2;3;2;3",
            "position_table.axes",
        ),
        ("target [mm],direction,stage 1 [µm],stage 2 [µm]\n0,+,1,2\n9,+,2,3\n0,-,1,2\n9,-,2,3", "position_table.axes"),
        ("target [mm],direction,reading [mm]\n9,+,9.001\n9,-,9.004\n9,+,9.002\n9,-,9.003", "position_table.one_place"),
        ("target [mm],forward 1 [µm],reverse 1 [µm],target [mm]\n0,1,2,9\n9,2,1,0", "position_table.form"),
    ],
)
def test_readings_of_several_machines_or_targets_in_a_row_are_not_mixed(tmp_path: Path, text: str, code: str) -> None:
    path = tmp_path / "axis.csv"
    path.write_text(text)
    assert refusal(path).code == code


def test_what_the_runs_say_of_slip_stands_beside_what_a_twin_calls_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    rng = np.random.default_rng(0)
    rows = [
        f"{c + 1},{t:g},{way},{-12.5 * c + (4.0 if way == '-' else 0.0) + rng.normal(0.0, 0.3):.2f}"
        for c in range(5)
        for way in "+-"
        for t in np.arange(0.0, 301.0, 50.0)[:: 1 if way == "+" else -1]
    ]
    path = tmp_path / "slips.csv"
    path.write_text("\n".join(["cycle,target [mm],direction,error [µm]", *rows]), encoding="utf-8")

    def told(*words: str) -> str:
        result = CliRunner().invoke(app, list(words))
        assert result.exit_code == 0, result.output
        return result.output

    told("ingest", str(path), "--axis", "X", "--machine", "router")
    told("twin", "fit", "slips", "--effects", "", "--name", "router")
    for verb in ("diagnose", "discover"):
        assert "the runs themselves say: cycles differ: the zero moves by -12.5" in told("twin", verb, "router")
    (found,) = json.loads(told("twin", "diagnose", "router", "--json"))["runs_say"]
    assert found["code"] == "linear.slip"
    # What cannot be kept, as on a full disk, is told all the same, and then that it is not kept.
    kept = max((tmp_path / "home" / "twins" / "router").glob("v*.diagnosis.json"))
    kept.unlink()
    kept.mkdir()
    lost = CliRunner().invoke(app, ["twin", "diagnose", "router"])
    assert (type(lost.exception), "cycles differ" in lost.output) == (StoreError, True)
    kept.rmdir()
    monkeypatch.setattr("dtwin.twins.shelf.os.access", lambda *_: False)
    told("twin", "show", "router", "--html", str(tmp_path / "twin.html"))
    assert "Not diagnosed" not in (tmp_path / "twin.html").read_text()


def report_of_passes(cycles: int = 2, backward: bool = True) -> str:
    """One table for each way, an encoder and a laser beside each other in it, and a single pass of other targets below."""
    lines = ["# motion test"]
    for way, values, off in (("Forward", FORWARD, 0.0), ("Backward", REVERSE, 0.0)):
        lines += [
            f"# {way} sequence",
            "",
            "i (pos id) | Cycle (j) | Tgt Pos [mm] | Encoder Act [mm] | ILD2300 [mm] | Diff [mm]",
        ]
        lines += ["--- | --- | --- | --- | --- | ---"]
        for (i, c), um in np.ndenumerate(values[:, :cycles] + off):
            read = f"{TARGETS[i] + 0.0002:.4f} | {TARGETS[i] + um / 1000.0:.4f} | {um / 1000.0:.4f}"
            lines += [
                f"{i + 1} | {c + 1} | {TARGETS[i]:.3f} | {read}"
                if way == "Forward" or backward
                else f"{i + 1} | {c + 1} | | | |"
            ]
        lines += [""]
    lines += [
        "## Accuracy, Positive Direction",
        "",
        "Test | Setpoint [mm] | Encoder Act [mm] | ILD2300 [mm]",
        "--- | --- | --- | ---",
    ]
    lines += [
        f"{n} | {n * 10}.0 | {n * 10}.0002 | {'Out of range' if n == 1 else f'{n * 10}.0100'}" for n in range(1, 8)
    ]
    return "\n".join([*lines, "Accuracy | - | 0.0002 | 0.0100", ""])


def test_instruments_beside_each_other_are_read_by_their_names(tmp_path: Path) -> None:
    path = tmp_path / "report.md"
    path.write_text(report_of_passes(), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        read_position_table(path)
    assert refused.value.got == "Encoder Act, ILD2300"
    assert refused.value.hint is not None
    assert '--instrument "ILD2300"' in refused.value.hint
    runs, _ = read_position_runs(path, Campaign("c", "m", kind="linear"), {"condition": {"instrument": "ild2300"}})
    assert [round(float(um), 6) for um in runs[0].samples["error_um"]] == [*FORWARD[:, 0], *REVERSE[::-1, 0]]
    told = {f.code: f.message for f in runs[0].findings}
    assert set(told) == {"linear.single_pass", "clock.assumed"}
    assert "Accuracy, Positive Direction" in told["linear.single_pass"]
    with pytest.raises(InputError) as refused:
        read_position_runs(path, Campaign("c", "m", kind="linear"), {"condition": {"instrument": "laser"}})
    assert (refused.value.code, refused.value.got) == ("position_table.instruments", "Encoder Act, ILD2300")


def test_what_the_axis_own_sensor_reads_is_no_accuracy(tmp_path: Path) -> None:
    path = tmp_path / "report.md"
    path.write_text(report_of_passes(backward=False), encoding="utf-8")
    runs, _ = read_position_runs(path, Campaign("c", "m", kind="linear"), {"condition": {"instrument": "Encoder Act"}})
    assert {f.code for f in runs[0].findings} == {"linear.own_sensor", "linear.single_pass", "clock.assumed"}
    assert set(runs[0].samples["direction"]) == {"forward"}


def test_a_single_pass_in_a_file_of_its_own_is_a_test(tmp_path: Path) -> None:
    path = tmp_path / "report.md"
    path.write_text("# " + report_of_passes().partition("## ")[2], encoding="utf-8")
    assert is_position_table(path)
    runs, _ = read_position_runs(path, Campaign("c", "m", kind="linear"), {"condition": {"instrument": "ILD2300"}})
    assert [list(run.samples["position_mm"]) for run in runs] == [[20.0, 30.0, 40.0, 50.0, 60.0, 70.0]]
    assert np.allclose(runs[0].samples["error_um"], 10.0)


def test_an_instrument_is_told_of_a_report_that_names_it_only(tmp_path: Path) -> None:
    path = tmp_path / "plain.csv"
    path.write_text(wide("{way} {c} [um]", 1000.0, False), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        check_source(path, told={"axis": "X", "instrument": "laser"})
    assert (refused.value.code, refused.value.got) == ("position_table.instruments", "a table that names no instrument")
    path.write_text("t_s,angle_deg,deviation_um\n" + "\n".join(f"{n},{n},0.5" for n in range(360)), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        check_source(path, told={"plane": "XY", "radius_mm": 100.0, "feed_mm_min": 1000.0, "instrument": "laser"})
    assert (refused.value.code, refused.value.got) == ("ingest.kind", "instrument laser")


def test_a_drift_that_a_table_without_a_clock_does_not_tell_is_no_number_in_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    file = tmp_path / "axis.csv"
    rows = [(way, cycle, 50.0 * i) for cycle in (1, 2, 3) for way in ("forward", "reverse") for i in range(9)]
    errors = np.random.default_rng(1).normal(0.0, 0.3, len(rows))
    lines = [f"{at},{cycle},{way},{um + 0.01 * at}" for (way, cycle, at), um in zip(rows, errors, strict=True)]
    file.write_text("\n".join(["target_mm,cycle,direction,error_um", *lines]), encoding="utf-8")
    invoked = CliRunner().invoke(app, ["ingest", str(file), "--axis", "X", "--machine", "m"], catch_exceptions=False)
    assert invoked.exit_code == 0, invoked.output
    told = ["twin", "fit", "axis", "--effects", "thermal_drift", "--name", "t"]
    text = CliRunner().invoke(app, told, catch_exceptions=False).stdout
    assert re.search(r"shift x +not told", text), text
    shown = json.loads(CliRunner().invoke(app, [*told, "--json"], catch_exceptions=False).stdout)
    (drift,) = [p for p in shown["parameters"] if p["name"] == "shift_x"]
    assert (drift["value"], drift["uncertainty"], drift["identifiable"]) == (None, None, False)


@pytest.mark.parametrize("numbered", [True, False])
@pytest.mark.parametrize("column", ["position_mm", "error_um"])
def test_targets_that_the_control_measured_are_joined_and_said(tmp_path: Path, numbered: bool, column: str) -> None:
    rng = np.random.default_rng(3)
    heads = ["target_mm", *(["cycle"] if numbered else []), "direction", column]
    lines = [",".join(heads)]
    for c in range(2):
        for way, values in (("forward", FORWARD), ("reverse", REVERSE)):
            for i in range(3):
                target = round(TARGETS[i] + 4e-4 * rng.uniform(-1.0, 1.0), 4)
                value = target + values[i, c] / 1000.0 if column == "position_mm" else values[i, c]
                lines.append(",".join([f"{target:.4f}", *([str(c + 1)] if numbered else []), way, f"{value:.5f}"]))
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    table = read_position_table(path)
    assert table.target_mm == pytest.approx(TARGETS, abs=4e-4)
    assert table.forward_um == pytest.approx(FORWARD, abs=1e-6)
    assert table.reverse_um == pytest.approx(REVERSE, abs=1e-6)
    runs, _ = read_position_runs(path, Campaign("c", "m", "linear"), {})
    assert {f.code for run in runs for f in run.findings} >= {"targets.joined"}


def test_targets_near_each_other_in_one_sweep_are_two(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{t},1,{way},0.0" for way in ("forward", "reverse") for t in (0.0, 0.002, 50.0, 50.002, 100.0)]
    path.write_text("\n".join(["target_mm,cycle,direction,error_um", *rows]), encoding="utf-8")
    assert read_position_table(path).target_mm.tolist() == [0.0, 0.002, 50.0, 50.002, 100.0]


def test_a_table_for_each_direction_below_its_title_is_one_test(tmp_path: Path) -> None:
    path = tmp_path / "slide.csv"
    lines = ["Slide 4, 3 May"]
    for title, values in (("Vorwärts", FORWARD), ("Rückwärts", REVERSE)):
        lines += [title, "Ziel [mm];1 [µm];2 [µm]"]
        lines += [f"{at:g};{a:g};{b:g}".replace(".", ",") for at, (a, b) in zip(TARGETS, values, strict=True)]
    path.write_text("\n".join(lines), encoding="utf-8")
    table = read_position_table(path)
    assert np.allclose(table.forward_um, FORWARD)
    assert np.allclose(table.reverse_um, REVERSE)
    path.write_text("\n".join([*lines, "Geradheit", "Ziel [mm];1 [µm]", "0;1"]), encoding="utf-8")
    with pytest.raises(InputError):
        read_position_table(path)


TWO_AXES = [
    [axis, "Target [mm],Fwd 1 [um],Rev 1 [um],Fwd 2 [um],Rev 2 [um]", *(f"{t},0,{b},0,{b}" for t in (0, 100, 200))]
    for axis, b in (("X axis", -3), ("Y axis", -9))
]


@pytest.mark.parametrize("ending", ["csv", "md", "xlsx"])
def test_of_tables_of_several_axes_the_one_is_read_that_is_asked_for(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"slide.{ending}"
    if ending == "xlsx":
        book = openpyxl.Workbook()
        book.remove(book.active)
        for title, head, *rows in TWO_AXES:
            sheet = book.create_sheet(title)
            sheet.append(head.split(","))
            for row in rows:
                sheet.append([float(cell) for cell in row.split(",")])
        book.save(path)
    elif ending == "csv":
        path.write_text("\n".join(["Slide 4, 3 May", *(line for part in TWO_AXES for line in part)]), encoding="utf-8")
    else:
        for title, *rows in TWO_AXES:
            table = [f"|{row.replace(',', '|')}|" for row in rows]
            with path.open("a", encoding="utf-8") as file:
                file.write("\n".join(["", f"## {title}", "", table[0], "|---|---|---|---|---|", *table[1:], ""]))
    assert is_position_table(path)
    for axis, play in (("X", -3.0), ("y", -9.0)):
        runs, _ = read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": axis}})
        back = runs[0].samples["direction"] == "reverse"
        assert runs[0].samples["error_um"][back].tolist() == pytest.approx([play] * 3)
        if ending != "md":
            imported = understand(path, Home(tmp_path / "home"), {"axis": axis, "machine": "m"}, {})
            assert f"{play:g}" in imported.text
            assert imported.text.count("200") == 1
    if ending == "csv":
        with pytest.raises(InputError, match="tables of several axes"):
            understand(path, Home(tmp_path / "home"), {}, {})
    with pytest.raises(InputError) as refused:
        read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "Z"}})
    assert "X" in refused.value.got
    assert "--axis X" in refused.value.hint


def test_a_lone_sheet_that_is_called_as_another_axis_is_refused(tmp_path: Path) -> None:
    book = openpyxl.Workbook()
    book.active.title = "Y axis"
    for row in TWO_AXES[0][1:]:
        book.active.append(row.split(","))
    book.save(path := tmp_path / "slide.xlsx")
    with pytest.raises(InputError, match="of another axis"):
        read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "X"}})
    assert len(read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "Y"}})[0]) == 2


def test_rows_of_one_axis_are_read_of_a_table_of_several_and_stay_that_axis(tmp_path: Path) -> None:
    path = tmp_path / "axes.csv"
    rows = [
        f"{axis if t == 0 else ''},{t},{way},{t / 100 + off}"
        for axis, off in (("X", 0.0), ("Y axis", 50.0))
        for way in ("+", "-")
        for t in (0, 100, 200)
    ]
    path.write_text("\n".join(["Axis,Target [mm],Direction,Deviation [µm]", *rows]), encoding="utf-8")
    for axis, off in (("X", 0.0), ("Y", 50.0)):
        runs, _ = read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": axis}})
        assert runs[0].samples["error_um"].tolist() == pytest.approx([off, 1 + off, 2 + off, 2 + off, 1 + off, off])
    with pytest.raises(InputError, match="several axes") as refused:
        read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "Z"}})
    assert refused.value.hint == "--axis X"
    lake = Lake(tmp_path / "lake")
    ingest(path, lake, told={"axis": "X", "machine": "m"})
    with pytest.raises(InputError) as wrong:
        amend(lake, "axes", ["condition.axis=Y"], "typed wrongly")
    assert wrong.value.code == "amend.read_with"
    path.write_text("\n".join(["Axis,Target [mm],Direction,Deviation [µm]", *rows[:6]]), encoding="utf-8")
    with pytest.raises(InputError, match="of another axis"):
        ingest(path, lake, told={"axis": "Y", "machine": "m", "campaign": "one"})
    path.write_text(path.read_text("utf-8").replace("Axis", "Stage").replace("\nX", "\n7"), encoding="utf-8")
    ingest(path, lake, told={"axis": "Y", "machine": "m", "campaign": "one"})
    assert amend(lake, "one", ["condition.axis=X"], "typed wrongly")


@pytest.mark.parametrize(
    ("head", "names"), [("slit", ("11358/1", "11358/2")), ("Axis", ("1", "2")), ("table no.", ("1", "2"))]
)
def test_of_several_axes_alike_the_one_is_read_by_its_name_or_number(
    tmp_path: Path, head: str, names: tuple[str, ...]
) -> None:
    path = tmp_path / "axes.csv"
    rows = [f"{name},{t},{t + n},{t + n + 0.5}" for n, name in enumerate(names) for t in (0, 100) for _ in (1, 2)]
    path.write_text("\n".join([f"{head},target [mm],forward [mm],reverse [mm]", *rows]), encoding="utf-8")
    with pytest.raises(InputError, match="several axes") as refused:
        read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "X"}})
    assert refused.value.hint == f'--axis "{names[0]}" reads the rows of that one; else a file for each'
    runs, _ = read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": names[1]}})
    assert [run.samples["error_um"].tolist() for run in runs] == [[1000.0, 1000.0, 1500.0, 1500.0]] * 2


def test_beside_the_own_sensor_of_an_axis_stands_its_instrument_whatever_its_name(tmp_path: Path) -> None:
    path = tmp_path / "slit.csv"
    rows = [f"{t},{way},{t},{t - 0.2}" for way in ("+", "-") for t in (10, 20, 30)]
    path.write_text("\n".join(["target [mm],direction,resolver [mm],ild2300_mm", *rows]), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "X"}})
    assert refused.value.got == "ild2300, resolver"
    told = {"condition": {"axis": "X", "instrument": "ild2300"}}
    runs, _ = read_position_runs(path, Campaign("a", "m", "linear"), told)
    assert runs[0].samples["error_um"].tolist() == pytest.approx([-200.0] * 6)


def test_the_unit_in_round_brackets_is_no_part_of_an_instrument_s_name(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("Target (mm),Laser (mm),Encoder (mm)\n0,0,0\n50,50.01,50\n100,100.02,100\n", encoding="utf-8")
    told = {"condition": {"axis": "X", "instrument": "laser"}}
    runs, _ = read_position_runs(path, Campaign("a", "m", "linear"), told)
    assert runs[0].samples["error_um"].tolist() == pytest.approx([0.0, 10.0, 20.0])


def test_a_sign_within_the_heads_is_the_direction_where_both_stand_there(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    heads = "Position [mm],Error + run1 [µm],Error - run1 [µm],Error + run2 [µm],Error - run2 [µm]"
    path.write_text("\n".join([heads, "0,1,2,3,4", "50,5,6,7,8"]), encoding="utf-8")
    table = read_position_table(path)
    assert table.forward_um.tolist() == [[1.0, 3.0], [5.0, 7.0]]
    assert table.reverse_um.tolist() == [[2.0, 4.0], [6.0, 8.0]]
    path.write_text("\n".join([heads.replace("+", "-"), "0,1,2,3,4", "50,5,6,7,8"]), encoding="utf-8")
    assert not is_position_table(path)


def test_a_scale_that_counts_the_other_way_is_told_as_that(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{t},{400 - t + 0.002},{400 - t - 0.001}" for t in (0, 100, 200, 400)]
    path.write_text("\n".join(["Target [mm],Fwd 1 [mm],Rev 1 [mm]", *rows]), encoding="utf-8")
    assert refusal(path).code == "position_table.mirrored"
    rows = [f"{way},{t},{t + 0.001 * n}" for n in range(3) for way in "+-" for t in (0, 100, 200, 400)]
    heads = "Dir,Target [mm],Actual [mm]"
    path.write_text("\n".join([heads, *rows]), encoding="utf-8")
    assert read_position_table(path).forward_um[2].tolist() == pytest.approx([0.0, 1.0, 2.0])
    path.write_text("\n".join(["Dir,Actual [mm],Target [mm]", *rows]), encoding="utf-8")
    assert refusal(path).code == "position_table.exchanged"


def test_positions_under_heads_of_deviations_are_read_as_such_and_told(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    for values, told in (("0,1", []), ("100001,100002", ["linear.positions"])):
        rows = ["0,0,1", f"100,{values}", f"200,{values.replace('1000', '2000')}"]
        path.write_text("\n".join(["Target [mm],Error fwd 1 [µm],Error rev 1 [µm]", *rows]), encoding="utf-8")
        table = read_position_table(path)
        assert [finding.code for finding in said_of(table)] == told
        assert np.abs(table.forward_um).max() < 2.0


@pytest.mark.parametrize("heads", ["trial,session,reading [mm]", "Home switch\nTrial,Session,Position [mm]"])
def test_one_place_approached_again_and_again_is_refused_with_how_it_repeats(tmp_path: Path, heads: str) -> None:
    path = tmp_path / "home.csv"
    rows = [f"{n % 10},{n // 10},{12 + (n % 2) / 1000 + 0.02 * (n // 10)}" for n in range(20)]
    path.write_text("\n".join([heads, *rows]), encoding="utf-8")
    assert kind_of_table(path) == "linear"
    with pytest.raises(InputError) as refused:
        read_position_table(path)
    assert refused.value.code == "position_table.one_place"
    assert "standard deviation 0.527 µm" in refused.value.got
    assert "differ by 20 µm" in refused.value.got
    path.write_text("\n".join(["trial,time [s],reading [mm]", *rows]), encoding="utf-8")
    assert not is_position_table(path)


INSTRUMENTS = {
    "target_mm,direction,laser_mm,encoder_mm": ("{t:g},{w},{p:.5f},{e:.5f}", "laser"),
    "target_mm,direction,encoder_error_um,laser_error_um": ("{t:g},{w},{u:.3f},{d:.3f}", "laser"),
    "Nr;Soll [mm];Richtung;Laser [mm];Encoder [mm];Luft [°C]": ("{n};{t:g};{w};{p:.5f};{e:.5f};20.1", "Laser"),
    "Position;Actual position encoder;Actual position laser;Direction\nmm;mm;mm;": (
        "{t:g};{e:.5f};{p:.5f};{w}",
        "laser",
    ),
}


@pytest.mark.parametrize("heads", INSTRUMENTS)
def test_laser_and_encoder_beside_each_other_are_chosen_by_name(tmp_path: Path, heads: str) -> None:
    row, name = INSTRUMENTS[heads]
    lines = [heads]
    for c in range(FORWARD.shape[1]):
        for way, values, order in (("forward", FORWARD, 1), ("reverse", REVERSE, -1)):
            for i in range(len(TARGETS))[::order]:
                t, d, u = float(TARGETS[i]), float(values[i, c]), 0.1
                told = {"n": len(lines), "t": t, "w": way, "d": d, "u": u, "p": t + d / 1000.0, "e": t + u / 1000.0}
                lines.append(row.format(**told))
    path = tmp_path / "beside.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    assert is_position_table(path)
    with pytest.raises(InputError) as refused:
        read_position_table(path)
    assert refused.value.code == "position_table.instruments"
    assert refused.value.hint is not None
    assert f'--instrument "{name}"' in refused.value.hint
    runs, _ = read_position_runs(path, Campaign("c", "m", kind="linear"), {"condition": {"instrument": "laser"}})
    assert len(runs) == FORWARD.shape[1]
    assert np.allclose(runs[0].samples["error_um"], [*FORWARD[:, 0], *REVERSE[::-1, 0]], atol=0.01)
    runs, _ = read_position_runs(path, Campaign("c", "m", kind="linear"), {"condition": {"instrument": "encoder"}})
    assert "linear.own_sensor" in {f.code for f in runs[0].findings}
    assert np.allclose(runs[0].samples["error_um"], 0.1, atol=0.01)


def test_columns_of_two_instruments_are_not_cycles_of_one(tmp_path: Path) -> None:
    heads = [f"{i} {w} {c} [µm]" for i in ("Laser", "Encoder") for c in (1, 2) for w in ("fwd", "rev")]
    lines = [";".join(["Target [mm]", *heads])]
    for i, t in enumerate(TARGETS):
        laser = [f"{v[i, c]:.3f}" for c in (0, 1) for v in (FORWARD, REVERSE)]
        lines.append(";".join([f"{t:g}", *laser, *["0.1"] * 4]))
    path = tmp_path / "beside.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    refused = refusal(path)
    assert (refused.code, refused.got) == ("position_table.instruments", "Encoder, Laser")
    runs, _ = read_position_runs(path, Campaign("c", "m", kind="linear"), {"condition": {"instrument": "Laser"}})
    assert np.allclose(runs[1].samples["error_um"], [*FORWARD[:, 1], *REVERSE[::-1, 1]], atol=0.01)


def test_an_encoder_beside_a_reading_without_a_name_is_not_read(tmp_path: Path) -> None:
    lines = ["target_mm,direction,encoder_error_um,error_um"]
    for way, values in (("forward", FORWARD), ("reverse", REVERSE)):
        lines += [f"{t:g},{way},0.1,{values[i, 0]:g}" for i, t in enumerate(TARGETS)]
    path = tmp_path / "beside.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    assert np.allclose(read_position_table(path).forward_um[:, 0], FORWARD[:, 0])


def test_a_missing_cell_is_no_gap_in_a_clock(tmp_path: Path) -> None:
    lines = wide("{way} {c} [um]", 1000.0, False).splitlines()
    cells = re.split(r"([,;\t])", lines[2])
    cells[2] = ""
    lines[2] = "".join(cells)
    path = tmp_path / "gap.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    runs, _ = read_position_runs(path, Campaign("c", "m", kind="linear"), {"condition": {"axis": "X"}})
    codes = {finding.code for run in runs for finding in kind_named("linear").judge_run(run)}
    assert "linear.missed_targets" in codes
    assert "clock.dropout" not in codes


@pytest.mark.parametrize("head", ["Target [deg]", "Soll [Grad]", "Target (mdeg)", "target_mrad"])
def test_tables_of_angles_are_refused_with_what_to_do(tmp_path: Path, head: str) -> None:
    path = tmp_path / "c.csv"
    path.write_text(f"{head};fwd 1;rev 1;fwd 2;rev 2\n0;1;2;1;2\n90;91;92;91;92", encoding="utf-8")
    with pytest.raises(InputError) as refused:
        read_position_table(path)
    assert (refused.value.code, refused.value.got) == ("position_table.unit", head)
    assert "--kind rotary" in str(refused.value.hint)


def test_an_axis_that_turns_by_its_name_needs_a_unit(tmp_path: Path) -> None:
    path = tmp_path / "c.csv"
    body = ";fwd 1;rev 1;fwd 2;rev 2\n0;0.001;0.002;0.001;0.002\n90;90.001;90.002;90.001;90.002"
    path.write_text(f"Target{body}", encoding="utf-8")
    stated = {"condition": {"axis": "C"}}
    with pytest.raises(InputError) as refused:
        read_position_runs(path, Campaign("c", "m", kind="linear"), stated)
    assert refused.value.got == "axis C, and no unit of length"
    # A title that names degrees is no unit of length, for an axis of any name.
    path.write_text(f"Rotary table (deg)\nTarget{body}", encoding="utf-8")
    for axis, got in (("C", "axis C, and no unit of length"), ("X", "Rotary table (deg)")):
        with pytest.raises(InputError, match="in angles") as refused:
            read_position_runs(path, Campaign("c", "m", kind="linear"), {"condition": {"axis": axis}})
        assert refused.value.got == got
    path.write_text(f"Room at 20.3 °\nTarget{body}", encoding="utf-8")
    assert len(read_position_runs(path, Campaign("c", "m", kind="linear"), {"condition": {"axis": "X"}})[0]) == 2
    path.write_text(
        "TGT_DATA[1]=0\nTGT_DATA[2]=90\nREF_DATA_FWD[1,1]=0.001\nREF_DATA_FWD[2,1]=90.001", encoding="utf-8"
    )
    with pytest.raises(InputError, match="in angles"):
        read_position_runs(path, Campaign("c", "m", kind="linear"), stated)
    path.write_text(f"Target{body}", encoding="utf-8")
    assert len(read_position_runs(path, Campaign("c", "m", kind="linear"), {"condition": {"axis": "X"}})[0]) == 2
    path.write_text(f"Target [mm]{body}", encoding="utf-8")
    assert len(read_position_runs(path, Campaign("c", "m", kind="linear"), stated)[0]) == 2


def test_poses_below_titles_are_no_positioning_table(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    rows = [f"{n};{n}.5;-{n}.1;{n}.2;{n}.6;-{n}.2;{n}.3" for n in range(1, 30)]
    heads = "Nr;Soll X [mm];Soll Y [mm];Soll Z [mm];Ist X [mm];Ist Y [mm];Ist Z [mm]"
    path.write_text("\n".join(["Messung;;;;;;", "Roboter;KR 16;;;;;", heads, *rows]), encoding="utf-8")
    assert not is_position_table(path)


@pytest.mark.parametrize(
    ("head", "way"),
    [
        ("Up1", "forward"),
        ("Hinfahrt 1", "forward"),
        ("Rückfahrt 1", "reverse"),
        ("bk 1 [µm]", "reverse"),
        ("Dn1", "reverse"),
        ("steigend", "forward"),
        ("abwärts 2 [µm]", "reverse"),
        ("from below 1 [mm]", "forward"),
        ("from_above_1_mm", "reverse"),
        ("above", "reverse"),
        ("von unten [mm]", "forward"),
        ("von oben", "reverse"),
        ("nach unten", None),
        ("R1+ [µm]", "forward"),
        ("R1- [µm]", "reverse"),
        ("F1", "forward"),
        ("sensor above [mm]", None),
    ],
)
def test_the_side_from_which_a_target_was_approached_is_its_direction(head: str, way: str | None) -> None:
    assert way_of(head) == way


@pytest.mark.parametrize("other", ["left", "a", "kalt"])
def test_readings_of_one_direction_are_not_taken_alone_beside_as_many_of_an_unknown_one(
    tmp_path: Path, other: str
) -> None:
    path = tmp_path / "a.csv"
    heads = ";".join(f"b {n} [µm];{other} {n} [µm];air {n} [°C]" for n in (1, 2, 3))
    rows = [";".join([str(t), *["1"] * 9]) for t in (0, 100, 200)]
    path.write_text("\n".join([f"target [mm];{heads}", *rows]), encoding="utf-8")
    assert not is_position_table(path)
    path.write_text(path.read_text("utf-8").replace(f"{other} ", "mean "), "utf-8")
    assert is_position_table(path)


@pytest.mark.parametrize(("digits", "highest", "told"), [(3, 5.0, True), (3, 99.0, False), (0, 99.0, False)])
def test_readings_at_the_end_of_the_range_are_told(tmp_path: Path, digits: int, highest: float, told: bool) -> None:
    rng = np.random.default_rng(2)
    target = np.arange(0.0, 401.0, 50.0)
    read = np.minimum(0.02 * target[:, None] + rng.normal(0.0, 0.3, (9, 10)), highest)
    heads = ";".join(f"fwd {n} [µm];rev {n} [µm]" for n in range(1, 6))
    rows = [";".join([str(t), *(f"{v:.{digits}f}" for v in line)]) for t, line in zip(target, read, strict=True)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([f"target [mm];{heads}", *rows]), encoding="utf-8")
    found = check_source(path, told={"axis": "X"})["findings"]
    assert told == any(f["code"] == "linear.clipped" for f in found)


@pytest.mark.parametrize(
    ("heads", "factors", "code"),
    [
        ("Nominal [mm];Actual [mm];Error [µm]", (1.0, -1.0), "position_table.sign"),
        ("Nominal [mm];Actual [mm];Error [mm]", (1.0, 1.0), "position_table.unit"),
        ("Nominal [mm];Cycle time [s];-Error [µm]", (1.0, -1.0), "position_table.sign"),
        ("Nominal [mm];Actual [mm];Error [µm]", (1.0, 1.0), ""),
    ],
)
def test_deviations_have_the_sign_and_unit_of_positions_beside_them(
    tmp_path: Path, heads: str, factors: tuple[float, float], code: str
) -> None:
    target = np.tile(np.arange(0.0, 401.0, 50.0), 3)
    error = 5.0 * np.sin(target)
    rows = [f"{t:g};{t + factors[0] * e / 1e3:.5f};{factors[1] * e:.2f};+" for t, e in zip(target, error, strict=True)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([f"{heads};direction", *rows]), encoding="utf-8")
    if code:
        assert refusal(path).code == code
        return
    found = check_source(path, told={"axis": "X"})["findings"]
    assert "linear.equal_cycles" in {f["code"] for f in found}


@pytest.mark.parametrize(
    "other", ["Error limit [µm]", "Std dev [µm]", "Following error [µm]", "Error code", "Device", "Previous error [µm]"]
)
def test_what_only_sounds_like_an_error_is_not_read_in_its_place(tmp_path: Path, other: str) -> None:
    rows = [f"{t};{way};7;{t / 100 + 3 * (way == '-')}" for _ in range(2) for way in "+-" for t in (0, 100, 200)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([f"target [mm];direction;{other};Error [µm]", *rows]), encoding="utf-8")
    assert read_position_table(path).reverse_um[:, 0].tolist() == [3.0, 4.0, 5.0]


@pytest.mark.parametrize("word", ["limit", "tolerance", "following error", "±"])
def test_limits_and_what_a_control_follows_by_are_no_readings(tmp_path: Path, word: str) -> None:
    heads = ";".join(f"forward {n} {word} [µm];reverse {n} {word} [µm]" for n in (1, 2))
    path = tmp_path / "a.csv"
    path.write_text(f"target [mm];{heads}\n0;1;2;3;4\n9;1;2;3;4\n", encoding="utf-8")
    with pytest.raises(InputError, match="no kind of test"):
        understand(path, Home(tmp_path / "home"), {"axis": "X"}, {})


def test_one_column_of_deviations_among_those_of_positions_is_read_as_such(tmp_path: Path) -> None:
    heads = ";".join(f"fwd {n} [{'in' if n == 2 else 'µm'}];rev {n} [mm]" for n in (1, 2, 3))
    rows = [f"{t};1;{1e-3};{1 / 25400:.9f};{1e-3};1;{1e-3}" for t in (0, 100, 200)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([f"target [mm];{heads}", *rows]), encoding="utf-8")
    table = read_position_table(path)
    assert np.allclose([table.forward_um, table.reverse_um], 1.0, atol=1e-3)
    path.write_text("Kompensationswerte\n" + path.read_text("utf-8"), encoding="utf-8")
    assert refusal(path).code == "position_table.sign"


def test_heads_that_are_cut_short_name_target_and_reading(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{t},{t + 0.001},{way}" for _ in (1, 2) for way, ts in (("+", (0, 50)), ("-", (50, 0))) for t in ts]
    path.write_text("\n".join(["cmd_mm,meas_mm,dir", *rows]), encoding="utf-8")
    assert read_position_table(path).forward_um == pytest.approx(np.ones((2, 2)))
    path.write_text("t_s,cmd_z_mm,act_z_mm\n0,0,0\n1,1,1\n", encoding="utf-8")
    assert not is_position_table(path)


def test_a_place_that_moves_steadily_is_told_as_that_and_not_as_scatter(tmp_path: Path) -> None:
    path = tmp_path / "home.csv"
    off = (0.0, 1.0, -1.0, 0.5, -0.5, 0.0)
    path.write_text("cycle,dial [mm]\n" + "\n".join(f"{n},{-0.01 * n + x / 1000}" for n, x in enumerate(off)))
    assert "they move by -10.1 µm from one reading to the next, and scatter by 0.77 µm" in str(refusal(path).got)
    path.write_text("cycle,dial [mm]\n" + "\n".join(f"{n},{x / 1000}" for n, x in enumerate(off)))
    assert "they move" not in str(refusal(path).got)


def test_a_sheet_of_several_alike_is_read_by_its_name_whatever_it_is(tmp_path: Path) -> None:
    book = openpyxl.Workbook()
    for n, title in enumerate(("11358-1", "11358-2")):
        sheet = book.active if n == 0 else book.create_sheet()
        sheet.title = title
        for row in (("target [mm]", "forward 1 [µm]", "reverse 1 [µm]"), (0, n, n), (50, n + 5, n + 5)):
            sheet.append(row)
    book.save(path := tmp_path / "slits.xlsx")
    assert kind_of_table(path) == "linear"
    with pytest.raises(InputError, match="several sheets") as refused:
        read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "X"}})
    assert str(refused.value.hint).startswith('--axis "11358-1" takes the sheet')
    runs, _ = read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "11358-2"}})
    assert runs[0].samples["error_um"].tolist() == [1.0, 6.0, 6.0, 1.0]


@pytest.mark.parametrize(
    ("titles", "read"),
    [(("# 11358-1", "# 11358-2"), False), (("# run 1", "# run 2"), True), (("# 9:00", "# 9:30"), True)],
)
def test_the_same_heads_below_titles_of_several_axes_are_no_cycles_of_one(
    tmp_path: Path, titles: tuple[str, ...], read: bool
) -> None:
    path = tmp_path / "a.csv"
    table = "target [mm];forward [mm];reverse [mm]\n0;0;0.001\n50;50.002;50.003\n"
    path.write_text("\n".join(f"{title}\n{table}" for title in titles), encoding="utf-8")
    if read:
        assert len(read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "X"}})[0]) == 2
        return
    with pytest.raises(InputError, match="the same heads stand there again") as refused:
        read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "X"}})
    assert refused.value.got == "11358-1, 11358-2"


def test_a_column_that_is_not_known_and_parts_the_rows_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{name},{t},{t},{t}" for name in ("left", "right") for t in (0, 50)]
    path.write_text("\n".join(["carriage,target [mm],forward [mm],reverse [mm]", *rows]), encoding="utf-8")
    runs, _ = read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "X"}})
    (told,) = (f.message for f in runs[0].findings if f.code == "linear.told_apart")
    assert "carriage (left, right)" in told
    path.write_text(path.read_text("utf-8").replace("left", "2026-01-01").replace("right", "2026-01-02"))
    runs, _ = read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "X"}})
    assert not [f for f in runs[0].findings if f.code == "linear.told_apart"]


def test_numbers_of_a_feed_part_tests_and_those_of_temperatures_count_no_cycles(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{feed},{t},{t},{t}" for feed in (1000, 5000) for t in (0, 50)]
    path.write_text("\n".join(["feed [mm/min],target [mm],forward [mm],reverse [mm]", *rows]), encoding="utf-8")
    runs, _ = read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "X"}})
    (told,) = (f.message for f in runs[0].findings if f.code == "linear.told_apart")
    assert "feed [mm/min] (1000, 5000)" in told
    rows = [f"{t},{way},{t}.00{n},{n}" for n in (1, 2, 2, 1) for way in "+-" for t in (0, 50)]
    for counted, heard in ((rows, ["pressure (1, 2)"]), (rows[:8], [])):
        path.write_text("\n".join(["target [mm],direction,position [mm],pressure", *counted]), encoding="utf-8")
        runs, _ = read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "X"}})
        found = [f.message for f in runs[0].findings if f.code == "linear.told_apart"]
        assert [told.partition(" is not read")[0].removeprefix("the column ") for told in found] == heard
    rows = [f"{t},{way},1,5" for way in "+-" for t in (0, 50)]
    path.write_text("\n".join(["target [mm],direction,error 20C [µm],error 30C [µm]", *rows]), encoding="utf-8")
    with pytest.raises(InputError, match="count no cycles") as refused:
        read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "X"}})
    assert "20, 30" in refused.value.got


@pytest.mark.parametrize(
    "names", [(f"{name}1", f"{name}2") for name in ("blade ", "Jaw ", "X", "robot ", "J", "M", "table ")]
)
def test_sister_axes_beside_each_other_are_no_cycles(tmp_path: Path, names: tuple[str, str]) -> None:
    path = tmp_path / "a.csv"
    heads = ",".join(f"{name} fwd [µm],{name} rev [µm]" for name in names)
    path.write_text(f"target [mm],{heads}\n0,1,2,3,4\n50,1,2,3,4\n", encoding="utf-8")
    with pytest.raises(InputError, match="several axes") as refused:
        read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "X"}})
    assert refused.value.got == ", ".join(names)


@pytest.mark.parametrize(
    "heads", ["set_mm,act_mm", "Set [mm],Actual [mm]", "demand (mm),act pos (mm)", "desired_mm,measured_mm"]
)
def test_what_is_set_or_asked_for_is_the_target(tmp_path: Path, heads: str) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{t},{t + 0.001 * (1 + (way == '-'))},{way}" for way in "+-" for t in (0, 50)]
    path.write_text("\n".join([f"{heads},direction", *rows]), encoding="utf-8")
    (run,), _ = read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "X"}})
    assert list(run.samples["position_mm"]) == [0, 50, 50, 0]
    assert run.samples["error_um"] == pytest.approx([1, 1, 2, 2])


@pytest.mark.parametrize("said", ["probe at 175.0,175.0 is z=", "probe: at 175.0,175.0 bed will contact at z="])
@pytest.mark.parametrize("name", ["klippy.log", "console.txt"])
def test_a_probe_of_a_printer_tells_how_one_place_repeats(tmp_path: Path, name: str, said: str) -> None:
    path = tmp_path / name
    heights = (2.001, 2.003, 2.002, 2.001, 2.003)
    path.write_text("\n".join(f"// {said}{z:.6f}" for z in heights), encoding="utf-8")
    assert is_position_table(path)
    with pytest.raises(InputError, match="one target, however often") as refused:
        read_position_runs(path, Campaign("a", "m", "linear"), {"condition": {"axis": "Z"}})
    # s of 1, 3, 2, 1, 3 is 1.
    assert "standard deviation 1 µm" in refused.value.got


def test_a_pitch_that_is_stated_anew_or_a_whole_number_counts(tmp_path: Path) -> None:
    path, lake = tmp_path / "a.csv", Lake(tmp_path / "lake")
    path.write_text("target [mm],forward 1 [µm],reverse 1 [µm]\n" + "\n".join(f"{10 * n},{n},{n}" for n in range(6)))
    ingest(path, lake, told={"axis": "X", "machine": "m"})
    for setting, pitch in (
        ("machine_geometry.screw_pitch_mm=5", 5.0),
        ("machine_geometry.screw_pitch_mm=10", 10.0),
        ("condition.screw_pitch_mm=20", 20.0),
    ):
        amend(lake, "a", [setting], "typo")
        (run,) = lake.iterate("a")
        assert linear_test([run]).pitch_mm == pitch
        assert "linear.step_divides_pitch" in {f.code for f in run.findings}
    for setting, said in (
        ("machine_geometry.screw_pitch_mm=abc", "screw_pitch_mm is not usable"),
        ("condition.screw_pitch_mm=-5", "pitch is no length"),
    ):
        with pytest.raises(InputError, match=said):
            amend(lake, "a", [setting], "typo")


@pytest.mark.parametrize(
    ("heads", "read"),
    [
        ("A [µm],B [µm],C [µm],D [µm],E [µm],F [µm]", False),
        ("A1 [µm],B1 [µm],C1 [µm],A2 [µm],B2 [µm],C2 [µm]", False),
        ("R1 [µm],R2 [µm],R3 [µm]", False),
        ("F1 [µm],R1 [µm],F2 [µm],R2 [µm]", True),
        ("F [µm],B [µm]", True),
    ],
)
def test_letters_of_columns_and_runs_are_no_directions(tmp_path: Path, heads: str, read: bool) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{t}," + ",".join("1" for _ in heads.split(",")) for t in (0, 50, 100)]
    path.write_text("\n".join([f"Position [mm],{heads}", *rows]), encoding="utf-8")
    assert is_position_table(path) is read


@pytest.mark.parametrize(
    ("heads", "code"),
    [
        ("fwd 20C [µm],rev 20C [µm],fwd 30C [µm],rev 30C [µm]", "position_table.cycles"),
        ("fwd 0 kg [µm],rev 0 kg [µm],fwd 50 kg [µm],rev 50 kg [µm]", "position_table.cycles"),
        ("Lathe 1 fwd [µm],Lathe 1 rev [µm],Lathe 2 fwd [µm],Lathe 2 rev [µm]", "position_table.axes"),
        ("fwd 0 [µm],rev 0 [µm],fwd 1 [µm],rev 1 [µm]", ""),
        ("fwd 1 [µm],rev 1 [µm],fwd 5 [µm],rev 5 [µm]", ""),
    ],
)
def test_numbers_of_conditions_and_machines_count_no_cycles(tmp_path: Path, heads: str, code: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text("\n".join([f"Target [mm],{heads}", "0,1,2,3,4", "50,1,2,3,4"]), encoding="utf-8")
    if code:
        assert refusal(path).code == code
        return
    assert [run.samples["error_um"][0] for run in runs_of(read_position_table(path), path, {})] == [1.0, 3.0]


@pytest.mark.parametrize(
    ("head", "by_position"),
    [
        ("target [mm],direction,error 1 [µm],error 2 [µm],2025 [µm]", False),
        ("target [mm],direction,Position 1 [mm],Position 2 [mm]", True),
        ("target [mm],sens,Laser 1 [mm],Laser 2 [mm],humidity 3 [%]", True),
    ],
)
def test_cycles_beside_a_column_of_directions_are_all_read(tmp_path: Path, head: str, by_position: bool) -> None:
    lines = [head]
    for i, target in enumerate(TARGETS):
        for way, errors in (("+", FORWARD), ("-", REVERSE)):
            told = [f"{target + um / 1000.0 if by_position else um:.4f}" for um in errors[i]]
            lines.append(",".join([f"{target:g}", way, *told, "7"][: head.count(",") + 1]))
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    table = read_position_table(path)
    np.testing.assert_allclose(table.forward_um, FORWARD, atol=1e-6)
    np.testing.assert_allclose(table.reverse_um, REVERSE, atol=1e-6)


@pytest.mark.parametrize(
    "head",
    [
        # Half of the directions is known; the other half was left out.
        "target [mm],A error [µm],B error [µm]",
        "target [mm],out 1 [mm],back 1 [mm],out 2 [mm],back 2 [mm],2025 [µm]",
        "Soll [mm],Position out 1 [mm],Position back 1 [mm],Position out 2 [mm],Position back 2 [mm]",
        # Of a target that is not known another column was taken for it.
        "Axis position [mm],pos 1 [mm],neg 1 [mm],pos 2 [mm],neg 2 [mm]",
        "X Target [mm],positive 1 [mil],negative 1 [mil],positive 2 [mil],negative 2 [mil]",
        "X Target [mm],forward 1 [µm],reverse 1 [µm],forward 2 [µm],reverse 2 [µm],Nominal error [µm]",
        # What is read is not beside columns that are not known.
        "target [mm],left 1 [µm],left 2 [µm],right 1 [µm],right 2 [µm],Nominal error [µm]",
    ],
)
def test_half_of_a_table_is_not_read_in_place_of_all_of_it(tmp_path: Path, head: str) -> None:
    path, n = tmp_path / "a.csv", head.count(",")
    rows = [",".join([f"{50 * i}", *(f"{50.0 * i + 0.001 * k:.4f}" for k in range(n))]) for i in range(5)]
    path.write_text("\n".join([head, *rows]), encoding="utf-8")
    assert refusal(path).code.startswith("position_table.")


@pytest.mark.parametrize("unknown", ["out", "A", "left"])
def test_a_direction_that_is_not_known_is_refused_beside_one_that_is(tmp_path: Path, unknown: str) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{target:g},{way},1.0,1.5" for target in TARGETS for way in (unknown, "back")]
    path.write_text("\n".join(["target [mm],direction,error 1 [µm],error 2 [µm]", *rows]), encoding="utf-8")
    assert unknown in str(refusal(path).got)


@pytest.mark.parametrize(
    ("heads", "row", "code", "got"),
    [
        ("Kompensation,target [mm],direction,error [µm]", "{s},{t:g},{w},{e}", "table.several", "off, on"),
        ("State,target [mm],forward [µm],reverse [µm]", "{s},{t:g},{e},{e}", "table.several", "off, on"),
        ("Feed [mm/min],target [mm],direction,error [µm]", "{f},{t:g},{w},{e}", "table.several", "1000, 5000"),
        (
            "target [mm],error Y [µm],error X [µm],direction",
            "{t:g},{n},{e},{w}",
            "position_table.columns",
            "error Y [µm], error X [µm]",
        ),
        (
            "target [mm],position [mm],encoder [mm],direction",
            "{t:g},{p},{t:g},{w}",
            "position_table.instruments",
            "encoder, position",
        ),
        ("position [mm],encoder [mm],direction", "{p},{q},{w}", "position_table.targets", "encoder"),
    ],
)
def test_readings_of_several_states_axes_or_sensors_are_no_cycles(
    tmp_path: Path, heads: str, row: str, code: str, got: str
) -> None:
    path = tmp_path / "a.csv"
    rows = [
        row.format(
            s=("off", "on")[n],
            f=(1000, 5000)[n],
            t=t,
            w=way,
            e=n + 1.5,
            n=n * t,
            q=t - 0.0003 * n - 0.0001 * (way == "-"),
            p=t + 0.001 * n + 0.0007 * (way == "-"),
        )
        for n in (0, 1)
        for way in ("+-" if "{w}" in row else "+")
        for t in TARGETS
    ]
    path.write_text("\n".join([heads, *rows]), encoding="utf-8")
    refused = refusal(path)
    assert (refused.code, refused.got) == (code, got)
    if code == "table.several":
        # Names that count are of cycles.
        text = path.read_text(encoding="utf-8").replace(got.split(", ")[0], "M1").replace(got.split(", ")[1], "M2")
        path.write_text(text, encoding="utf-8")
        assert read_position_table(path).forward_um.shape[1] == 2


@pytest.mark.parametrize("head", ["Bewegung", "Laufrichtung", "Movement"])
def test_a_direction_under_other_heads_beside_targets_that_rise_both_ways(tmp_path: Path, head: str) -> None:
    rows = [f"{t:g};{way};{um}" for k in (0, 1) for way, um in (("hin", 1 + k), ("rück", 5 + k)) for t in TARGETS]
    (tmp_path / "a.csv").write_text("\n".join([f"Soll [mm];{head};Abweichung [µm]", *rows]), encoding="utf-8")
    table = read_position_table(tmp_path / "a.csv")
    assert (table.forward_um[0].tolist(), table.reverse_um[0].tolist()) == ([1.0, 2.0], [5.0, 6.0])
