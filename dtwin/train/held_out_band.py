"""How uncertain a learned correction is: what it left of data that were left out."""

from __future__ import annotations

import math
from dataclasses import replace

from dtwin.serve.band import constant_band
from dtwin.serve.bundle import Bundle
from dtwin.serve.proof import with_vectors
from dtwin.train.results import OUTPUT_RMS, Candidate

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
