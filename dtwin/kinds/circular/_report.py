"""Figures of one circular test, as a check tells them."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from dtwin.acquire.motion_quality import Motion, aligned_angle_deg, motion_of
from dtwin.physics.circular import CircularFigures, circular_figures, fit_circle, residual_um
from dtwin.physics.spectrum import strongest_lines
from dtwin.schema import Floats, Run


def circular_result(run: Run) -> dict[str, Any]:
    """Return figures and spectrum of a circle, by the file's indices and aligned by the stops, JSON-ready."""
    by_file = _figures(run, run.samples["angle_deg"], run.marked)
    out: dict[str, Any] = {"by_file_indices": by_file}
    long_enough = run.window is not None and run.meta.feed_mm_min is not None
    motion = motion_of(run) if long_enough else None
    aligned = None if motion is None else aligned_angle_deg(run, motion)
    if motion is not None and aligned is not None:
        out["stops"] = [int(s) for s in motion.stops]
        out["period_samples"] = motion.period_samples
        full = _whole_turn(run, motion)
        if full is not None:
            out["aligned_by_stops"] = _figures(run, aligned, full) | {
                "first_sample": full.start,
                "last_sample": full.stop - 1,
            }
    out["spectrum"] = _spectrum(run)
    return out


def _figures(run: Run, angle_deg: Floats, window: slice) -> dict[str, Any]:
    assert run.meta.radius_mm is not None
    figures: CircularFigures = circular_figures(
        angle_deg[window], run.samples["deviation_um"][window], run.meta.radius_mm
    )
    flat = asdict(figures)
    circle = flat.pop("circle")
    n = window.stop - window.start if window.stop is not None else run.n_samples
    arc = np.radians(figures.arc_deg)
    flat["feed_mm_min"] = arc * run.meta.radius_mm / (n / run.meta.sample_rate_hz) * 60.0
    return circle | flat


def _whole_turn(run: Run, motion: Motion) -> slice | None:
    """Return the two consecutive half turns that lie nearest to the marked window."""
    if len(motion.stops) < 3 or run.window is None:
        return None
    starts = motion.stops[:-2]
    k = int(np.argmin(np.abs(starts - run.window[0])))
    return slice(int(motion.stops[k]), int(motion.stops[k + 2]))


def _spectrum(run: Run) -> dict[str, Any]:
    assert run.meta.radius_mm is not None
    angle, deviation = run.arc
    rest = residual_um(angle, deviation, run.meta.radius_mm, fit_circle(angle, deviation, run.meta.radius_mm))
    lines, bands = strongest_lines(rest, run.meta.sample_rate_hz)
    return {
        "lines": [{"frequency_hz": f, "amplitude_um": a} for f, a in lines],
        "bands_um": [{"from_hz": lo, "to_hz": hi, "rms_um": rms} for lo, hi, rms in bands],
    }
