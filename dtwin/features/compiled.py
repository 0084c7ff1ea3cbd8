"""How kernels are compiled: strict floating point, so that guards against NaN survive."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit

_Function = TypeVar("_Function", bound=Callable[..., object])


def compiled(function: _Function) -> _Function:
    """Compile ``function`` with numba: cached on disk, IEEE division, never fast-math."""
    return cast(_Function, njit(cache=True, error_model="numpy")(function))


def compiled_for_many(function: _Function) -> _Function:
    """Compile as :func:`compiled` what takes long enough that other threads should run meanwhile.

    Never what a serving loop calls: to get the lock back may take it milliseconds.
    """
    return cast(_Function, njit(cache=True, error_model="numpy", nogil=True)(function))
