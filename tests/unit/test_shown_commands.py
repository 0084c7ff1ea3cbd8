from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "system"))
from shown_commands import alike


@pytest.mark.parametrize(
    ("shown", "line", "same"),
    [
        ("error 1.92 -> 1.21 µm", "error 1.92 -> 1.22 µm", True),
        ("error 1.92 -> 1.21 µm", "error 1.92 -> 1.24 µm", False),
        ("36 runs added", "35 runs added", False),
        ("harmonic 2 (70 %)", "harmonic 2 (71 %)", True),
        ("harmonic 2 (70 %)", "harmonic 3 (70 %)", False),
        ("p 4.2e-20", "p 4.3e-20", True),
        ("p 4.2e-20", "p 4.2e-19", False),
        ("x  0.0 %", "x +0.0 %", True),
        ("backlash X", "backlash Y", False),
    ],
)
def test_numbers_are_compared_to_the_precision_that_is_shown(shown: str, line: str, same: bool) -> None:
    assert alike(shown, line) is same


def test_a_line_that_is_left_open_may_go_on() -> None:
    assert alike("floor 0.51", "floor 0.51 µm and more", begun=True)
    assert not alike("floor 0.51", "floor 0.51 µm and more")
