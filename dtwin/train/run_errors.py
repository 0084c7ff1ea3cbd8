"""The error of every run of a campaign, in the form in which runs are compared with each other."""

from __future__ import annotations

import hashlib
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from dtwin.errors import InputError
from dtwin.features.sine import fit_tone
from dtwin.kinds.registry import kind_named
from dtwin.schema import Floats, Run
from dtwin.statistics import rms
from dtwin.units import UM_PER_MM

_BINS = 180
# Of one turn; what is swept less of begins somewhere.
_WHOLE_DEG = 350.0
_PLACE_DEG = 10.0
Condition = Mapping[str, str | float]


@dataclass(frozen=True)
class RunError:
    """The error of one run under one condition.

    Attributes
    ----------
    run : int
        Place of the run among those that were given.
    condition : mapping
        What was set; runs of equal conditions are repeats.
    direction : str
        Sense of the motion; runs of one condition differ by it without disagreeing.
    rest_um : ndarray, shape (n,)
        The error at places that the repeats share, its RMS about ``size_um``.
    """

    run: int
    condition: Condition
    direction: str
    size_um: float
    rest_um: Floats = field(repr=False)


def run_errors(runs: Sequence[Run]) -> list[RunError]:
    """Return the errors of runs of one kind, what belongs to the set-up taken out.

    ``runs``: all without a correction, or all with the same: the instrument's mounting is fitted to them together.
    """
    kinds = sorted({run.meta.kind for run in runs})
    if not kinds:
        return []
    if len(kinds) > 1:
        raise InputError("runs of several kinds are not compared", code="evidence.kind", got=", ".join(kinds))
    return kind_named(kinds[0]).run_errors(runs)


def measured_sha256(run: Run) -> str:
    """Return a hash of what the instrument measured, whatever the run is called.

    Two runs with the same one are copies: no instrument reads thousands of samples alike twice.
    """
    digest = hashlib.sha256()
    for name in sorted(run.samples):
        values = run.samples[name]
        if name != "t_s" and values.dtype != object:
            digest.update(np.ascontiguousarray(np.round(values, 6)).tobytes())
    return digest.hexdigest()


def circle_errors(runs: Sequence[Run]) -> list[RunError]:
    """Return the errors of circles.

    Centre and radius belong to a mounting, which all feeds and both directions share.
    """
    parts = [_arc(run) for run in runs]
    mounted = defaultdict(list)
    for number, (run, (angle_deg, _)) in enumerate(zip(runs, parts, strict=True)):
        mounted[run.meta.setup, run.meta.plane, run.meta.radius_mm, _swept(angle_deg)].append(number)
    rest = dict[int, Floats]()
    for numbers in mounted.values():
        designs = {n: _mounting(parts[n][0]) for n in numbers}
        # A slow circle has more samples; every run weighs the same.
        normal = sum((d.T @ d / len(d) for d in designs.values()), np.zeros((3, 3)))
        right = sum((d.T @ parts[n][1] / len(d) for n, d in designs.items()), np.zeros(3))
        terms = np.linalg.lstsq(normal, right, rcond=None)[0]
        rest |= {n: parts[n][1] - d @ terms for n, d in designs.items()}
    conditions = [_circle(run) for run in runs]
    grids = _grids(runs, [angle for angle, _ in parts])
    return [
        RunError(n, conditions[n], str(run.meta.direction), rms(rest[n]), _at(grids[n], parts[n][0], rest[n]))
        for n, run in enumerate(runs)
    ]


def _circle(run: Run) -> Condition:
    meta = run.meta
    if meta.radius_mm and meta.feed_mm_min:
        return {"plane": str(meta.plane), "radius_mm": meta.radius_mm, "feed_mm_min": meta.feed_mm_min}
    raise InputError("a circle does not state radius and feed", code="evidence.condition", where=f"run {meta.run_id}")


def _arc(run: Run) -> tuple[Floats, Floats]:
    """Return angle and error of the measured arc."""
    part = slice(None) if run.window is None else slice(*run.window)
    return run.samples["angle_deg"][part], run.samples["deviation_um"][part]


def _swept(angle_deg: Floats) -> int:
    """Tell arcs apart that do not cover the same angles; a whole turn covers all of them."""
    low, high = float(angle_deg.min()), float(angle_deg.max())
    if high - low >= _WHOLE_DEG:
        return -1
    return round((low % 360.0) / _PLACE_DEG)


def _mounting(angle_deg: Floats) -> Floats:
    angle = np.radians(angle_deg)
    return np.column_stack([np.ones_like(angle), np.cos(angle), np.sin(angle)])


def _grids(runs: Sequence[Run], angles: Sequence[Floats]) -> list[Floats]:
    """Return, for each run, angles that all of its direction and condition went through."""
    ends: dict[object, tuple[float, float]] = {}
    keys = [(r.meta.plane, r.meta.radius_mm, r.meta.feed_mm_min, r.meta.direction) for r in runs]
    for key, angle in zip(keys, angles, strict=True):
        low, high = ends.get(key, (-math.inf, math.inf))
        ends[key] = max(low, float(angle.min())), min(high, float(angle.max()))
    steps = (np.arange(_BINS) + 0.5) / _BINS
    return [ends[key][0] + steps * (ends[key][1] - ends[key][0]) for key in keys]


def _at(places: Floats, angle_deg: Floats, rest_um: Floats) -> Floats:
    order = np.argsort(angle_deg)
    return np.asarray(np.interp(places, angle_deg[order], rest_um[order]))


def stroke_errors(runs: Sequence[Run]) -> list[RunError]:
    """Return the errors of strokes along an axis.

    The zero of a laser is arbitrary: the mean over both directions is no error.
    """
    found = []
    for number, run in enumerate(runs):
        middle = float(np.mean(run.samples["error_um"]))
        axis = str(run.meta.condition.get("axis", ""))
        for way in sorted({str(d) for d in run.samples["direction"]}):
            chosen = run.samples["direction"] == way
            place, error = run.samples["position_mm"][chosen], run.samples["error_um"][chosen]
            rest = error[np.argsort(place)] - middle
            condition: Condition = {
                "axis": axis,
                "approached": way,
                "targets": float(len(place)),
                "from_mm": round(float(place.min()), 2),
                "to_mm": round(float(place.max()), 2),
            }
            found.append(RunError(number, condition, way, rms(rest), rest))
    return found


def tone_errors(runs: Sequence[Run]) -> list[RunError]:
    """Return the errors of tones.

    The error of a tone is the length of the difference of two vectors, tool and command.
    """
    found = []
    for number, run in enumerate(runs):
        stated = run.meta.condition
        axis, frequency = str(stated.get("axis", "Z")), float(stated["frequency_hz"])
        names = [f"{part}_{axis.lower()}_mm" for part in ("cmd", "tool")]
        missing = [name for name in names if name not in run.samples]
        if missing:
            raise InputError(
                "a run does not tell where the tool was",
                code="evidence.columns",
                where=f"run {run.meta.run_id}",
                got=", ".join(run.samples),
                allowed=", ".join(missing),
            )
        command, tool = (
            fit_tone(run.samples["t_s"], run.samples[name] * UM_PER_MM, frequency).phasor for name in names
        )
        error = tool - command
        condition: Condition = {"axis": axis, "frequency_hz": frequency, "amplitude_um": float(stated["amplitude_um"])}
        # In the command's own direction, whatever the instant at which the record began.
        turned = error * np.conj(command) / abs(command)
        rest = math.sqrt(2.0) * np.array([turned.real, turned.imag])
        found.append(RunError(number, condition, "", abs(error), rest))
    return found
