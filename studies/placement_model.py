"""Where blocks were placed, as a correction of the next target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dtwin import __version__
from dtwin.schema import Floats
from dtwin.serve.band import COVARIANCE, Band
from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits
from dtwin.statistics import k2_factor

JOINT_MOTION = "joint_motion"
_AXES = ("base_x", "base_y", "base_z")


@dataclass(frozen=True)
class TrainingPlacement:
    """One placement without correction that counts.

    ``motion``: ``MoveL`` or ``MoveJ``.
    ``error_um``, shape (3,): measured.
    """

    motion: str
    feed_mm_min: float
    error_um: Floats


def placement_bundle(
    placements: Sequence[TrainingPlacement], machine: str, *, feeds_mm_min: tuple[float, float]
) -> Bundle:
    """Freeze the mean error of each motion at the one place that was measured.

    One place and two motions cannot support more than a mean by motion; a term of the feed is not
    fitted, because it would be asked for beyond what was measured.

    ``feeds_mm_min``: lowest and highest feed at which the correction may be used.
    """
    means = [np.mean([p.error_um for p in placements if p.motion == motion], axis=0) for motion in ("MoveL", "MoveJ")]
    g = GraphBuilder()
    joint, feed = g.input(JOINT_MOTION), g.input("programmed_feed_mm_min")
    outputs = {
        f"{axis}_um": float(means[0][i]) + float(means[1][i] - means[0][i]) * joint + 0.0 * feed
        for i, axis in enumerate(_AXES)
    }
    band = _band(g, placements, joint)
    largest = max(float(np.linalg.norm(mean)) for mean in means)
    return create_bundle(
        corrects="placement",
        name="placement-means",
        machine=machine,
        model_version=0,
        inputs=[
            Input(JOINT_MOTION, "1", "none", 500.0, "covariate", -1e-9, 1.0 + 1e-9),
            Input("programmed_feed_mm_min", "mm/min", "path", 500.0, "path", *feeds_mm_min),
        ],
        outputs=[Output(f"{axis}_um", axis) for axis in _AXES],
        tick_graph=g.graph(outputs),
        safety=SafetyLimits(clamp_um=1.25 * largest),
        provenance=Provenance(code_version=__version__),
        band=band,
    )


def _band(g: GraphBuilder, placements: Sequence[TrainingPlacement], joint: Expression) -> Band | None:
    """Return how uncertain the means are, by Student's t; None when a motion was placed once only."""
    halves = []
    for motion in ("MoveL", "MoveJ"):
        errors = np.array([p.error_um for p in placements if p.motion == motion])
        if len(errors) < 2:
            return None
        factor = k2_factor(len(errors) - 1.0)
        halves.append(factor * errors.std(axis=0, ddof=1) / np.sqrt(len(errors)))
    return Band(
        COVARIANCE,
        g.graph(
            {
                # The motion is 0 or 1; a rounding below 0 must not be a half width below 0.
                f"{axis}_um": abs(float(halves[0][i]) + float(halves[1][i] - halves[0][i]) * joint)
                for i, axis in enumerate(_AXES)
            }
        ),
    )
