"""How kernels are compiled: strict floating point, so that guards against NaN survive."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit

_Function = TypeVar("_Function", bound=Callable[..., object])


def compiled(function: _Function) -> _Function:
    """Compile ``function`` with numba: cached on disk, IEEE division, never fast-math."""
    return cast(_Function, njit(cache=True, error_model="numpy")(function))
