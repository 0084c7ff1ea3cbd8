"""Every effect of the library, in the shape that suits what a set leaves best, tested beside that set."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from dtwin.physics._dictionary import Dictionary, Entry, is_periodic
from dtwin.physics._score import NoiseLevel
from dtwin.physics.candidates import Candidate, independent_by_products, independent_pitches
from dtwin.physics.effect import Instance
from dtwin.physics.problem import Problem


def in_best_shapes(
    dictionary: Dictionary, chosen: Sequence[Entry], given: Problem, level: NoiseLevel, but: Collection[str] = ()
) -> tuple[list[Candidate], list[str]]:
    """Test every effect of a dictionary against what a set leaves.

    ``given``: the dictionary's problem with the set known.
    ``but``: labels that are not tested.
    Returns the effects, and the labels of those that cannot be seen beside what is known.
    """
    seen, invisible = [], []
    for instance in (i for i in dictionary.candidates.instances if i.label not in but):
        candidate = in_best_shape(dictionary, chosen, given, instance, level)
        if candidate is None:
            invisible.append(instance.label)
        else:
            seen.append(candidate)
    return seen, invisible


def in_best_shape(
    dictionary: Dictionary, chosen: Sequence[Entry], given: Problem, instance: Instance, level: NoiseLevel
) -> Candidate | None:
    """Test an effect in the shape that suits best, its p-value counting all that were tried; None when it cannot be seen."""
    entries = dictionary.shapes_of(instance, given.residual)
    if not entries:
        return None
    gains, products, sizes = dictionary.family(chosen, entries)
    best = int(np.argmax(np.where(sizes > 0, gains, -1.0)))
    candidate = dictionary.candidates.together(given, entries[best].term, level) if sizes[best] else None
    if candidate is None:
        return None
    tried = independent_by_products(products, sizes[sizes > 0], given.obs)
    if is_periodic(instance):
        tried = max(tried, independent_pitches(given.obs))
    return candidate.with_p_value(float(-np.expm1(tried * np.log1p(-min(candidate.score.p_value, 1.0 - 1e-12)))))
