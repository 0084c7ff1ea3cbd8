"""Expression graphs: numbered nodes over a closed list of operators, each using earlier ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from dtwin.errors import InputError
from dtwin.serve._fields import number, only_fields, text, whole

_MAX_NODES = 4096
_MAX_DEPTH = 256
_MAX_TABLE_VALUES = 65536


@dataclass(frozen=True)
class Table:
    """Values at uniform arguments.

    ``start``, ``spacing``: argument of the first value, and from one value to the next.
    ``values``: at least two.
    ``periodic``: whether the last value is followed by the first; else the ends are held.
    """

    start: float
    spacing: float
    values: tuple[float, ...]
    periodic: bool


@dataclass(frozen=True)
class Node:
    """One operation.

    ``op``: ``const``, ``input``, ``state`` or a name of ``OPERATORS``.
    ``args``: numbers of earlier nodes.
    ``value``: of a ``const``.
    ``n``: exponent of a ``pow_int``; table number of a ``lookup``.
    """

    op: str
    args: tuple[int, ...] = ()
    value: float = 0.0
    name: str = ""
    n: int = 0


@dataclass(frozen=True)
class Graph:
    """Nodes in an order in which they can be evaluated.

    ``nodes``: each refers to earlier nodes only.
    ``updates``: node of each state's next value; a state that is not named keeps its value.
    ``tables``: for ``lookup``.
    """

    nodes: tuple[Node, ...]
    outputs: Mapping[str, int]
    updates: Mapping[str, int] = field(default_factory=dict)
    tables: tuple[Table, ...] = ()

    def __post_init__(self) -> None:
        """Refuse a graph that cannot be evaluated safely."""
        _check_graph(self)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs that are used, in order of first use."""
        return tuple(dict.fromkeys(n.name for n in self.nodes if n.op == "input"))

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states that are read or updated."""
        read = [n.name for n in self.nodes if n.op == "state"]
        return tuple(dict.fromkeys([*read, *self.updates]))

    def evaluate(
        self, inputs: Mapping[str, float], state: Mapping[str, float]
    ) -> tuple[dict[str, float], dict[str, float]]:
        """Return outputs and next state, slowly, as the reference for the tape."""
        values: list[float] = []
        for node in self.nodes:
            values.append(self._value(node, values, inputs, state))
        after = dict(state) | {name: values[i] for name, i in self.updates.items()}
        return {name: values[i] for name, i in self.outputs.items()}, after

    def _value(
        self, node: Node, values: Sequence[float], inputs: Mapping[str, float], state: Mapping[str, float]
    ) -> float:
        if node.op == "const":
            return node.value
        if node.op == "input":
            return float(inputs[node.name])
        if node.op == "state":
            return float(state[node.name])
        args = [values[i] for i in node.args]
        if node.op == "pow_int":
            return _power(args[0], node.n)
        if node.op == "lookup":
            table = self.tables[node.n]
            return _lookup(args[0], table.start, table.spacing, list(table.values), table.periodic)
        return float(OPERATORS[node.op].evaluate(*args))

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {
            "nodes": [_node_to_dict(node) for node in self.nodes],
            "outputs": dict(self.outputs),
            "updates": dict(self.updates),
            "tables": [
                {"start": t.start, "spacing": t.spacing, "values": list(t.values), "periodic": t.periodic}
                for t in self.tables
            ],
        }

    @classmethod
    def from_dict(cls, data: object, where: str) -> Graph:
        """Return the graph that ``to_dict`` described.

        Raises ``InputError`` when a field is missing, unknown, of the wrong type or out of range.
        """
        fields = only_fields(data, ("nodes", "outputs", "updates", "tables"), where)
        nodes = _listed(fields["nodes"], f"{where}.nodes", _MAX_NODES)
        tables = _listed(fields["tables"], f"{where}.tables", _MAX_NODES)
        return cls(
            nodes=tuple(_node_from_dict(n, f"{where}.nodes[{i}]") for i, n in enumerate(nodes)),
            outputs=_indices(fields["outputs"], f"{where}.outputs"),
            updates=_indices(fields["updates"], f"{where}.updates"),
            tables=tuple(_table_from_dict(t, f"{where}.tables[{i}]") for i, t in enumerate(tables)),
        )


def _check_graph(graph: Graph) -> None:
    """Refuse a graph with unknown operators, wrong references or non-finite constants."""
    if not 1 <= len(graph.nodes) <= _MAX_NODES:
        raise _wrong("the count of nodes is out of range", f"{len(graph.nodes)}", f"1 to {_MAX_NODES}")
    if sum(len(table.values) for table in graph.tables) > _MAX_TABLE_VALUES:
        raise _wrong("the tables are too large", "", f"{_MAX_TABLE_VALUES} values")
    for i, table in enumerate(graph.tables):
        _check_table(table, i)
    depths: list[int] = []
    for i, node in enumerate(graph.nodes):
        _check_node(graph, node, i)
        depths.append(1 + max((depths[a] for a in node.args), default=0))
    if max(depths) > _MAX_DEPTH:
        raise _wrong("the graph is too deep", str(max(depths)), f"{_MAX_DEPTH}")
    targets = [*graph.outputs.values(), *graph.updates.values()]
    if not graph.outputs or not all(0 <= i < len(graph.nodes) for i in targets):
        raise _wrong("an output or update names no node", str(targets)[:80], "a node's number")


def _check_node(graph: Graph, node: Node, i: int) -> None:
    if node.op not in OPERATORS and node.op not in _LEAVES:
        allowed = ", ".join([*_LEAVES, *OPERATORS])
        raise _wrong(f"node {i} has an unknown operator", node.op[:40], allowed)
    arity = OPERATORS[node.op].arity if node.op in OPERATORS else 0
    if len(node.args) != arity or not all(0 <= a < i for a in node.args):
        raise _wrong(
            f"node {i} ({node.op}) has wrong arguments", str(node.args)[:80], f"{arity} numbers of earlier nodes"
        )
    if node.op == "const" and not math.isfinite(node.value):
        raise _wrong(f"node {i} is a constant that is not finite", str(node.value), "a number")
    if node.op in ("input", "state") and not node.name:
        raise _wrong(f"node {i} ({node.op}) has no name", "", "a name")
    if node.op == "pow_int" and not (1 <= abs(node.n) <= _MAX_POWER):
        raise _wrong(f"node {i} has an unusable exponent", str(node.n), f"+-1 to +-{_MAX_POWER}")
    if node.op == "lookup" and not 0 <= node.n < len(graph.tables):
        raise _wrong(f"node {i} names no table", str(node.n), f"0 to {len(graph.tables) - 1}")


def _check_table(table: Table, i: int) -> None:
    finite = all(math.isfinite(v) for v in (table.start, table.spacing, *table.values))
    if not finite or table.spacing <= 0 or len(table.values) < 2:
        raise _wrong(f"table {i} is unusable", "", "two or more finite values at a positive spacing")


def _node_to_dict(node: Node) -> dict[str, Any]:
    plain: dict[str, Any] = {"op": node.op}
    if node.op == "const":
        plain["value"] = node.value
    elif node.op in _LEAVES:
        plain["name"] = node.name
    else:
        plain["args"] = list(node.args)
    if node.op == "pow_int":
        plain["n"] = node.n
    if node.op == "lookup":
        plain["table"] = node.n
    return plain


def _node_from_dict(data: object, where: str) -> Node:
    op = text(data.get("op"), f"{where}.op") if isinstance(data, dict) else ""
    extra: tuple[str, ...] = {"const": ("value",), "input": ("name",), "state": ("name",)}.get(op, ("args",))
    extra += {"pow_int": ("n",), "lookup": ("table",)}.get(op, ())
    fields = only_fields(data, ("op", *extra), where)
    args = _listed(fields.get("args", []), f"{where}.args", 2)
    place = fields.get("n", fields.get("table", 0))
    return Node(
        op=op,
        args=tuple(whole(a, f"{where}.args") for a in args),
        value=number(fields.get("value", 0.0), f"{where}.value"),
        name=text(fields["name"], f"{where}.name") if "name" in fields else "",
        n=whole(place, where),
    )


def _table_from_dict(data: object, where: str) -> Table:
    fields = only_fields(data, ("start", "spacing", "values", "periodic"), where)
    if not isinstance(fields["periodic"], bool):
        raise _wrong(f"{where}.periodic is not true or false", "", "true, false")
    values = _listed(fields["values"], f"{where}.values", _MAX_TABLE_VALUES)
    return Table(
        number(fields["start"], where),
        number(fields["spacing"], where),
        tuple(number(v, f"{where}.values") for v in values),
        fields["periodic"],
    )


def _indices(data: object, where: str) -> dict[str, int]:
    if not isinstance(data, dict):
        raise _wrong(f"{where} is not a mapping", type(data).__name__, "name: node number")
    return {text(k, where): whole(v, f"{where}.{k}"[:80]) for k, v in data.items()}


def _listed(data: object, where: str, longest: int) -> list[Any]:
    if not isinstance(data, list) or len(data) > longest:
        got = f"{len(data)} items" if isinstance(data, list) else type(data).__name__
        raise _wrong(f"{where} is not a usable list", got, f"a list of at most {longest}")
    return data


def _wrong(message: str, got: str, allowed: str) -> InputError:
    return InputError(message, code="bundle.graph", got=got or None, allowed=allowed)


_NAN = math.nan
_MAX_POWER = 32
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


def _power(x: float, n: int) -> float:
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


def _lookup(x: float, start: float, spacing: float, values: list[float], periodic: bool) -> float:
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
_LEAVES = ("const", "input", "state")
