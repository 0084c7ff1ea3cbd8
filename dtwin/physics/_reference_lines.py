"""Over how much the curves of guideways have no line and no bow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from dtwin.physics.effect import OVER, Effect
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term


def over(effect: Effect, campaigns: Sequence[Observations]) -> dict[str, float]:
    """Return the part of an effect's shape that the largest circle of some campaigns gives; empty for most effects.

    Squareness is the angle of the least-squares lines of two axes (ISO 230-1), and straightness the least-squares bow;
    beside a curve that had a line of its own it would be the slope in the middle, which may be many times that.
    """
    if OVER not in effect.shapes:
        return {}
    return {OVER.name: max((float(obs.radius_mm.max()) for obs in campaigns if obs.grid.in_plane), default=0.0)}


def with_reference_lines(terms: Sequence[Term], campaigns: Sequence[Observations]) -> list[Term]:
    """Return terms in which the curves of guideways have no line and no bow over the largest circle of some campaigns."""
    return [replace(t, shape=dict(t.shape) | over(t.instance.effect, campaigns)) for t in terms]
