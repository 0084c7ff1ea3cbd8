"""Figures of tests, effects and twins."""

__all__ = [
    "circular",
    "diagnose",
    "diagnosis",
    "effect",
    "experiment",
    "fit",
    "library",
    "linear",
    "observations",
    "state",
    "twin",
]
