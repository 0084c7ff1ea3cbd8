"""How twins of a kind of campaign are told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from dtwin.report.html import Section


class TwinReport(Protocol):
    """How twins of a kind are told; results are what their ``as_dict`` gives."""

    def twin_text(self, twin: Any, /) -> str:
        """Return a twin for the terminal."""

    def comparison_text(self, result: Mapping[str, Any], /) -> str:
        """Return a comparison for the terminal."""

    def diagnosis_text(self, name: str, result: Mapping[str, Any], /) -> str:
        """Return a diagnosis for the terminal."""

    def diagnosis_section(self, name: str, result: Mapping[str, Any], /) -> Section:
        """Return a diagnosis for a report."""

    def twin_section(self, twin: Any, /) -> Section:
        """Return a twin for a report."""

    def history_section(self, rungs: Sequence[Mapping[str, Any]], /) -> Section:
        """Return the versions of a twin for a report."""

    def comparison_sections(self, found: Any, result: Mapping[str, Any], /) -> list[Section]:
        """Return a comparison for a report."""
