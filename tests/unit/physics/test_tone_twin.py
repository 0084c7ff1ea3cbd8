"""Twins of tones, on a slide that is followed in time and shares no formula with the library."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.sinusoidal._simulate import Grid, simulate_turning, virtual_runs, virtual_slide
from dtwin.lake.parquet import write_parquet
from dtwin.physics.diagnose import diagnose
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations, observe
from dtwin.physics.twin import chosen_terms
from dtwin.physics.whitening import from_harmonics, to_harmonics
from dtwin.schema import Campaign, Run
from dtwin.twins.measured import load

LIBRARY = Library()
TONES = Grid((5.0, 10.0, 20.0, 30.0, 40.0), (2.0, 5.0, 10.0))
CAMPAIGN = Campaign("tones", "slide", kind="sinusoidal")


def measured(truth: str) -> list[Run]:
    """Three repeats, each group on a slide whose stiffness is not quite what it was."""
    rng = np.random.default_rng(5)
    runs = []
    for repeat in (1, 2, 3):
        for number, (frequency_hz, amplitude_um) in enumerate(TONES.groups, start=1):
            slide = virtual_slide(truth)
            warm, warmer = 1.0 + 0.002 * rng.standard_normal(2)
            slide = replace(slide, servo_hz=slide.servo_hz * warm, structure_hz=slide.structure_hz * warmer)
            tone = Grid((frequency_hz,), (amplitude_um,))
            (run,) = virtual_runs(tone, slide, 100 * repeat + number)
            meta = replace(run.meta, run_id=f"g{number:03d}-{repeat}", repeat=repeat)
            runs.append(replace(run, meta=meta, signals=()))
    return runs


@pytest.fixture(scope="module")
def linear() -> Observations:
    """A linear slide."""
    return observe(CAMPAIGN, measured("linear"))


def test_a_mode_is_missing_and_brings_the_error_to_the_floor(linear: Observations) -> None:
    found = diagnose(linear, [], LIBRARY)
    assert found.verdict == "missing_effect", found.headline
    assert [s.label for s in found.group] == ["structural_mode Z"]
    assert "harmonic 1 of the tone" in found.headline
    after = fit(linear, chosen_terms(["structural_mode"], LIBRARY, linear))
    assert after.rms_before_um > 1.0
    assert after.rms_after_um < 1.5 * after.noise_floor_um


def test_friction_beside_a_mode_gets_no_wrong_name() -> None:
    obs = observe(CAMPAIGN, measured("friction"))
    mode = fit(obs, chosen_terms(["structural_mode"], LIBRARY, obs))
    found = diagnose(obs, mode.terms, LIBRARY)
    # The structure filters it once more than the effect does, so that some is left: no name, or one among others.
    assert not found.group or "guideway_friction Z" in {s.label for s in found.group}, found.headline
    assert min(found.suspects, key=lambda s: s.p_value).label == "guideway_friction Z"
    both = fit(obs, [*mode.terms, *chosen_terms(["guideway_friction"], LIBRARY, obs)])
    assert both.rms_after_um < 0.6 * mode.rms_after_um


def test_a_joint_that_stiffens_is_not_called_a_mode() -> None:
    obs = observe(CAMPAIGN, measured("hardening"))
    found = diagnose(obs, [], LIBRARY)
    assert [s.label for s in found.group] == ["stiffening_joint Z"], found.headline
    twin = fit(obs, chosen_terms(["stiffening_joint"], LIBRARY, obs))
    # Its third harmonic is in no effect: that is said, and not named.
    assert diagnose(obs, twin.terms, LIBRARY).verdict == "unknown_effect"


def test_a_run_becomes_the_error_over_the_phase_of_its_command() -> None:
    (run,) = (r for r in measured("linear") if r.meta.run_id == "g015-1")
    t_s = run.samples["t_s"]
    phase = 2.0 * np.pi * 40.0 * t_s
    late = 0.3 * np.sin(phase - 0.5) + 0.1 * np.cos(3.0 * phase) + 0.02
    samples = run.samples | {"tool_z_mm": run.samples["cmd_z_mm"] + 1e-3 * late}
    obs = observe(CAMPAIGN, [replace(run, samples=samples)])
    theta = obs.grid.phase_rad
    wanted = 0.3 * np.sin(theta - 0.5) + 0.1 * np.cos(3.0 * theta) + 0.02
    np.testing.assert_allclose(obs.y_um[0], wanted, atol=1e-6)
    assert str(obs.conditions[0]) == "Z 40 Hz 10 µm"


def test_tones_that_cannot_be_reduced_are_refused() -> None:
    run = measured("linear")[0]
    without = {k: v for k, v in run.samples.items() if k != "tool_z_mm"}
    slow = {k: v[::100] for k, v in run.samples.items()}
    silent = replace(run.meta, condition={"axis": "Z"})
    for broken, code in (
        (replace(run, samples=without), "twin.columns"),
        (replace(run, samples=slow), "twin.short"),
        (replace(run, meta=silent), "twin.condition"),
    ):
        with pytest.raises(InputError) as refused:
            observe(CAMPAIGN, [broken])
        assert refused.value.code == code


@pytest.mark.parametrize("n", [15, 16, 151, 360])
def test_harmonics_keep_sums_of_squares_and_come_back(n: int) -> None:
    values = np.random.default_rng(n).standard_normal((3, n))
    there = to_harmonics(values)
    assert (there**2).sum() == pytest.approx((values**2).sum())
    np.testing.assert_allclose(from_harmonics(there), values, atol=1e-12)


def test_tones_without_the_tool_are_not_taken_for_copies(tmp_path: Path) -> None:
    simulate_turning(tmp_path / "blind", grid=Grid((10.0,), (2.0, 5.0)))
    for run in ("g001", "g002"):
        path = tmp_path / "blind" / f"{run}.parquet"
        seen = pq.read_table(path)
        write_parquet(path, seen.drop_columns(["tool_z_mm"]))
    with pytest.raises(InputError) as refused:
        load(Home(tmp_path / "home"), str(tmp_path / "blind"))
    assert refused.value.code == "twin.columns"
