"""What commands print of a twin, whatever its kind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from dtwin.kinds.registry import kind_named
from dtwin.report.html import Section
from dtwin.schema import DEFAULT_KIND

if TYPE_CHECKING:
    from dtwin.kinds.kind import TwinReport
    from dtwin.kinds.volumetric import HeatTwin
    from dtwin.physics.twin import Twin


def twin_text(twin: Twin | HeatTwin) -> str:
    """Return a twin for the terminal."""
    return _of(twin.as_dict()).twin_text(twin)


def comparison_text(result: Mapping[str, Any]) -> str:
    """Return a comparison, as its ``as_dict`` gives it, for the terminal."""
    return _of(result).comparison_text(result)


def diagnosis_text(name: str, result: Mapping[str, Any]) -> str:
    """Return a diagnosis, as its ``as_dict`` gives it, for the terminal."""
    return _of(result).diagnosis_text(name, result)


def diagnosis_section(name: str, result: Mapping[str, Any]) -> Section:
    """Return a diagnosis, as its ``as_dict`` gives it, for a report."""
    return _of(result).diagnosis_section(name, result)


def twin_section(twin: Twin | HeatTwin) -> Section:
    """Return a twin for a report."""
    return _of(twin.as_dict()).twin_section(twin)


def history_section(twin: Twin | HeatTwin, rungs: Sequence[Mapping[str, Any]]) -> Section:
    """Return the rungs of a twin for a report."""
    return _of(twin.as_dict()).history_section(rungs)


def comparison_sections(found: Any, result: Mapping[str, Any]) -> list[Section]:
    """Return a comparison, and what its ``as_dict`` gives, for a report."""
    return _of(result).comparison_sections(found, result)


def _of(document: Mapping[str, Any]) -> TwinReport:
    if "campaigns" in document:
        from dtwin.report import several

        return several
    # A twin of tests of a path names no kind.
    return kind_named(document.get("kind", DEFAULT_KIND)).twin_report
