"""Files .rtl and .pos: read back what was put in, in every encoding; hostile files are refused as mistakes."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dtwin.acquire.ingest import open_source
from dtwin.errors import InputError
from dtwin.kinds.linear._rtl_file import read_rtl_runs
from dtwin.schema import Campaign, Run

CAMPAIGN = Campaign(name="c", machine="m", kind="linear")
SHIPPED = Path(__file__).parent / "synthetic.rtl"


def rtl(
    targets: list[float], cycles: list[tuple[list[float], list[float]]], *, comma: bool = False, flags: str = "0 0 2 0"
) -> str:
    """Return a file in the form of the public writers: forward runs count up, reverse runs down."""
    rows, run = [], 0
    for forward, reverse in cycles:
        for values, order in ((forward, 1), (reverse, -1)):
            run += 1
            rows += [f"{run}   {n}      {values[n - 1]:.3f}" for n in range(1, len(targets) + 1)[::order]]
    lines = ["HEADER::", "File type  : rtl", "Owner      : dtwin", "", "TARGET DATA::", "Filetype  : ISO"]
    lines += [f"Target-count: {len(targets)}", "Targets :"]
    lines += [" ".join(f"{t:.4f}" for t in targets[n : n + 5]) + " " for n in range(0, len(targets), 5)]
    lines += [
        f"Flags: {flags}",
        "",
        "USER-TEXT::",
        "Machine: Fräse 7",
        "Axis: X",
        "",
        "RUNS::",
        f"Run-count: {run}",
        "",
    ]
    text = "\r\n".join(
        [*lines, "DEVIATIONS::", "Run Target Data:", *rows, "", "ENVIRONMENT::", "Air temp   :", "", "EOF::", ""]
    )
    return text.replace(".", ",") if comma else text


def synthetic() -> str:
    targets = [50.0 * n for n in range(9)]
    line = np.linspace(0.0, 8.0, 9)
    return rtl(targets, [((line + 0.1 * n).tolist(), (line + 3.0 - 0.1 * n).tolist()) for n in range(5)])


def read(path: Path) -> list[Run]:
    return read_rtl_runs(path, CAMPAIGN, {})[0]


def codes(runs: list[Run]) -> set[str]:
    return {finding.code for finding in runs[0].findings}


def test_the_shipped_file_is_the_one_that_this_writes() -> None:
    assert SHIPPED.read_bytes().decode("cp1252") == synthetic()
    campaign, sources, _ = open_source(SHIPPED, {"axis": "X", "machine": "mill-7"})
    runs = next(iter(sources))[0]
    assert (campaign.machine, len(runs), runs[0].meta.condition) == ("mill-7", 5, {"axis": "X"})
    assert {"rtl.untried", "rtl.said", "clock.assumed"} == codes(runs)
    back = runs[2].samples["error_um"][9:]
    assert back == pytest.approx(np.linspace(8.0, 0.0, 9) + 2.8)


NUMBERS = st.integers(-9_000_000, 9_000_000).map(lambda n: n / 1000.0)


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_what_was_written_is_read(tmp_path: Path, data: st.DataObject) -> None:
    targets = sorted(data.draw(st.lists(NUMBERS, min_size=2, max_size=12, unique=True)))
    if data.draw(st.booleans()):
        targets.reverse()
    row = st.lists(NUMBERS, min_size=len(targets), max_size=len(targets))
    cycles = data.draw(st.lists(st.tuples(row, row), min_size=1, max_size=4))
    encoding = data.draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "utf-16-be", "cp1252"]))
    path = tmp_path / "x.rtl"
    path.write_bytes(rtl(targets, cycles, comma=data.draw(st.booleans())).encode(encoding))
    runs = read(path)
    assert len(runs) == len(cycles)
    up = np.argsort(targets)
    for run, (first, second) in zip(runs, cycles, strict=True):
        # Forward is towards larger positions, whatever the file counts first.
        forward, reverse = (first, second) if targets[0] < targets[-1] else (second, first)
        np.testing.assert_allclose(run.samples["error_um"], [*np.array(forward)[up], *np.array(reverse)[up][::-1]])
        assert (run.samples["position_mm"][: len(targets)] == np.array(targets)[up]).all()


def test_one_direction_is_padded_with_zeros_which_are_no_readings(tmp_path: Path) -> None:
    path = tmp_path / "x.rtl"
    path.write_text(rtl([0.0, 1.0, 2.0], [([1.0, 2.0, 3.0], [0.0] * 3)] * 2, flags="0 1 2 0"), encoding="utf-8")
    runs = read(path)
    assert [run.samples["error_um"].tolist() for run in runs] == [[1.0, 2.0, 3.0]] * 2
    assert "rtl.padding" in codes(runs)


def test_sorted_runs_and_short_files_are_said(tmp_path: Path) -> None:
    path = tmp_path / "x.rtl"
    text = synthetic()
    cut = text[: text.index("\r\n10   ")] + "\r\n"
    path.write_text(cut, encoding="utf-8", newline="")
    assert "rtl.short" in codes(read(path))
    head, data = text.split("Run Target Data:\r\n")
    rows = sorted(
        (line for line in data.splitlines() if line[:1].isdigit()), key=lambda line: [int(c) for c in line.split()[:2]]
    )
    path.write_text(head + "Run Target Data:\r\n" + "\r\n".join(rows), encoding="utf-8", newline="")
    runs = read(path)
    assert "rtl.directions" in codes(runs)
    assert runs[0].samples["error_um"][9:] == pytest.approx(np.linspace(8.0, 0.0, 9) + 3.0)


def test_means_by_direction(tmp_path: Path) -> None:
    path = tmp_path / "x.pos"
    tables = [("Bidirectional", 0.002), ("Forward Directional", 0.001), ("Reverse Directional", 0.003)]
    lines = [line for name, v in tables for line in (f"Position   \t{name} Avg Error", f"0.0\t{v}", f"10.0\t{v}")]
    path.write_text("\n".join(lines), encoding="utf-8")
    (run,) = read(path)
    assert run.samples["error_um"] == pytest.approx([1.0, 1.0, 3.0, 3.0])
    assert "rtl.means" in codes([run])


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("Target-count: 9", "Target-count: 8"),
        ("1   9      8.000", "1   10      8.000"),
        ("1   9      8.000", "1   9      nan"),
        ("1   9      8.000", "1   9      8_000"),
        ("1   9      8.000", "1   9"),
        ("1   9      8.000", "1   8      8.000"),
        ("50.0000", "1e300"),
        ("Run Target Data:", "Nothing:"),
        # Lines without an end.
        ("Run Target Data:", " " * 100_000 + "x"),
        ("Run Target Data:", "position " + "a" * 100_000),
        ("Machine: Fräse 7", "TITLE: Straightness of X in Y"),
        ("Machine: Fräse 7", "TITLE: Theta axis"),
        ("Machine: Fräse 7", "Units: inch"),
    ],
)
def test_what_does_not_belong_together_is_refused(tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / "x.rtl"
    assert old in synthetic()
    path.write_text(synthetic().replace(old, new), encoding="utf-8")
    with pytest.raises(InputError):
        read(path)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_hostile_files_are_refused_as_mistakes(tmp_path: Path, data: st.DataObject) -> None:
    whole = synthetic().encode()
    junk = data.draw(st.binary(min_size=1, max_size=40))
    at = data.draw(st.integers(0, len(whole)))
    path = tmp_path / "x.rtl"
    path.write_bytes(data.draw(st.sampled_from([junk, whole[:at] + junk, whole[:at] + junk + whole[at:]])))
    with suppress(InputError):
        read(path)


@pytest.mark.parametrize(
    ("axis", "told", "why"), [("C", "C", "turns"), ("Y", "X", "another axis"), ("C", "X", "another")]
)
def test_an_axis_that_turns_or_is_another_one_is_refused(tmp_path: Path, axis: str, told: str, why: str) -> None:
    path = tmp_path / "axis.rtl"
    path.write_text(SHIPPED.read_text(encoding="cp1252").replace("Axis: X", f"Axis: {told}"), encoding="cp1252")
    with pytest.raises(InputError, match=why):
        list(open_source(path, {"axis": axis, "machine": "m"})[1])
