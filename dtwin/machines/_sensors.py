"""Two triaxial accelerometers, at the tool flange and on the base, behind AC coupling, and the ball bar on its own clock."""

from __future__ import annotations

import numpy as np

from dtwin.kinematics import kernel
from dtwin.machines.parameters import AccelerometerParameters, BallbarParameters
from dtwin.schema import Floats, SignalGroup
from dtwin.units import G_MM_S2, UM_PER_MM

_UG = 1e-6


@kernel
def _resample_kernel(values: Floats, rate_hz: float, times_s: Floats, out: Floats) -> None:
    """Interpolate columns at times by cubic Lagrange polynomials; ends are held.

    ``values``, (n, m): samples at multiples of ``1 / rate_hz`` from time 0.
    ``rate_hz``: rate of ``values``.
    ``times_s``, (k,): wanted times.
    ``out``, (k, m): receives the result.
    """
    last = values.shape[0] - 1
    for n in range(times_s.shape[0]):
        place = min(max(times_s[n] * rate_hz, 0.0), float(last))
        left = min(max(int(place), 1), last - 2)
        u = place - left
        before = -u * (u - 1.0) * (u - 2.0) / 6.0
        here = (u + 1.0) * (u - 1.0) * (u - 2.0) / 2.0
        after = -(u + 1.0) * u * (u - 2.0) / 2.0
        beyond = (u + 1.0) * u * (u - 1.0) / 6.0
        for m in range(values.shape[1]):
            out[n, m] = (
                before * values[left - 1, m]
                + here * values[left, m]
                + after * values[left + 1, m]
                + beyond * values[left + 2, m]
            )


@kernel
def _couple_kernel(signal: Floats, corner_hz: float, rate_hz: float) -> None:
    """Apply a first-order high-pass in place, settled on the first sample.

    Bilinear transform with the corner prewarped; ``signal`` has shape (n, channels).
    """
    k = np.tan(np.pi * corner_hz / rate_hz)
    gain, pole = 1.0 / (1.0 + k), (1.0 - k) / (1.0 + k)
    for m in range(signal.shape[1]):
        last_in = signal[0, m]
        last_out = 0.0
        for n in range(signal.shape[0]):
            value = signal[n, m]
            last_out = pole * last_out + gain * (value - last_in)
            last_in = value
            signal[n, m] = last_out


@kernel
def _felt_kernel(flange_mm: Floats, rotation: Floats, rate_hz: float, felt_g: Floats) -> None:
    """Write the specific force at the flange, in the tool's axes, in g.

    ``flange_mm``, (n, 3): position of the flange in the base frame.
    ``rotation``, (n, 9): rotation of the tool by rows.
    ``felt_g``, (n, 6): receives tool-frame specific force (3) and base-frame acceleration (3).
    """
    for n in range(flange_mm.shape[0]):
        at = min(max(n, 1), flange_mm.shape[0] - 2)
        for i in range(3):
            bend = flange_mm[at + 1, i] - 2.0 * flange_mm[at, i] + flange_mm[at - 1, i]
            felt_g[n, 3 + i] = bend * rate_hz**2 / G_MM_S2
        for k in range(3):
            total = 0.0
            for i in range(3):
                gravity = 1.0 if i == 2 else 0.0
                total += rotation[n, 3 * i + k] * (felt_g[n, 3 + i] + gravity)
            felt_g[n, k] = total


def sensor_matrix(parameters: AccelerometerParameters, rng: np.random.Generator) -> Floats:
    """Return one sensor's matrix (3, 3): misalignment, then cross-axis, then gain."""
    tilt = np.radians(parameters.misalignment_deg) * rng.uniform(-1, 1, 3)
    turned = np.eye(3) + np.array([[0, -tilt[2], tilt[1]], [tilt[2], 0, -tilt[0]], [-tilt[1], tilt[0], 0]])
    cross = parameters.cross_axis * rng.uniform(-1, 1, (3, 3)) / np.sqrt(2.0)
    np.fill_diagonal(cross, 1.0)
    gain = np.diag(1.0 + parameters.gain_error * rng.uniform(-1, 1, 3))
    return np.asarray(gain @ cross @ turned, dtype=np.float64)


def accelerometer_group(
    parameters: AccelerometerParameters,
    matrices: tuple[Floats, Floats],
    base_share: float,
    motion: tuple[Floats, Floats, float],
    start_s: float,
    ppm: float,
    rng: np.random.Generator,
) -> SignalGroup:
    """Return what the digitiser records during a run.

    ``matrices``: wrist and base sensor, from ``sensor_matrix``.
    ``base_share``: part of the arm's acceleration that reaches the base.
    ``motion``: flange positions (n, 3) in mm, rotations (n, 9), their rate in Hz.
    ``start_s``, ``ppm``: machine time of the first sample; error of the digitiser's clock.
    Columns ``wrist_x_g`` ... ``base_z_g``.
    """
    flange_mm, rotation, rate_hz = motion
    felt_g = np.empty((len(flange_mm), 6))
    _felt_kernel(flange_mm, rotation, rate_hz, felt_g)
    wrist_matrix, base_matrix = matrices
    felt_g[:, :3] = felt_g[:, :3] @ wrist_matrix.T
    felt_g[:, 3:] = base_share * felt_g[:, 3:] @ base_matrix.T
    n = int((len(flange_mm) / rate_hz - start_s) * parameters.rate_hz)
    times_s = start_s + np.arange(n) / (parameters.rate_hz * (1.0 + 1e-6 * ppm))
    signal = np.empty((n, 6))
    _resample_kernel(felt_g, rate_hz, times_s, signal)
    hum = np.sin(2.0 * np.pi * (parameters.base_line_hz * times_s + rng.uniform()))
    signal[:, 5] += np.sqrt(2.0) * _UG * parameters.base_line_ug * hum
    signal[:, 3:] += _UG * parameters.base_floor_ug * rng.standard_normal((n, 3))
    _couple_kernel(signal, parameters.corner_hz, parameters.rate_hz)
    signal += _UG * parameters.noise_rms_ug * rng.standard_normal((n, 6))
    np.clip(signal, -parameters.range_g, parameters.range_g, out=signal)
    names = [f"{place}_{axis}_g" for place in ("wrist", "base") for axis in "xyz"]
    columns = {name: np.ascontiguousarray(signal[:, m]) for m, name in enumerate(names)}
    return SignalGroup("accelerometers", parameters.rate_hz, columns)


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
    _resample_kernel(tool_mm, tool_rate_hz, times_s, tool)
    length_mm = np.sqrt(np.sum((tool - centre_mm) ** 2, axis=1))
    deviation_um = UM_PER_MM * (length_mm - radius_mm) + noise_um
    quanta = np.round(deviation_um / parameters.quantum_um)
    return np.asarray(quanta * parameters.quantum_um / UM_PER_MM, dtype=np.float64)
