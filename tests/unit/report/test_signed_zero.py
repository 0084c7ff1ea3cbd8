"""No figure prints a signed zero: which sign a nothing has depends on the processor."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import dtwin
import flows
import studies
from dtwin.report.text import micrometres, table

_FIXED = re.compile(r":[<>^]?[+]?([z]?)[0-9,]*\.([0-9]+|\{[a-z_]+\})f\}")


@pytest.mark.parametrize("package", [dtwin, flows, studies])
def test_every_format_with_fixed_digits_drops_the_sign_of_zero(package: object) -> None:
    root = Path(str(package.__file__)).parent  # type: ignore[attr-defined]
    files = sorted(root.rglob("*.py"))
    formats = [(path, match) for path in files for match in _FIXED.finditer(path.read_text("utf-8"))]
    assert len(formats) > 5
    assert [f"{path}: {match[0]}" for path, match in formats if not match[1]] == []


def test_a_nothing_from_below_is_a_nothing() -> None:
    assert f"{-0.04:+z.1f} %" == "+0.0 %"
    assert micrometres(-0.0) == "0.00"
    assert "-" not in table(("x",), [[-0.0]]).splitlines()[-1]
