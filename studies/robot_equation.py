"""The equation that corrected the source thesis's robot: three printed forms, and what decides them."""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from scipy.stats import kurtosis
from sklearn.metrics import r2_score

from dtwin.machines.cobot import CircleCondition, CobotRecording, VirtualCobot
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

Form = Literal["equation 6-1", "its terms, as rewritten below it", "the program that ran"]
FORMS: tuple[Form, ...] = get_args(Form)
# Peak X in g, mean square Y in g², RMS X in g, kurtosis X: quiet, ordinary, at the critical RMS.
WINDOWS = ((0.05, 0.0004, 0.02, 3.0), (0.15, 0.0025, 0.05, 3.0), (0.4, 0.0146, 0.121, 3.0))
FEEDS_MM_MIN = (2000.0, 4000.0, 6000.0)
_RADIUS_MM, _WINDOW_S = 100.0, 0.5


def radial_error_mm(peak_g: Floats, power_g2: Floats, rms_g: Floats, kurt: Floats, form: Form) -> Floats:
    """Return the radial error by one of the three forms that the thesis gives.

    ``peak_g``, ``power_g2``, ``rms_g``, ``kurt``: peak along X, mean square along Y, RMS and kurtosis along X of one
    window; the units are not printed, these are the ones that give plausible sizes.
    ``form``: one of ``FORMS``.
    Returns mm.
    """
    impulsive = 16.5 * (0.00161 * kurt - 1.0) ** 2
    scaling = 0.0158 * peak_g + 21.8
    if form == "equation 6-1":
        return scaling * (power_g2 - 0.362 * np.exp(-14200.0 * (0.121 - rms_g) ** 2) - impulsive) - 0.0209
    if form == "its terms, as rewritten below it":
        dip = 0.362 * np.exp(-14200.0 * (0.121 - rms_g) ** 2 - impulsive)
        return scaling * (power_g2 - dip) - 0.0209
    dip = 0.362 * np.exp(-1420.0 * (0.121 - rms_g) ** 2 - impulsive)
    return 0.0158 * peak_g + 21.8 * power_g2 - dip - 0.0209


def robot_equation(seed: int) -> dict[str, Any]:
    """Evaluate the forms at given windows, and the one that ran on windows of the virtual cobot.

    ``seed``: of the cobot.
    Returns ``at``: value of each form in mm by window; ``windows``, ``runs``: how many of the cobot; ``decided_r2``: of
    the form that ran, by 21.8 times the mean square along Y alone; ``held_against_bar_r2``: of that form, against the
    mean of the ball bar in the same window.
    """
    cobot = VirtualCobot(seed=seed)
    made = [
        cobot.measure(CircleCondition("XY", _RADIUS_MM, feed, way), setup="s", repeat=1)
        for feed in FEEDS_MM_MIN
        for way in ("CCW", "CW")
    ]
    windows = np.concatenate([_windows(run) for run in made])
    peak, power, rms, kurt, bar_mm = windows.T
    ran = radial_error_mm(peak, power, rms, kurt, "the program that ran")
    first, second, third, fourth = np.array(WINDOWS).T
    return {
        "at": {form: radial_error_mm(first, second, third, fourth, form).tolist() for form in FORMS},
        "runs": len(made),
        "windows": len(windows),
        "decided_r2": float(r2_score(ran, 21.8 * power - 0.0209)),
        "held_against_bar_r2": float(r2_score(bar_mm, ran)),
        "said_um": (UM_PER_MM * np.percentile(ran, [0, 50, 100])).tolist(),
        "measured_um": (UM_PER_MM * np.percentile(bar_mm, [0, 50, 100])).tolist(),
    }


def _windows(made: CobotRecording) -> Floats:
    """Return peak, power, RMS, kurtosis and the bar's mean in mm of each window, shape (n, 5)."""
    sensors = made.groups[0]
    n = round(_WINDOW_S * sensors.rate_hz)
    # As the thesis's program: wrist less base, not filtered.
    x, y = (sensors.columns[f"wrist_{a}_g"] - sensors.columns[f"base_{a}_g"] for a in "xy")
    sensor_s = made.truth.accelerometer_start_s + np.arange(len(x)) / sensors.rate_hz
    bar_s = made.truth.bar_start_s + np.arange(len(made.deviation_mm)) / made.sample_rate_hz
    begin_s, end_s = bar_s[made.window[0]], bar_s[made.window[1] - 1]
    rows = []
    for first in range(0, len(x) - n, n):
        if sensor_s[first] < begin_s or sensor_s[first + n] > end_s:
            continue
        part, beside = x[first : first + n], y[first : first + n]
        during = (bar_s >= sensor_s[first]) & (bar_s < sensor_s[first + n])
        rows.append(
            (
                part.max(),
                np.mean(beside**2),
                np.sqrt(np.mean(part**2)),
                kurtosis(part, fisher=False),
                made.deviation_mm[during].mean(),
            )
        )
    return np.array(rows)
