"""Slides that are slower or faster than a slow tool servo, followed in time by a solver of linear systems."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import scipy

from dtwin.physics.diagnose import diagnose
from dtwin.physics.diagnosis import Diagnosis
from dtwin.physics.library import Library
from dtwin.physics.observations import observe
from dtwin.schema import Campaign, Floats, Run, RunMeta

LIBRARY = Library()
FINER = 5


@cache
def _answered(
    numerator: tuple[float, ...], denominator: tuple[float, ...], frequency_hz: float
) -> tuple[Floats, Floats, Floats]:
    """Return the time, a tone of one micrometre, and the answer to it."""
    # A solver that draws the command as straight lines between 80 points loses 0.05 % of it, which diagnosis finds.
    every_s = np.arange(8 * 80 * FINER) / (80.0 * FINER * frequency_hz)
    wanted = np.sin(2.0 * np.pi * frequency_hz * every_s)
    _, answer, _ = scipy.signal.lsim((numerator, denominator), wanted, every_s)
    return every_s[::FINER], wanted[::FINER], answer[::FINER]


def named(
    numerator: list[float],
    denominator: list[float],
    frequencies_hz: tuple[float, ...],
    amplitudes_um: tuple[float, ...],
    noise_um: float,
) -> Diagnosis:
    """Diagnose tones of eight periods, three times, of a slide with such a transfer function from command to tool."""
    rng = np.random.default_rng(3)
    runs: list[Run] = []
    for repeat in (1, 2, 3):
        for frequency_hz in frequencies_hz:
            t_s, of_command, of_tool = _answered(tuple(numerator), tuple(denominator), frequency_hz)
            for amplitude_um in amplitudes_um:
                command, tool = amplitude_um * of_command, amplitude_um * of_tool
                wander = 1.0 + 0.002 * rng.standard_normal()
                read = command + wander * (tool - command) + noise_um * rng.standard_normal(len(t_s))
                stated: dict[str, float | str] = {
                    "axis": "Z",
                    "frequency_hz": frequency_hz,
                    "amplitude_um": amplitude_um,
                }
                meta = RunMeta(f"g{len(runs)}", kind="sinusoidal", condition=stated, repeat=repeat)
                samples = {"t_s": t_s, "cmd_z_mm": 1e-3 * command, "tool_z_mm": 1e-3 * read}
                runs.append(Run(meta, samples))
    return diagnose(observe(Campaign("tones", "slide", kind="sinusoidal"), runs), [], LIBRARY)


SLOW, SLOW_UM = (1.0, 2.0, 4.0, 6.0, 8.0), (50.0, 200.0, 800.0)
FAST, FAST_UM = (40.0, 80.0, 120.0, 160.0, 200.0), (2.0, 6.0, 20.0)


@pytest.mark.parametrize(
    ("mode_hz", "frequencies_hz", "amplitudes_um", "noise_um"),
    [
        (14.0, SLOW, SLOW_UM, 0.1),
        (18.0, SLOW, SLOW_UM, 0.1),
        (360.0, FAST, FAST_UM, 0.01),
        (420.0, FAST, FAST_UM, 0.01),
    ],
)
def test_a_mode_of_a_slow_or_a_fast_slide_is_named(
    mode_hz: float, frequencies_hz: tuple[float, ...], amplitudes_um: tuple[float, ...], noise_um: float
) -> None:
    w, damping = 2.0 * np.pi * mode_hz, 0.03
    swings = [2.0 * damping * w, w**2]
    found = named(swings, [1.0, *swings], frequencies_hz, amplitudes_um, noise_um)
    assert [s.label for s in found.group][:1] == ["structural_mode Z"], found.headline
    assert len(found.found) == 1, found.headline


@pytest.mark.parametrize(
    ("loop_hz", "frequencies_hz", "amplitudes_um", "noise_um"),
    [
        (14.0, SLOW, SLOW_UM, 0.1),
        (20.0, SLOW, SLOW_UM, 0.1),
        (380.0, FAST, FAST_UM, 0.01),
        (480.0, FAST, FAST_UM, 0.01),
    ],
)
def test_the_loop_of_a_slow_or_a_fast_slide_is_named(
    loop_hz: float, frequencies_hz: tuple[float, ...], amplitudes_um: tuple[float, ...], noise_um: float
) -> None:
    w, damping = 2.0 * np.pi * loop_hz, 0.5
    found = named([1.6 * damping * w, w**2], [1.0, 2.0 * damping * w, w**2], frequencies_hz, amplitudes_um, noise_um)
    assert [s.label for s in found.group][:1] == ["servo_response Z"], found.headline
    assert len(found.found) == 1, found.headline


def test_a_gain_that_is_off_by_one_per_cent_is_a_scale() -> None:
    found = named([1.01], [1.0], FAST, FAST_UM, 0.01)
    assert [group[0].label for group in found.found] == ["lead_error Z"], found.headline


def test_inertia_and_a_delay_together_are_what_a_mode_or_a_loop_is_far_above_the_tones() -> None:
    w, late_s = 2.0 * np.pi * 150.0, 3e-4
    # After Pade, to second order.
    dead = late_s**2 / 12.0, late_s / 2.0, 1.0
    numerator = np.polymul([dead[0], -dead[1], 1.0], [0.06 * w, w**2])
    denominator = np.polymul(dead, [1.0, 0.06 * w, w**2])
    found = named(numerator.tolist(), denominator.tolist(), SLOW, SLOW_UM, 0.3)
    told = {s.effect for s in found.group}
    assert told == {"structural_mode", "servo_response", "inertial_compliance", "tracking_delay"}, found.headline
