"""A graph as one flat tape of numbers, run by one compiled interpreter.

No code is generated: a bundle can only ever choose among the operators below.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from numba import typeof
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.features.compiled import compiled, compiled_for_many
from dtwin.schema import Floats
from dtwin.serve._tape_program import MULTIPLY_ADD, POWER_SHIFT, SINE_AND_COSINE, Instruction, tape_runs
from dtwin.serve.graph import FARTHEST, Graph

_Program = NDArray[np.uint64]
_WORDS = 4
_A, _B, _C, _STEP = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(_WORDS)


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
    if op == 4:
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
def _run_of_one(op: int, program: _Program, memory: Floats, first: int, count: int) -> None:
    """Do the instructions of one operator; the frequent ones have loops of their own."""
    # Unsigned: a signed place would be looked at for counting from the end.
    at, end = np.uint64(first), np.uint64(first + _WORDS * count)
    if op == 1:
        while at < end:
            memory[program[at]] = memory[program[at + _A]] + memory[program[at + _B]]
            at += _STEP
    elif op == 2:
        while at < end:
            memory[program[at]] = memory[program[at + _A]] - memory[program[at + _B]]
            at += _STEP
    elif op == 3:
        while at < end:
            memory[program[at]] = memory[program[at + _A]] * memory[program[at + _B]]
            at += _STEP
    elif op == 12:
        while at < end:
            memory[program[at]] = math.sin(memory[program[at + _A]])
            at += _STEP
    elif op == 13:
        while at < end:
            memory[program[at]] = math.cos(memory[program[at + _A]])
            at += _STEP
    elif op == MULTIPLY_ADD:
        while at < end:
            product = memory[program[at + _A]] * memory[program[at + _B]]
            memory[program[at]] = memory[program[at + _C]] + product
            at += _STEP
    elif op == SINE_AND_COSINE:
        while at < end:
            sine, cosine = _sine_and_cosine(memory[program[at + _A]])
            memory[program[at]], memory[program[at + _B]] = sine, cosine
            at += _STEP
    elif op == 9:
        while at < end:
            n = int(program[at + _B]) - POWER_SHIFT
            memory[program[at]] = _powered(memory[program[at + _A]], n)
            at += _STEP
    elif op == 22:
        while at < end:
            table, x = int(program[at + _B]), memory[program[at + _A]]
            memory[program[at]] = _looked_up(memory, table, x)
            at += _STEP
    else:
        while at < end:
            x, y = memory[program[at + _A]], memory[program[at + _B]]
            memory[program[at]] = _operated(op, x, y)
            at += _STEP


@compiled
def _run_tape(program: _Program, memory: Floats) -> None:
    """Evaluate a tape once on the inputs in its memory, and step its state.

    ``program``: header (runs, copies, place of outputs), then per run its operator, its number of instructions, and
    target and three arguments of each, then source and target of the copies.
    ``memory``: inputs, state, constants, intermediate values, tables, outputs, staging.
    """
    at = 3
    for _ in range(int(program[0])):
        count = int(program[at + 1])
        _run_of_one(int(program[at]), program, memory, at + 2, count)
        at += 2 + _WORDS * count
    copy, end = np.uint64(at), np.uint64(at) + _B * program[1]
    while copy < end:
        memory[program[copy + _A]] = memory[program[copy]]
        copy += _B


@compiled_for_many
def _run_tape_many(program: _Program, memory: Floats, inputs: Floats, out: Floats) -> None:
    """Evaluate a tape for successive rows of inputs (n, n_inputs) into rows of ``out``."""
    for n in range(inputs.shape[0]):
        for i in range(inputs.shape[1]):
            memory[i] = inputs[n, i]
        _run_tape(program, memory)
        for i in range(out.shape[1]):
            out[n, i] = memory[int(program[2]) + i]


class Tape:
    """A graph, ready to run.

    ``inputs``: order of the input vector; inputs that the graph does not use are allowed.
    ``outputs``: order of the output vector.
    Raises ``InputError`` when the graph uses an input, state or output that is not named.
    """

    def __init__(
        self, graph: Graph, inputs: Sequence[str], states: Mapping[str, float], outputs: Sequence[str]
    ) -> None:
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
        updates = [(slots[i], places[("state", name)]) for name, i in graph.updates.items()]
        copies = [(slots[graph.outputs[name]], free + i) for i, name in enumerate(outputs)]
        copies += _updates(updates, free + len(outputs))
        memory = np.zeros(free + len(outputs) + len(updates))
        _fill(memory, graph, slots, tables)
        self.program = _assembled(tape_runs(graph, slots, tables), copies, free)
        self.inputs = memory[: len(inputs)]
        """What is evaluated next; to be filled in place."""
        self.memory = memory
        self.outputs = memory[free : free + len(outputs)]
        """The newest outputs; a view that the next run overwrites."""
        self.state = memory[self._first_state : self._first_state + len(states)]
        _run_tape(self.program, memory)
        self.reset()
        # What numba's dispatcher would find again at every call, for twice the time of the call.
        compiled_for = typeof(self.program), typeof(memory)
        entry = _run_tape.overloads[compiled_for].entry_point  # type: ignore[attr-defined]
        self.evaluate: Callable[[], None] = partial(entry, self.program, memory)
        """Evaluate ``inputs`` once, into ``outputs``, and step the state."""

    def reset(self) -> None:
        """Return the state to its initial values and the outputs to zero."""
        self.state[:] = self._initial
        self.outputs[:] = 0.0

    def run(self, inputs: Floats) -> Floats:
        """Evaluate once; return the outputs, a view that the next run overwrites.

        ``inputs`` (n_inputs,): in the order given at the start.
        """
        if len(inputs) != len(self.inputs):
            raise ValueError(f"{len(inputs)} inputs given, {len(self.inputs)} wanted")
        self.inputs[:] = inputs
        self.evaluate()
        return self.outputs

    def run_many(self, inputs: Floats) -> Floats:
        """Evaluate rows of inputs (n, n_inputs) one after the other, through the state."""
        rows = np.ascontiguousarray(inputs, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[1] != len(self.inputs):
            raise ValueError(f"rows of shape {rows.shape}, {len(self.inputs)} inputs wanted")
        out = np.empty((len(rows), len(self.outputs)))
        _run_tape_many(self.program, self.memory, rows, out)
        return out


def _fill(memory: Floats, graph: Graph, slots: Sequence[int], tables: Sequence[int]) -> None:
    """Write constants and tables to their places."""
    for slot, node in zip(slots, graph.nodes, strict=True):
        if node.op == "const":
            memory[slot] = node.value
    for place, table in zip(tables, graph.tables, strict=True):
        n = len(table.values)
        memory[place : place + 4] = table.start, table.spacing, n, table.periodic
        memory[place + 4 : place + 4 + n] = table.values


def _assembled(
    runs: Sequence[tuple[int, Sequence[Instruction]]], copies: Sequence[tuple[int, int]], first_output: int
) -> _Program:
    """Return the words that ``_run_tape`` reads."""
    words = [len(runs), len(copies), first_output]
    for op, instructions in runs:
        words += [op, len(instructions)]
        for one in instructions:
            words += [one.target, *one.arguments]
    words += [place for copy in copies for place in copy]
    return np.array(words, dtype=np.uint64)


def _updates(pairs: Sequence[tuple[int, int]], staging: int) -> list[tuple[int, int]]:
    """Return copies from sources to states; a source that is itself a state waits apart."""
    states = {target for _, target in pairs}
    staged = [(pair, staging + i) for i, pair in enumerate(pairs) if pair[0] in states]
    copies = [(source, place) for (source, _), place in staged]
    copies += [pair for pair in pairs if pair[0] not in states]
    return copies + [(place, target) for (_, target), place in staged]


def _require(used: Sequence[str], given: Sequence[str], what: str) -> None:
    missing = [name for name in used if name not in given]
    if missing or len(set(given)) != len(given):
        raise InputError(
            f"the graph's {what} are not those that are declared",
            code="bundle.names",
            got=", ".join(missing)[:200] or "a name is declared twice",
            allowed=", ".join(given)[:400],
        )


# A quarter turn in three parts; the first two times a whole number below 2**20 are exact.
_QUARTER = 1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21
_PER_QUARTER = 2.0 / math.pi
_FARTHEST = 1e6


@compiled
def _sine_and_cosine(x: float) -> tuple[float, float]:
    """Return sine and cosine, each within two units of the last place of 1.

    Reduction after Cody and Waite (Software Manual for the Elementary Functions, 1980),
    polynomials of fdlibm (Sun Microsystems, 1993).

    ``x``: angle in rad; beyond a million the slower functions of the C library answer.
    """
    if not abs(x) < _FARTHEST:
        return math.sin(x), math.cos(x)
    turns = np.floor(x * _PER_QUARTER + 0.5)
    r = ((x - turns * _QUARTER[0]) - turns * _QUARTER[1]) - turns * _QUARTER[2]
    z = r * r
    odd = 1.58969099521155010221e-10
    odd = odd * z - 2.50507602534068634195e-08
    odd = odd * z + 2.75573137070700676789e-06
    odd = odd * z - 1.98412698298579493134e-04
    odd = odd * z + 8.33333333332248946124e-03
    odd = odd * z - 1.66666666666666324348e-01
    even = -1.13596475577881948265e-11
    even = even * z + 2.08757232129817482790e-09
    even = even * z - 2.75573143513906633035e-07
    even = even * z + 2.48015872894767294178e-05
    even = even * z - 1.38888888888741095749e-03
    even = even * z + 4.16666666666666019037e-02
    sine, cosine = r * (1.0 + z * odd), 1.0 - (0.5 * z - z * z * even)
    quarter = int(turns) & 3
    if quarter & 1:
        sine, cosine = cosine, sine
    return (-sine if quarter & 2 else sine), (-cosine if (quarter + 1) & 2 else cosine)
