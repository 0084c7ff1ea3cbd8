"""Twins of tones, on a slide that is followed in time and shares no formula with the library."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dtwin.acquire.virtual_turning import Grid, virtual_runs, virtual_slide
from dtwin.errors import InputError
from dtwin.physics.diagnose import diagnose
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations, observe
from dtwin.physics.twin import chosen_terms
from dtwin.physics.whitening import from_harmonics, to_harmonics
from dtwin.schema import Campaign, Run

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
            slide = replace(
                slide, servo_hz=slide.servo_hz * warm, structure_hz=slide.structure_hz * warmer
            )
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
    # Servo and structure are two modes in series: tool and command alone cannot tell which.
    assert found.verdict in ("missing_effect", "ambiguous"), found.headline
    assert "structural_mode Z" in [s.label for s in found.group]
    assert "harmonic 1 of the tone" in found.headline
    after = fit(linear, chosen_terms(["structural_mode"], LIBRARY, linear))
    assert after.rms_before_um > 1.0
    assert after.rms_after_um < 1.5 * after.noise_floor_um


def test_friction_and_a_stiffening_joint_are_closest_to_what_is_left() -> None:
    for truth, name in (("friction", "guideway_friction"), ("hardening", "stiffening_joint")):
        obs = observe(CAMPAIGN, measured(truth))
        mode = chosen_terms(["structural_mode"], LIBRARY, obs)
        found = diagnose(obs, mode, LIBRARY)
        leading = [s.effect for s in found.suspects[:3]]
        assert name in leading, (truth, leading)
        with_it = fit(obs, [*mode, *chosen_terms([name], LIBRARY, obs)])
        assert with_it.rms_after_um < 0.8 * fit(obs, mode).rms_after_um, truth


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
    assert str(obs.conditions[0]) == "Z 40 Hz 10 um"


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
