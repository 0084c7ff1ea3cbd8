"""Twins of an arm as text, and as sections of a report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from dtwin.report.html import Part, Table
from dtwin.report.text import micrometres, words_of
from dtwin.report.twin_of_machine import candidate_table
from dtwin.report.twin_of_terms import TermTwinReport

if TYPE_CHECKING:
    import plotly.graph_objects as go

    from dtwin.kinds.poses._twins import PoseComparison, PoseTwin

_UNIT = "unit of replication: the block of neighbouring poses"


class _PoseReport(TermTwinReport):
    """How twins of an arm are told."""

    without_effects = "no effects yet: frame and tool alone"

    def parameter_table(self, twin: PoseTwin, *, in_words: bool = True) -> Table:
        """Return the parameters; what the poses cannot tell is said so, without a number."""
        rows = [
            (
                words_of(p["effect"]) if in_words else p["effect"],
                p["axis"],
                p["name"],
                "not identifiable" if p["value"] is None else f"{p['value']:z.3f}",
                "" if p["value"] is None else f"± {p['uncertainty']:z.3f}",
                p["unit"],
            )
            for p in twin.as_dict()["parameters"]
        ]
        return Table(("effect", "joint", "parameter", "value", "95 %", "unit"), rows)

    def compared(self, result: Mapping[str, Any]) -> list[str]:
        floor = result["noise_floor_um"]
        return [
            f"twin {result['twin']} version {result['version']} against campaign {result['campaign']} "
            f"({result['runs']} readings)",
            f"mean error {result['mean_before_mm']:z.4f} (frame and tool alone) -> {result['mean_after_mm']:z.4f} mm; "
            + ("no repeats, no floor" if floor is None else f"scatter of repeats {floor:z.0f} µm"),
            f"with frame and tool as they were fitted to the twin's own campaign: {result['mean_same_mounting_mm']:z.4f} mm",
            "largest:",
            *(f"  row {w['row']}, joints {w['joints_deg']} deg: {w['left_mm']:z.3f} mm" for w in result["where"]),
        ]

    def told(self, name: str, result: Mapping[str, Any]) -> list[Part]:
        lines: list[Part] = [
            f"{result['verdict']}: {result['headline']}",
            f"{micrometres(result['held_out_rms_um'])} µm RMS on poses held out ({_UNIT})",
        ]
        lines += candidate_table(result["candidates"])
        if result.get("nested_mean_mm") is not None:
            lines.append(
                "with the effects chosen anew without them, from nothing, quarters of the blocks are left with a mean of "
                f"{result['nested_mean_mm']:z.4f} mm"
            )
        if result.get("idle"):
            lines.append(f"pays nothing beside the others: {', '.join(result['idle'])}")
        if result.get("doubtful"):
            lines.append(
                f"perhaps a part of what no effect explains, for they are small beside it: {', '.join(result['doubtful'])}"
            )
        if result["invisible"]:
            lines.append(f"not identifiable beside frame, tool and what the twin has: {', '.join(result['invisible'])}")
        if result["next_experiment"]:
            lines.append(f"next: {result['next_experiment']['text']}")
        best = next((c for c in result["candidates"] if c["in_group"]), None)
        return [*lines, f"try: dtwin twin add {name} {best['label']}" if best else "nothing to add"]

    def figures(self, comparison: PoseComparison, result: Mapping[str, Any]) -> list[go.Figure]:
        """Draw every reading before and after, and where the poses lie that are left furthest off."""
        # Commands that print no figure do not wait for plotly.
        import numpy as np

        from dtwin.kinds.poses._fit import left_mm
        from dtwin.kinds.poses._sheet import above_figure
        from dtwin.report.plots import error_figure

        grams = comparison.loaded.grams
        sizes = {"without": left_mm(grams, ()), "with the twin": comparison.left_mm}
        rows = comparison.loaded.rows.astype(np.float64)
        curves = {name: (rows, 1000.0 * np.linalg.norm(left, axis=1)) for name, left in sizes.items()}
        title = "Distance from the commanded pose, frame and tool fitted"
        by_reading = error_figure(curves, title=title, x_title="row of the table", y_title="distance, µm")
        return [by_reading, above_figure(grams.series, comparison.left_mm, "What the twin leaves, from above")]

    def fell(self, figures: Mapping[str, float | None]) -> str:
        floor = figures["noise_floor_um"]
        return (
            f"mean error {figures['mean_before_mm']:z.4f} (frame and tool alone) -> {figures['mean_after_mm']:z.4f} mm, "
            f"{figures['held_out_mean_mm']:z.4f} mm on poses held out ({_UNIT}); "
            + ("no repeats: the floor is not known" if floor is None else f"scatter of repeats {floor:z.0f} µm")
        )


REPORT = _PoseReport()
