"""The ball bar: length between two balls, on the bar's own clock."""

from __future__ import annotations

import numpy as np

from dtwin.kinematics import kernel
from dtwin.machines._sensors import resample_kernel
from dtwin.machines.parameters import BallbarParameters
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM


@kernel
def drift_kernel(noise: Floats, rms: float, time_s: float, tick_s: float) -> None:
    """Turn white noise (n, m) in place into a drift of bounded variance.

    Stationary Ornstein-Uhlenbeck process, exactly discretised.
    """
    keep = np.exp(-tick_s / time_s)
    fresh = rms * np.sqrt(1.0 - keep * keep)
    for m in range(noise.shape[1]):
        value = rms * noise[0, m]
        for n in range(noise.shape[0]):
            value = keep * value + fresh * noise[n, m]
            noise[n, m] = value


def read_ballbar(
    parameters: BallbarParameters,
    tool_mm: Floats,
    tool_rate_hz: float,
    centre_mm: Floats,
    radius_mm: float,
    clock: tuple[float, float, int],
    noise_um: Floats,
) -> Floats:
    """Return the bar's deviation from the nominal radius in mm, shape (n,).

    ``tool_mm`` (ticks, 3): where the tool's ball really is.
    ``tool_rate_hz``: rate of ``tool_mm``.
    ``centre_mm`` (3,): where the ball at the table really is.
    ``clock``: machine time of the first sample in s, clock error in ppm, number of samples.
    ``noise_um`` (n,): noise and length error to add.
    """
    start_s, ppm, n = clock
    times_s = start_s + np.arange(n) / (parameters.rate_hz * (1.0 + 1e-6 * ppm))
    tool = np.empty((n, 3))
    resample_kernel(tool_mm, tool_rate_hz, times_s, tool)
    length_mm = np.sqrt(np.sum((tool - centre_mm) ** 2, axis=1))
    deviation_um = UM_PER_MM * (length_mm - radius_mm) + noise_um
    quanta = np.round(deviation_um / parameters.quantum_um)
    return np.asarray(quanta * parameters.quantum_um / UM_PER_MM, dtype=np.float64)
