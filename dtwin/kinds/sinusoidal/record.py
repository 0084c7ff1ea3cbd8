"""Tones: a slide that is told sines of several frequencies and amplitudes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from dtwin.kinds.kind import TWINS_OF_PATHS, Kind


class _Sinusoidal(Kind):
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
    places: ClassVar[Mapping[str, str]] = {
        **TWINS_OF_PATHS,
        "machines": "_machines:MACHINES",
        "plan": "_plan:planned",
        "draft": "_plan:draft",
        "foreseen": "_plan:foreseen",
        "completed": "_check:with_bandwidth",
        "judge_run": "_check:judge_sinusoidal_run",
        "judge_campaign": "_check:judge_sinusoidal_campaign",
        "run_figures": "_report:tone_result",
        "drawings": "_plots:DRAWINGS",
        "rows": "_grid:tone_rows",
        "run_errors": "_drift:tone_errors",
        "training": "_candidates:train_tones",
        "recognises": "_bundle:is_tone_bundle",
        "gates": "_gates:tone_gates",
        "twin_correction": "_correction:WAY",
        "champion_error": "_drift:tones_error",
        "held_out": "_drift:tones_held_out",
    }

    def figure_lines(self, result: Mapping[str, Any]) -> list[str]:
        from dtwin.kinds.sinusoidal._report import tone_lines

        return tone_lines(result["runs"])


KIND = _Sinusoidal()
