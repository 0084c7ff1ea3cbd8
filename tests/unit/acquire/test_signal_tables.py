"""Signals as tables of text: thermocouples of a logger beside the runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from dtwin.acquire.signal_files import read_signals, write_signals
from dtwin.errors import InputError
from dtwin.schema import SignalGroup


@pytest.mark.parametrize(
    "text",
    [
        "t_s,bed_1_c,column_c\n0,20.5,21\n60,20.6,\n120,20.7,22\n",
        "Zeit [s];bed 1 [°C];column [°C]\n0;20,5;21\n60;20,6;\n120;20,7;22\n",
        "Datum;bed_1_c;column_c\n31.12.2026 08:00:00;20,5;21\n31.12.2026 08:01:00;20,6;\n31.12.2026 08:02:00;20,7;22\n",
        "time;bed 1;column\ns;°C;°C\n0;20,5;21\n60;20,6;\n120;20,7;22\n",
    ],
)
def test_a_table_of_temperatures_is_a_group_of_signals(tmp_path: Path, text: str) -> None:
    path = tmp_path / "c000.thermocouples.csv"
    path.write_text(text, encoding="utf-8")
    (group,) = read_signals(path)
    assert group.name == "thermocouples"
    assert group.rate_hz == pytest.approx(1.0 / 60.0)
    assert group.columns["bed_1_c"].tolist() == [20.5, 20.6, 20.7]
    assert np.isnan(group.columns["column_c"][1])


def test_a_log_of_one_channel_by_time_stamps_is_a_table(tmp_path: Path) -> None:
    path = tmp_path / "c000.bed.csv"
    path.write_text("Logger 7\nZeit;bed [°C]\n08:00:00;20,5\n08:01:00;20,6\n08:02:00;20,7\n", encoding="utf-8")
    (group,) = read_signals(path)
    assert (group.rate_hz, group.columns["bed_c"].tolist()) == (1.0 / 60.0, [20.5, 20.6, 20.7])


@pytest.mark.parametrize("head", ["bed [°F]", "bed (deg F)", "bed_degF"])
def test_degrees_fahrenheit_are_degrees_celsius_here(tmp_path: Path, head: str) -> None:
    path = tmp_path / "c000.thermocouples.csv"
    path.write_text(f"t_s,{head},rise [°F]\n0,32,0\n60,68,1.8\n120,212,18\n", encoding="utf-8")
    (group,) = read_signals(path)
    assert group.columns["bed_c"] == pytest.approx([0.0, 20.0, 100.0])
    # A difference has no zero.
    assert group.columns["rise_c"] == pytest.approx([0.0, 1.0, 10.0])


@pytest.mark.parametrize("head", ["bed x [m/s²]", "bed x (m/s^2)", "bed x [mg]"])
def test_accelerations_are_read_in_g(tmp_path: Path, head: str) -> None:
    path = tmp_path / "r001.bed.csv"
    size = 1000.0 if "mg" in head else 9.80665
    path.write_text(f"Time [s],{head}\n0,{size}\n0.1,0\n0.2,{-size}\n", encoding="utf-8")
    assert read_signals(path)[0].columns["bed_x_g"] == pytest.approx([1.0, 0.0, -1.0])


def test_a_file_of_another_form_is_not_called_damaged(tmp_path: Path) -> None:
    path = tmp_path / "r001.bed.wav"
    path.write_bytes(b"RIFF....WAVE")
    with pytest.raises(InputError) as refused:
        read_signals(path)
    assert refused.value.code == "signals.type"


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("t_s,T_bed\n0,20.5\n60,20.6\n", "signals.unit"),
        ("t_s,bed [K]\n0,293\n60,294\n", "signals.unit"),
        ("bed_c,column_c\n20,21\n20,21\n", "signals.rate"),
        ("nothing here\n", "import.table"),
    ],
)
def test_a_table_that_tells_no_unit_or_clock_is_refused(tmp_path: Path, text: str, code: str) -> None:
    path = tmp_path / "c000.thermocouples.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as refused:
        read_signals(path)
    assert refused.value.code == code


@pytest.mark.parametrize("name", ["bed_c", "t_s"])
@pytest.mark.parametrize(
    "column",
    [pa.array([[1.0], [2.0]]), pa.array([0, 1], pa.timestamp("us")), pa.array(["0", "1"]), pa.array([True, False])],
)
def test_a_column_that_holds_no_numbers_is_refused(tmp_path: Path, name: str, column: pa.Array) -> None:
    path = tmp_path / "c000.thermocouples.parquet"
    pq.write_table(pa.table({"t_s": pa.array([0.0, 1.0]), name: column}), path)
    with pytest.raises(InputError) as refused:
        read_signals(path)
    assert refused.value.code == ("table.nested" if pa.types.is_list(column.type) else "signals.columns")


def test_signals_of_one_name_or_without_a_reading_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "r1.accelerometers.parquet"
    numbers = pa.array([0.0, 1.0])
    pq.write_table(pa.table([numbers, numbers, numbers], ["t_s", "wrist_x_g", "wrist_x_g"]), path)
    with pytest.raises(InputError, match="one name"):
        read_signals(path)
    write_signals(path, SignalGroup("accelerometers", 100.0, {"wrist_x_g": np.zeros(0)}))
    with pytest.raises(InputError, match="no reading"):
        read_signals(path)
    write_signals(path, SignalGroup("accelerometers", 100.0, {"wrist_x_g": np.array([0.0, np.inf])}))
    with pytest.raises(InputError, match="computed with"):
        read_signals(path)


@pytest.mark.parametrize(
    ("spoil", "even"),
    [
        (lambda t: t, True),
        (lambda t: np.round(t, 1), True),
        (lambda t: t + np.where(np.arange(t.size) < 300, 0.0, 3.0), False),
        (lambda t: np.where(np.arange(t.size) == 100, t[90], t), False),
        (lambda t: np.where(np.arange(t.size) == 100, np.nan, t), False),
        (lambda t: t[np.arange(t.size) % 100 != 99], True),
        (lambda t: np.concatenate([t[:200], t[210:]]), False),
    ],
)
def test_a_clock_that_jumps_or_lost_readings_is_refused(tmp_path: Path, spoil: Any, even: bool) -> None:
    path = tmp_path / "r1.accelerometers.parquet"
    t_s = spoil(0.01 * np.arange(700))
    pq.write_table(pa.table({"t_s": t_s, "wrist_x_g": np.sin(t_s)}), path)
    if even:
        assert read_signals(path)[0].rate_hz == pytest.approx(100.0, rel=0.02)
        return
    with pytest.raises(InputError) as refused:
        read_signals(path)
    assert refused.value.code == "signals.clock"
