"""Accelerometers behind a virtual acquisition module: volts at any sample, always the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dtwin.schema import Floats

_SENSITIVITY_V_G = 1.0
"""True sensitivity of every virtual sensor."""

_RANGE_V = 5.0
_CODES = 2**24
_BIAS_V = 11.0
_NOISE_G = 50e-6
_UNPOWERED_V = 2e-6


@dataclass(frozen=True)
class Wiring:
    """How a channel was set up by the client.

    ``powered``: whether the module feeds the sensor (IEPE).
    ``ac_coupled``: whether the module takes the bias off.
    """

    powered: bool
    ac_coupled: bool


class Sensors:
    """What the sensors at the physical channels put out.

    Without a recording every channel carries two tones of its own and noise; all of it depends
    on the sample's number alone, so that a lost or repeated sample cannot hide.

    ``recording``, (n,): accelerations in g by physical channel, played sample by sample and begun again.
    """

    def __init__(self, channels: Sequence[str], recording: Mapping[str, Floats] | None = None, seed: int = 0) -> None:
        self._place = {name: number for number, name in enumerate(channels)}
        self._recording = dict(recording or {})
        self._seed = seed

    def felt_g(self, channel: str, first: int, n: int, rate_hz: float) -> Floats:
        """Return the acceleration at a sensor, shape (n,), in g."""
        k = np.arange(first, first + n)
        played = self._recording.get(channel)
        if played is not None:
            return np.asarray(played[k % len(played)], dtype=np.float64)
        place = self._place[channel]
        t_s = k / rate_hz
        slow = 0.05 * (1 + place) * np.sin(2 * np.pi * (9.4 + place) * t_s + place)
        fast = 0.02 * np.sin(2 * np.pi * (120.0 + 37.0 * place) * t_s)
        return slow + fast + _NOISE_G * self._noise(place, k)

    def volts(self, channel: str, wiring: Wiring, first: int, n: int, rate_hz: float) -> Floats:
        """Return what the converter reads, shape (n,), in V: coupled, clipped, in 24-bit steps.

        The converter's digital filter and its delay are not modelled, and the coupling only
        removes the bias.
        """
        if wiring.powered:
            volts = self.felt_g(channel, first, n, rate_hz) * _SENSITIVITY_V_G
            volts += 0.0 if wiring.ac_coupled else _BIAS_V
        else:
            k = np.arange(first, first + n)
            volts = _UNPOWERED_V * self._noise(self._place[channel], k)
        step_v = 2 * _RANGE_V / _CODES
        return np.clip(np.round(volts / step_v) * step_v, -_RANGE_V, _RANGE_V - step_v)

    def _noise(self, place: int, k: NDArray[np.int64]) -> Floats:
        """Return uniform noise of unit variance that depends on place and sample alone."""
        start = (place + 1) * 0x9E3779B97F4A7C15 + self._seed * 0xD1B54A32D192ED03
        mixed = k.astype(np.uint64) + np.uint64(start % 2**64)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
        mixed ^= mixed >> np.uint64(31)
        return (mixed.astype(np.float64) / 2.0**64 - 0.5) * np.sqrt(12.0)
