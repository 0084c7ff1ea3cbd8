"""The uncertainty of a correction, tick by tick, and how a correction smaller than it fades out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.errors import GateRefusal
from dtwin.features.compiled import compiled
from dtwin.schema import Floats
from dtwin.serve._fields import number, one_of, only_fields
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.graph import Graph
from dtwin.serve.interface import sequence, wrong

COVARIANCE, HELD_OUT = "covariance", "held-out residuals"
_BASES = (COVARIANCE, HELD_OUT)


@dataclass(frozen=True)
class Band:
    """Half width at k = 2 of what a bundle tells, um.

    ``basis``: ``covariance``: of the parameters that were fitted, so how far the correction may be from what its form
    can tell. ``held-out residuals``: twice the RMS of what it left of data that were left out, with their noise and
    with what the form lacks; one number for each output.
    ``graph``: from the bundle's inputs and intermediate values to one half width for each output, by its name.
    ``vectors``: half widths at the bundle's test vectors, one row per tick.
    """

    basis: str
    graph: Graph
    vectors: tuple[tuple[float, ...], ...] = ()

    @property
    def fades(self) -> bool:
        """Whether a smaller correction fades out: not by residuals, whose noise is no error of the correction."""
        return self.basis == COVARIANCE

    def check(self, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        """Refuse a graph that tells other outputs, remembers, or uses what the bundle has not."""
        if set(self.graph.outputs) != set(outputs):
            raise wrong("the band is not one of the outputs", ", ".join(self.graph.outputs)[:200])
        unknown = {*(set(self.graph.inputs) - set(inputs)), *self.graph.states}
        if unknown:
            raise wrong("the band uses what is not declared", ", ".join(sorted(unknown))[:200])

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {"basis": self.basis, "graph": self.graph.to_dict(), "vectors": [list(row) for row in self.vectors]}


def read_band(data: object) -> Band:
    """Return the band that ``Band.as_dict`` described."""
    fields = only_fields(data, ("basis", "graph", "vectors"), "band")
    rows = tuple(
        tuple(number(v, "band.vectors") for v in sequence(row, "band.vectors"))
        for row in sequence(fields["vectors"], "band.vectors")
    )
    return Band(one_of(fields["basis"], _BASES, "band.basis"), Graph.from_dict(fields["graph"], "band.graph"), rows)


def constant_band(half_um: Mapping[str, float], basis: str = HELD_OUT) -> Band:
    """Return one half width (k = 2, um) for each output, the same at every tick."""
    builder = GraphBuilder()
    return Band(basis, builder.graph({name: builder.constant(half) for name, half in half_um.items()}))


def require_fading(band: Band | None) -> None:
    """Refuse to fade by a band that is not there, or not of the correction itself.

    Raises ``GateRefusal`` with what the bundle has.
    """
    if band is None or not band.fades:
        raise GateRefusal(
            "the model does not say how uncertain its correction is",
            code="serve.fade",
            got="no band" if band is None else f"a band from {band.basis}",
            allowed=f"a band from the {COVARIANCE} of what was fitted",
            hint="serve it without --fade; dtwin twin correct makes a bundle with such a band",
        )


@compiled
def fade(outputs: Floats, half_um: Floats) -> None:
    """Make corrections that are smaller than their half width smaller, in place.

    A correction c with half width U is multiplied by s^2 (3 - 2 s), where s is the smaller of |c| / U and 1: a
    correction of U and more stays as it is, and one far below U goes to nothing without a step. What is taken
    away never exceeds 0.26 U.

    ``outputs``, ``half_um``, (n,): in um.
    """
    for k in range(outputs.shape[0]):
        size, half = abs(outputs[k]), half_um[k]
        if size < half:
            share = size / half
            outputs[k] *= share * share * (3.0 - 2.0 * share)
        elif not half >= 0.0:
            # A band that is no number must stop the correction.
            outputs[k] = np.nan


@compiled
def fade_many(outputs: Floats, half_um: Floats) -> None:
    """Fade successive ticks, shape (n, outputs), in place."""
    for tick in range(outputs.shape[0]):
        fade(outputs[tick], half_um[tick])
