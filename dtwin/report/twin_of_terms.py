"""Twins that are a list of terms, as text and as sections of a report: what does not depend on their kind."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from dtwin.report.html import Part, Section, Table, parts_text
from dtwin.report.text import table
from dtwin.report.twin_of_machine import history_section, missing_section

if TYPE_CHECKING:
    import plotly.graph_objects as go


class TermTwinReport(ABC):
    """How twins of a kind are told; the kind says what it tells. ``without_effects``: what is said of a twin that has none."""

    without_effects: ClassVar[str]

    @abstractmethod
    def parameter_table(self, twin: Any, *, in_words: bool = True) -> Table:
        """Return the parameters; names of effects ``in_words`` for people, or as commands take them."""

    @abstractmethod
    def fell(self, figures: Mapping[str, Any]) -> str:
        """Return a line that says how far the error fell."""

    @abstractmethod
    def compared(self, result: Mapping[str, Any]) -> list[str]:
        """Return what a comparison tells, line by line."""

    @abstractmethod
    def told(self, name: str, result: Mapping[str, Any]) -> list[Part]:
        """Return what a diagnosis tells, line by line."""

    @abstractmethod
    def figures(self, comparison: Any, result: Mapping[str, Any]) -> list[go.Figure]:
        """Draw a comparison."""

    def of(self, twin: Any) -> str:
        """Return what a twin was fitted to."""
        return f"campaign {twin.campaign}"

    def twin_text(self, twin: Any) -> str:
        """Return a twin for the terminal."""
        shown = self.parameter_table(twin, in_words=False)
        head = f"twin {twin.name} version {twin.version} ({twin.action}) of machine {twin.machine}, {self.of(twin)}"
        rows = table(shown.head, shown.rows) if shown.rows else self.without_effects
        return "\n".join([head, self.fell(twin.figures), rows])

    def comparison_text(self, result: Mapping[str, Any]) -> str:
        """Return a comparison for the terminal."""
        return "\n".join(self.compared(result))

    def diagnosis_text(self, name: str, result: Mapping[str, Any]) -> str:
        """Return a diagnosis for the terminal."""
        return parts_text(self.told(name, result))

    def diagnosis_section(self, name: str, result: Mapping[str, Any]) -> Section:
        """Return a diagnosis for a report."""
        return missing_section(result, self.told(name, result))

    def twin_section(self, twin: Any) -> Section:
        """Return a twin for a report."""
        return Section("The twin", [self.fell(twin.figures)], tables=[self.parameter_table(twin)])

    def comparison_sections(self, comparison: Any, result: Mapping[str, Any]) -> list[Section]:
        """Return a comparison for a report; without ``comparison`` as text."""
        drawn = [] if comparison is None else self.figures(comparison, result)
        return [Section("Measured against predicted", [line.strip() for line in self.compared(result)], figures=drawn)]

    def history_section(self, rungs: Sequence[Mapping[str, Any]]) -> Section:
        """Return the versions of a twin for a report."""
        return history_section(rungs)
