"""Tables below each other with the same heads: those of several machines are refused, repeats of one are not."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import pytest

from dtwin.acquire.repeated_heads import require_one_block, require_whole_end
from dtwin.errors import InputError

TABLE = "speed [rpm];run-out [µm]\n1000;3\n2000;4\n"


@pytest.mark.parametrize("titles", [("# tool A", "# tool B"), ("UR5", "UR10"), ("spindle on", "spindle off")])
def test_titles_of_several_are_refused(titles: tuple[str, str]) -> None:
    with pytest.raises(InputError) as refused:
        require_one_block("\n".join(f"{title}\n{TABLE}" for title in titles), Path("a.csv"))
    assert (refused.value.code, refused.value.got) == ("table.titles", ", ".join(t.strip("# ") for t in titles))


@pytest.mark.parametrize("titles", [("# run 1", "# run 2"), ("", ""), ("9:00", "9:30"), ("1", "2"), ("same", "same")])
def test_repeats_are_not(titles: tuple[str, str]) -> None:
    require_one_block("\n".join(f"{title}\n{TABLE}" for title in titles), Path("a.csv"))
    require_one_block("x,x,x\n" * 3, Path("a.csv"))
    require_one_block("a;b;c\n1;2;3\n4;5\n\na;b;c\n1;2;3\n6;7\n\na;b;c\n1;2;3\n", Path("a.csv"))


def test_other_tables_of_a_report_may_repeat_their_heads() -> None:
    text = "\n".join(f"## {title} limit\n\nTest | Counter [mm]\n--- | ---\n1 | 0.5\n" for title in ("Low", "High"))
    require_one_block(text, Path("a.md"), needed=lambda cell: cell.startswith("Target"))
    with pytest.raises(InputError):
        require_one_block(text, Path("a.md"))


def test_decimal_commas_among_commas_are_refused() -> None:
    """``37,5`` in a table that commas part is two cells: 37 was the target, and 5 the first reading."""
    heads = "Test of axis X\nTarget [mm],Forward 1 [µm],Reverse 1 [µm]\n"
    with pytest.raises(InputError) as refused:
        require_one_block(heads + "0,1.2,3.1\n37,5,1.4,3.3\n", Path("a.csv"))
    assert refused.value.code == "table.more_cells"
    for sound in ("0,1.2,3.1,,\n", '"37,5","1,4","3,3"\n', "0,1.2,3.1,see note 3\n"):
        require_one_block(heads + sound, Path("a.csv"))
    require_one_block("Target [mm];Forward 1 [µm]\n37,5;1,4\n", Path("a.csv"))


def test_numbers_of_rows_without_a_head_are_refused() -> None:
    """As R writes them: the head of each column stood above its neighbour."""
    with pytest.raises(InputError) as refused:
        require_one_block("Target [mm];Forward 1 [µm]\n1;0,0;1,2\n2;37,5;1,4\n", Path("a.csv"))
    assert refused.value.code == "table.more_cells"
    require_one_block("Target [mm];Forward 1 [µm]\n0,0;1,2\n37,5;1,4;3\n", Path("a.csv"))
    require_one_block("Target;Forward\n;1;2\n0,0;1,2;1,3\n37,5;1,4;1,5\n", Path("a.csv"))


def test_a_row_that_lacks_a_cell_is_refused_with_its_number() -> None:
    """Without ``1.4`` behind 100 the reverse reading stood below the head of the forward one."""
    heads = "Test of axis X\nNo;7\n\nTarget [mm];Forward 1 [µm];Reverse 1 [µm]\n"
    short = heads + "0;1.2;3.1\n# a remark\n100;3.3\n200;1.5;3.2\n"
    named = heads.replace("\nT", "\nAxis;T") + "X;0;1.2;3.1\n# a remark\nX;100;3.3\nX;200;1.5;3.2\n"
    for text in (short, short.replace(";", ","), short.replace(";", "\t"), named):
        with pytest.raises(InputError) as refused:
            require_one_block(text, Path("a.csv"))
        assert (refused.value.code, refused.value.where) == ("table.fewer_cells", "a.csv row 7")
    # Nothing read at the end, columns that are rarely filled, remarks, other tables.
    for sound in (
        "0;1.2;3.1\n100;1.4;\n200;1.5;3.2\n",
        "0;1.2\n100;1.3;3.3\n200;1.5\n",
        "0;1.2;ok\n100;1.3\n200;1.5;ok\n",
        "0;1.2;3.1\n100;1.3;3.3\n200;1.5;3.2\nMean;2.2\nunit;tests\n1;2\n3;4\n",
    ):
        require_one_block(heads + sound, Path("a.csv"))


@pytest.mark.parametrize(
    ("value", "last", "cut"),
    [
        ("{:.3f}", "359.00,13", True),
        ("{:.3f}", "359.00,1.", True),
        ("{:.3f}", "359.00,1.25", True),
        ("{:.3f}", "359.00,1.250", False),
        ("{:.3f}", "359.00,1.25\n", False),
        ("{:.3f}", "359.00,1.25\r\n", False),
        ("{:.3f}", "# end", False),
        # Without zeros at the end, or whole: nobody knows how long the number was.
        ("{!r}", "359.00,1.2", False),
        ("{:.0f}", "359.00,1", False),
    ],
)
@pytest.mark.parametrize("european", [False, True])
def test_a_table_that_ends_in_the_middle_of_a_number_is_refused(
    value: str, last: str, cut: bool, european: bool
) -> None:
    text = "angle_deg,deviation_um\n" + "".join(f"{k}.00,{value.format(k / 8)}\n" for k in range(1, 41)) + last
    text = text.replace(",", ";").replace(".", ",") if european else text
    with pytest.raises(InputError, match="in the middle of a number") if cut else nullcontext():
        require_whole_end(text, Path("a.csv"))
