"""A small evaluator of the structured text and the URScript that dtwin emits, and nothing more."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

_TOKEN = re.compile(
    r"\s*(?:(?P<number>\d+\.\d+(?:[eE][+-]?\d+)?|\d+(?:[eE][+-]?\d+)?)|(?P<word>[A-Za-z_]\w*)"
    r"|(?P<sign>:=|>=|<=|==|!=|<>|\.\.|[-+*/%()\[\],;:<>=]))"
)


class Reader:
    """Tokens of one text, and its expressions."""

    def __init__(self, text: str) -> None:
        self.tokens: list[tuple[str, str]] = []
        at = 0
        text = text.rstrip()
        while at < len(text):
            found = _TOKEN.match(text, at)
            assert found is not None, f"not in the grammar: {text[at : at + 40]!r}"
            kind = str(found.lastgroup)
            self.tokens.append((kind, found.group(kind)))
            at = found.end()
        self.at = 0

    def peek(self) -> str:
        return self.tokens[self.at][1] if self.at < len(self.tokens) else ""

    def take(self, wanted: str | None = None) -> str:
        word = self.peek()
        assert wanted is None or word == wanted, f"{word!r} instead of {wanted!r}"
        self.at += 1
        return word

    def expression(self, level: int = 0) -> Any:
        levels = [(">", "<", ">=", "<=", "==", "!=", "=", "<>"), ("+", "-"), ("*", "/", "%", "MOD")]
        if level == len(levels):
            return self.factor()
        left = self.expression(level + 1)
        while self.peek() in levels[level]:
            op = self.take()
            left = (op, left, self.expression(level + 1))
        return left

    def factor(self) -> Any:
        if self.peek() == "-":
            self.take()
            return ("neg", self.factor())
        if self.peek() == "(":
            self.take()
            inner = self.expression()
            self.take(")")
            return inner
        if self.peek() == "[":
            return ("list", self.listed("[", "]"))
        kind, word = self.tokens[self.at]
        self.at += 1
        if kind == "number":
            return ("number", float(word) if set(word) & set(".eE") else int(word))
        assert kind == "word", word
        if self.peek() == "(":
            return ("call", word, self.listed("(", ")"))
        if self.peek() == "[":
            self.take()
            index = self.expression()
            self.take("]")
            return ("index", word, index)
        return ("name", word)

    def listed(self, first: str, last: str) -> list[Any]:
        self.take(first)
        out = []
        while self.peek() != last:
            out.append(self.expression())
            if self.peek() == ",":
                self.take()
        self.take(last)
        return out


_SIGNS: dict[str, Callable[[Any, Any], Any]] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "%": lambda a, b: a % b,
    "MOD": lambda a, b: a % b,
    ">": lambda a, b: a > b,
    "<": lambda a, b: a < b,
    ">=": lambda a, b: a >= b,
    "<=": lambda a, b: a <= b,
    "==": lambda a, b: a == b,
    "=": lambda a, b: a == b,
    "!=": lambda a, b: a != b,
}


class Program:
    """Functions of a text, callable with numbers."""

    def __init__(self, built_in: dict[str, Callable[..., Any]], *, whole_division: bool) -> None:
        self.functions: dict[str, Callable[..., Any]] = dict(built_in)
        self.whole_division = whole_division

    def value(self, tree: Any, names: dict[str, Any]) -> Any:
        kind = tree[0]
        if kind == "number":
            return tree[1]
        if kind == "name":
            return names[tree[1]]
        if kind == "neg":
            return -self.value(tree[1], names)
        if kind == "list":
            return [self.value(item, names) for item in tree[1]]
        if kind == "call":
            return self.functions[tree[1]](*(self.value(item, names) for item in tree[2]))
        if kind == "index":
            index = self.value(tree[2], names)
            assert isinstance(index, int), "an index that is no whole number"
            assert index >= 0
            return names[tree[1]][index]
        left, right = self.value(tree[1], names), self.value(tree[2], names)
        if kind == "/":
            whole = self.whole_division and isinstance(left, int) and isinstance(right, int)
            return left // right if whole else left / right
        return _SIGNS[kind](left, right)


# Structured text -----------------------------------------------------------------------------


class StructuredText(Program):
    """Functions and one function block."""

    def __init__(self, text: str) -> None:
        plain = {
            "ABS": abs,
            "SQRT": math.sqrt,
            "EXP": math.exp,
            "LN": math.log,
            "SIN": math.sin,
            "COS": math.cos,
            "TAN": math.tan,
            "ATAN": math.atan,
            "MIN": min,
            "MAX": max,
            "TRUNC": math.trunc,
            "DINT_TO_LREAL": float,
        }
        super().__init__(plain, whole_division=True)
        text = re.sub(r"\(\*.*?\*\)", " ", text, flags=re.S)
        reader = Reader(text)
        self.memory: dict[str, Any] = {}
        while reader.peek():
            self._unit(reader)

    def _unit(self, reader: Reader) -> None:
        kind, name = reader.take(), reader.take()
        assert kind in ("FUNCTION", "FUNCTION_BLOCK")
        if kind == "FUNCTION":
            reader.take(":")
            reader.take("LREAL")
        inputs, outputs, start = [], [], {}
        while reader.peek() in ("VAR_INPUT", "VAR_OUTPUT", "VAR"):
            section = reader.take()
            while reader.peek() != "END_VAR":
                word, value = self._declared(reader)
                start[word] = value
                {"VAR_INPUT": inputs, "VAR_OUTPUT": outputs, "VAR": []}[section].append(word)
            reader.take()
        body = self._statements(reader, f"END_{kind}")
        reader.take()
        if kind == "FUNCTION":

            def call(*values: Any) -> Any:
                names = start | dict(zip(inputs, values, strict=True))
                self._run(body, names)
                return names[name]

            self.functions[name] = call
        else:
            self.inputs, self.outputs, self.memory, self.body = inputs, outputs, start, body

    def _declared(self, reader: Reader) -> tuple[str, Any]:
        word = reader.take()
        reader.take(":")
        value: Any = 0
        kind = reader.take()
        if kind == "ARRAY":
            reader.take("[")
            low = reader.take()
            reader.take("..")
            high = reader.take()
            reader.take("]")
            reader.take("OF")
            reader.take("LREAL")
        else:
            assert kind in ("LREAL", "DINT")
        if reader.peek() == ":=":
            reader.take()
            value = self.value(reader.expression(), {})
        if kind == "ARRAY":
            assert (int(low), int(high)) == (0, len(value) - 1), "bounds of the array"
        reader.take(";")
        return word, value

    def _statements(self, reader: Reader, *ends: str) -> list[Any]:
        out: list[Any] = []
        while reader.peek() not in ends:
            word = reader.take()
            if word == "IF":
                branches = []
                while True:
                    condition = reader.expression()
                    reader.take("THEN")
                    branches.append((condition, self._statements(reader, "ELSIF", "ELSE", "END_IF")))
                    if reader.peek() != "ELSIF":
                        break
                    reader.take()
                other: list[Any] = []
                if reader.peek() == "ELSE":
                    reader.take()
                    other = self._statements(reader, "END_IF")
                reader.take("END_IF")
                out.append(("if", branches, other))
            elif word == "WHILE":
                condition = reader.expression()
                reader.take("DO")
                out.append(("while", condition, self._statements(reader, "END_WHILE")))
                reader.take()
            else:
                reader.take(":=")
                out.append(("set", word, reader.expression()))
            reader.take(";")
        return out

    def _run(self, statements: list[Any], names: dict[str, Any]) -> None:
        for kind, *parts in statements:
            if kind == "set":
                names[parts[0]] = self.value(parts[1], names)
            elif kind == "while":
                while self.value(parts[0], names):
                    self._run(parts[1], names)
            else:
                for condition, branch in parts[0]:
                    if self.value(condition, names):
                        self._run(branch, names)
                        break
                else:
                    self._run(parts[1], names)

    def tick(self, inputs: dict[str, float]) -> dict[str, float]:
        """Call the block once; it remembers its states."""
        assert set(inputs) == set(self.inputs)
        declared = set(self.memory)
        self.memory |= inputs
        self._run(self.body, self.memory)
        assert set(self.memory) == declared, "a variable that is not declared"
        return {name: self.memory[name] for name in self.outputs}


# URScript ------------------------------------------------------------------------------------


class _Return(Exception):
    def __init__(self, value: Any) -> None:
        self.value = value


class URScript(Program):
    """Functions of a script, by lines and indentation-free blocks that end with ``end``."""

    def __init__(self, text: str) -> None:
        plain = {
            "sqrt": math.sqrt,
            "pow": math.pow,
            "sin": math.sin,
            "cos": math.cos,
            "tan": math.tan,
            "atan2": math.atan2,
            "floor": lambda x: math.floor(x),
            "log": lambda base, x: math.log(x) / math.log(base),
        }
        super().__init__(plain, whole_division=False)
        lines = [line.strip() for line in text.splitlines()]
        self.lines = [line for line in lines if line and not line.startswith("#")]
        at = 0
        while at < len(self.lines):
            head = re.fullmatch(r"def (\w+)\(([^)]*)\):", self.lines[at])
            assert head is not None, self.lines[at]
            body, at = self._block(at + 1)
            assert self.lines[at] == "end"
            at += 1
            self.functions[head[1]] = self._function(head[2], body)

    def _function(self, arguments: str, body: list[Any]) -> Callable[..., Any]:
        inputs = [a.strip() for a in arguments.split(",") if a.strip()]

        def call(*values: Any) -> Any:
            try:
                self._run(body, dict(zip(inputs, values, strict=True)))
            except _Return as result:
                return result.value
            raise AssertionError("no return")

        return call

    def _block(self, at: int) -> tuple[list[Any], int]:
        out: list[Any] = []
        while self.lines[at] != "end" and not re.match(r"(elif |else:)", self.lines[at]):
            line = self.lines[at]
            if line.startswith(("if ", "while ")):
                kind, condition = line[:-1].split(" ", 1)
                body, at = self._block(at + 1)
                branches, other = [(Reader(condition).expression(), body)], []
                while self.lines[at].startswith("elif "):
                    condition = self.lines[at][5:-1]
                    body, at = self._block(at + 1)
                    branches.append((Reader(condition).expression(), body))
                if self.lines[at] == "else:":
                    other, at = self._block(at + 1)
                assert self.lines[at] == "end"
                out.append((kind, branches, other))
            elif line.startswith("return "):
                out.append(("return", Reader(line[7:]).expression(), None))
            else:
                name, value = line.removeprefix("local ").split(" = ", 1)
                out.append(("new" if line.startswith("local ") else "set", name, Reader(value).expression()))
            at += 1
        return out, at

    def _run(self, statements: list[Any], names: dict[str, Any]) -> None:
        for kind, first, second in statements:
            if kind == "return":
                raise _Return(self.value(first, names))
            if kind in ("new", "set"):
                assert kind == "new" or first in names, f"{first} is not declared"
                names[first] = self.value(second, names)
            elif kind == "while":
                while self.value(first[0][0], names):
                    self._run(first[0][1], names)
            else:
                for condition, branch in first:
                    if self.value(condition, names):
                        self._run(branch, names)
                        break
                else:
                    self._run(second, names)
