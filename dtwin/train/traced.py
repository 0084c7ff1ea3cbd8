"""An array that writes down what is done to it, so that an effect becomes an expression.

An effect's regressors are ordinary numpy code. Called with these stand-ins instead of numbers, the
same code builds a graph over the closed operator list of bundles: nothing is retyped, and a
user's own effect file can be frozen like a built-in one. What the list does not hold is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from dtwin.schema import Floats
from dtwin.serve.builder import Expression, GraphBuilder

_PLAIN = {
    np.add: "add",
    np.subtract: "sub",
    np.multiply: "mul",
    np.true_divide: "div",
    np.negative: "neg",
    np.absolute: "abs",
    np.sqrt: "sqrt",
    np.square: "square",
    np.exp: "exp",
    np.log: "log",
    np.sin: "sin",
    np.cos: "cos",
    np.tan: "tan",
    np.arctan2: "atan2",
    np.tanh: "tanh",
    np.minimum: "min",
    np.maximum: "max",
    np.sign: "sign",
}


_Parts: TypeAlias = tuple[Expression, Expression]


class NotTraceable(Exception):
    """An effect does what the operators of a bundle cannot do."""


class Traced(NDArrayOperatorsMixin):
    """Columns of expressions that stand for an array of one point, shape (1,), or (1, columns) for a ``table``."""

    def __init__(self, columns: Sequence[Expression], *, table: bool = False) -> None:
        self.columns = tuple(columns)
        self.table = table

    @property
    def size(self) -> int:
        """Number of points."""
        return 1

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        # ``a *= b`` names a as where the result goes; a new value takes its name instead.
        options.pop("out", None)
        if method != "__call__" or options:
            raise NotTraceable(f"{ufunc.__name__}.{method}")
        if any(_is_complex(item) for item in inputs):
            return _complex(ufunc, inputs, self.columns[0].builder)
        listed = [_columns(item, self.columns[0].builder) for item in inputs]
        width = max(len(item) for item in listed)
        table = any(isinstance(item, Traced) and item.table for item in inputs)
        wide = [item * width if len(item) == 1 else item for item in listed]
        return Traced([_apply(ufunc, row) for row in zip(*wide, strict=True)], table=table)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Traced:
        """Apply one of the few functions of numpy that effects use."""
        made = _FUNCTIONS.get(func)
        if made is None:
            raise NotTraceable(func.__name__)
        return made(self.columns[0].builder, *args, **kwargs)

    def __getitem__(self, key: Any) -> Traced:
        """Return one column, or the column as a table."""
        if isinstance(key, tuple) and len(key) == 2 and key[0] == slice(None):
            if key[1] is None and not self.table:
                return Traced(self.columns, table=True)
            if isinstance(key[1], int) and self.table:
                return Traced([self.columns[key[1]]])
        raise NotTraceable(f"indexing with {key!r}")

    def __bool__(self) -> bool:
        """Refuse: which way a program goes cannot be written down."""
        raise NotTraceable("a decision that depends on the state")

    def __float__(self) -> float:
        """Refuse: there is no number yet."""
        raise NotTraceable("a number that depends on the state")

    def __array__(self, *_: Any, **__: Any) -> Any:
        """Refuse: there is no array yet."""
        raise NotTraceable("an array that depends on the state")


class TracedAlong(Traced):
    """A point of a path that was measured at ``points`` (n,): what is asked of them all is a number."""

    def __init__(self, point: Expression, points: Floats) -> None:
        super().__init__([point])
        self.points = points

    def min(self) -> float:
        """Return the lowest measured point."""
        return float(self.points.min())

    def max(self) -> float:
        """Return the highest measured point."""
        return float(self.points.max())

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        """Answer for all measured points, or as any stand-in."""
        if func in (np.unique, np.ptp, np.min, np.max) and len(args) == 1 and not kwargs:
            return func(self.points)
        return super().__array_function__(func, types, args, kwargs)


class _TracedComplex(NDArrayOperatorsMixin):
    """A complex number of two expressions, as the response to a tone is one."""

    def __init__(self, real_part: Expression, imaginary_part: Expression) -> None:
        self.parts = real_part, imaginary_part

    @property
    def real(self) -> Traced:
        """Real part."""
        return Traced([self.parts[0]])

    @property
    def imag(self) -> Traced:
        """Imaginary part."""
        return Traced([self.parts[1]])

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        """Apply one of the four operations, or a whole power."""
        if method != "__call__" or options:
            raise NotTraceable(f"{ufunc.__name__}.{method}")
        return _complex(ufunc, inputs, self.parts[0].builder)


class NotTold(Traced):
    """What serving does not know: whatever is done with it is refused."""

    def __init__(self, what: str) -> None:
        super().__init__([])
        self.what = what

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Traced:
        raise NotTraceable(f"it needs {self.what}, which is not known while the machine works")

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Traced:
        raise NotTraceable(f"it needs {self.what}, which is not known while the machine works")


def expressions_of(traced: Any, builder: GraphBuilder, count: int) -> list[Expression]:
    """Return the columns that an effect returned. ``traced``, (1, count): what its regressors gave."""
    columns = _columns(traced, builder)
    if len(columns) != count:
        raise NotTraceable(f"{len(columns)} columns for {count} parameters")
    return columns


def _columns(item: Any, builder: GraphBuilder) -> list[Expression]:
    if isinstance(item, Traced):
        return list(item.columns)
    values = np.asarray(item, dtype=float).ravel()
    return [builder.constant(float(v)) for v in values]


def _apply(ufunc: Any, args: Sequence[Expression]) -> Expression:
    if ufunc in _PLAIN:
        return _simple(_PLAIN[ufunc], args)
    made = _BUILT.get(ufunc)
    if made is None:
        raise NotTraceable(ufunc.__name__)
    return made(*args)


def _is_complex(item: Any) -> bool:
    return not isinstance(item, Traced) and (isinstance(item, _TracedComplex) or np.iscomplexobj(item))


def _complex(ufunc: Any, inputs: Sequence[Any], builder: GraphBuilder) -> _TracedComplex:
    made = _OF_COMPLEX.get(ufunc)
    if made is None:
        raise NotTraceable(f"{ufunc.__name__} of complex numbers")
    return _TracedComplex(*made(*(_parts(item, builder) for item in inputs)))


def _parts(item: Any, builder: GraphBuilder) -> _Parts:
    if isinstance(item, _TracedComplex):
        return item.parts
    if isinstance(item, Traced):
        if len(item.columns) != 1:
            raise NotTraceable("complex numbers in columns")
        return item.columns[0], builder.constant(0.0)
    value = complex(np.asarray(item).item())
    return builder.constant(value.real), builder.constant(value.imag)


def _sum(a: _Parts, b: _Parts) -> _Parts:
    return _simple("add", (a[0], b[0])), _simple("add", (a[1], b[1]))


def _difference(a: _Parts, b: _Parts) -> _Parts:
    return _simple("sub", (a[0], b[0])), _simple("sub", (a[1], b[1]))


def _product(a: _Parts, b: _Parts) -> _Parts:
    def times(i: int, j: int) -> Expression:
        return _simple("mul", (a[i], b[j]))

    return (_simple("sub", (times(0, 0), times(1, 1))), _simple("add", (times(0, 1), times(1, 0))))


def _quotient(a: _Parts, b: _Parts) -> _Parts:
    real, imaginary = _product(a, (b[0], _simple("neg", (b[1],))))
    size = _simple("add", (_simple("square", (b[0],)), _simple("square", (b[1],))))
    return _simple("div", (real, size)), _simple("div", (imaginary, size))


def _whole_power(base: _Parts, exponent: _Parts) -> _Parts:
    n = _constant(exponent[0])
    if n is None or n != int(n) or not 1 <= n <= 4:
        raise NotTraceable("a power of a complex number other than 1 to 4")
    result = base
    for _ in range(int(n) - 1):
        result = _product(result, base)
    return result


def _simple(op: str, args: Sequence[Expression]) -> Expression:
    """Apply an operator; products and sums with 0 and 1 need no node."""
    values = [_constant(a) for a in args]
    builder = args[0].builder
    if op == "mul":
        if 0.0 in values:
            return builder.constant(0.0)
        if 1.0 in values:
            return args[1 - values.index(1.0)]
        if -1.0 in values:
            return builder.apply("neg", args[1 - values.index(-1.0)])
    if op == "add" and 0.0 in values:
        return args[1 - values.index(0.0)]
    if op in ("sub", "div") and values[1] == (0.0 if op == "sub" else 1.0):
        return args[0]
    return builder.apply(op, *args)


def _constant(item: Expression) -> float | None:
    node = item.builder.node(item)
    return node.value if node.op == "const" else None


def _power(base: Expression, exponent: Expression) -> Expression:
    value = _constant(exponent)
    if value is None:
        raise NotTraceable("a power whose exponent depends on the state")
    builder = base.builder
    if value == 0.0:
        return builder.constant(1.0)
    if value == 1.0:
        return base
    if value == int(value) and abs(value) <= 32:
        return builder.power(base, int(value))
    if 2.0 * value == int(2.0 * value) and abs(value) <= 16:
        return builder.power(builder.apply("sqrt", base), int(2.0 * value))
    # Feeds and radii are positive.
    return builder.apply("exp", value * builder.apply("log", base))


def _remainder(value: Expression, period: Expression) -> Expression:
    """Return the remainder by the angle that it is of a full turn: 0 to the period."""
    length = _constant(period)
    if length is None or length <= 0.0:
        raise NotTraceable("a remainder by what depends on the state")
    b = value.builder
    turn = value * (2.0 * np.pi / length)
    angle = b.apply("atan2", b.apply("sin", turn), b.apply("cos", turn))
    full = angle + 2.0 * np.pi * (1.0 - b.apply("step", angle))
    return full * (length / (2.0 * np.pi))


def _at_least(first: Expression, second: Expression) -> Expression:
    return first.builder.apply("step", first - second)


def _above(first: Expression, second: Expression) -> Expression:
    return 1.0 - first.builder.apply("step", second - first)


_OF_COMPLEX: dict[Any, Callable[..., _Parts]] = {
    np.add: _sum,
    np.subtract: _difference,
    np.multiply: _product,
    np.true_divide: _quotient,
    np.power: _whole_power,
    np.square: lambda a: _product(a, a),
}

_BUILT: dict[Any, Callable[..., Expression]] = {
    np.power: _power,
    np.float_power: _power,
    np.remainder: _remainder,
    np.positive: lambda a: a,
    np.hypot: lambda a, b: a.builder.apply("sqrt", a**2 + b**2),
    np.radians: lambda a: a * (np.pi / 180.0),
    np.deg2rad: lambda a: a * (np.pi / 180.0),
    np.degrees: lambda a: a * (180.0 / np.pi),
    np.greater_equal: _at_least,
    np.greater: _above,
    np.less_equal: lambda a, b: _at_least(b, a),
    np.less: lambda a, b: _above(b, a),
    np.logical_and: lambda a, b: a * b,
    np.bitwise_and: lambda a, b: a * b,
}


def _where(builder: GraphBuilder, condition: Any, then: Any, other: Any) -> Traced:
    chosen = Traced(_columns(condition, builder))
    return other + chosen * (then - other)


def _stack(builder: GraphBuilder, parts: Sequence[Any], axis: int = 0) -> Traced:
    if axis not in (1, -1):
        raise NotTraceable(f"stacking along axis {axis}")
    return Traced([c for part in parts for c in _columns(part, builder)], table=True)


def _clip(builder: GraphBuilder, value: Any, low: Any, high: Any) -> Traced:
    return np.minimum(np.maximum(value, low), high)


def _like(number: float) -> Callable[..., Traced]:
    return lambda builder, value, **_: Traced([builder.constant(number)] * len(value.columns), table=value.table)


_FUNCTIONS: dict[Any, Callable[..., Traced]] = {
    np.where: _where,
    np.stack: _stack,
    np.column_stack: lambda builder, parts: _stack(builder, parts, 1),
    np.clip: _clip,
    np.zeros_like: _like(0.0),
    np.ones_like: _like(1.0),
}
