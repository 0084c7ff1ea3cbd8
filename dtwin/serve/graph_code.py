"""A graph as text, LaTeX, Python and C, always from what is stored, never retyped."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from dtwin.serve.graph import Graph, Node, Table


@dataclass(frozen=True)
class Style:
    """How one language writes leaves and operations; arguments come fully bracketed.

    ``name``: writes an input or a state.
    ``operations``: templates by operator, from ``operations_with``.
    ``power``, ``table``, ``assign``: templates of a whole power, of a look-up, and of an assignment.
    """

    number: Callable[[float], str]
    name: Callable[[Node], str]
    operations: dict[str, str]
    power: str
    table: str
    assign: str


def operations_with(**changes: str) -> dict[str, str]:
    """Return templates of all operators, some of them changed."""
    plain = {
        "add": "({0} + {1})",
        "sub": "({0} - {1})",
        "mul": "({0} * {1})",
        "div": "({0} / {1})",
        "neg": "(-{0})",
        "square": "({0} * {0})",
    }
    names = ("abs", "sqrt", "exp", "log", "sin", "cos", "tan", "atan2", "tanh", "logistic")
    for name in (*names, "min", "max", "sign", "step"):
        plain[name] = f"{name}({{0}}, {{1}})" if name in ("atan2", "min", "max") else f"{name}({{0}})"
    return plain | changes


_TEXT = Style(
    number=lambda v: f"{v:.6g}",
    name=lambda node: node.name,
    operations=operations_with(square="{0}^2"),
    power="{0}^{1}",
    table="table{1}({0})",
    assign="{0} = {1}",
)


def to_text(graph: Graph) -> str:
    """Return the equations as plain text, numbers to six digits, one line per output."""
    lines = assignments(graph, _TEXT, "t{}")
    return "\n".join(lines + _table_lines(graph))


def to_latex(graph: Graph) -> str:
    """Return the equations as LaTeX lines of an ``aligned`` environment."""
    style = Style(
        number=_latex_number,
        # A name comes with a bundle that somebody sent: nothing in it may become a command of LaTeX.
        name=lambda node: r"\mathrm{" + re.sub(r"[^A-Za-z0-9]", r"\\_", node.name) + "}",
        operations=operations_with(
            mul=r"{0} \cdot {1}",
            div=r"\frac{{{0}}}{{{1}}}",
            square=r"\left({0}\right)^2",
            add=r"\left({0} + {1}\right)",
            sub=r"\left({0} - {1}\right)",
            neg=r"\left(-{0}\right)",
            abs=r"\left|{0}\right|",
            sqrt=r"\sqrt{{{0}}}",
            logistic=r"\sigma\left({0}\right)",
            step=r"H\left({0}\right)",
            sign=r"\operatorname{{sgn}}\left({0}\right)",
            atan2=r"\operatorname{{atan2}}\left({0}, {1}\right)",
            **{f: rf"\{f}\left({{0}}\right)" for f in ("exp", "log", "sin", "cos", "tan", "tanh")},
            **{f: rf"\{f}\left({{0}}, {{1}}\right)" for f in ("min", "max")},
        ),
        power=r"\left({0}\right)^{{{1}}}",
        table=r"T_{{{1}}}\left({0}\right)",
        assign="{0} &= {1}",
    )
    lines = assignments(graph, style, "t_{{{}}}", lambda name: style.name(Node("input", name=name)))
    return "\\begin{aligned}\n" + " \\\\\n".join(lines) + "\n\\end{aligned}"


_PYTHON_PRELUDE = """\
import math


def _power(x, n):
    result, base, left = 1.0, x, abs(n)
    while left:
        if left % 2:
            result *= base
        base *= base
        left //= 2
    return 1.0 / result if n < 0 else result


def _table(x, start, spacing, values, periodic):
    n, u = len(values), (x - start) / spacing
    if not periodic:
        if u <= 0:
            return values[0]
        if u >= n - 1:
            return values[-1]
        low = int(u)
        return values[low] + (u - low) * (values[low + 1] - values[low])
    u -= math.floor(u / n) * n
    low = min(int(u), n - 1)
    return values[low] + (u - low) * (values[(low + 1) % n] - values[low])


"""


def to_python(graph: Graph, name: str = "tick") -> str:
    """Return a Python module with one function ``name(inputs, state) -> (outputs, state)``.

    Inputs, state and outputs are mappings by name; needs only the standard library. The state stays as it was where an input
    is no finite number.
    """
    style = Style(
        number=lambda v: repr(float(v)) if v >= 0 else f"({float(v)!r})",
        name=lambda node: f"{'inputs' if node.op == 'input' else 'state'}[{node.name!r}]",
        operations=operations_with(
            logistic="(1.0 / (1.0 + math.exp(-{0})))",
            sign="float(({0} > 0) * 1 - ({0} < 0) * 1)",
            step="float({0} >= 0)",
            **{f: f"math.{f}({{0}})" for f in ("sqrt", "exp", "log", "sin", "cos", "tan", "tanh")},
            atan2="math.atan2({0}, {1})",
        ),
        power="_power({0}, {1})",
        table="_table({0}, *TABLES[{1}])",
        assign="    {0} = {1}",
    )
    lines = assignments(graph, style, "t{}", lambda n: f"out[{n!r}]", lambda n: f"after[{n!r}]")
    tables = [f"    ({t.start!r}, {t.spacing!r}, {list(t.values)!r}, {t.periodic!r})," for t in graph.tables]
    head = ["TABLES = (", *tables, ")", "", "", f"def {identifier(name)}(inputs, state):"]
    kept = ["    if not all(map(math.isfinite, [*inputs.values(), *after.values()])):", "        after = dict(state)"]
    body = ["    out, after = {}, dict(state)", *lines, *(kept if graph.updates else []), "    return out, after"]
    return _PYTHON_PRELUDE + "\n".join(head + body) + "\n"


_C_PRELUDE = """\
#include <math.h>

static double dtwin_power(double x, int n) {
  double result = 1.0, base = x;
  for (int left = n < 0 ? -n : n; left; left /= 2) {
    if (left % 2) result *= base;
    base *= base;
  }
  return n < 0 ? 1.0 / result : result;
}
static double dtwin_sign(double x) { return isnan(x) ? x : (double)((x > 0) - (x < 0)); }
static double dtwin_at_least_zero(double x) { return isnan(x) ? x : (double)(x >= 0); }
static double dtwin_min(double a, double b) {
  return isnan(a) || isnan(b) ? NAN : a < b ? a : b;
}
static double dtwin_max(double a, double b) {
  return isnan(a) || isnan(b) ? NAN : a > b ? a : b;
}
static double dtwin_table(double x, double start, double spacing, const double *v, int n,
                          int periodic) {
  double u = (x - start) / spacing;
  if (isnan(u) || (periodic && !(fabs(u) < 1e12))) return NAN;
  if (!periodic) {
    if (u <= 0.0) return v[0];
    if (u >= n - 1) return v[n - 1];
    int low = (int)u;
    return v[low] + (u - low) * (v[low + 1] - v[low]);
  }
  u -= floor(u / n) * n;
  int low = (int)u;
  if (low > n - 1) low = n - 1;
  return v[low] + (u - low) * (v[(low + 1) % n] - v[low]);
}
"""


def to_c(
    graph: Graph, inputs: tuple[str, ...], states: tuple[str, ...], outputs: tuple[str, ...], name: str = "tick"
) -> str:
    """Return a C99 file with ``void dtwin_<name>(const double *in, double *state, double *out)``.

    The state stays as it was where an input is no finite number. Every symbol starts with ``dtwin_``, because C libraries own
    short names such as ``step``.
    Compile without ``-ffast-math``, which would remove the guards against NaN.

    ``inputs``, ``states``, ``outputs``: order of the three arrays.
    """

    def leaf(node: Node) -> str:
        array, order = ("in", inputs) if node.op == "input" else ("state", states)
        return f"{array}[{order.index(node.name)}]"

    style = Style(
        number=lambda v: f"({float(v)!r})",
        name=leaf,
        operations=operations_with(
            abs="fabs({0})",
            logistic="(1.0 / (1.0 + exp(-{0})))",
            min="dtwin_min({0}, {1})",
            max="dtwin_max({0}, {1})",
            sign="dtwin_sign({0})",
            step="dtwin_at_least_zero({0})",
        ),
        power="dtwin_power({0}, {1})",
        table="dtwin_table({0}, DTWIN_TABLE_ARGUMENTS_{1})",
        assign="  const double {0} = {1};",
    )
    lines = assignments(graph, style, "t{}", lambda n: f"out_{outputs.index(n)}", lambda n: f"after_{states.index(n)}")
    lines += [f"  out[{i}] = out_{i};" for i in range(len(outputs))]
    if graph.updates:
        finite = [*(f"in[{i}]" for i in range(len(inputs))), *(f"after_{states.index(n)}" for n in graph.updates)]
        lines += [f"  if (!({' && '.join(f'isfinite({n})' for n in finite)})) return;"]
    lines += [f"  state[{states.index(n)}] = after_{states.index(n)};" for n in graph.updates]
    tables = [line for i, t in enumerate(graph.tables) for line in _c_table(i, t)]
    symbol = f"dtwin_{identifier(name)}"
    head = [*tables, f"void {symbol}(const double *in, double *state, double *out) {{"]
    unused = ["  (void)in;", "  (void)state;"]
    return _C_PRELUDE + "\n".join(head + unused + lines + ["}"]) + "\n"


def _c_table(i: int, table: Table) -> list[str]:
    values = ", ".join(repr(float(v)) for v in table.values)
    arguments = f"{table.start!r}, {table.spacing!r}, dtwin_table_{i}, {len(table.values)}"
    return [
        f"static const double dtwin_table_{i}[] = {{{values}}};",
        f"#define DTWIN_TABLE_ARGUMENTS_{i} {arguments}, {int(table.periodic)}",
    ]


def assignments(
    graph: Graph,
    style: Style,
    temporary: str,
    output: Callable[[str], str] = str,
    update: Callable[[str], str] = "next {}".format,
) -> list[str]:
    """Return one assignment per shared term, then one per output and per update.

    ``temporary``: template of the names of shared terms, numbered from 1.
    ``output``, ``update``: write where an output, and the next value of a state, goes.
    """
    uses = Counter(a for node in graph.nodes for a in node.args)
    uses.update(a for node in graph.nodes if node.op == "square" for a in node.args)
    lines: list[str] = []
    written: list[str] = []
    shared = 0
    for i, node in enumerate(graph.nodes):
        term = _term(node, style, [written[a] for a in node.args])
        if node.args and (uses[i] > 1 or len(term) > 400):
            shared += 1
            name = temporary.format(shared)
            lines.append(style.assign.format(name, term))
            term = name
        written.append(term)
    for name, i in graph.outputs.items():
        lines.append(style.assign.format(output(name), written[i]))
    for name, i in graph.updates.items():
        lines.append(style.assign.format(update(name), written[i]))
    return lines


def _term(node: Node, style: Style, args: list[str]) -> str:
    if node.op == "const":
        return style.number(node.value)
    if not args:
        return style.name(node)
    if node.op == "pow_int":
        return style.power.format(args[0], node.n)
    if node.op == "lookup":
        return style.table.format(args[0], node.n)
    return style.operations[node.op].format(*args)


def _table_lines(graph: Graph) -> list[str]:
    return [
        f"table{i}: {len(t.values)} values from {t.start:.6g} every {t.spacing:.6g}"
        + (", periodic" if t.periodic else ", held at its ends")
        for i, t in enumerate(graph.tables)
    ]


def _latex_number(value: float) -> str:
    plain = f"{value:.6g}"
    if "e" not in plain:
        return plain
    digits, exponent = plain.split("e")
    return rf"{digits} \cdot 10^{{{int(exponent)}}}"


def identifier(name: str) -> str:
    """Return a name with everything replaced that an identifier cannot hold."""
    return re.sub(r"\W", "_", name)
