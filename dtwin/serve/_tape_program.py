"""From a graph to the instructions of a tape, in runs of one operator each.

An interpreter loses most of its time where it cannot guess which operator comes next. No
instruction writes where another one writes, so any order that keeps the operands first gives
the same bits: the order with few changes of operator is the fast one.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence, Set
from dataclasses import dataclass
from functools import cached_property

from dtwin.serve.graph import OPERATORS, Graph, Node

POWER_SHIFT = 64
MULTIPLY_ADD = 23
SINE_AND_COSINE = 24


@dataclass(frozen=True)
class Instruction:
    """One operation on places of the memory.

    ``target``: place of the result.
    ``arguments``, length 3: places, or what else the operator wants; unsigned.
    ``reads``: places whose values must be there before.
    ``also``: place of a second result.
    """

    op: int
    target: int
    arguments: tuple[int, int, int]
    reads: frozenset[int]
    also: int | None = None

    @cached_property
    def writes(self) -> frozenset[int]:
        """Places that have their values afterwards."""
        return frozenset((self.target,) if self.also is None else (self.target, self.also))


def tape_runs(graph: Graph, slots: Sequence[int], tables: Sequence[int]) -> list[tuple[int, list[Instruction]]]:
    """Return the operator of each run, with its instructions.

    ``slots``, ``tables``: place of each node's value, and of each table.
    """
    waiting = _instructions(graph, slots, tables)
    runs: list[tuple[int, list[Instruction]]] = []
    while waiting:
        missing = {place for one in waiting for place in one.writes}
        of_op: defaultdict[int, list[Instruction]] = defaultdict(list)
        for one in waiting:
            of_op[one.op].append(one)
        # An instruction may follow the one that it needs within the same run.
        op, done = max(
            ((op, _ready(same, missing)) for op, same in of_op.items()),
            key=lambda run: (len(run[1]) / len(of_op[run[0]]), len(run[1]), -run[0]),
        )
        runs.append((op, done))
        taken = {one.target for one in done}
        waiting = [one for one in waiting if one.target not in taken]
    return runs


def _ready(same: Sequence[Instruction], missing: Set[int]) -> list[Instruction]:
    """Return the instructions of one operator that can be done one after the other now.

    ``missing``: places whose values are not there yet.
    """
    done: list[Instruction] = []
    made: set[int] = set()
    for one in same:
        if missing.isdisjoint(one.reads - made):
            done.append(one)
            made |= one.writes
    return done


def _instructions(graph: Graph, slots: Sequence[int], tables: Sequence[int]) -> list[Instruction]:
    """Return one instruction per operation, or per two that are cheaper together."""
    products, cosines = _products_of_sums(graph), _cosines_of_sines(graph)
    absorbed = {*products.values(), *cosines.values()}
    instructions = []
    for i, node in enumerate(graph.nodes):
        if node.op not in OPERATORS or i in absorbed:
            continue
        places = [slots[a] for a in node.args]
        if i in products:
            other = next(a for a in (*node.args[1:], node.args[0]) if a != products[i])
            places = [slots[a] for a in (*graph.nodes[products[i]].args, other)]
            instructions.append(Instruction(MULTIPLY_ADD, slots[i], _three(places), frozenset(places)))
        elif i in cosines:
            also = slots[cosines[i]]
            instructions.append(Instruction(SINE_AND_COSINE, slots[i], (places[0], also, 0), frozenset(places), also))
        else:
            arguments = places[0], _second(node, tables, places[-1]), 0
            op = OPERATORS[node.op].code
            instructions.append(Instruction(op, slots[i], arguments, frozenset(places)))
    return instructions


def _products_of_sums(graph: Graph) -> dict[int, int]:
    """Return for sums a product that nothing else uses: it joins the sum."""
    kept = [*graph.outputs.values(), *graph.updates.values()]
    uses = Counter([*kept, *(a for node in graph.nodes for a in node.args)])
    products: dict[int, int] = {}
    for i, node in enumerate(graph.nodes):
        for a in node.args if node.op == "add" else ():
            if graph.nodes[a].op == "mul" and uses[a] == 1 and a not in kept:
                products.setdefault(i, a)
    return products


def _cosines_of_sines(graph: Graph) -> dict[int, int]:
    """Return for sines the cosine of the same angle: both come from one reduction."""
    cosines = {node.args: i for i, node in enumerate(graph.nodes) if node.op == "cos"}
    return {i: cosines[node.args] for i, node in enumerate(graph.nodes) if node.op == "sin" and node.args in cosines}


def _three(places: Sequence[int]) -> tuple[int, int, int]:
    first, second, third = places
    return first, second, third


def _second(node: Node, tables: Sequence[int], slot: int) -> int:
    """Return the second argument of an instruction; unsigned, so exponents are shifted."""
    if node.op == "pow_int":
        return node.n + POWER_SHIFT
    return tables[node.n] if node.op == "lookup" else slot
