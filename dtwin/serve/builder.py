"""Builds a graph from ordinary arithmetic, sharing what is equal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from dtwin.errors import InputError
from dtwin.serve.graph import OPERATORS, Graph, Node, Table

Term: TypeAlias = "Expression | float | int"


@dataclass(frozen=True)
class Expression:
    """Handle of a node; arithmetic on it adds nodes to its builder."""

    builder: GraphBuilder
    index: int

    def __add__(self, other: Term) -> Expression:
        return self.builder.apply("add", self, other)

    def __radd__(self, other: Term) -> Expression:
        return self.builder.apply("add", other, self)

    def __sub__(self, other: Term) -> Expression:
        return self.builder.apply("sub", self, other)

    def __rsub__(self, other: Term) -> Expression:
        return self.builder.apply("sub", other, self)

    def __mul__(self, other: Term) -> Expression:
        return self.builder.apply("mul", self, other)

    def __rmul__(self, other: Term) -> Expression:
        return self.builder.apply("mul", other, self)

    def __truediv__(self, other: Term) -> Expression:
        return self.builder.apply("div", self, other)

    def __rtruediv__(self, other: Term) -> Expression:
        return self.builder.apply("div", other, self)

    def __neg__(self) -> Expression:
        return self.builder.apply("neg", self)

    def __abs__(self) -> Expression:
        return self.builder.apply("abs", self)

    def __pow__(self, n: int) -> Expression:
        """Raise to a whole power."""
        return self.builder.power(self, n)


class GraphBuilder:
    """Collects nodes.

    Equal nodes are shared, so that a term written twice is evaluated once.
    """

    def __init__(self) -> None:
        self._nodes: list[Node] = []
        self._numbers: dict[Node, int] = {}
        self._tables: list[Table] = []

    def input(self, name: str) -> Expression:
        """Return the handle of an input."""
        return self._add(Node("input", name=name))

    def state(self, name: str) -> Expression:
        """Return the handle of a state's value before this tick."""
        return self._add(Node("state", name=name))

    def constant(self, value: float) -> Expression:
        """Return the handle of a constant."""
        return self._add(Node("const", value=float(value)))

    def node(self, term: Expression) -> Node:
        """Return the node behind a handle."""
        return self._nodes[term.index]

    def apply(self, op: str, *terms: Term) -> Expression:
        """Return the handle of an operation, for example ``apply("sin", x)``.

        Args:
            op: Name in ``OPERATORS``, except ``pow_int`` and ``lookup``.

        Raises:
            InputError: When there is no such operator, or the count of arguments is wrong.
        """
        wanted = OPERATORS.get(op)
        if wanted is None or op in ("pow_int", "lookup") or wanted.arity != len(terms):
            raise InputError(
                "no such operation",
                code="graph.operator",
                got=f"{op[:40]} with {len(terms)} arguments",
                allowed=", ".join(OPERATORS),
            )
        return self._add(Node(op, tuple(self._term(t).index for t in terms)))

    def power(self, base: Term, n: int) -> Expression:
        """Return the handle of a whole power."""
        term = self._term(base)
        if n == 2:
            return self.apply("square", term)
        return self._add(Node("pow_int", (term.index,), n=n))

    def lookup(
        self, argument: Term, start: float, spacing: float, values: Sequence[float], periodic: bool = False
    ) -> Expression:
        """Return the handle of a uniform table's linear interpolation.

        Args:
            start: Argument of the first value.
            spacing: From one value to the next.
            values: At least two.
            periodic: Whether the first value follows the last; else the ends are held.
        """
        table = Table(float(start), float(spacing), tuple(map(float, values)), periodic)
        if table not in self._tables:
            self._tables.append(table)
        place = self._tables.index(table)
        return self._add(Node("lookup", (self._term(argument).index,), n=place))

    def total(self, terms: Sequence[Term]) -> Expression:
        """Return the handle of a sum, left to right."""
        result = self._term(terms[0]) if terms else self.constant(0.0)
        for term in terms[1:]:
            result = result + term
        return result

    def graph(self, outputs: Mapping[str, Term], updates: Mapping[str, Term] | None = None) -> Graph:
        """Return the graph of what the outputs and updates need, nothing else.

        Args:
            updates: Next value of states by name.

        Raises:
            InputError: When the graph is too large or too deep.
        """
        out = {name: self._term(term).index for name, term in outputs.items()}
        after = {name: self._term(term).index for name, term in (updates or {}).items()}
        needed: set[int] = set()
        pending = [*out.values(), *after.values()]
        while pending:
            i = pending.pop()
            if i not in needed:
                needed.add(i)
                pending.extend(self._nodes[i].args)
        order = sorted(needed)
        moved = {old: new for new, old in enumerate(order)}
        used = sorted({self._nodes[i].n for i in order if self._nodes[i].op == "lookup"})
        shift = {old: new for new, old in enumerate(used)}
        nodes = []
        for i in order:
            node = self._nodes[i]
            n = shift[node.n] if node.op == "lookup" else node.n
            args = tuple(moved[a] for a in node.args)
            nodes.append(Node(node.op, args, node.value, node.name, n))
        return Graph(
            tuple(nodes),
            {name: moved[i] for name, i in out.items()},
            {name: moved[i] for name, i in after.items()},
            tuple(self._tables[i] for i in used),
        )

    def _term(self, term: Term) -> Expression:
        return term if isinstance(term, Expression) else self.constant(float(term))

    def _add(self, node: Node) -> Expression:
        if node not in self._numbers:
            self._numbers[node] = len(self._nodes)
            self._nodes.append(node)
        return Expression(self, self._numbers[node])
