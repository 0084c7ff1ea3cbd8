"""Twins of drift as text, and as sections of a report."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from dtwin.report.html import Part, Table
from dtwin.report.text import decimals, micrometres, words_of
from dtwin.report.twin_of_machine import candidate_table
from dtwin.report.twin_of_terms import TermTwinReport
from dtwin.units import shown_number

if TYPE_CHECKING:
    import plotly.graph_objects as go

    from dtwin.kinds.drift._twins import DriftComparison, DriftTwin

_UNITS = {"um/K": "µm/K", "um/K^2": "µm/K²"}


def _minutes(late_s: float | None, half_s: float | None) -> str:
    if not late_s:
        return ""
    if not half_s:
        return f"{shown_number(late_s / 60.0)} min"
    digits = decimals(half_s / 60.0)
    return f"{late_s / 60.0:z.{digits}f} ± {half_s / 60.0:z.{digits}f} min"


class _DriftReport(TermTwinReport):
    """How twins of drift are told."""

    without_effects = "no effects yet: the mean alone"

    def parameter_table(self, twin: DriftTwin, *, in_words: bool = True) -> Table:
        document = twin.as_dict()
        rows = []
        for effect, parameter in zip(document["effects"], document["parameters"], strict=True):
            late, half = effect["time_constant_s"], parameter["uncertainty"] or 0.0
            digits = decimals(half) if half else 3
            rows.append(
                (
                    words_of(effect["effect"]) if in_words else effect["effect"],
                    effect["axis"],
                    _minutes(late, effect.get("time_constant_uncertainty_s")),
                    f"{parameter['value']:z.{digits}f} ± {half:z.{digits}f}",
                    _UNITS[parameter["unit"]],
                )
            )
        return Table(("effect", "sensor", "time constant", "value, ± 95 %", "unit"), rows)

    def of(self, twin: DriftTwin) -> str:
        return f"{super().of(twin)}, log {twin.as_dict()['data']['fitted_to']}"

    def compared(self, result: Mapping[str, Any]) -> list[str]:
        floor = result["noise_floor_um"]
        return [
            f"twin {result['twin']} version {result['version']} against log {result['log']} of campaign "
            f"{result['campaign']} ({result['runs']} readings)",
            f"{micrometres(result['rms_before_um'])} -> {micrometres(result['residual_rms_um'])} µm RMS about the mean; "
            + ("no repeats, no floor" if floor is None else f"noise of a reading {micrometres(floor)} µm"),
            "worst:",
            *(
                f"  {w['from_h']:z.2f} to {w['to_h']:z.2f} h: {micrometres(w['residual_rms_um'])} µm"
                for w in result["where"]
            ),
        ]

    def told(self, name: str, result: Mapping[str, Any]) -> list[Part]:
        lines: list[Part] = [
            f"{result['verdict']}: {result['headline']}",
            f"{micrometres(result['held_out_rms_um'])} µm RMS on times held out (unit of replication: the stretch of time)",
        ]
        lines += candidate_table([c for c in result["candidates"] if c["cv_gain"] > 0.0])
        if result["idle"]:
            lines.append(f"pays nothing beside the others: {', '.join(result['idle'])}")
        if result["next_experiment"]:
            lines.append(f"next: {result['next_experiment']['text']}")
        best = next((c for c in result["candidates"] if c["in_group"]), None)
        if best is None:
            return [*lines, "nothing to add"]
        return [*lines, f"remedy: {best['remedy']}", f"try: dtwin twin add {name} {best['label']}"]

    def figures(self, comparison: DriftComparison, result: Mapping[str, Any]) -> list[go.Figure]:
        """Draw the log and the twin over the time, and what is left."""
        # Commands that print no figure do not wait for plotly.
        from dtwin.report.plots import error_figure

        series, hours = comparison.loaded.series, comparison.loaded.series.t_s / 3600.0
        curves = {"measured": (hours, series.moved_um), "twin": (hours, series.moved_um - comparison.left_um)}
        over_time = partial(error_figure, x_title="time, h", y_title="displacement, µm")
        return [
            over_time(curves, title="Measured and twin"),
            over_time({"left": (hours, comparison.left_um)}, title="What the twin leaves"),
        ]

    def fell(self, figures: Mapping[str, float | None]) -> str:
        before, after, held = (float(figures[n] or 0.0) for n in ("rms_before_um", "rms_after_um", "held_out_rms_um"))
        floor = figures["noise_floor_um"]
        return (
            f"{micrometres(before)} -> {micrometres(after)} µm RMS about the mean, {micrometres(held)} µm on times held out "
            "(unit of replication: the stretch of time); "
            + ("no repeats: the floor is not known" if floor is None else f"noise of a reading {micrometres(floor)} µm")
        )


REPORT = _DriftReport()
