"""Amplitude and phase of a tone of known frequency, by least squares."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

import numpy as np

from dtwin.schema import Floats


@dataclass(frozen=True)
class Tone:
    """One tone over a stretch of a signal.

    ``phasor``: ``amplitude * exp(i * phase)`` of ``amplitude * sin(2 pi f t + phase)``.
    ``rest_rms``: what the tone, a constant and a slope leave.
    """

    phasor: complex
    rest_rms: float

    @property
    def amplitude(self) -> float:
        """Amplitude in the unit of the signal."""
        return abs(self.phasor)

    @property
    def share(self) -> float:
        """Share of the tone in the power without mean and slope."""
        power = 0.5 * self.amplitude**2
        return power / (power + self.rest_rms**2) if power > 0.0 else 0.0


def fit_tone(t_s: Floats, values: Floats, frequency_hz: float) -> Tone:
    """Fit a tone beside a constant and a slope (IEEE Std 1057, three-parameter fit, and slope).

    ``t_s``, shape (n,): times, any spacing.
    ``values``, shape (n,): signal.
    """
    angle = 2.0 * np.pi * frequency_hz * t_s
    design = np.column_stack([np.sin(angle), np.cos(angle), np.ones_like(t_s), t_s - t_s.mean()])
    coefficients = np.linalg.lstsq(design, values, rcond=None)[0]
    rest = values - design @ coefficients
    return Tone(complex(coefficients[0], coefficients[1]), float(np.sqrt(np.mean(rest**2))))


def lag_deg(reference: Tone, follower: Tone) -> float:
    """Return by how many degrees one tone lags behind another, -180 to 180; NaN where there is none."""
    turned = reference.phasor * follower.phasor.conjugate()
    return math.degrees(cmath.phase(turned)) if turned else math.nan


@dataclass(frozen=True)
class ToneErrors:
    """How a tone was followed.

    ``encoder_lag_deg``, ``tool_lag_deg``: by how much encoder and tool lag behind the command.
    ``tracking_um``, ``total_um``: amplitudes of encoder minus command and of tool minus command: lengths of the
    difference of vectors, not differences of lengths.
    """

    command_um: float
    encoder_um: float
    tool_um: float
    encoder_lag_deg: float
    tool_lag_deg: float
    tracking_um: float
    total_um: float

    @property
    def amplitude_error_um(self) -> float:
        """Amplitude of the tool minus that of the command."""
        return self.tool_um - self.command_um


def tone_errors(
    t_s: Floats, command_um: Floats, encoder_um: Floats, tool_um: Floats, frequency_hz: float
) -> ToneErrors:
    """Return how encoder and tool follow a commanded tone.

    ``t_s``, shape (n,): times.
    ``command_um``, ``encoder_um``, ``tool_um``, shape (n,): positions.
    """
    command, encoder, tool = (fit_tone(t_s, values, frequency_hz) for values in (command_um, encoder_um, tool_um))
    return ToneErrors(
        command.amplitude,
        encoder.amplitude,
        tool.amplitude,
        lag_deg(command, encoder),
        lag_deg(command, tool),
        abs(encoder.phasor - command.phasor),
        abs(tool.phasor - command.phasor),
    )
