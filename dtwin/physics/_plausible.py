"""Fitted values that no machine can have, and shapes that the runs do not tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dtwin.physics.problem import Term
from dtwin.schema import Floats
from dtwin.units import shown_number

# Nearer to a limit than this share counts as at it.
_AT_LIMIT = 0.01


def implausible(terms: Sequence[Term], values: Floats, *, on_circles: bool) -> Mapping[str, str]:
    """Return what is wrong with fitted effects, by label.

    ``values``, (parameters,): their parameters, in the order of the terms.
    ``on_circles``: whether runs go round, each with a clock; that of a table of an axis may be one that was assumed.
    """
    out = {}
    first = 0
    for term in terms:
        effect = term.instance.effect
        own = values[first : first + len(effect.parameters)]
        first += len(effect.parameters)
        said = []
        for shape in effect.shapes:
            at, (low, high) = term.shape[shape.name], shape.bounds
            if shape.as_large and at > (1.0 + _AT_LIMIT) * shape.largest_at(own[0]):
                said.append(
                    f"its {shape.name} of {shown_number(at)} {shape.unit} is much longer than its "
                    f"{effect.parameters[0].name} of {shown_number(abs(own[0]))} {effect.parameters[0].unit}"
                )
            # A limit at which an effect begins is its plain law: a drift that does not settle.
            below = at < high / (1.0 + _AT_LIMIT) or (on_circles and shape.start >= high)
            if not (low * (1.0 + _AT_LIMIT) <= at and below):
                said.append(
                    f"its {shape.name} of {shown_number(at)} {shape.unit} lies at a limit of what is possible "
                    f"({shown_number(low)} to {shown_number(high)})"
                )
        for parameter, value in zip(effect.parameters, own, strict=True):
            if not np.abs(value) <= parameter.largest:
                said.append(
                    f"its {parameter.name} of {shown_number(value)} {parameter.unit} is more than {shown_number(parameter.largest)}"
                )
        if said:
            out[term.label] = "; ".join(said)
    return out


def at_its_end(term: Term) -> bool:
    """Tell whether a shape lies at the largest value tried, beyond which the effect is another one."""
    shapes = (shape for shape in term.instance.effect.shapes if shape.ends)
    return any(term.shape[shape.name] > (1.0 - _AT_LIMIT) * max(shape.grid) for shape in shapes)
