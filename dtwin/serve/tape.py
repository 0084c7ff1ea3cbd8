"""A graph as one flat tape of numbers, run by one compiled interpreter.

No code is generated: a bundle can only ever choose among the operators below.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.features.compiled import compiled
from dtwin.schema import Floats
from dtwin.serve.graph import Graph, Node
from dtwin.serve.operators import FARTHEST, OPERATORS

Program = NDArray[np.uint64]
_POWER_SHIFT = 64
_MULTIPLY_ADD = 23


@compiled
def _looked_up(memory: Floats, table: int, x: float) -> float:
    """Interpolate the table at ``memory[table]``: start, spacing, count, periodic, values."""
    n = int(memory[table + 2])
    first = table + 4
    u = (x - memory[table]) / memory[table + 1]
    if memory[table + 3] == 0.0:
        if u <= 0.0:
            return memory[first]
        if u >= n - 1:
            return memory[first + n - 1]
        if not u < n - 1:
            return np.nan
        low = int(u)
        left = memory[first + low]
        return left + (u - low) * (memory[first + low + 1] - left)
    if not abs(u) < FARTHEST:
        return np.nan
    u -= np.floor(u / n) * n
    low = int(u)
    if low > n - 1:
        low = n - 1
    low = max(low, 0)
    after = low + 1 if low + 1 < n else 0
    left = memory[first + low]
    return left + (u - low) * (memory[first + after] - left)


@compiled
def _powered(x: float, n: int) -> float:
    result, base, left = 1.0, x, abs(n)
    while left:
        if left % 2:
            result *= base
        base *= base
        left //= 2
    return 1.0 / result if n < 0 else result


@compiled
def _operated(op: int, x: float, y: float) -> float:
    result = np.nan
    if op == 1:
        result = x + y
    elif op == 2:
        result = x - y
    elif op == 3:
        result = x * y
    elif op == 4:
        result = x / y
    elif op == 5:
        result = -x
    elif op == 6:
        result = abs(x)
    elif op == 7:
        result = math.sqrt(x) if x >= 0.0 else np.nan
    elif op == 8:
        result = x * x
    elif op == 10:
        result = math.exp(x)
    elif op == 11:
        result = np.log(x)
    elif op == 12:
        result = math.sin(x)
    elif op == 13:
        result = math.cos(x)
    elif op == 14:
        result = math.tan(x)
    elif op == 15:
        result = math.atan2(x, y)
    elif op == 16:
        result = math.tanh(x)
    elif op == 17:
        result = 1.0 / (1.0 + math.exp(-x))
    elif x == x and y == y:
        if op == 18:
            result = x if x < y else y
        elif op == 19:
            result = x if x > y else y
        elif op == 20:
            result = 1.0 if x > 0.0 else (-1.0 if x < 0.0 else 0.0)
        elif op == 21:
            result = 1.0 if x >= 0.0 else 0.0
    return result


@compiled
def run_tape(program: Program, memory: Floats, inputs: Floats) -> None:
    """Evaluate a tape once, and step its state.

    Parameters
    ----------
    program : ndarray of uint64
        Header (instructions, inputs, outputs, updates, place of outputs, place of staging),
        then operator, target and three arguments per instruction, then the sources of the
        outputs, then the sources and targets of the updates.
    memory : ndarray of float64
        Inputs, state, constants, intermediate values, tables, outputs, staging.
    inputs : ndarray, shape (n_inputs,)
        Copied to the start of the memory.
    """
    count, n_inputs = int(program[0]), int(program[1])
    n_outputs, n_updates = int(program[2]), int(program[3])
    first_output, first_staged = int(program[4]), int(program[5])
    for i in range(n_inputs):
        memory[i] = inputs[i]
    at = 6
    for _ in range(count):
        op, target, a, b = program[at], program[at + 1], program[at + 2], program[at + 3]
        if op == _MULTIPLY_ADD:
            memory[target] = memory[program[at + 4]] + memory[a] * memory[b]
        elif op == 9:
            memory[target] = _powered(memory[a], int(b) - _POWER_SHIFT)
        elif op == 22:
            memory[target] = _looked_up(memory, int(b), memory[a])
        else:
            memory[target] = _operated(op, memory[a], memory[b])
        at += 5
    for i in range(n_outputs):
        memory[first_output + i] = memory[program[at + i]]
    at += n_outputs
    for i in range(n_updates):
        memory[first_staged + i] = memory[program[at + i]]
    at += n_updates
    for i in range(n_updates):
        memory[program[at + i]] = memory[first_staged + i]


@compiled
def run_tape_many(program: Program, memory: Floats, inputs: Floats, out: Floats) -> None:
    """Evaluate a tape for successive rows of inputs (n, n_inputs) into rows of ``out``."""
    for n in range(inputs.shape[0]):
        run_tape(program, memory, inputs[n])
        for i in range(out.shape[1]):
            out[n, i] = memory[int(program[4]) + i]


class Tape:
    """A graph, ready to run.

    Parameters
    ----------
    graph : Graph
        What to evaluate.
    inputs : sequence of str
        Order of the input vector; inputs that the graph does not use are allowed.
    states : mapping of str to float
        Initial values.
    outputs : sequence of str
        Order of the output vector.
    n_given : int, optional
        How many of the first inputs ``run`` is given; the others are held in ``inputs``.

    Raises
    ------
    InputError
        When the graph uses an input, state or output that is not named.
    """

    def __init__(
        self, graph: Graph, inputs: Sequence[str], states: Mapping[str, float],
        outputs: Sequence[str], n_given: int | None = None,
    ) -> None:  # fmt: skip
        _require(graph.inputs, inputs, "inputs")
        _require(graph.states, list(states), "states")
        _require(outputs, list(graph.outputs), "outputs")
        self._first_state = len(inputs)
        self._initial = np.array(list(states.values()), dtype=np.float64)
        places = {("input", name): i for i, name in enumerate(inputs)}
        places |= {("state", name): len(inputs) + i for i, name in enumerate(states)}
        free = len(inputs) + len(states)
        slots: list[int] = []
        for node in graph.nodes:
            key = (node.op, node.name)
            slots.append(places.get(key, free))
            free += key not in places
        tables = []
        for table in graph.tables:
            tables.append(free)
            free += 4 + len(table.values)
        updates = list(graph.updates.items())
        program = [len(graph.nodes), len(inputs), len(outputs), len(updates)]
        program += [free, free + len(outputs)]
        memory = np.zeros(free + len(outputs) + len(updates))
        for place, table in zip(tables, graph.tables, strict=True):
            n = len(table.values)
            memory[place : place + 4] = table.start, table.spacing, n, table.periodic
            memory[place + 4 : place + 4 + n] = table.values
        for slot, node in zip(slots, graph.nodes, strict=True):
            if node.op == "const":
                memory[slot] = node.value
        instructions = _instructions(graph, slots, tables)
        program[0] = len(instructions)
        program += [word for instruction in instructions for word in instruction]
        program += [slots[graph.outputs[name]] for name in outputs]
        program += [slots[i] for _, i in updates]
        program += [places[("state", name)] for name, _ in updates]
        self._all_given = np.array(program, dtype=np.uint64)
        self.program = self._all_given.copy()
        self._n_given = len(inputs) if n_given is None else n_given
        self.program[1] = self._n_given
        self.inputs = memory[: len(inputs)]
        """The newest inputs; the held ones may be set here."""
        self.memory = memory
        self.outputs = memory[free : free + len(outputs)]
        """The newest outputs; a view that the next run overwrites."""
        self.state = memory[self._first_state : self._first_state + len(states)]
        self.reset()

    def reset(self) -> None:
        """Return the state to its initial values and the outputs to zero."""
        self.state[:] = self._initial
        self.outputs[:] = 0.0

    def run(self, inputs: Floats) -> Floats:
        """Evaluate once; return the outputs, a view that the next run overwrites.

        Parameters
        ----------
        inputs : ndarray of float64, shape (n_given,)
            In the order given at the start.
        """
        if len(inputs) != self._n_given:
            raise ValueError(f"{len(inputs)} inputs given, {self._n_given} wanted")
        run_tape(self.program, self.memory, inputs)
        return self.outputs

    def run_many(self, inputs: Floats) -> Floats:
        """Evaluate rows of inputs (n, n_inputs) one after the other, through the state."""
        rows = np.ascontiguousarray(inputs, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[1] != len(self.inputs):
            raise ValueError(f"rows of shape {rows.shape}, {len(self.inputs)} inputs wanted")
        out = np.empty((len(rows), len(self.outputs)))
        run_tape_many(self._all_given, self.memory, rows, out)
        return out


def _instructions(
    graph: Graph, slots: Sequence[int], tables: Sequence[int]
) -> list[tuple[int, int, int, int, int]]:
    """Return one instruction per operation; a product that only a sum uses joins that sum."""
    uses = [*graph.outputs.values(), *graph.updates.values()]
    uses += [a for node in graph.nodes for a in node.args]
    once = {i for i, count in Counter(uses).items() if count == 1}
    kept = set(graph.outputs.values()) | set(graph.updates.values())
    found: dict[int, tuple[int, int, int, int, int]] = {}
    for i, node in enumerate(graph.nodes):
        if node.op not in OPERATORS:
            continue
        if node.op == "add":
            product = next(
                (a for a in node.args if graph.nodes[a].op == "mul" and a in once - kept), None
            )
            if product is not None:
                other = node.args[0] if node.args[1] == product else node.args[1]
                p, q = graph.nodes[product].args
                found[i] = (_MULTIPLY_ADD, slots[i], slots[p], slots[q], slots[other])
                found.pop(product, None)
                continue
        b = _second(node, tables, slots[node.args[-1]])
        found[i] = (OPERATORS[node.op].code, slots[i], slots[node.args[0]], b, 0)
    return [found[i] for i in sorted(found)]


def _second(node: Node, tables: Sequence[int], slot: int) -> int:
    """Return the second argument of an instruction; unsigned, so exponents are shifted."""
    if node.op == "pow_int":
        return node.n + _POWER_SHIFT
    return tables[node.n] if node.op == "lookup" else slot


def _require(used: Sequence[str], given: Sequence[str], what: str) -> None:
    missing = [name for name in used if name not in given]
    if missing or len(set(given)) != len(given):
        raise InputError(
            f"the graph's {what} are not those that are declared",
            code="bundle.names",
            got=", ".join(missing)[:200] or "a name is declared twice",
            allowed=", ".join(given)[:400],
        )
