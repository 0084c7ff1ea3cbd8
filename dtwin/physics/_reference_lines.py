"""Lines and bows that other effects of a twin hold are taken out of the shapes of guideways."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.state import AXES_OF


def with_reference_lines(terms: Sequence[Term], campaigns: Sequence[Observations]) -> list[Term]:
    """Return terms in which the shape of a guideway has no line where squareness is fitted too, and no bow beside straightness.

    Squareness is the angle of the least-squares lines of two axes (ISO 230-1); beside a curve of third order it would be the
    slope in the middle, which may be many times that. What the terms can do together stays the same.
    """
    circles = [obs for obs in campaigns if obs.grid.in_plane]
    labels = {term.label for term in terms}
    planes = {plane for obs in circles for plane in obs.planes}
    reach_mm = max((float(obs.radius_mm.max()) for obs in circles), default=0.0)
    out = []
    for term in terms:
        if term.instance.effect.name == "guideway_shape":
            axis = term.instance.axis
            has_lines = all(f"squareness {plane}" in labels for plane in planes if axis in AXES_OF[plane])
            has_bow = f"straightness {axis}" in labels
            over = {"line_over_mm": reach_mm * has_lines, "bow_over_mm": reach_mm * has_bow}
            term = replace(term, shape=dict(term.shape) | over)
        out.append(term)
    return out
