"""Serving: bundle, tape, safety, loop. Numpy, numba and the standard library only."""
