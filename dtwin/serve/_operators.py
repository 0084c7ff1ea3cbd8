"""The closed list of operators of a bundle's graphs, with their slow reference meaning."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

_NAN = math.nan
MAX_POWER = 32
# Further out a periodic argument has lost its phase to rounding.
FARTHEST = 1e12


@dataclass(frozen=True)
class _Operator:
    """One operator. ``evaluate``: reference meaning on Python floats; IEEE results instead of exceptions."""

    code: int
    arity: int
    evaluate: Callable[..., float]


def _ieee(function: Callable[[float], float]) -> Callable[[float], float]:
    def guarded(x: float) -> float:
        try:
            return function(x)
        except ValueError:
            return _NAN
        except OverflowError:
            return math.inf

    return guarded


def _div(a: float, b: float) -> float:
    if b != 0.0:
        return a / b
    if a == 0.0 or math.isnan(a):
        return _NAN
    return math.copysign(math.inf, a) * math.copysign(1.0, b)


def _log(x: float) -> float:
    return -math.inf if x == 0.0 else _ieee(math.log)(x)


def power(x: float, n: int) -> float:
    """Return x to a whole power by repeated squaring, as the tape does it."""
    result, base, left = 1.0, x, abs(n)
    while left:
        if left % 2:
            result *= base
        base *= base
        left //= 2
    return _div(1.0, result) if n < 0 else result


def _min(a: float, b: float) -> float:
    if math.isnan(a) or math.isnan(b):
        return _NAN
    return a if a < b else b


def _max(a: float, b: float) -> float:
    if math.isnan(a) or math.isnan(b):
        return _NAN
    return a if a > b else b


def _sign(x: float) -> float:
    return _NAN if math.isnan(x) else float((x > 0) - (x < 0))


def _step(x: float) -> float:
    return _NAN if math.isnan(x) else float(x >= 0)


def _logistic(x: float) -> float:
    return _div(1.0, 1.0 + _ieee(math.exp)(-x))


def lookup(x: float, start: float, spacing: float, values: list[float], periodic: bool) -> float:
    """Interpolate a uniform table linearly; periodic, or held constant beyond its ends."""
    n, u = len(values), (x - start) / spacing
    if math.isnan(u) or (periodic and not abs(u) < FARTHEST):
        return _NAN
    if not periodic:
        if u <= 0.0:
            return values[0]
        if u >= n - 1:
            return values[-1]
        low = int(u)
        return values[low] + (u - low) * (values[low + 1] - values[low])
    u -= math.floor(u / n) * n
    low = min(int(u), n - 1)
    return values[low] + (u - low) * (values[(low + 1) % n] - values[low])


def _unused(*_: float) -> float:
    raise AssertionError("evaluated by its own branch")


OPERATORS: dict[str, _Operator] = {
    "add": _Operator(1, 2, lambda a, b: a + b),
    "sub": _Operator(2, 2, lambda a, b: a - b),
    "mul": _Operator(3, 2, lambda a, b: a * b),
    "div": _Operator(4, 2, _div),
    "neg": _Operator(5, 1, lambda a: -a),
    "abs": _Operator(6, 1, abs),
    "sqrt": _Operator(7, 1, _ieee(math.sqrt)),
    "square": _Operator(8, 1, lambda a: a * a),
    "pow_int": _Operator(9, 1, _unused),
    "exp": _Operator(10, 1, _ieee(math.exp)),
    "log": _Operator(11, 1, _log),
    "sin": _Operator(12, 1, _ieee(math.sin)),
    "cos": _Operator(13, 1, _ieee(math.cos)),
    "tan": _Operator(14, 1, _ieee(math.tan)),
    "atan2": _Operator(15, 2, math.atan2),
    "tanh": _Operator(16, 1, math.tanh),
    "logistic": _Operator(17, 1, _logistic),
    "min": _Operator(18, 2, _min),
    "max": _Operator(19, 2, _max),
    "sign": _Operator(20, 1, _sign),
    "step": _Operator(21, 1, _step),
    "lookup": _Operator(22, 1, _unused),
}
LEAVES = ("const", "input", "state")
