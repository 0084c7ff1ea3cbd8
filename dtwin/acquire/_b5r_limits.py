"""Tolerances that a ``.b5r`` file states, of figures that a test sheet has, too."""

from __future__ import annotations

from xml.etree.ElementTree import Element

from dtwin.acquire.xmlsafe import child_text, number_or_none

_LIMITED = {"AF_BEST_RADIUS": (("D",), True), "AF_CIRCULARITY": (("G(CCW)", "G(CW)"), False)}
"""Features that a test sheet has, too: their symbols, and whether the limits are of the radius, not of its deviation."""


def tolerances(bar: Element) -> dict[str, dict[str, float]]:
    """Return limits of figures by symbol, in µm; of several levels the widest: beyond it the test has failed."""
    radius_mm = number_or_none(child_text(bar, "TEST_RADIUS"))
    limits_by_symbol: dict[str, dict[str, float]] = {}
    for feature in bar.iter("FEATURE_SPEC"):
        symbols, from_radius = _LIMITED.get(feature.get("NAME", ""), ((), False))
        pairs = [
            (number_or_none(child_text(level, "LOWER_LIMIT")), number_or_none(child_text(level, "UPPER_LIMIT")))
            for level in feature.findall("TOLERANCE")
        ]
        known = [(low, high) for low, high in pairs if low is not None and high is not None and low < high]
        if not known or (from_radius and radius_mm is None) or feature.get("DT") != "UT_LENGTH_MM":
            continue
        zero = radius_mm if from_radius and radius_mm is not None else 0.0
        low, high = min(low for low, _ in known), max(high for _, high in known)
        limits = {"low": round(1000.0 * (low - zero), 4), "high": round(1000.0 * (high - zero), 4)}
        limits_by_symbol |= {symbol: limits if from_radius else {"high": limits["high"]} for symbol in symbols}
    return limits_by_symbol
