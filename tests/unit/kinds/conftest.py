"""What every test of a kind holds dtwin to."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from dtwin.report.certificate import _german_of
from dtwin.schema import Finding

_OF_CERTIFICATES = [
    "angle",
    "circle_table",
    "circular",
    "drift",
    "laser",
    "linear",
    "poses",
    "radius",
    "reading",
    "rotary",
    "rotation",
    "rtl",
    "run",
    "vendor",
]


@pytest.fixture(autouse=True)
def _german(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What dtwin finds in a test of a kind that has a certificate can be said in German."""
    told: set[str] = set()
    made = Finding.__init__

    def tell(self: Finding, *args: Any, **named: Any) -> None:
        made(self, *args, **named)
        if self.severity != "info" and self.code.partition(".")[0] in _OF_CERTIFICATES:
            told.add(self.message)

    monkeypatch.setattr(Finding, "__init__", tell)
    yield
    assert [message for message in told if _german_of(message, str) is None] == []
