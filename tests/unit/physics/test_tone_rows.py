"""What a run of a tone is reduced to, where samples are lost or few."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.kinds.sinusoidal._grid import tone_row
from dtwin.physics.diagnose import diagnose
from dtwin.physics.library import Library
from dtwin.physics.observations import observe
from dtwin.schema import Campaign, Floats, Run, RunMeta

LATE_UM, THIRD_UM = 0.4, 0.1


def tone(seconds: float = 6.0, frequency_hz: float = 20.0, rate_hz: float = 1000.0) -> Run:
    """Return a tone of 5 µm whose tool is late, and has a third harmonic."""
    t_s = np.arange(round(seconds * rate_hz)) / rate_hz
    turn = 2.0 * np.pi * frequency_hz * t_s
    error_um = -LATE_UM * np.cos(turn) + THIRD_UM * np.sin(3.0 * turn)
    command = 5e-3 * np.sin(turn)
    samples = {"t_s": t_s, "cmd_z_mm": command, "tool_z_mm": command + 1e-3 * error_um, "oil_c": 20.0 + 0.0 * t_s}
    stated: dict[str, float | str] = {"axis": "Z", "frequency_hz": frequency_hz, "amplitude_um": 5.0}
    return Run(RunMeta("g1", kind="sinusoidal", condition=stated), samples)


def changed(run: Run, **samples: Floats) -> Run:
    """Return a run with other samples."""
    return replace(run, samples={**run.samples, **samples})


def expected_um(row_um: Floats) -> Floats:
    """Return the error of such a tone at the phases of a row."""
    phase = (np.arange(len(row_um)) + 0.5) * 2.0 * np.pi / len(row_um)
    return np.asarray(-LATE_UM * np.cos(phase) + THIRD_UM * np.sin(3.0 * phase))


def row_um(run: Run) -> Floats:
    """Return what a run is reduced to."""
    return tone_row(run, 0.0).y_um


@pytest.mark.parametrize("lost", [np.nan, np.inf])
def test_samples_that_were_lost_are_left_out(lost: float) -> None:
    run = tone()
    tool = run.samples["tool_z_mm"].copy()
    tool[1500:1600], tool[3000::101] = lost, np.nan
    found = row_um(changed(run, tool_z_mm=tool))
    assert found == pytest.approx(expected_um(found), abs=1e-9)


def test_a_logged_column_counts_where_it_was_read() -> None:
    run = tone()
    oil_c = run.samples["oil_c"].copy()
    oil_c[:10] = np.nan
    columns: Mapping[str, float | Floats] = tone_row(changed(run, oil_c=oil_c, gap_c=np.nan * oil_c), 0.0).columns
    assert columns["oil_c"] == 20.0
    assert "gap_c" not in columns


@pytest.mark.parametrize(("seconds", "frequency_hz", "rate_hz"), [(0.5, 100.0, 5000.0), (1.0, 200.0, 10000.0)])
def test_fast_tones_are_short(seconds: float, frequency_hz: float, rate_hz: float) -> None:
    found = row_um(tone(seconds, frequency_hz, rate_hz))
    assert found == pytest.approx(expected_um(found), abs=1e-9)


def test_of_a_slow_tone_a_whole_period_is_kept() -> None:
    run = tone(2.0, 0.5)
    noisy = run.samples["tool_z_mm"] + 1e-6 * np.random.default_rng(1).standard_normal(len(run.samples["t_s"]))
    found = row_um(changed(run, tool_z_mm=noisy))
    assert found == pytest.approx(expected_um(found), abs=1e-3)


def test_half_a_period_is_refused() -> None:
    with pytest.raises(InputError, match="shorter than its period"):
        tone_row(tone(1.0, 0.5), 0.0)


def test_an_endless_amplitude_is_refused() -> None:
    run = tone()
    stated = {**run.meta.condition, "amplitude_um": float("inf")}
    with pytest.raises(InputError, match="needs axis, amplitude and frequency"):
        tone_row(replace(run, meta=replace(run.meta, condition=stated)), 0.0)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(("late_um", "expected"), [(0.0, set()), (LATE_UM, {"tracking_delay Z"})])
def test_repeats_without_any_noise_are_judged(late_um: float, expected: set[str]) -> None:
    runs = []
    for repeat in (1, 2, 3):
        for number, frequency_hz in enumerate((5.0, 10.0, 20.0, 40.0)):
            run = tone(2.0, frequency_hz)
            turn = 2.0 * np.pi * frequency_hz * run.samples["t_s"]
            late_mm = 1e-3 * late_um * frequency_hz / 40.0 * np.cos(turn)
            meta = replace(run.meta, run_id=f"g{number}-{repeat}", repeat=repeat)
            runs.append(replace(changed(run, tool_z_mm=run.samples["cmd_z_mm"] - late_mm), meta=meta))
    found = diagnose(observe(Campaign("tones", "slide", kind="sinusoidal"), runs), [], Library())
    assert expected <= {s.label for s in found.group}, found.headline
    assert bool(found.found) == bool(expected), found.headline
