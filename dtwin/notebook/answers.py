"""What the verbs of a notebook return: readable as text, as frames, and as figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import TYPE_CHECKING, Any

import pandas as pd

from dtwin.errors import InputError
from dtwin.report.twin_of_kind import report_of

if TYPE_CHECKING:
    import plotly.graph_objects as go

    from dtwin.twins.shelf import TwinShelf


@dataclass(frozen=True, repr=False, eq=False)
class Result:
    """What a verb found; shown as text, it is what the command prints.

    Attributes:
        document: The result as plain records, JSON-ready: what ``--json`` prints of it.
    """

    document: Mapping[str, Any]
    text: str
    _draw: Callable[[], Sequence[go.Figure]]

    def __repr__(self) -> str:
        return self.text

    def plot(self, number: int = 0) -> go.Figure:
        """Return a figure of the report about this result, by its number from 0.

        Raises:
            InputError: When there are not so many.
        """
        drawn = self._draw()
        wanted: object = number
        if not isinstance(wanted, Integral) or not 0 <= int(wanted) < len(drawn):
            raise InputError(
                "there is no such figure of the result",
                code="notebook.figure",
                got=repr(number)[:60],
                allowed=f"0 to {len(drawn) - 1}" if drawn else "this result has no figure",
            )
        return drawn[number]

    def _frame(self, name: str, *columns: str) -> pd.DataFrame:
        """Return rows of the document, with ``columns`` even without any; columns that hold records are left out."""
        rows = list(self.document.get(name, ()))
        frame = pd.DataFrame(rows, columns=None if rows else list(columns))
        return frame[[column for column in frame if not frame[column].map(_holds_records).any()]]


class TwinResult(Result):
    """A version of a twin; ``plot()`` shows how the error fell up to it."""

    @property
    def name(self) -> str:
        """Of the twin."""
        return str(self.document["twin"])

    @property
    def version(self) -> int:
        """From 1."""
        return int(self.document["version"])

    @property
    def rms_before_um(self) -> float:
        """Measured error, set-ups taken out."""
        return float(self.document["figures"]["rms_before_um"])

    @property
    def rms_after_um(self) -> float:
        """What the twin leaves of it."""
        return float(self.document["figures"]["rms_after_um"])

    @property
    def noise_floor_um(self) -> float:
        """What repeats of one condition disagree by; NaN without repeats."""
        return _number(self.document["figures"]["noise_floor_um"])

    @property
    def parameters(self) -> pd.DataFrame:
        """One row for each: effect, axis, name, value, uncertainty (k = 2), unit."""
        return self._frame("parameters", "effect", "axis", "name", "value", "uncertainty", "unit")


class ComparisonResult(Result):
    """A twin against measurements; ``plot()`` shows where it fails, ``plot(1)`` the worst condition."""

    @property
    def residual_rms_um(self) -> float:
        """What the twin leaves."""
        return float(self.document["residual_rms_um"])

    @property
    def noise_floor_um(self) -> float:
        """What repeats of one condition disagree by; NaN without repeats."""
        return _number(self.document["noise_floor_um"])

    @property
    def conditions(self) -> pd.DataFrame:
        """RMS of every condition before and after; no row where the kind has no conditions, as for drift and poses."""
        return self._frame("conditions", "rms_before_um", "rms_after_um")

    @property
    def where(self) -> pd.DataFrame:
        """Where the residual is largest."""
        return self._frame("where", "residual_rms_um")


class DiagnosisResult(Result):
    """What a twin lacks; ``plot()`` shows the candidates, ranked."""

    @property
    def verdict(self) -> str:
        """One word, such as ``missing_effect`` or ``nothing_missing``."""
        return str(self.document["verdict"])

    @property
    def headline(self) -> str:
        """The same in words."""
        return str(self.document["headline"])

    @property
    def candidates(self) -> pd.DataFrame:
        """Effects that were considered, best first; ``in_group`` marks those that are reported."""
        return self._frame("candidates", "effect", "axis", "rms_after_um", "cv_gain", "p_value", "grade", "in_group")


@dataclass(frozen=True, repr=False, eq=False)
class IngestResult:
    """What came into the lake.

    Attributes:
        added, unchanged: Run ids.
        rejected_rows: Rows without a usable number.
        findings: What is noteworthy: ``run_id`` (empty for the whole campaign), ``severity``, ``code``, ``message``.
    """

    campaign: str
    added: tuple[str, ...]
    unchanged: tuple[str, ...]
    rejected_rows: int
    findings: pd.DataFrame

    def __repr__(self) -> str:
        return (
            f"{self.campaign}: {len(self.added)} runs added, {len(self.unchanged)} unchanged, "
            f"{self.rejected_rows} rows rejected, {len(self.findings)} findings"
        )


def of_twin(twins: TwinShelf, twin: Any) -> TwinResult:
    """Return a version of a twin as a result."""

    def draw() -> Sequence[go.Figure]:
        rungs = [rung for rung in twins.history(twin.name) if rung["version"] <= twin.version]
        return _figures([report_of(twin.as_dict()).history_section(rungs)])

    return TwinResult(twin.as_dict(), report_of(twin.as_dict()).twin_text(twin), draw)


def of_comparison(comparison: Any) -> ComparisonResult:
    """Return a comparison as a result."""
    document = comparison.as_dict()
    report = report_of(document)
    return ComparisonResult(
        document, report.comparison_text(document), lambda: _figures(report.comparison_sections(comparison, document))
    )


def of_diagnosis(twin: Any, diagnosis: Any) -> DiagnosisResult:
    """Return a diagnosis of a version of a twin as a result."""
    name: str = twin.name
    document = {"twin": name, "version": twin.version, "campaign": twin.campaign, **diagnosis.as_dict()}
    report = report_of(document)
    return DiagnosisResult(
        document, report.diagnosis_text(name, document), lambda: _figures([report.diagnosis_section(name, document)])
    )


def _figures(sections: Sequence[Any]) -> Sequence[go.Figure]:
    return [figure for section in sections for figure in section.figures]


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _holds_records(value: object) -> bool:
    parts = value if isinstance(value, list | tuple) else [value]
    return any(isinstance(part, Mapping) for part in parts)
