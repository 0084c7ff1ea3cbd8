"""Instruments of the virtual slide that add nothing to what they read."""

from __future__ import annotations

from dataclasses import replace

from dtwin.kinds.sinusoidal._simulate import Instruments

_GIVEN = Instruments()
NOISELESS = replace(
    _GIVEN,
    probe_um=0.0,
    encoder_um=1e-9,
    accelerometer=replace(_GIVEN.accelerometer, gain_1=1.0, noise_g_per_root_hz=0.0, drift_g=0.0),
)
