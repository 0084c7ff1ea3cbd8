"""Formulas as text from search engines: parsed by a closed grammar, never executed."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats
from dtwin.serve.builder import Expression, GraphBuilder

_BINARY: dict[type[ast.operator], str] = {ast.Add: "add", ast.Sub: "sub", ast.Mult: "mul", ast.Div: "div"}
_FUNCTIONS = ("sin", "cos", "tan", "exp", "log", "sqrt", "square", "abs", "tanh")
_NUMPY: dict[str, Callable[..., Floats]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "neg": np.negative,
    **{name: getattr(np, name) for name in _FUNCTIONS},
}
_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/"}
_MAX_CHARS = 20_000


@dataclass(frozen=True)
class Formula:
    """A formula as a tree.

    ``op``: ``constant``, ``input`` or an operation.
    ``place``: of a constant, in the vector of constants.
    """

    op: str
    args: tuple[Formula, ...] = ()
    name: str = ""
    place: int = -1

    @property
    def size(self) -> int:
        """Number of nodes."""
        return 1 + sum(arg.size for arg in self.args)

    @property
    def inputs(self) -> set[str]:
        """Names of the inputs that it uses."""
        own = {self.name} if self.op == "input" else set()
        return own.union(*(arg.inputs for arg in self.args))

    def text(self, constants: Floats) -> str:
        """Return it with its constants (k,) as text that :func:`parse_formula` reads."""
        if self.op == "constant":
            return f"({float(constants[self.place])!r})"
        if self.op == "input":
            return self.name
        parts = [arg.text(constants) for arg in self.args]
        if self.op in _INFIX:
            return f"({parts[0]} {_INFIX[self.op]} {parts[1]})"
        return f"(-{parts[0]})" if self.op == "neg" else f"{self.op}({', '.join(parts)})"

    def values(self, inputs: Mapping[str, Floats], constants: Floats) -> Floats:
        """Evaluate over rows.

        ``inputs`` (n,): columns by name.
        ``constants`` (k,): values of the constants.
        """
        if self.op == "constant":
            return np.asarray(constants[self.place])
        if self.op == "input":
            return inputs[self.name]
        with np.errstate(all="ignore"):
            return np.asarray(_NUMPY[self.op](*(arg.values(inputs, constants) for arg in self.args)))

    def build(self, builder: GraphBuilder, constants: Sequence[float]) -> Expression:
        """Add the formula to a graph and return its handle."""
        if self.op == "constant":
            return builder.constant(float(constants[self.place]))
        if self.op == "input":
            return builder.input(self.name)
        return builder.apply(self.op, *(arg.build(builder, constants) for arg in self.args))


def parse_formula(text: str, names: Sequence[str]) -> tuple[Formula, Floats]:
    """Read a formula such as ``0.3 * sin(q1_rad) + 2``.

    ``text``: the formula; ``^`` and ``**`` are powers.
    The tree, and the values of its constants.
    Raises ``InputError`` when it holds anything but numbers, inputs, arithmetic and known functions.
    """
    if len(text) > _MAX_CHARS:
        raise _refused(f"{len(text)} characters", f"up to {_MAX_CHARS}")
    try:
        tree = ast.parse(text.replace("^", "**"), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise _refused(text[:80], "a formula") from error
    constants: list[float] = []
    formula = _convert(tree.body, frozenset(names), constants)
    return formula, np.array(constants)


def _convert(node: ast.expr, names: frozenset[str], constants: list[float]) -> Formula:
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        constants.append(float(node.value))  # type: ignore[arg-type]
        return Formula("constant", place=len(constants) - 1)
    if isinstance(node, ast.Name) and node.id in names:
        return Formula("input", name=node.id)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return Formula("neg", (_convert(node.operand, names, constants),))
    if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
        pair = tuple(_convert(part, names, constants) for part in (node.left, node.right))
        return Formula(_BINARY[type(node.op)], pair)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
        return _power(node, names, constants)
    known = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords
    if known and node.func.id in _FUNCTIONS and len(node.args) == 1:  # type: ignore[attr-defined]
        argument = _convert(node.args[0], names, constants)  # type: ignore[attr-defined]
        return Formula(node.func.id, (argument,))  # type: ignore[attr-defined]
    raise _refused(ast.dump(node)[:80], "numbers, inputs, + - * / ^ and " + ", ".join(_FUNCTIONS))


def _power(node: ast.BinOp, names: frozenset[str], constants: list[float]) -> Formula:
    exponent = node.right
    if not isinstance(exponent, ast.Constant) or exponent.value not in (2, 2.0, 3, 3.0):
        raise _refused(ast.dump(node)[:80], "powers 2 and 3")
    base = _convert(node.left, names, constants)
    square = Formula("square", (base,))
    return square if exponent.value == 2 else Formula("mul", (square, base))


def _refused(got: str, allowed: str) -> InputError:
    return InputError("not a formula that can be served", code="formula.grammar", got=got, allowed=allowed)


def unit_findings(formula: Formula, units: Mapping[str, str]) -> list[str]:
    """Say where a formula adds unlike units or takes a function of a unit.

    A constant may carry any unit, so what is multiplied by one is free.
    """
    lines: list[str] = []
    _unit(formula, units, lines)
    return list(dict.fromkeys(lines))


_FREE = "?"


def _unit(formula: Formula, units: Mapping[str, str], faults: list[str]) -> str:
    if formula.op == "constant":
        return _FREE
    if formula.op == "input":
        return units.get(formula.name, _FREE)
    parts = [_unit(arg, units, faults) for arg in formula.args]
    if formula.op in ("add", "sub"):
        known = [p for p in parts if p != _FREE]
        if len(set(known)) > 1:
            faults.append(f"adds {known[0]} and {known[1]}")
        return known[0] if known else _FREE
    if formula.op in ("mul", "div"):
        return _FREE if _FREE in parts else f"({parts[0]}{'*' if formula.op == 'mul' else '/'}{parts[1]})"
    if formula.op in ("neg", "abs"):
        return parts[0]
    if formula.op in ("square", "sqrt"):
        return _FREE if parts[0] == _FREE else f"{formula.op}({parts[0]})"
    if parts[0] not in (_FREE, "1", "rad"):
        faults.append(f"{formula.op} of {parts[0]}")
    return "1"
