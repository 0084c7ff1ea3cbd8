"""What the environment may set is listed, for people and for the documentation."""

from __future__ import annotations

import re
from pathlib import Path

from dtwin.config import SETTINGS

ROOT = Path(__file__).parents[2]
READ = re.compile(r"environ(?:\.get|\.setdefault)?[(\[]\s*\"([A-Z_]+)\"")


def test_every_variable_that_the_code_reads_is_listed() -> None:
    sources = [p for folder in ("dtwin", "flows", "studies") for p in (ROOT / folder).rglob("*.py")]
    read = {name for path in sources for name in READ.findall(path.read_text(encoding="utf-8"))}
    assert len(read) > 3
    assert read <= set(SETTINGS)
