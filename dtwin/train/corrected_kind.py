"""Which kind of campaign a bundle was made of."""

from __future__ import annotations

from dtwin.schema import DEFAULT_KIND
from dtwin.serve.bundle import Bundle
from dtwin.train.positioning_bundle import is_positioning_bundle
from dtwin.train.tone_bundle import is_tone_bundle
from dtwin.train.volumetric_bundle import is_volumetric_bundle


def corrected_kind(bundle: Bundle) -> str:
    """Return the name of the kind.

    Bundles from before 2026-11 do not say it; theirs is told by their inputs.
    """
    if bundle.corrects:
        return bundle.corrects
    for kind, is_one in (
        ("sinusoidal", is_tone_bundle),
        ("linear", is_positioning_bundle),
        ("volumetric", is_volumetric_bundle),
    ):
        if is_one(bundle):
            return kind
    return DEFAULT_KIND
