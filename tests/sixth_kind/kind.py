"""The record of rotary tables: every verb that physics allows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from dtwin.kinds.kind import Drawing, Kind, Planned
from dtwin.schema import Finding, Run
from sixth_kind.machine import REPEATS, RIM_MM, SPEEDS_DEG_S, Table

if TYPE_CHECKING:
    from dtwin.config import Home
    from dtwin.kinds.machine import VirtualMachine
    from dtwin.physics.effect import Effect
    from dtwin.physics.grid import Grid, Row
    from dtwin.progress import Progress
    from dtwin.report.twin_of_kind import TwinReport
    from dtwin.serve.bundle import Bundle
    from dtwin.train.champion_error import RunError
    from dtwin.train.gates import Verdict
    from dtwin.train.results import Training
    from dtwin.twins.verbs import Twins


class Turntable(Kind):
    name = "turntable"
    columns = ("t_s", "angle_deg", "error_um")
    campaign_columns = columns
    always_fitted = "The zero of every set-up is always fitted."
    instead: ClassVar[Mapping[str, str]] = {"programs": "the table turns by hand"}

    @property
    def machines(self) -> Sequence[VirtualMachine]:
        return (Table(),)

    def plan(self, document: Mapping[str, Any], where: str) -> Planned:
        repeats = int(document["plan"].get("repeats", REPEATS))
        few = [Finding("turntable.few", "warning", "one turn has no noise floor")] if repeats < 2 else []
        seconds = repeats * sum(360.0 / speed for speed in SPEEDS_DEG_S)
        return Planned("turntable", repeats, {"name": "table"}, seconds, few, (f"{repeats} turns",))

    def judge_run(self, run: Run) -> list[Finding]:
        if len(run.samples["angle_deg"]) >= 36:
            return []
        return [Finding("turntable.short", "error", "fewer than 36 places of the turn")]

    def campaign_figures(self, runs: Sequence[Run], progress: Progress | None = None) -> Mapping[str, Any]:
        spans = {run.meta.run_id: float(np.ptp(run.samples["error_um"])) for run in runs}
        return {"span_um": spans}

    def figure_lines(self, result: Mapping[str, Any]) -> list[str]:
        return [f"{run} spans {value:.1f} µm" for run, value in result["span_um"].items()]

    @property
    def drawings(self) -> Sequence[Drawing]:
        from dtwin.report.plots import error_figure

        def turn(run: Run, floor_um: object) -> Any:
            curve = {run.meta.run_id: (run.samples["angle_deg"], run.samples["error_um"])}
            return error_figure(curve, title="Error over the turn", x_title="angle, deg")

        return (Drawing("turn", "Error over the turn", 460, turn),)

    def twins(self, home: Home, library: Mapping[str, Effect] | None) -> Twins:
        from dtwin.twins.verbs import Twins

        return Twins(home, library)

    @property
    def twin_report(self) -> TwinReport:
        from dtwin.report import twins

        return twins

    def rows(self, runs: Sequence[Run], times_h: Sequence[float]) -> tuple[Grid, list[Row]]:
        from sixth_kind.model import rows

        return rows(runs, times_h)

    def run_errors(self, runs: Sequence[Run]) -> list[RunError]:
        from sixth_kind.model import run_errors

        return run_errors(runs)

    def training(self) -> Callable[..., Training]:
        from sixth_kind.model import train

        return train

    def gates(self, bundle: Bundle, metrics: Mapping[str, float]) -> list[Verdict]:
        from dtwin.train.gates import bounded_output, latency_gate, vectors_proved

        return [bounded_output(bundle), vectors_proved(bundle), latency_gate(metrics)]


@dataclass(frozen=True)
class Turn:
    """One turn of the table at one speed, as a condition."""

    speed_deg_s: float
    plane: str = "C"
    axes: tuple[str, ...] = ("C",)
    radius_mm: float = RIM_MM
    direction: str = "up"
    sense: float = 1.0
    turned: None = None
    mounted: str = "C"

    @property
    def feed_mm_min(self) -> float:
        return self.speed_deg_s / 57.29577951 * RIM_MM * 60.0

    @property
    def swept(self) -> Mapping[str, float]:
        return {"speed_deg_s": self.speed_deg_s}

    @property
    def seconds(self) -> float:
        return 360.0 / self.speed_deg_s

    def as_dict(self) -> dict[str, Any]:
        return {"axis": "C", "direction": f"at {self.speed_deg_s:g} deg/s"}

    def __str__(self) -> str:
        return f"C {self.speed_deg_s:g} deg/s"


KIND = Turntable()
