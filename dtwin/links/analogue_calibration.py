"""Calibration of an analogue correction: what a volt at each input really does to each axis."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import GateRefusal, InputError
from dtwin.links.analogue import AXES, FULL_SCALE_V, AxisCalibration
from dtwin.units import is_number, shown_number

_HEAD = ("axis", "voltage_v", "x_um", "y_um", "z_um")
_LEVELS = 3
# Straightness of the line, and what another axis may move, as shares of the span.
_MOST_BENT = 0.03
_MOST_CROSS_TALK = 0.2
_SANE_UM_PER_V = (2.0, 250.0)
_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class _AxisFit:
    """A line through what was measured on one axis.

    ``um_per_v``, ``neutral_v``: slope, and the voltage without displacement.
    ``um_per_v_uncertainty``, ``neutral_v_uncertainty``: expanded, k = 2; unit of replication: the reading.
    ``noise_um``: RMS about the line.
    ``cross_talk``: what the same volt does to the other axes, as share of what it does to this one.
    """

    um_per_v: float
    neutral_v: float
    um_per_v_uncertainty: float
    neutral_v_uncertainty: float
    noise_um: float
    cross_talk: Mapping[str, float]
    readings: int

    @property
    def calibration(self) -> AxisCalibration:
        """The two numbers that the output needs."""
        return AxisCalibration(self.um_per_v, self.neutral_v)


def read_points(path: Path) -> dict[str, tuple[_Floats, _Floats]]:
    """Return voltages and displacements of every axis from a CSV file.

    ``path``: columns ``axis,voltage_v,x_um,y_um,z_um``: the input that was driven, and where the machine went.
    Returns, by axis, voltages of shape (n,) and displacements of shape (n, 3).
    Raises ``InputError`` when the file cannot be read, lacks a column or holds what is no number.
    """
    rows: dict[str, list[list[float]]] = {}
    try:
        if path.exists() and not path.is_file():
            raise ValueError("no plain file")
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            if tuple(reader.fieldnames or ()) != _HEAD:
                raise _bad(path, "columns", ",".join(reader.fieldnames or ()), ",".join(_HEAD))
            for number, row in enumerate(reader, start=2):
                # Of 1,5 commas make two cells, and all that follows would be of the next column.
                if None in row:
                    raise _bad(path, f"line {number}", "more cells than columns", "decimal points, a cell for each")
                if row["axis"] not in AXES:
                    raise _bad(path, f"line {number}, axis", str(row["axis"]), ", ".join(AXES))
                values = [float(row[name] or "nan") for name in _HEAD[1:]]
                if not all(math.isfinite(v) for v in values):
                    raise _bad(path, f"line {number}", str(values), "finite numbers")
                rows.setdefault(row["axis"], []).append(values)
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise _bad(path, "file", str(error)[:120], "a CSV file of numbers") from error
    return {axis: (np.array(points)[:, 0], np.array(points)[:, 1:]) for axis, points in rows.items()}


def calibrate(points: Mapping[str, tuple[_Floats, _Floats]]) -> dict[str, _AxisFit]:
    """Fit a line to every axis.

    ``points``, shapes (n,) and (n, 3): voltages, and displacements along x, y and z, by the input that
    was driven.
    Raises ``GateRefusal`` when axes are swapped, an input does nothing, the answer is bent, or there are too few
    levels: a correction through such a path would make the error larger.
    """
    missing = [axis for axis in AXES if axis not in points]
    if missing:
        raise GateRefusal(
            "an axis was not measured",
            code="calibration.axis",
            got=", ".join(missing),
            allowed="x, y and z",
            hint="drive each input by itself at three voltages or more",
        )
    return {axis: _line(axis, *points[axis]) for axis in AXES}


def save(path: Path, fits: Mapping[str, _AxisFit]) -> Path:
    """Write a calibration as JSON and return the path."""
    from dtwin.atomic import write_text

    document = {"format": "dtwin.analogue.1", "axes": {k: asdict(v) for k, v in fits.items()}}
    return write_text(path, json.dumps(document, indent=1), "the calibration")


def load(path: Path) -> tuple[AxisCalibration, AxisCalibration, AxisCalibration]:
    """Return the calibration of x, y and z from a file of :func:`save`.

    Raises ``InputError`` when it is no such file.
    """
    try:
        document: Any = json.loads(path.read_text(encoding="utf-8"))
        if document["format"] != "dtwin.analogue.1":
            raise _bad(path, "format", str(document["format"])[:40], "dtwin.analogue.1")
        told = [(axis, document["axes"][axis]["um_per_v"], document["axes"][axis]["neutral_v"]) for axis in AXES]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise _bad(path, "file", str(error)[:120], "what dtwin analogue calibrate writes") from error
    for axis, *two in told:
        if not all(map(is_number, two)) or (wrong := _no_input(float(two[0]), float(two[1]))):
            got = wrong if all(map(is_number, two)) else str(two)[:80]
            raise _bad(path, f"axis {axis}", got, "what dtwin analogue calibrate writes")
    x, y, z = (AxisCalibration(float(um_per_v), float(neutral_v)) for _, um_per_v, neutral_v in told)
    return x, y, z


def _no_input(um_per_v: float, neutral_v: float) -> str:
    """Return why a slope and a neutral voltage are of no correction input; empty when they may be."""
    if not _SANE_UM_PER_V[0] <= abs(um_per_v) <= _SANE_UM_PER_V[1]:
        return f"{shown_number(um_per_v)} µm per volt is no correction input"
    return (
        ""
        if 0.0 < neutral_v < FULL_SCALE_V
        else f"at no voltage from 0 to {FULL_SCALE_V:g} is the axis where it belongs"
    )


def _line(axis: str, volts: _Floats, moved_um: _Floats) -> _AxisFit:
    if len(np.unique(np.round(volts, 3))) < _LEVELS:
        raise _refused(axis, "too few voltages to see whether the answer is a line", len(volts))
    design = np.column_stack([volts, np.ones_like(volts)])
    slopes, offsets = np.linalg.lstsq(design, moved_um, rcond=None)[0]
    own = AXES.index(axis)
    largest = int(np.argmax(np.abs(slopes)))
    if largest != own and abs(slopes[largest]) > _SANE_UM_PER_V[0]:
        raise _refused(axis, f"this input moves {AXES[largest]}: wires are swapped", slopes[largest])
    um_per_v = float(slopes[own])
    neutral = -float(offsets[own]) / um_per_v if um_per_v else math.nan
    if wrong := _no_input(um_per_v, neutral):
        raise _refused(axis, wrong, f"{shown_number(um_per_v)} µm/V, neutral {shown_number(neutral)} V")
    left = moved_um[:, own] - design @ np.array([um_per_v, offsets[own]])
    dof = max(len(volts) - 2, 1)
    noise = float(np.sqrt((left**2).sum() / dof))
    span = float(np.ptp(moved_um[:, own]))
    if float(np.abs(left).max()) > _MOST_BENT * span:
        raise _refused(axis, "the answer is not a line", f"{shown_number(np.abs(left).max())} µm off it")
    cross = {other: float(slopes[i] / um_per_v) for i, other in enumerate(AXES) if other != axis}
    worst = max(cross, key=lambda other: abs(cross[other]))
    if abs(cross[worst]) > _MOST_CROSS_TALK:
        raise _refused(axis, f"this input also moves {worst}", f"{100 * cross[worst]:z.0f} %")
    covariance = noise**2 * np.linalg.inv(design.T @ design)
    gradient = np.array([-neutral / um_per_v, -1.0 / um_per_v])
    return _AxisFit(
        um_per_v=um_per_v,
        neutral_v=neutral,
        um_per_v_uncertainty=2.0 * float(np.sqrt(covariance[0, 0])),
        neutral_v_uncertainty=2.0 * float(np.sqrt(gradient @ covariance @ gradient)),
        noise_um=noise,
        cross_talk=cross,
        readings=len(volts),
    )


def _refused(axis: str, text: str, got: object) -> GateRefusal:
    return GateRefusal(
        f"input {axis}: {text}",
        code="calibration.refused",
        got=str(got),
        hint="mend the wiring or measure again; nothing was written",
    )


def _bad(path: Path, where: str, got: str, allowed: str) -> InputError:
    return InputError(
        "the calibration file cannot be used",
        code="calibration.file",
        where=f"{path} {where}",
        got=got,
        allowed=allowed,
    )


def calibration_rows(fits: Mapping[str, _AxisFit]) -> Sequence[tuple[str, ...]]:
    """Return rows for a table: axis, slope, neutral, noise, cross-talk."""
    return [
        (
            axis,
            f"{f.um_per_v:z.3f} ± {f.um_per_v_uncertainty:z.3f}",
            f"{f.neutral_v:z.4f} ± {f.neutral_v_uncertainty:z.4f}",
            f"{f.noise_um:z.3f}",
            ", ".join(f"{other} {100 * share:+z.1f} %" for other, share in f.cross_talk.items()),
            str(f.readings),
        )
        for axis, f in fits.items()
    ]
