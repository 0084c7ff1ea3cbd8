"""Sine and cosine of one angle together, for less than the price of one of them."""

from __future__ import annotations

import math

import numpy as np

from dtwin.features.compiled import compiled

# A quarter turn in three parts; the first two times a whole number below 2**20 are exact.
_QUARTER = 1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21
_PER_QUARTER = 2.0 / math.pi
_FARTHEST = 1e6


@compiled
def sine_and_cosine(x: float) -> tuple[float, float]:
    """Return sine and cosine, each within two units of the last place of 1.

    Reduction after Cody and Waite (Software Manual for the Elementary Functions, 1980),
    polynomials of fdlibm (Sun Microsystems, 1993).

    ``x``: angle in rad; beyond a million the slower functions of the C library answer.
    """
    if not abs(x) < _FARTHEST:
        return math.sin(x), math.cos(x)
    turns = np.floor(x * _PER_QUARTER + 0.5)
    r = ((x - turns * _QUARTER[0]) - turns * _QUARTER[1]) - turns * _QUARTER[2]
    z = r * r
    odd = 1.58969099521155010221e-10
    odd = odd * z - 2.50507602534068634195e-08
    odd = odd * z + 2.75573137070700676789e-06
    odd = odd * z - 1.98412698298579493134e-04
    odd = odd * z + 8.33333333332248946124e-03
    odd = odd * z - 1.66666666666666324348e-01
    even = -1.13596475577881948265e-11
    even = even * z + 2.08757232129817482790e-09
    even = even * z - 2.75573143513906633035e-07
    even = even * z + 2.48015872894767294178e-05
    even = even * z - 1.38888888888741095749e-03
    even = even * z + 4.16666666666666019037e-02
    sine, cosine = r * (1.0 + z * odd), 1.0 - (0.5 * z - z * z * even)
    quarter = int(turns) & 3
    if quarter & 1:
        sine, cosine = cosine, sine
    return (-sine if quarter & 2 else sine), (-cosine if (quarter + 1) & 2 else cosine)
