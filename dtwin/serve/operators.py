"""The closed list of operators of a bundle's graphs, with their slow reference meaning."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

NAN = math.nan
MAX_POWER = 32
# Further out a periodic argument has lost its phase to rounding.
FARTHEST = 1e12


@dataclass(frozen=True)
class Operator:
    """One operator.

    ``evaluate``: reference meaning on Python floats; IEEE results instead of exceptions.
    """

    code: int
    arity: int
    evaluate: Callable[..., float]


def _ieee(function: Callable[[float], float]) -> Callable[[float], float]:
    def guarded(x: float) -> float:
        try:
            return function(x)
        except ValueError:
            return NAN
        except OverflowError:
            return math.inf

    return guarded


def _div(a: float, b: float) -> float:
    if b != 0.0:
        return a / b
    if a == 0.0 or math.isnan(a):
        return NAN
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
        return NAN
    return a if a < b else b


def _max(a: float, b: float) -> float:
    if math.isnan(a) or math.isnan(b):
        return NAN
    return a if a > b else b


def _sign(x: float) -> float:
    return NAN if math.isnan(x) else float((x > 0) - (x < 0))


def _step(x: float) -> float:
    return NAN if math.isnan(x) else float(x >= 0)


def _logistic(x: float) -> float:
    return _div(1.0, 1.0 + _ieee(math.exp)(-x))


def lookup(x: float, start: float, spacing: float, values: list[float], periodic: bool) -> float:
    """Interpolate a uniform table linearly; periodic, or held constant beyond its ends."""
    n, u = len(values), (x - start) / spacing
    if math.isnan(u) or (periodic and not abs(u) < FARTHEST):
        return NAN
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


OPERATORS: dict[str, Operator] = {
    "add": Operator(1, 2, lambda a, b: a + b),
    "sub": Operator(2, 2, lambda a, b: a - b),
    "mul": Operator(3, 2, lambda a, b: a * b),
    "div": Operator(4, 2, _div),
    "neg": Operator(5, 1, lambda a: -a),
    "abs": Operator(6, 1, abs),
    "sqrt": Operator(7, 1, _ieee(math.sqrt)),
    "square": Operator(8, 1, lambda a: a * a),
    "pow_int": Operator(9, 1, _unused),
    "exp": Operator(10, 1, _ieee(math.exp)),
    "log": Operator(11, 1, _log),
    "sin": Operator(12, 1, _ieee(math.sin)),
    "cos": Operator(13, 1, _ieee(math.cos)),
    "tan": Operator(14, 1, _ieee(math.tan)),
    "atan2": Operator(15, 2, math.atan2),
    "tanh": Operator(16, 1, math.tanh),
    "logistic": Operator(17, 1, _logistic),
    "min": Operator(18, 2, _min),
    "max": Operator(19, 2, _max),
    "sign": Operator(20, 1, _sign),
    "step": Operator(21, 1, _step),
    "lookup": Operator(22, 1, _unused),
}
LEAVES = ("const", "input", "state")
