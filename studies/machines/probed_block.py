"""A block on the mill's table and a touch probe that finds it.

Geometry by contact: a ball of known radius moves along an axis until it touches a face of a block
that is shifted, turned, and as large as its temperature makes it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.schema import Floats

HALF_X_MM, HALF_Y_MM, THICK_MM = 10.0, 17.5, 10.0
EXPANSION_1_K = 11.5e-6
REFERENCE_C = 20.0
BALL_MM = 0.9935
SEARCH_MM = 2.5
# Where the probe comes down, in the frame of the expected block: thesis, in outline.
X_AT_Y_MM, Y_AT_X_MM = (-10.0, 10.0), (7.5, -7.5)
HITS = ("x1", "x2", "y1", "y2", "z")


@dataclass(frozen=True)
class Block:
    """Where a block really is.

    ``centre_mm``, (3,): centre of its lower face, relative to where it was to be placed.
    ``turned_rad``: about the vertical.
    ``temperature_c``: its temperature.
    """

    centre_mm: Floats
    turned_rad: float
    temperature_c: float


def probe(block: Block, noise_um: float, rng: np.random.Generator) -> Floats:
    """Return the five readings of the ball's centre, mm, in the order of ``HITS``.

    Each search covers 2.5 mm on both sides of where the face is expected; a face that is further
    away is not found, and the reading is the end of the search.

    ``block``: the block.
    ``noise_um``: standard deviation of a hit.
    ``rng``: source of the noise.
    """
    grown = 1.0 + EXPANSION_1_K * (block.temperature_c - REFERENCE_C)
    cosine, sine = np.cos(block.turned_rad), np.sin(block.turned_rad)
    x, y, z = block.centre_mm
    hits = [x + (HALF_X_MM * grown + BALL_MM - sine * (at - y)) / cosine for at in X_AT_Y_MM]
    hits += [y + (HALF_Y_MM * grown + BALL_MM + sine * (at - x)) / cosine for at in Y_AT_X_MM]
    hits.append(z + THICK_MM * grown + BALL_MM)
    expected = np.array([HALF_X_MM] * 2 + [HALF_Y_MM] * 2 + [THICK_MM]) + BALL_MM
    found = np.array(hits) + 1e-3 * noise_um * rng.standard_normal(len(hits))
    return np.clip(found, expected - SEARCH_MM, expected + SEARCH_MM)
