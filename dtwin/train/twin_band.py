"""How uncertain a correction is: of a learned one what it left of data left out; of a twin's, as expressions of a bundle: from the covariance of its parameters.

The uncertainty of each parameter is the twin's own; their correlations follow from where the machine was
measured, by all campaigns of the twin. Shapes (a pitch, a frequency) count as known. What the form of the effects lacks is not in it: it
says how far a correction may be from what these effects can tell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dtwin.physics.observations import Observations
from dtwin.physics.problem import unweighted
from dtwin.physics.several_twin import SeenTwin
from dtwin.physics.twin import Twin
from dtwin.schema import Floats
from dtwin.serve.band import COVARIANCE, Band, constant_band
from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.proof import with_vectors
from dtwin.train.results import OUTPUT_RMS, Candidate

# Share of the whole variance that the directions left out may have together.
_NEGLIGIBLE = 1e-4


def parameter_factor(twin: Twin, carried: Twin, obs: Observations) -> Floats | None:
    """Return what turns regressors (parameters,) into independent parts of the half width, k = 2.

    The half width at regressors x is the length of ``x @ factor``.

    ``twin``: as it was fitted; of several campaigns as one of them sees it.
    ``carried``: reduced to what the bundle carries.
    ``obs``: the runs of the fit.
    Returns (parameters, parts) of the carried effects; None when the runs do not tell the uncertainty of one of them,
    as without repeats.
    """
    half = {(e.effect, e.axis, e.name): e.uncertainty_at_shape for e in twin.estimates}
    keys = [(t.instance.effect.name, t.instance.axis, p.name) for t in twin.terms for p in t.instance.effect.parameters]
    labels = [t.label for t in twin.terms for _ in t.instance.effect.parameters]
    wanted = [n for n, label in enumerate(labels) if label in carried.labels]
    problem = unweighted(obs, [])
    columns = np.concatenate([problem.whitened(obs.regressors(t.instance, t.shape)) for t in twin.terms], axis=1)
    seen = columns - problem.basis @ (problem.basis.T @ columns)
    size = np.sqrt((seen**2).sum(axis=0))
    # What does nothing where the machine was measured does nothing where it is corrected.
    expanded = np.array([half[keys[n]] if size[n] > 0.0 else 0.0 for n in wanted])
    if not len(wanted) or not np.isfinite(expanded).all():
        return None
    scaled = seen / np.where(size > 0.0, size, 1.0)
    joint = twin.covariance if isinstance(twin, SeenTwin) else _inverse(scaled)
    inverse = joint[np.ix_(wanted, wanted)]
    spread = np.sqrt(np.maximum(np.diag(inverse), 0.0))
    both = np.outer(spread, spread)
    correlation = np.divide(inverse, both, out=np.zeros_like(inverse), where=both > 0.0)
    value, vector = np.linalg.eigh(correlation)
    # In units of each parameter's own half width: what is negligible is so for every regressor.
    kept = np.cumsum(np.maximum(value, 0.0)) > _NEGLIGIBLE * value.sum()
    return np.asarray(expanded[:, None] * vector[:, kept] * np.sqrt(value[kept]))


def _inverse(columns: Floats) -> Floats:
    return np.asarray(np.linalg.pinv(columns.T @ columns, rcond=1e-10, hermitian=True))


def half_width(builder: GraphBuilder, regressors: Sequence[Expression], factor: Floats) -> Expression:
    """Return the half width at traced regressors (parameters,)."""
    return builder.apply("sqrt", squared(builder, regressors, factor))


def squared(builder: GraphBuilder, regressors: Sequence[Expression], factor: Floats) -> Expression:
    """Return the square of the half width at traced regressors (parameters,)."""
    # What is zero everywhere needs no node.
    live = [n for n, r in enumerate(regressors) if builder.node(r).op != "const" or builder.node(r).value != 0.0]
    parts = [
        builder.total([regressors[n] * float(factor[n, j]) for n in live if factor[n, j] != 0.0])
        for j in range(factor.shape[1])
    ]
    return builder.total([builder.apply("square", part) for part in parts])


def band(builder: GraphBuilder, name: str, half: Expression) -> Band:
    """Return the band of a bundle with one output. ``name``: of the output."""
    return Band(COVARIANCE, builder.graph({name: half}))


_K = 2.0


def with_held_out_band(candidate: Candidate) -> Candidate:
    """Return the candidate with a band of twice its held-out RMS in its bundle; as it is where there is one, or none can be.

    The worst of the groups counts. The residuals hold the noise of the measurement too, so the band is rather
    too wide than too narrow, and nothing fades by it.
    """
    if candidate.bundle is None or "band" in candidate.bundle:
        return candidate
    left = candidate.numbers.get(OUTPUT_RMS, max((s.rms_um for s in candidate.scores.values()), default=math.nan))
    if not math.isfinite(left):
        return candidate
    bundle = Bundle.from_dict(dict(candidate.bundle))
    band = constant_band({o.name: _K * left for o in bundle.outputs})
    return replace(candidate, bundle=with_vectors(replace(bundle, band=band), bundle.vectors.window_seed).to_dict())
