from __future__ import annotations

from dtwin.processes import is_gone, process


def test_a_process_is_told_from_a_later_one_with_its_number() -> None:
    mine = process()
    assert not is_gone(mine)
    host, number, start = mine.split()
    assert is_gone(f"{host} {number} {int(start) - 1}")
    assert is_gone(f"{host} 4194305 17")
    assert not is_gone(f"elsewhere {number} 1")
    assert not is_gone("")
