"""Serving: bundle, tape, safety, loop. Numpy, numba and the standard library only."""

__all__ = [
    "analogue_link",
    "builder",
    "bundle_file",
    "controller_kind",
    "decision",
    "lockstep",
    "loop",
    "pointer",
    "proved",
    "safety",
    "sealed",
    "serve_request",
    "session",
    "targets",
    "withdrawn",
]
