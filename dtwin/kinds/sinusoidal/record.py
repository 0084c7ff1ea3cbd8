"""Tones: a slide that is told sines of several frequencies and amplitudes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from dtwin.kinds.kind import Drawing, Planned
from dtwin.kinds.path_kind import PathKind

if TYPE_CHECKING:
    from dtwin.kinds.machine import VirtualMachine
    from dtwin.lake.store import Lake
    from dtwin.physics.grid import Grid, Row
    from dtwin.physics.observations import Observations
    from dtwin.progress import Progress
    from dtwin.schema import Campaign, Finding, Run
    from dtwin.serve.bundle import Bundle
    from dtwin.train.champion_error import ChampionError, HeldOut
    from dtwin.train.gates import Verdict
    from dtwin.train.results import Training
    from dtwin.train.run_errors import RunError
    from dtwin.twins.correct import TwinWay


class _Sinusoidal(PathKind):
    name = "sinusoidal"
    settings = (
        "machine_geometry.z_bandwidth_hz",
        "condition.frequency_hz",
        "condition.amplitude_um",
        "condition.z_bandwidth_hz",
    )
    columns = ("t_s", "cmd_z_mm", "act_z_mm")
    in_one_table = True
    always_fitted = "The zero of every set-up is always fitted."
    instead: ClassVar[Mapping[str, str]] = {
        "laws": "dtwin twin correct serves the effects of the twin; dtwin turning fit fits an equation"
    }

    @property
    def machines(self) -> Sequence[VirtualMachine]:
        from dtwin.kinds.sinusoidal._machines import MACHINES

        return MACHINES

    def plan(self, document: Mapping[str, Any], where: str) -> Planned:
        from dtwin.kinds.sinusoidal._planned import planned

        return planned(document, where)

    def draft(self, machine: str, axes: Mapping[str, Mapping[str, float]]) -> Mapping[str, Any]:
        from dtwin.kinds.sinusoidal._planned import draft

        return draft(machine, axes)

    def foreseen(self, planned: Planned) -> Observations:
        from dtwin.kinds.sinusoidal._planned import foreseen

        return foreseen(planned.plan)

    def completed(self, run: Run, campaign: Campaign) -> Run:
        from dtwin.kinds.sinusoidal._check import with_bandwidth

        return with_bandwidth(run, campaign)

    def judge_run(self, run: Run) -> list[Finding]:
        from dtwin.acquire.quality import judge_clock
        from dtwin.kinds.sinusoidal._check import judge_sinusoidal_run

        return [*judge_clock(run), *judge_sinusoidal_run(run)]

    def judge_campaign(self, runs: Sequence[Run]) -> list[Finding]:
        from dtwin.kinds.sinusoidal._check import judge_sinusoidal_campaign

        return judge_sinusoidal_campaign(runs)

    def run_figures(self, run: Run) -> Mapping[str, Any]:
        from dtwin.kinds.sinusoidal._report import tone_result

        return tone_result(run)

    def figure_lines(self, result: Mapping[str, Any]) -> list[str]:
        from dtwin.kinds.sinusoidal._report import tone_lines

        return tone_lines(result["runs"])

    @property
    def drawings(self) -> Sequence[Drawing]:
        from dtwin.kinds.sinusoidal._drawings import DRAWINGS

        return DRAWINGS

    def rows(self, runs: Sequence[Run], times_h: Sequence[float]) -> tuple[Grid, list[Row]]:
        from dtwin.kinds.sinusoidal._grid import TONE, tone_row

        return TONE, [tone_row(run, time_h) for run, time_h in zip(runs, times_h, strict=True)]

    def run_errors(self, runs: Sequence[Run]) -> list[RunError]:
        from dtwin.kinds.sinusoidal._run_errors import tone_errors

        return tone_errors(runs)

    def training(self) -> Callable[..., Training]:
        from dtwin.kinds.sinusoidal._training import train_tones

        return train_tones

    def recognises(self, bundle: Bundle) -> bool:
        from dtwin.kinds.sinusoidal._bundle import is_tone_bundle

        return is_tone_bundle(bundle)

    def gates(self, bundle: Bundle, metrics: Mapping[str, float]) -> list[Verdict]:
        from dtwin.kinds.sinusoidal._gates import tone_gates

        return tone_gates(bundle, metrics)

    def twin_correction(self) -> TwinWay:
        from dtwin.kinds.sinusoidal._correction import freeze_tones, judge_tones
        from dtwin.twins.correct import BY_SHAPE, LITTLE, MEAN_IS_TOLD, TwinWay

        return TwinWay(freeze_tones, judge_tones, BY_SHAPE, MEAN_IS_TOLD, LITTLE, {"type": "turning"})

    def champion_error(
        self,
        lake: Lake,
        rows: Sequence[dict[str, Any]],
        bundle: Bundle,
        metrics: Mapping[str, float],
        progress: Progress | None = None,
    ) -> ChampionError:
        from dtwin.kinds.sinusoidal._drift import tones_error

        return tones_error(lake, rows, bundle)

    def held_out(self, known: Sequence[Mapping[str, Any]], fresh: Sequence[Mapping[str, Any]]) -> HeldOut:
        from dtwin.kinds.sinusoidal._drift import tones_held_out

        return tones_held_out(known, fresh)


KIND = _Sinusoidal()
