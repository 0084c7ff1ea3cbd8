"""From outputs along the path's own axes to one vector in the base frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dtwin.features.compiled import compiled
from dtwin.schema import Floats
from dtwin.serve.interface import OUTPUT_FRAMES, Output

_ERROR_SIGN = {"error": -1.0, "correction": 1.0}


@compiled
def _correction_kernel(
    outputs: Floats, frames: NDArray[np.int64], signs: Floats, angle_rad: float, plane_id: float, vector_um: Floats
) -> None:
    """Write the correction vector in the base frame.

    ``outputs``, (n_outputs,): in um.
    ``frames``, (n_outputs,): position of each output's frame in ``OUTPUT_FRAMES``.
    ``signs``, (n_outputs,): -1 for a predicted error, +1 for a correction.
    ``angle_rad``: path angle, from the plane's first axis towards its second.
    ``plane_id``: 0, 1, 2 for XY, YZ, ZX; anything else gives NaN.
    ``vector_um``, (3,): receives the correction along base x, y, z.
    """
    vector_um[:] = 0.0
    if not (plane_id == 0.0 or plane_id == 1.0 or plane_id == 2.0):
        vector_um[:] = np.nan
        return
    first = int(plane_id)
    second, normal = (first + 1) % 3, (first + 2) % 3
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    for k in range(outputs.shape[0]):
        value = signs[k] * outputs[k]
        frame = frames[k]
        if frame == 0:
            vector_um[first] += value * cosine
            vector_um[second] += value * sine
        elif frame == 1:
            vector_um[first] -= value * sine
            vector_um[second] += value * cosine
        elif frame == 2:
            vector_um[normal] += value
        else:
            vector_um[frame - 3] += value


@compiled
def _kernel_many(
    outputs: Floats, frames: NDArray[np.int64], signs: Floats, angle_rad: Floats, plane_id: float, vectors_um: Floats
) -> None:
    """Write the correction vectors of successive ticks, shape (n, 3)."""
    for tick in range(outputs.shape[0]):
        _correction_kernel(outputs[tick], frames, signs, angle_rad[tick], plane_id, vectors_um[tick])


@compiled
def _band_kernel(
    half_um: Floats, frames: NDArray[np.int64], angle_rad: float, plane_id: float, band_um: Floats, largest_um: Floats
) -> None:
    """Write the half widths along base x, y, z: those of several outputs add as independent ones.

    ``half_um``, (n_outputs,): half width of each output.
    ``band_um``, (3,): receives them.
    ``largest_um``, (1,): receives the largest length so far.
    Others as in ``_correction_kernel``.
    """
    band_um[:] = 0.0
    if not (plane_id == 0.0 or plane_id == 1.0 or plane_id == 2.0):
        band_um[:] = np.nan
        return
    first = int(plane_id)
    second, normal = (first + 1) % 3, (first + 2) % 3
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    for k in range(half_um.shape[0]):
        square, frame = half_um[k] ** 2, frames[k]
        if frame == 0:
            band_um[first] += square * cosine**2
            band_um[second] += square * sine**2
        elif frame == 1:
            band_um[first] += square * sine**2
            band_um[second] += square * cosine**2
        elif frame == 2:
            band_um[normal] += square
        else:
            band_um[frame - 3] += square
    largest_um[0] = max(largest_um[0], np.sqrt(band_um[0] + band_um[1] + band_um[2]))
    for i in range(3):
        band_um[i] = np.sqrt(band_um[i])


class Direction:
    """Maps the outputs of one bundle to the base frame.

    The radial axis points outward, the tangential one towards growing path angle whatever
    the direction of travel, and the normal completes a right-handed frame.

    ``outputs``: declared outputs, in the order of the output vector.
    """

    def __init__(self, outputs: tuple[Output, ...]) -> None:
        self._frames = np.array([OUTPUT_FRAMES.index(o.frame) for o in outputs], dtype=np.int64)
        self._signs = np.array([_ERROR_SIGN[o.role] for o in outputs])
        self.vector_um = np.zeros(3)
        self.band_um = np.full(3, np.nan)
        """Half width of the newest correction along base x, y, z; NaN before the first ``apply_band``."""
        self._largest_um = np.zeros(1)

    def apply(self, outputs: Floats, angle_rad: float, plane_id: float) -> Floats:
        """Return the correction vector (3,) in um; the next call overwrites it."""
        _correction_kernel(outputs, self._frames, self._signs, angle_rad, plane_id, self.vector_um)
        return self.vector_um

    def apply_band(self, half_um: Floats, angle_rad: float, plane_id: float) -> None:
        """Write the half widths (n_outputs,) of the outputs into ``band_um``."""
        _band_kernel(half_um, self._frames, angle_rad, plane_id, self.band_um, self._largest_um)

    @property
    def largest_band_um(self) -> float:
        """Length of the largest half width so far."""
        return float(self._largest_um[0])

    def run(self, outputs: Floats, angle_rad: Floats, plane_id: float) -> Floats:
        """Return the correction vectors of successive ticks, shape (n, 3) in um.

        ``outputs``, shape (n, n_outputs): in um.
        ``angle_rad``, shape (n,): path angles.
        ``plane_id``: as in ``_correction_kernel``.
        """
        vectors = np.empty((len(outputs), 3))
        _kernel_many(outputs, self._frames, self._signs, angle_rad, plane_id, vectors)
        return vectors
