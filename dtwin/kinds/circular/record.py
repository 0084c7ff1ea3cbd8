"""Circular tests: a ball bar or a robot's path round a circle, after ISO 230-4."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from dtwin.kinds.kind import TWINS_OF_PATHS, FileReader, Kind, Planned

if TYPE_CHECKING:
    from pathlib import Path

    from dtwin.physics.grid import Grid, Row
    from dtwin.physics.observations import Observations
    from dtwin.schema import Run


class _Circular(Kind):
    name = "circular"
    settings = (
        "instrument.nominal_mm",
        "instrument.calibrated_mm",
        "instrument.calibration_um",
        "instrument.height_difference_mm",
        "machine_geometry.centre_mm",
        "machine_geometry.centre_small_mm",
        "machine_geometry.centre_large_mm",
        "machine_geometry.large_radius_from_mm",
        "machine_geometry.joint_branch",
        "machine_geometry.screw_pitch_mm",
    )
    columns = ("t_s", "angle_deg", "deviation_um")
    stated = ("plane", "radius_mm", "feed_mm_min")
    goes_round = True
    campaign_columns = ("angle_deg", "deviation_um")
    sheet_columns = campaign_columns
    measured_by = ("ballbar", "kreisform", "qc10", "qc20", "grid encoder", "kreuzgitter", "kgm")
    figures = ("G(CCW)", "Fmax(CCW)", "Fmin(CCW)", "G(CW)", "Fmax(CW)", "Fmin(CW)", "G(b)", "H", "D")
    laws = True
    always_fitted = "Centre and radius of every set-up are always fitted."
    places: ClassVar[Mapping[str, str]] = {
        **TWINS_OF_PATHS,
        "machines": "_machines:MACHINES",
        "takes_alone": "_circle_table:is_circle_table",
        "titled": "_titles:told_by_table",
        "told_above": "_titles:told_above",
        "plan": "_planned:planned",
        "usual_plan": "_planned:usual_plan",
        "draft": "_planned:draft",
        "programs": "_planned:programs",
        "proposals": "_planned:proposals",
        "completed": "_check:with_whole_angle",
        "judge_run": "_check:judge_circular_run",
        "judge_campaign": "_check:judge_circular_campaign",
        "sheet": "_sheet:circular_sheet",
        "sheet_figure": "_sheet:both_ways_figure",
        "drawings": "_drawings:DRAWINGS",
        "run_errors": "_drift:circle_errors",
        "training": "_training:train_campaign",
        "gates": "dtwin.train.gates:offline_gates",
        "twin_correction": "_correction:WAY",
        "champion_error": "_drift:circles_error",
        "held_out": "_drift:circles_held_out",
    }

    def reader_of(self, path: Path) -> FileReader | None:
        from dtwin.kinds.circular._circle_table import is_circle_table, read_circle_runs

        return read_circle_runs if is_circle_table(path) else None

    def foreseen(self, planned: Planned) -> Observations:
        from dtwin.physics.experiment import planned_observations

        return planned_observations(planned.plan)

    def run_figures(self, run: Run) -> Mapping[str, Any]:
        from dtwin.kinds.circular._report import circular_result

        lost = any(f.severity == "error" and f.code in ("angle.jump", "angle.short") for f in run.findings)
        return circular_result(run) if run.meta.radius_mm and not lost else {}

    def rows(self, runs: Sequence[Run], times_h: Sequence[float]) -> tuple[Grid, list[Row]]:
        from dtwin.physics.gridding import CIRCLE, rows_of

        pairs = zip(runs, times_h, strict=True)
        return CIRCLE, [row for run, time_h in pairs for row in rows_of(run, time_h)]

    def training_obstacle(self, rows: Sequence[Mapping[str, Any]]) -> str:
        if not all(map(_has_controller, rows)):
            return "no controller signals, so it cannot train a correction"
        feeds = {row["feed_mm_min"] for row in rows}
        return "" if len(feeds) > 1 else "one feed only, so a model could not be judged"

    def drift_obstacle(self, rows: Sequence[Mapping[str, Any]]) -> str:
        return "" if all(map(_has_controller, rows)) else "no controller signals, so it cannot judge a champion"


def _has_controller(row: Mapping[str, Any]) -> bool:
    return any(group["group"] == "controller" for group in json.loads(row["signals_json"]))


KIND = _Circular()
