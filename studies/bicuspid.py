"""A bicuspid surface cut on the virtual slide, with and without correction."""

from __future__ import annotations

import cmath
from collections.abc import Sequence
from typing import Any

import numpy as np

from dtwin.features.sine import fit_tone
from dtwin.kinds.sinusoidal._evidence import AIR_S, CLOCK, RIM_MM, SLOPE_UM_PER_MM, LoopRecord, ToneCommand, run_loop
from dtwin.kinds.sinusoidal._evidence import TRIAL_HZ as TRIAL_HZ
from dtwin.kinds.sinusoidal._simulate import virtual_slide
from dtwin.machines.turning import SERVO_HZ
from dtwin.progress import Progress, silent
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.statistics import rms
from studies.report.turning import Surface

_FEED_UM_PER_REV = 2.0
_SWELL_S = 1.0
# The rim: where the form is largest and the published figures were taken.
_RIM_SHARE = 0.9


def _bicuspid(frequency_hz: float) -> ToneCommand:
    """Return the command of the surface at a tool frequency of twice the spindle's."""
    per_s = _FEED_UM_PER_REV / 1000.0 * frequency_hz / 2.0
    cut_s = RIM_MM / per_s

    def amplitude(t: Floats) -> Floats:
        x: Floats = np.clip(RIM_MM - per_s * (t - AIR_S), 0.0, RIM_MM)
        return SLOPE_UM_PER_MM * x * np.minimum(t / _SWELL_S, 1.0)

    return ToneCommand(frequency_hz, amplitude, lambda t: -amplitude(t), AIR_S + float(np.ceil(cut_s)))


def _surface_of(record: LoopRecord, frequency_hz: float) -> Surface:
    """Return what the tool left of a run of :func:`_bicuspid`."""
    per_s = _FEED_UM_PER_REV / 1000.0 * frequency_hz / 2.0
    x = RIM_MM - per_s * (record.t_s - AIR_S)
    cut = (record.t_s >= AIR_S) & (x > 0.0)
    turned = np.pi * frequency_hz * record.t_s[cut]
    return Surface(x[cut], turned, record.command_um[cut], record.tool_um[cut])


def _surface_figures(surface: Surface, frequency_hz: float) -> dict[str, float]:
    """Return form and phase error of a surface.

    ``form_um``: amplitude at the rim minus the wanted one, without sign; ``phase_deg``: its lag, without sign;
    ``vector_um``: length of the difference of both; ``peak_to_valley_um`` and ``rms_um`` of the height error over the
    whole surface.
    """
    t = surface.turned_rad / (np.pi * frequency_hz)
    rim = surface.x_mm >= _RIM_SHARE * RIM_MM
    # Both in proportion to the wanted amplitude, which falls towards the middle.
    size = SLOPE_UM_PER_MM * surface.x_mm[rim]
    wanted = fit_tone(t[rim], surface.wanted_um[rim] / size, frequency_hz)
    cut = fit_tone(t[rim], surface.cut_um[rim] / size, frequency_hz)
    ratio = cut.phasor / wanted.phasor
    full = SLOPE_UM_PER_MM * RIM_MM
    error = surface.cut_um - surface.wanted_um
    return {
        "form_um": abs(abs(ratio) - 1.0) * full,
        "phase_deg": abs(float(np.degrees(cmath.phase(ratio)))),
        "vector_um": abs(ratio - 1.0) * full,
        "peak_to_valley_um": float(np.ptp(error)),
        "rms_um": rms(error),
    }


def trial(
    bundle: Bundle,
    *,
    truth: str = "linear",
    seed: int = 1,
    frequencies_hz: Sequence[float] = TRIAL_HZ,
    progress: Progress = silent,
) -> tuple[dict[str, Any], dict[float, tuple[Surface, Surface]]]:
    """Cut the surface at several frequencies without and with a bundle.

    ``bundle``: corrects tones.
    ``truth``: as for :func:`dtwin.kinds.sinusoidal._simulate.virtual_slide`.
    Returns ``found``, ``surfaces``: JSON-ready figures, and (without, with) by frequency.
    """
    mechanism = virtual_slide(truth)
    rows, surfaces = [], {}
    for done, frequency in enumerate(frequencies_hz, start=1):
        command = _bicuspid(frequency)
        records = [run_loop(mechanism, command, given, seed=seed + done) for given in (None, bundle)]
        cut = _surface_of(records[0], frequency), _surface_of(records[1], frequency)
        surfaces[float(frequency)] = cut
        rows.append(_row(frequency, cut, records[1]))
        progress(done, len(frequencies_hz), f"{frequency:g} Hz")
    return {
        "clock": CLOCK,
        "truth": truth,
        "surface": f"z = {SLOPE_UM_PER_MM / 1000:g} x sin 2C - {SLOPE_UM_PER_MM / 1000:g} x, "
        f"x to {RIM_MM:g} mm, {_FEED_UM_PER_REV:g} µm a turn",
        "rows": rows,
        "worse": [r["frequency_hz"] for r in rows if min(r["reduction"]["vector_um"], r["reduction"]["rms_um"]) < 0.0],
    }, surfaces


def _row(frequency: float, cut: tuple[Surface, Surface], record: LoopRecord) -> dict[str, Any]:
    before, after = (_surface_figures(s, frequency) for s in cut)
    return {
        "frequency_hz": frequency,
        "spindle_rpm": 30.0 * frequency,
        "before": before,
        "after": after,
        "reduction": {k: 1.0 - after[k] / before[k] for k in before},
        "windows": len(record.gains),
        "foretold_um": record.left_um.tolist(),
        "guard": record.guard,
        "saturated_ticks": record.saturated,
        "alarm": record.alarm,
        "ticks": round(record.t_s[-1] * SERVO_HZ) + 1,
    }
