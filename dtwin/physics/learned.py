"""A provisional effect made from a scaling law that a search found."""

from __future__ import annotations

import re
from functools import lru_cache

import numpy as np

from dtwin.errors import InputError
from dtwin.physics._law_search import LawKey, ScalingLaw
from dtwin.physics._learned_places import LEARNED, PLACES
from dtwin.physics.effect import Effect, Law, Parameter, Shape, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats

PREFIX = "learned_"
_REFERENCE_FEED_MM_S = 50.0
_REFERENCE_RADIUS_MM = 100.0
_NAME = re.compile(r"learned_(even|odd)_h(\d+)_f(m?\d+(?:p\d)?)_r(m?\d+(?:p\d)?)")


def learned_name(law: ScalingLaw) -> str:
    """Return the name of the effect, which says everything about it."""
    return name_of((law.harmonic, law.odd, law.feed, law.radius))


def name_of(key: LawKey) -> str:
    """Return the name of the effect of a law: harmonic, odd, exponents of feed and radius."""
    harmonic, odd, feed, radius = key
    return f"{PREFIX}{'odd' if odd else 'even'}_h{harmonic}_f{_coded(feed)}_r{_coded(radius)}"


def law_size(
    key: LawKey, feed_mm_s: float | Floats, radius_mm: float | Floats, direction: float | Floats
) -> float | Floats:
    """Return the factor by which a law scales the waves of its harmonic."""
    _, odd, feed, radius = key
    size = (feed_mm_s / _REFERENCE_FEED_MM_S) ** feed * (radius_mm / _REFERENCE_RADIUS_MM) ** radius
    return size * direction if odd else size


@lru_cache(maxsize=1024)
def learned_effect(name: str) -> Effect:
    """Return the effect that a name describes.

    ``name``: ``learned_odd_h3_f1_r0``: odd in direction, third harmonic, feed to the power of one.
    Raises ``InputError`` when the name describes no law.
    """
    if name in PLACES:
        return PLACES[name]
    match = _NAME.fullmatch(name)
    if match is None:
        raise InputError(
            "this is not the name of a learned effect",
            code="effect.learned",
            got=name[:60],
            allowed=f"learned_(even|odd)_hN_fA_rB, as dtwin twin learn makes them, {', '.join(PLACES)}",
        )
    parity, harmonic = match[1], int(match[2])
    feed, radius = _decoded(match[3]), _decoded(match[4])
    n = 2 if harmonic else 1
    names = ("cosine", "sine") if harmonic else ("radius",)

    def columns(state: State, axis: str, shape: Shape) -> Floats:
        phase = harmonic * state.angle_rad
        waves = stacked(*(np.cos(phase), np.sin(phase))[:n])
        key = harmonic, parity == "odd", feed, radius
        return np.asarray(law_size(key, state.feed_mm_s, state.radius_mm, state.direction) * waves)

    law_text = f"F^{feed:g} R^{radius:g}, {parity} in direction"
    return Effect(
        name=name,
        title=f"Learned: harmonic {harmonic}, {law_text}",
        parameters=tuple(Parameter(f"{n}_at_50_mm_s_100_mm", "um", 1.0) for n in names),
        regressors=columns,
        law=Law(feed, radius, "odd" if parity == "odd" else "even"),
        per="machine",
        meaning="Found in the residual, not understood: a description, no cause.",
        formula=f"(a cos({harmonic}t) + b sin({harmonic}t)) (F / 50 mm/s)^{feed:g} "
        f"(R / 100 mm)^{radius:g}" + (" d" if parity == "odd" else ""),
        looks_like=f"{harmonic} waves per turn.",
        separate_by="Measure at feeds and radii that were not used to find it.",
        remedy="Find the cause before correcting for it.",
        reference="Learned from the residual of this twin; provisional.",
        source=LEARNED,
    )


def can_learn(kind: str) -> bool:
    """Tell whether laws can be learned in campaigns of a kind."""
    return kind in learned_effect(f"{PREFIX}even_h0_f0_r0").kinds


def _coded(exponent: float) -> str:
    return f"{exponent:g}".replace("-", "m").replace(".", "p")


def _decoded(text: str) -> float:
    return float(text.replace("m", "-").replace("p", "."))
