"""What commands print of a twin, whatever its kind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dtwin.physics.twin import Twin
from dtwin.physics.volumetric.heat_twin import KIND, HeatTwin
from dtwin.report import heat_twins, twins
from dtwin.report.html import Section


def twin_text(twin: Twin | HeatTwin) -> str:
    """Return a twin for the terminal."""
    return heat_twins.heat_twin_text(twin) if isinstance(twin, HeatTwin) else twins.twin_text(twin)


def comparison_text(result: Mapping[str, Any]) -> str:
    """Return a comparison, as its ``as_dict`` gives it, for the terminal."""
    return (heat_twins.heat_comparison_text if _heat(result) else twins.comparison_text)(result)


def diagnosis_text(name: str, result: Mapping[str, Any]) -> str:
    """Return a diagnosis, as its ``as_dict`` gives it, for the terminal."""
    return (heat_twins.heat_diagnosis_text if _heat(result) else twins.diagnosis_text)(name, result)


def diagnosis_section(name: str, result: Mapping[str, Any]) -> Section:
    """Return a diagnosis, as its ``as_dict`` gives it, for a report."""
    made = heat_twins.heat_diagnosis_section if _heat(result) else twins.diagnosis_section
    return made(name, result)


def twin_section(twin: Twin | HeatTwin) -> Section:
    """Return a twin for a report."""
    if isinstance(twin, HeatTwin):
        return heat_twins.heat_twin_section(twin)
    return twins.twin_section(twin)


def history_section(twin: Twin | HeatTwin, rungs: Sequence[Mapping[str, Any]]) -> Section:
    """Return the rungs of a twin for a report."""
    if isinstance(twin, HeatTwin):
        return heat_twins.heat_history_section(rungs)
    return twins.history_section(rungs)


def comparison_sections(found: Any, result: Mapping[str, Any]) -> list[Section]:
    """Return a comparison, and what its ``as_dict`` gives, for a report."""
    if _heat(result):
        return heat_twins.heat_comparison_sections(result)
    return twins.comparison_sections(found.obs, found.before_um, found.residual_um, result)


def _heat(result: Mapping[str, Any]) -> bool:
    return result.get("kind") == KIND
