"""Tones of the virtual slide with and without a correction, by turns."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from datetime import timedelta

import numpy as np

from dtwin.acquire.virtual import EPOCH
from dtwin.kinds.sinusoidal._folder import SAMPLE_HZ
from dtwin.kinds.sinusoidal._loop import CLOCK, LoopRecord, ToneCommand, run_loop
from dtwin.kinds.sinusoidal._simulate import virtual_slide
from dtwin.machines.turning import MM_PER_UM, SERVO_HZ, AnaloguePath, Instruments
from dtwin.progress import Progress
from dtwin.schema import Floats, Run, RunMeta
from dtwin.serve.bundle import Bundle
from dtwin.train.measured_ways import MeasuredWays, guard_shares, numbered
from dtwin.train.results import condition_name

# z = 0.006 x sin 2C - 0.006 x, x and z in mm.
SLOPE_UM_PER_MM = 6.0
RIM_MM = 0.5
TRIAL_HZ = (5.0, 10.0, 20.0, 30.0, 40.0)
# Before the cut the tool swings in the air: five seconds for a window, and some to settle.
AIR_S = 9.0
_REPEATS = 3
_RECORDED_S = 4.0
_AMPLITUDE_UM = SLOPE_UM_PER_MM * RIM_MM


def measured_tones(bundle: Bundle, truth: str, *, seed: int, progress: Progress | None = None) -> MeasuredWays:
    """Swing the tool at each frequency several times with and without a bundle, by turns."""
    slide = virtual_slide(truth)
    runs: list[Run] = []
    counts: dict[str, list[Mapping[str, int]]] = defaultdict(list)
    for repeat in range(_REPEATS):
        for number, frequency in enumerate(TRIAL_HZ):
            command = ToneCommand(frequency, _swelling, np.zeros_like, AIR_S + _RECORDED_S)
            for way in (None, bundle):
                drawn = 1000 * (seed + 1) + 10 * (_REPEATS * number + repeat) + (way is not None)
                record = run_loop(slide, command, way, seed=drawn)
                run = _run(record, frequency, drawn, len(runs), bundle.model_sha256 if way else "")
                if way:
                    counts[condition_name(run.meta.condition)].append(record.guard)
                runs.append(run)
        if progress is not None:
            progress(repeat + 1, _REPEATS, "tones")
    return MeasuredWays(
        numbered(runs),
        CLOCK,
        {"analogue path": AnaloguePath().delay_s},
        acted={name: guard_shares(found) for name, found in counts.items()},
    )


def _swelling(t_s: Floats) -> Floats:
    return np.asarray(_AMPLITUDE_UM * np.minimum(t_s, 1.0))


def _run(record: LoopRecord, frequency: float, seed: int, number: int, correction: str) -> Run:
    """Return what command and probe say after the tool has swung in."""
    kept = np.flatnonzero(record.t_s >= AIR_S)[:: round(SERVO_HZ / SAMPLE_HZ)]
    seen = Instruments().probe_um * np.random.default_rng(seed).normal(size=len(kept))
    samples = {
        "t_s": record.t_s[kept] - AIR_S,
        "cmd_z_mm": record.command_um[kept] * MM_PER_UM,
        "tool_z_mm": (record.tool_um[kept] + seen) * MM_PER_UM,
    }
    meta = RunMeta(
        "e",
        kind="sinusoidal",
        sample_rate_hz=SAMPLE_HZ,
        correction=correction,
        condition={"axis": "Z", "frequency_hz": frequency, "amplitude_um": _AMPLITUDE_UM},
        started=(EPOCH + timedelta(minutes=number)).isoformat(),
    )
    return Run(meta, samples, source="virtual slide")
