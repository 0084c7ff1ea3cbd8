"""Figures of a positioning test: ISO 230-2, and the four figures of a before/after table; what the standard asks, and what makes figures uncertain."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from dtwin.physics.linear import linear_figures
from dtwin.positioning.check import phases_of
from dtwin.positioning.matrix import LinearTest
from dtwin.positioning.positioning_sheet import evaluated_tests
from dtwin.progress import Progress, silent
from dtwin.report.text import counted, table
from dtwin.report.uncertainty import Circumstances, Contribution, off_line_um
from dtwin.schema import Floats, Run

_MAX_HARMONIC = 5
_TREND_DEGREE = 3


def before_after_figures(test: LinearTest) -> dict[str, float | None]:
    """Return the four figures by which compensations are compared, in um.

    Returns ``max_average_error_um``: range of the averages of both directions (E of ISO 230-2);
    ``max_reversal_error_um``: largest difference of the two averages at a target (B); ``max_repeat_um``: largest range
    of all readings at a target, both directions; ``cyclic_error_um``: peak to peak of the harmonics of one screw turn,
    the larger direction, None without pitch or with too few phases.
    """
    up, down = test.forward_um.mean(axis=1), test.reverse_um.mean(axis=1)
    both = np.hstack([test.forward_um, test.reverse_um])
    return {
        "max_average_error_um": float(max(up.max(), down.max()) - min(up.min(), down.min())),
        "max_reversal_error_um": float(np.abs(up - down).max()),
        "max_repeat_um": float(np.ptp(both, axis=1).max()),
        "cyclic_error_um": _cyclic_um(test),
    }


def _cyclic_um(test: LinearTest) -> float | None:
    """Return the peak-to-peak cyclic error of the screw in um; None when it cannot be seen.

    Harmonics of the screw's turn and a cubic trend are fitted to the averages of each direction.
    """
    if not test.pitch_mm:
        return None
    phases = phases_of(test.position_mm, test.pitch_mm)
    harmonics = min(_MAX_HARMONIC, (phases - 1) // 2)
    if harmonics < 1 or len(test.position_mm) < 3 * (_TREND_DEGREE + 1 + 2 * harmonics):
        return None
    x = test.position_mm
    trend = np.vander((x - x.mean()) / max(float(np.ptp(x)), 1e-9), _TREND_DEGREE + 1)
    turn = np.linspace(0.0, 2 * np.pi, 720, endpoint=False)
    amplitudes = []
    for errors in (test.forward_um.mean(axis=1), test.reverse_um.mean(axis=1)):
        design = np.hstack([_waves(2 * np.pi * x / test.pitch_mm, harmonics), trend])
        fitted = np.linalg.lstsq(design, errors, rcond=None)[0][: 2 * harmonics]
        amplitudes.append(float(np.ptp(_waves(turn, harmonics) @ fitted)))
    return max(amplitudes)


def positioning_result(runs: Sequence[Run], progress: Progress = silent) -> dict[str, Any]:
    """Return the figures of a campaign's axis as a JSON-ready mapping; of several axes a list of such mappings under ``axes``.

    ``runs``: with their samples; those that the sheet leaves out, and those in one direction, are left out.
    """
    told = [_figures_of(test) for test in evaluated_tests(runs)]
    return {"axes": told} if len(told) > 1 else next(iter(told), {})


def _figures_of(test: LinearTest) -> dict[str, Any]:
    """Return all figures of one axis."""
    runs = test.forward_um.shape[1]
    result: dict[str, Any] = {"axis": test.axis, "targets": len(test.position_mm), "left_out_targets": test.left_out}
    if not result["targets"]:
        return result
    result |= {
        "runs": runs,
        "from_mm": float(test.position_mm[0]),
        "to_mm": float(test.position_mm[-1]),
        "screw_pitch_mm": test.pitch_mm,
        "screw_phases": phases_of(test.position_mm, test.pitch_mm) if test.pitch_mm else None,
        "before_after": before_after_figures(test),
    }
    if runs > 1:
        result["iso_230_2"] = asdict(linear_figures(test.forward_um, test.reverse_um))
    return result


_BEFORE_AFTER = (
    ("max_average_error_um", "Max average error"),
    ("max_reversal_error_um", "Max reversal error"),
    ("max_repeat_um", "Max repeat"),
    ("cyclic_error_um", "Cyclic error"),
)


def positioning_lines(result: Mapping[str, Any]) -> list[str]:
    """Return the lines that a terminal shows of :func:`positioning_result`."""
    if "axes" in result:
        return [line for axis in result["axes"] for line in [f"axis {axis['axis']}:", *positioning_lines(axis), ""]][
            :-1
        ]
    if not result:
        return ["no run approached its targets from both sides: no figures of both directions"]
    if not result["targets"]:
        return ["no target was read in every run from both sides: no figures"]
    lines = [
        f"{counted(result['runs'], 'run')}, {counted(result['targets'], 'target')} from {result['from_mm']:z.3f} to "
        f"{result['to_mm']:z.3f} mm"
        + ("" if not result["left_out_targets"] else f", {result['left_out_targets']} left out")
        + _phases(result)
    ]
    if "iso_230_2" in result and result["runs"] < 5:
        lines.append(f"  the standard asks for 5 runs, these are {result['runs']}")
    return [*lines, "", *before_after_lines({"measured": result["before_after"]})]


def before_after_lines(figures: Mapping[str, Mapping[str, float | None]]) -> list[str]:
    """Return the four figures of one or more states beside each other, in um and percent.

    ``figures``: by state, the uncompensated first; as :func:`before_after_figures` gives them.
    """
    names = list(figures)
    rows = []
    for key, title in _BEFORE_AFTER:
        first = figures[names[0]][key]
        row = [title]
        for number, name in enumerate(names):
            value = figures[name][key]
            share = f" ({100 * value / first:z.1f} %)" if number and value and first else ""
            row.append("not visible" if value is None else f"{value:z.2f}{share}")
        rows.append(row)
    return table(("error, µm", *names), rows).splitlines()


def _phases(result: Mapping[str, Any]) -> str:
    if result["screw_pitch_mm"] == 0.0:
        return "; measured by a linear scale"
    if result["screw_phases"] is None:
        return "; the pitch of the screw is not stated (screw_pitch_mm)"
    count = result["screw_phases"]
    return f"; pitch {result['screw_pitch_mm']:g} mm, {count} phase{'s' if count > 1 else ''} of it"


def _waves(angle: Floats, harmonics: int) -> Floats:
    orders = np.arange(1, harmonics + 1)
    return np.hstack([np.sin(np.outer(angle, orders)), np.cos(np.outer(angle, orders))])


_READING_UM = 0.2
_SCALE_UM_PER_M = 0.5
_ASLANT_MM = 1.0
# A beam that leans by more does not come back into the instrument: on a short axis the millimetre is not the limit.
_MOST_ASLANT = 0.004
_RUNS, _TARGETS, _PER_METRE = 5, 5, 5
_LONG_MM = 2000.0
_LONG_STEP_MM = 250.0


def asked(test: LinearTest) -> list[str]:
    """Return what the standard asks for and the test has not."""
    targets, runs = test.forward_um.shape
    travel_mm = float(np.ptp(test.position_mm))
    said = []
    # Targets in inches are rounded.
    if travel_mm > 1.001 * _LONG_MM:
        if travel_mm / (targets - 1) > 1.001 * _LONG_STEP_MM:
            said.append(f"over 2 m ISO 230-2 asks for a target every 250 mm in the mean, these are {targets}")
        if runs > 1:
            said.append("ISO 230-2 tells R and A of 2 m at most; over it one run tells E, B and M")
    else:
        fewest = max(_TARGETS, math.ceil(_PER_METRE * travel_mm / 1000.0))
        if targets < fewest:
            said.append(f"ISO 230-2 asks for {fewest} targets on this travel, these are {targets}")
        if runs < _RUNS:
            runs_said = "this is one, and tells no repeatability" if runs == 1 else f"these are {runs}"
            said.append(f"ISO 230-2 asks for five runs, {runs_said}")
    return said


def contributions(under: Circumstances, symbol: str, test: LinearTest) -> tuple[Contribution, ...]:
    """Say what makes a figure uncertain: R and B compare readings of one target, the others readings along the axis."""
    parts = [under.reading(_READING_UM), *under.environment(test.forward_um.shape[1])]
    if symbol[0] in "AEM":
        travel_mm = float(np.ptp(test.position_mm))
        scale = under.stated("uncertainty_um_per_m", _SCALE_UM_PER_M)
        aslant = under.stated("alignment_mm", min(_ASLANT_MM, _MOST_ASLANT * travel_mm))
        parts += [
            Contribution(
                "instrument's scale",
                scale.value / 2 * travel_mm / 1000.0,
                scale.basis("µm/m (k = 2)"),
                assumed=scale.assumed,
            ),
            Contribution(
                "set-up",
                off_line_um(aslant.value, travel_mm),
                f"beam off the axis by {aslant.basis('mm at most')}",
                assumed=aslant.assumed,
            ),
            *under.length(travel_mm / 1000.0),
        ]
    return tuple(parts)
