"""Campaigns of tones: written, read, and what is wrong with them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dtwin.acquire.campaign_folder import open_campaign
from dtwin.acquire.quality import judge_campaign, judge_run
from dtwin.errors import InputError
from dtwin.kinds.sinusoidal._check import followed
from dtwin.kinds.sinusoidal._report import tone_lines
from dtwin.kinds.sinusoidal._simulate import Grid, simulate_turning, virtual_runs, virtual_slide
from dtwin.report.checking import check_source, render_check, run_result
from dtwin.schema import Run

SMALL = Grid((5.0, 40.0), (1.0, 8.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("tones") / "campaign"
    assert simulate_turning(made, grid=SMALL, seed=2) == 4
    return made


def codes(run: Run) -> set[str]:
    return {f.code for f in judge_run(run)}


def loud() -> Run:
    run = next(virtual_runs(Grid((40.0,), (8.0,)), virtual_slide("linear"), 1))
    condition = dict(run.meta.condition) | {"z_bandwidth_hz": 50.0}
    return replace(run, meta=replace(run.meta, condition=condition))


def test_what_is_written_is_read(folder: Path) -> None:
    opened = open_campaign(folder)
    assert opened.campaign.kind == "sinusoidal"
    runs = [run for part, _ in opened for run in part]
    assert [run.meta.condition["frequency_hz"] for run in runs] == [5.0, 5.0, 40.0, 40.0]
    assert runs[0].meta.condition["z_bandwidth_hz"] == 50.0
    assert runs[0].signals[0].rate_hz == 1000.0
    assert codes(runs[0]) == {"sensor.below_noise"}
    assert codes(runs[3]) == set()
    assert {f.code for f in judge_campaign(runs)} == {"campaign.no_repeat"}
    with pytest.raises(InputError, match="already"):
        simulate_turning(folder)
    with pytest.raises(InputError, match="no such slide"):
        simulate_turning(folder.parent / "x", truth="other")


def test_check_prints_amplitude_and_lag_of_each_run(folder: Path) -> None:
    result = check_source(folder)
    tone = result["runs"][3]["tone"]
    assert tone["tool_um"] == pytest.approx(15.2, abs=0.1)
    assert tone["tool_lag_deg"] == pytest.approx(8.2, abs=0.1)
    text = render_check(result)
    assert "amplitude error µm" in text
    assert "does not hear 1 µm at 5 Hz" in text


def test_an_encoder_that_stands_still_lags_by_nothing_that_is_known() -> None:
    run = loud()
    stood = replace(run, samples=dict(run.samples) | {"act_z_mm": np.zeros(len(run.samples["t_s"]))})
    told = followed(stood)
    assert told is not None
    assert np.isnan(told.encoder_lag_deg)
    shown = tone_lines([run_result(stood)])
    assert "nan" not in "\n".join(shown)
    assert shown[2].split()[3:5] == ["0.000", "-"]
    assert "reading.clipped" in codes(stood)


def test_a_grid_with_holes_is_told(folder: Path) -> None:
    runs = [run for part, _ in open_campaign(folder) for run in part]
    found = {f.code: f for f in judge_campaign(runs[:3])}
    assert found["sinusoidal.grid"].numbers == {"missing_1": 1.0}


def thinned(run: Run) -> Run:
    samples = {k: v[::14] for k, v in run.samples.items()}
    return replace(run, samples=samples, meta=replace(run.meta, sample_rate_hz=1000.0 / 14))


def conditioned(**values: Any) -> Callable[[Run], Run]:
    def change(run: Run) -> Run:
        return replace(run, meta=replace(run.meta, condition=dict(run.meta.condition) | values))

    return change


def clipped(run: Run) -> Run:
    tool = run.samples["tool_z_mm"]
    limited = np.clip(tool, None, 0.9 * tool.max())
    return replace(run, samples=dict(run.samples) | {"tool_z_mm": limited})


def saturated(run: Run) -> Run:
    group = run.signals[0]
    values = group.columns["tool_z_g"]
    limited = np.clip(values, -0.02, 0.02)
    return replace(run, signals=(replace(group, columns={"tool_z_g": limited}),))


def in_volts(run: Run) -> Run:
    group = run.signals[0]
    return replace(run, signals=(replace(group, columns={"tool_z_v": group.columns["tool_z_g"]}),))


def without(name: str) -> Callable[[Run], Run]:
    def change(run: Run) -> Run:
        return replace(run, samples={k: v for k, v in run.samples.items() if k != name})

    return change


def cut_short(run: Run) -> Run:
    return replace(run, samples={k: v[:4000] for k, v in run.samples.items()})


@pytest.mark.parametrize(
    ("change", "code", "severity"),
    [
        (thinned, "sinusoidal.aliasing", "error"),
        (conditioned(z_bandwidth_hz=45.0), "sinusoidal.beyond_safe", "error"),
        (conditioned(frequency_hz=35.0), "sinusoidal.not_the_tone", "error"),
        (conditioned(amplitude_um=5.0), "sinusoidal.not_the_tone", "error"),
        (conditioned(frequency_hz=39.98), "sinusoidal.frequency", "warning"),
        (clipped, "reading.clipped", "error"),
        (saturated, "sensor.saturated", "error"),
        (in_volts, "sensor.unit", "warning"),
        (without("tool_z_mm"), "sinusoidal.no_reference", "warning"),
        (cut_short, "sinusoidal.short", "warning"),
    ],
)
def test_what_is_wrong_is_found(change: Callable[[Run], Run], code: str, severity: str) -> None:
    good = loud()
    assert codes(good) == set()
    found = {f.code: f.severity for f in judge_run(change(good))}
    assert found.get(code) == severity


def test_the_frequency_that_was_run_is_said() -> None:
    (found,) = (f for f in judge_run(conditioned(frequency_hz=39.98)(loud())) if f.code == "sinusoidal.frequency")
    assert found.numbers["frequency_hz"] == pytest.approx(40.0, abs=1e-4)
    assert "40 Hz, not of 39.98 Hz" in found.message


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("frequency_hz = 40.0\n", "", "must state frequency and amplitude"),
        ("frequency_hz = 40.0\n", "frequency_hz = -40\n", "must state frequency and amplitude"),
        ("z_bandwidth_hz = 50.0", 'z_bandwidth_hz = "wide"', "z_bandwidth_hz is not usable"),
    ],
)
def test_a_run_without_its_tone_or_with_no_bandwidth_is_refused(
    folder: Path, tmp_path: Path, old: str, new: str, told: str
) -> None:
    changed = tmp_path / "changed"
    shutil.copytree(folder, changed)
    text = (changed / "campaign.toml").read_text()
    assert old in text
    (changed / "campaign.toml").write_text(text.replace(old, new))
    with pytest.raises(InputError, match=told):
        list(open_campaign(changed))
