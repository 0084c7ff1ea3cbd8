"""A graph as IEC 61131-3 structured text and as a URScript function.

Neither language is available here: what is written is checked by an evaluator of the emitted
grammar in the tests, and has not run on a controller.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from decimal import Decimal

from dtwin.errors import InputError
from dtwin.serve.graph import Graph, Table
from dtwin.serve.graph_code import Style, assignments, identifier, operations_with

NOT_RUN = "Checked by dtwin's own evaluator of this grammar; never run on a controller."
_WORD = re.compile(r"[A-Za-z][A-Za-z0-9_]*")

_FINITE = "1000000000000000.0"
"""No number of a machine is as large; no comparison with a NaN is true."""

_ST_HELPERS = {
    "DTWIN_FINITE": f"""\
FUNCTION DTWIN_FINITE : LREAL
VAR_INPUT x : LREAL; END_VAR
IF ABS(x) < {_FINITE} THEN DTWIN_FINITE := 1.0;
ELSE DTWIN_FINITE := 0.0; END_IF;
END_FUNCTION
""",
    "DTWIN_SIGN": """\
FUNCTION DTWIN_SIGN : LREAL
VAR_INPUT x : LREAL; END_VAR
IF x > 0.0 THEN DTWIN_SIGN := 1.0;
ELSIF x < 0.0 THEN DTWIN_SIGN := -1.0;
ELSE DTWIN_SIGN := 0.0; END_IF;
END_FUNCTION
""",
    "DTWIN_STEP": """\
FUNCTION DTWIN_STEP : LREAL
VAR_INPUT x : LREAL; END_VAR
IF x >= 0.0 THEN DTWIN_STEP := 1.0;
ELSE DTWIN_STEP := 0.0; END_IF;
END_FUNCTION
""",
    "DTWIN_TANH": """\
FUNCTION DTWIN_TANH : LREAL
VAR_INPUT x : LREAL; END_VAR
VAR e : LREAL; END_VAR
e := EXP(-2.0 * ABS(x));
DTWIN_TANH := (1.0 - e) / (1.0 + e);
IF x < 0.0 THEN DTWIN_TANH := -(1.0 - e) / (1.0 + e); END_IF;
END_FUNCTION
""",
    "DTWIN_ATAN2": """\
FUNCTION DTWIN_ATAN2 : LREAL
VAR_INPUT y : LREAL; x : LREAL; END_VAR
IF x > 0.0 THEN DTWIN_ATAN2 := ATAN(y / x);
ELSIF x < 0.0 THEN
  IF y >= 0.0 THEN DTWIN_ATAN2 := ATAN(y / x) + 3.141592653589793;
  ELSE DTWIN_ATAN2 := ATAN(y / x) - 3.141592653589793; END_IF;
ELSIF y > 0.0 THEN DTWIN_ATAN2 := 1.5707963267948966;
ELSIF y < 0.0 THEN DTWIN_ATAN2 := -1.5707963267948966;
ELSE DTWIN_ATAN2 := 0.0; END_IF;
END_FUNCTION
""",
    "DTWIN_POWER": """\
FUNCTION DTWIN_POWER : LREAL
VAR_INPUT x : LREAL; n : DINT; END_VAR
VAR result : LREAL; base : LREAL; left : DINT; END_VAR
result := 1.0;
base := x;
left := ABS(n);
WHILE left > 0 DO
  IF left MOD 2 = 1 THEN result := result * base; END_IF;
  base := base * base;
  left := left / 2;
END_WHILE;
IF n < 0 THEN result := 1.0 / result; END_IF;
DTWIN_POWER := result;
END_FUNCTION
""",
}


def to_structured_text(
    graph: Graph, inputs: Sequence[str], states: dict[str, float], name: str = "DTWIN_CORRECTION"
) -> str:
    """Return a function block with the functions that it needs.

    ``inputs``: order of the inputs.
    ``states``: states with their initial values; the block remembers them, as they were where an input is no finite number.
    Raises ``InputError`` when a name of the graph is no identifier of the language.
    """
    _require_words([*inputs, *states, *graph.outputs])
    style = Style(
        number=_st_number,
        name=lambda node: node.name,
        operations=operations_with(
            logistic="(1.0 / (1.0 + EXP(-{0})))",
            sign="DTWIN_SIGN({0})",
            step="DTWIN_STEP({0})",
            atan2="DTWIN_ATAN2({0}, {1})",
            tanh="DTWIN_TANH({0})",
            log="LN({0})",
            **{f: f"{f.upper()}({{0}})" for f in ("abs", "sqrt", "exp", "sin", "cos", "tan")},
            **{f: f"{f.upper()}({{0}}, {{1}})" for f in ("min", "max")},
        ),
        power="DTWIN_POWER({0}, {1})",
        table="DTWIN_TABLE_{1}({0})",
        assign="{0} := {1};",
    )
    lines = assignments(graph, style, "tmp{}", update="next_{}".format)
    temporaries = [line.split(" := ")[0] for line in lines if line.startswith("tmp")]
    held = [*temporaries, *(f"next_{s}" for s in graph.updates)]
    lines += _remembered(
        [*inputs, *(f"next_{s}" for s in graph.updates)],
        "DTWIN_FINITE",
        "IF {0} > 0.5 THEN",
        [f"  {s} := next_{s};" for s in graph.updates],
        "END_IF;",
    )
    text = "\n".join(lines)
    helpers = [code for word, code in _ST_HELPERS.items() if word + "(" in text]
    helpers += [_st_table(i, t) for i, t in enumerate(graph.tables)]
    block = [
        f"FUNCTION_BLOCK {identifier(name)}",
        "VAR_INPUT",
        *(f"  {i} : LREAL;" for i in inputs),
        "END_VAR",
        "VAR_OUTPUT",
        *(f"  {o} : LREAL;" for o in graph.outputs),
        "END_VAR",
        "VAR",
        *(f"  {s} : LREAL := {_st_number(v)};" for s, v in states.items()),
        *(f"  {t} : LREAL;" for t in held),
        "END_VAR",
        *lines,
        "END_FUNCTION_BLOCK",
    ]
    return "\n".join([*helpers, *block]) + "\n"


def _remembered(told: Sequence[str], finite: str, condition: str, statements: Sequence[str], end: str) -> list[str]:
    """Return the lines that do something to the states where all numbers of a call are finite, or where not; nothing without states."""
    all_finite = " * ".join(f"{finite}({name})" for name in told)
    return [condition.format(all_finite), *statements, end] if statements else []


def _st_table(number: int, table: Table) -> str:
    n = len(table.values)
    values = ", ".join(_st_number(v) for v in table.values)
    head = [
        f"FUNCTION DTWIN_TABLE_{number} : LREAL",
        "VAR_INPUT x : LREAL; END_VAR",
        f"VAR v : ARRAY[0..{n - 1}] OF LREAL := [{values}]; u : LREAL; low : DINT; END_VAR",
        f"u := (x - {_st_number(table.start)}) / {_st_number(table.spacing)};",
    ]
    between = "v[low] + (u - DINT_TO_LREAL(low)) * (v[{0}] - v[low])"
    if table.periodic:
        # What is no number must not become an index.
        lines = [
            "IF ABS(u) < 1000000000.0 THEN",
            f"  low := TRUNC(u / {n}.0);",
            f"  IF DINT_TO_LREAL(low) * {n}.0 > u THEN low := low - 1; END_IF;",
            f"  u := u - DINT_TO_LREAL(low) * {n}.0;",
            "  low := TRUNC(u);",
            f"  IF low > {n - 1} THEN low := {n - 1}; END_IF;",
            f"  DTWIN_TABLE_{number} := {between.format(f'(low + 1) MOD {n}')};",
            f"ELSE DTWIN_TABLE_{number} := u - u; END_IF;",
        ]
    else:
        lines = [
            f"IF u <= 0.0 THEN DTWIN_TABLE_{number} := v[0];",
            f"ELSIF u >= {n - 1}.0 THEN DTWIN_TABLE_{number} := v[{n - 1}];",
            "ELSIF u > 0.0 THEN",
            "  low := TRUNC(u);",
            f"  DTWIN_TABLE_{number} := {between.format('low + 1')};",
            f"ELSE DTWIN_TABLE_{number} := u; END_IF;",
        ]
    return "\n".join([*head, *lines, "END_FUNCTION", ""])


def _st_number(value: float) -> str:
    plain = repr(float(value))
    if "e" in plain:
        digits, exponent = plain.split("e")
        plain = f"{digits if '.' in digits else digits + '.0'}E{int(exponent)}"
    return f"({plain})" if value < 0 or math.copysign(1.0, value) < 0 else plain


_UR_HELPERS = {
    "dtwin_finite": f"""\
def dtwin_finite(x):
  if x < {_FINITE}:
    if x > -{_FINITE}:
      return 1.0
    end
  end
  return 0.0
end
""",
    "dtwin_sign": """\
def dtwin_sign(x):
  if x > 0:
    return 1.0
  elif x < 0:
    return -1.0
  end
  return 0.0
end
""",
    "dtwin_step": """\
def dtwin_step(x):
  if x >= 0:
    return 1.0
  end
  return 0.0
end
""",
    "dtwin_abs": """\
def dtwin_abs(x):
  if x < 0:
    return -x
  end
  return x
end
""",
    "dtwin_min": """\
def dtwin_min(a, b):
  if a < b:
    return a
  end
  return b
end
""",
    "dtwin_max": """\
def dtwin_max(a, b):
  if a > b:
    return a
  end
  return b
end
""",
    "dtwin_tanh": """\
def dtwin_tanh(x):
  if x < 0:
    local e = pow(2.718281828459045, 2.0 * x)
    return (e - 1.0) / (1.0 + e)
  end
  local f = pow(2.718281828459045, -2.0 * x)
  return (1.0 - f) / (1.0 + f)
end
""",
    "dtwin_power": """\
def dtwin_power(x, n):
  local result = 1.0
  local base = x
  local left = n
  if n < 0:
    left = -n
  end
  while left > 0:
    if left % 2 == 1:
      result = result * base
    end
    base = base * base
    left = floor(left / 2)
  end
  if n < 0:
    return 1.0 / result
  end
  return result
end
""",
}


def to_urscript(graph: Graph, inputs: Sequence[str], states: Sequence[str], name: str = "dtwin_correction") -> str:
    """Return a URScript function with the functions that it needs.

    It takes the inputs and the states, and returns a list: outputs, then next states, as they were
    where an input is no finite number. It keeps nothing itself.

    ``inputs``, ``states``: order of the arguments.
    Raises ``InputError`` when a name of the graph is no identifier of the language.
    """
    _require_words([*inputs, *states, *graph.outputs])
    style = Style(
        number=_ur_number,
        name=lambda node: node.name,
        operations=operations_with(
            logistic="(1.0 / (1.0 + pow(2.718281828459045, (-{0}))))",
            exp="pow(2.718281828459045, {0})",
            log="log(2.718281828459045, {0})",
            **{f: f"dtwin_{f}({{0}})" for f in ("abs", "sign", "step", "tanh")},
            **{f: f"dtwin_{f}({{0}}, {{1}})" for f in ("min", "max")},
        ),
        power="dtwin_power({0}, {1})",
        table="dtwin_table_{1}({0})",
        assign="  local {0} = {1}",
    )
    lines = assignments(graph, style, "tmp{}", "out_{}".format, "next_{}".format)
    lines += _remembered(
        [*inputs, *(f"next_{s}" for s in graph.updates)],
        "dtwin_finite",
        "  if {0} < 0.5:",
        [f"    next_{s} = {s}" for s in states if s in graph.updates],
        "  end",
    )
    text = "\n".join(lines)
    helpers = [code for word, code in _UR_HELPERS.items() if word + "(" in text]
    helpers += [_ur_table(i, t) for i, t in enumerate(graph.tables)]
    results = [f"out_{o}" for o in graph.outputs]
    results += [f"next_{s}" if s in graph.updates else s for s in states]
    function = [
        f"def {identifier(name)}({', '.join([*inputs, *states])}):",
        *lines,
        f"  return [{', '.join(results)}]",
        "end",
    ]
    return "\n".join([*helpers, *function]) + "\n"


def _ur_table(number: int, table: Table) -> str:
    n = len(table.values)
    values = ", ".join(_ur_number(v) for v in table.values)
    head = [
        f"def dtwin_table_{number}(x):",
        f"  local v = [{values}]",
        f"  local u = (x - {_ur_number(table.start)}) / {_ur_number(table.spacing)}",
    ]
    if table.periodic:
        lines = [
            f"  u = u - floor(u / {n}.0) * {n}.0",
            "  local low = floor(u)",
            f"  if low > {n - 1}:",
            f"    low = {n - 1}",
            "  end",
            f"  local high = (low + 1) % {n}",
            "  return v[low] + (u - low) * (v[high] - v[low])",
        ]
    else:
        lines = [
            "  if u <= 0:",
            "    return v[0]",
            f"  elif u >= {n - 1}:",
            f"    return v[{n - 1}]",
            "  end",
            "  local low = floor(u)",
            "  return v[low] + (u - low) * (v[low + 1] - v[low])",
        ]
    return "\n".join([*head, *lines, "end", ""])


def _ur_number(value: float) -> str:
    """Return a number without an exponent, with all its digits."""
    plain = format(Decimal(repr(float(value))), "f")
    plain = plain if "." in plain else plain + ".0"
    return f"({plain})" if plain.startswith("-") else plain


def _require_words(names: Sequence[str]) -> None:
    wrong = [n for n in names if not _WORD.fullmatch(n) or "__" in n or n.startswith("tmp")]
    if wrong:
        raise InputError(
            "a name of the equation is no identifier of the target language",
            code="export.name",
            got=", ".join(wrong)[:120],
            allowed="letters, digits and single underscores, starting with a letter, not tmp...",
        )
