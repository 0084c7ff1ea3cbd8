"""What one recording can tell about a machine, and what it cannot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.b5r import BallbarTest, read_b5r
from dtwin.physics.effect import Effect
from dtwin.physics.problem import Term
from dtwin.physics.state import has_joints
from dtwin.schema import Floats
from studies import recording_models as models
from studies.recording_effects import ARC_DIP, STOP_RINGING
from studies.recording_passes import Aligned, align, within_run_floor_um
from studies.recording_search import Search
from studies.recording_vendor import vendor_figures

_ELBOW_UP_DEG = (-18.5, -86.3, 137.0, -140.7, -90.0, -108.5)
_ASKED_HZ = (9.0, 9.8)
_REPEATS = 3
_HIGHEST, _PER_ORDER = 90, 3
_GRADES = {ARC_DIP.name: "description only"}


@dataclass(frozen=True)
class Study:
    """A recording and what was found in it.

    ``residual_um``, shape (n,): what is left of each pass by the model that was fitted to the other.
    """

    passes: models.Passes
    residual_um: tuple[Floats, Floats]
    result: dict[str, Any]


def ur10e_geometry(centre_mm: Sequence[float], zero_deg: float) -> dict[str, Any]:
    """Return the geometry of a UR10e in the frame of the bar.

    ``centre_mm``: centre of the circle in the robot's base frame.
    ``zero_deg``: where the bar's 0 deg lies, as an angle about the base's vertical axis.
    """
    turn = np.radians(-zero_deg)
    x, y, z = centre_mm
    branch = np.radians(_ELBOW_UP_DEG)
    branch[[0, 5]] += turn
    return {
        "type": "ur10e",
        "centre_mm": [float(x * np.cos(turn) - y * np.sin(turn)), float(x * np.sin(turn) + y * np.cos(turn)), float(z)],
        "tcp_mm": [0.0, 0.0, 158.3],
        "joint_branch": branch.tolist(),
    }


def study_recording(path: Path, library: Mapping[str, Effect], geometry: Mapping[str, Any] | None = None) -> Study:
    """Align a ball-bar file by its stops, fit on one pass and judge on the other.

    ``path``: a ``.b5r`` file whose runs stop every half turn and pass parts of the path twice.
    ``geometry``: ``machine_geometry``; without one, effects of joints are left out.
    Raises ``InputError`` when the file cannot be read, or a run cannot be aligned or repeats nothing.
    """
    test = read_b5r(path)
    passes = models.passes_of([align(run, geometry or {}) for run in test.runs])
    ladders = _ladders(passes, library, geometry or {})
    best = min(ladders, key=lambda name: ladders[name][-1].held_out_um)
    base = models.setup_terms(library, passes.aligned[0].state)
    terms = [*base, *(rung.term for rung in ladders[best])]
    columns = models.stack([passes.columns(term) for term in terms])
    residual = models.left_by_the_other(passes.y_um, columns)
    result = {
        **_recording(test, passes, geometry or {}),
        "vendor": vendor_figures(passes, library, test.diagnostics),
        **_comparison(passes, base, ladders, best, columns),
        "alone": _alone(passes, base, library),
        "remaining_lines": _lines(passes, residual),
        "plan": _plan(ladders[best], passes),
    }
    return Study(passes, residual, result)


def _ladders(
    passes: models.Passes, library: Mapping[str, Effect], geometry: Mapping[str, Any]
) -> dict[str, list[models.Rung]]:
    state = passes.aligned[0].state
    base = models.setup_terms(library, state)
    tried = {"cartesian": (False, False)}
    if has_joints(geometry):
        tried["cartesian+joints"] = (True, False)
    tried["everything"] = (has_joints(geometry), True)
    return {
        name: models.grow(passes, base, list(models.candidate_terms(library, state, joints=joints, clock=clock)))
        for name, (joints, clock) in tried.items()
    }


def _recording(test: BallbarTest, passes: models.Passes, geometry: Mapping[str, Any]) -> dict[str, Any]:
    stretches = [s for a in passes.aligned for s in a.stretches]
    return {
        "machine": test.machine,
        "started": test.started,
        "geometry": dict(geometry),
        "runs": [_run(a) for a in passes.aligned],
        "stretches": [s.as_dict() for s in stretches],
        "floor_um": within_run_floor_um(tuple(stretches)),
        "floor_kind": "within_run",
        "look_up_um": models.look_up_um(passes),
    }


def _run(aligned: Aligned) -> dict[str, Any]:
    return {
        "run_id": aligned.run.meta.run_id,
        "samples": aligned.run.n_samples,
        "stops": aligned.motion.stops.tolist(),
        "misregistered_deg": aligned.misregistered_deg,
        "feed_mm_min": aligned.state.feed_mm_s * 60.0,
    }


def _comparison(
    passes: models.Passes,
    base: Sequence[Term],
    ladders: Mapping[str, list[models.Rung]],
    best: str,
    columns: tuple[Floats, Floats],
) -> dict[str, Any]:
    setup = models.stack([passes.columns(term) for term in base])
    shapes = sum(len(rung.term.shape) for rung in ladders[best])
    parameters = ladders[best][-1].parameters + shapes
    unseen = _unseen_by_rung(passes, base, ladders[best])
    held_out, ceiling = ladders[best][-1].held_out_um, models.look_up_um(passes)
    return {
        "setup_only_um": models.judge(passes.y_um, setup)[1],
        "setup_only_unseen_path_um": models.unseen_path_um(passes, setup),
        "ladders": {name: [_rung(r) for r in rungs] for name, rungs in ladders.items()},
        "best": best,
        "parameters": parameters,
        "held_out_um": held_out,
        "unseen_path_um": models.unseen_path_um(passes, columns),
        "unseen_path_by_rung_um": unseen,
        "rungs_that_carry_over": _carry_over(passes, base, unseen),
        "harmonics": {
            "shared": _best_harmonics(passes, parameters, by_direction=False),
            "by_direction": _best_harmonics(passes, parameters, by_direction=True),
            "chosen_orders_by_direction": _chosen_harmonics(passes, parameters),
        },
        "unexplained_um": float(np.sqrt(max(held_out**2 - ceiling**2, 0.0))),
        "verdict": "unknown_effect" if held_out > 1.5 * ceiling else "need_repeats",
    }


def _best_harmonics(passes: models.Passes, most: int, *, by_direction: bool) -> dict[str, Any]:
    """Return the best harmonic model with at most so many parameters: more is not always better."""

    def held_out(parameters: int) -> float:
        waves = models.harmonic_columns(passes, parameters, by_direction=by_direction)
        return models.judge(passes.y_um, waves)[1]

    best = min(range(3, most + 1, 2), key=held_out)
    return _judged_harmonics(passes, most, best, models.harmonic_columns(passes, best, by_direction=by_direction))


def _judged_harmonics(
    passes: models.Passes, most: int, parameters: int, waves: tuple[Floats, Floats]
) -> dict[str, Any]:
    return {
        "at_most": most,
        "parameters": parameters,
        "held_out_um": models.judge(passes.y_um, waves)[1],
        "unseen_path_um": models.unseen_path_um(passes, waves),
    }


def _chosen_harmonics(passes: models.Passes, most: int) -> dict[str, Any]:
    """Return what is left by harmonics of each direction, added one after the other by what they leave on the other pass.

    An order counts as three parameters: two amplitudes and its number, as shapes of effects do.
    """
    runs = range(len(passes.aligned))
    model = models.stack([_wave(passes, 0, run) for run in runs])
    pool = [_wave(passes, order, run) for run in runs for order in range(1, _HIGHEST + 1)]
    search = Search(passes.y_um, pool)
    search.add(model)
    chosen: list[int] = []
    while len(runs) + _PER_ORDER * (len(chosen) + 1) <= most and len(chosen) < len(pool):
        left_um = search.left_um()
        left_um[chosen] = np.inf
        best = int(np.argmin(left_um))
        search.add(pool[best])
        chosen.append(best)
    model = models.stack([model, *(pool[number] for number in chosen)])
    return _judged_harmonics(passes, most, len(runs) + _PER_ORDER * len(chosen), model)


def _wave(passes: models.Passes, order: int, run: int) -> tuple[Floats, Floats]:
    """Return the waves of one order in one run, nothing in the others, of both passes."""
    whole = []
    for number, aligned in enumerate(passes.aligned):
        phase = order * aligned.state.angle_rad
        waves = np.stack([np.cos(phase), np.sin(phase)], axis=1)[:, : 2 if order else 1]
        whole.append(waves * float(number == run))
    return passes.both(whole)


def _unseen_by_rung(passes: models.Passes, base: Sequence[Term], rungs: Sequence[models.Rung]) -> list[float]:
    columns = models.stack([passes.columns(term) for term in base])
    unseen_um = []
    for rung in rungs:
        columns = models.stack([columns, passes.columns(rung.term)])
        unseen_um.append(models.unseen_path_um(passes, columns))
    return unseen_um


def _carry_over(passes: models.Passes, base: Sequence[Term], unseen: Sequence[float]) -> int:
    """Return after how many rungs parts of the path that were not fitted are foretold best."""
    columns = models.stack([passes.columns(term) for term in base])
    return int(np.argmin([models.unseen_path_um(passes, columns), *unseen]))


def _rung(rung: models.Rung) -> dict[str, Any]:
    effect = rung.term.instance.effect
    return {
        "label": rung.term.label,
        "shape": dict(rung.term.shape),
        "parameters": rung.parameters,
        "fit_um": rung.fit_um,
        "held_out_um": rung.held_out_um,
        "grade": _GRADES.get(effect.name, "shape-consistent"),
    }


def _alone(passes: models.Passes, base: Sequence[Term], library: Mapping[str, Effect]) -> list[dict[str, Any]]:
    """Return what each family does alone, added to the set-up, at its best shape."""
    state = passes.aligned[0].state
    pool = list(models.candidate_terms(library, state, joints=True, clock=True))
    ringing = [t for t in pool if t.instance.effect is STOP_RINGING]
    near = [t for t in ringing if _ASKED_HZ[0] <= t.shape["frequency_hz"] <= _ASKED_HZ[1]]
    families = {
        "ringing after stops, 9.0 to 9.8 Hz": near,
        "ringing after stops, any frequency": ringing,
        "effects of joints": [t for t in pool if t.instance.effect.per == "joint"],
        "dip within every arc": [t for t in pool if t.instance.effect is ARC_DIP],
    }
    rows = []
    for name, terms in families.items():
        best = models.best_of(passes, base, terms)
        if best is not None:
            term, left = best
            rows.append({"family": name, "label": term.label, "shape": dict(term.shape), "held_out_um": left})
    return rows


def _lines(passes: models.Passes, residual: tuple[Floats, Floats]) -> list[dict[str, Any]]:
    """Return the strongest line above 2 Hz in what is left of every stretch."""
    found, at = [], 0
    for aligned in passes.aligned:
        rate = aligned.run.meta.sample_rate_hz
        for stretch in aligned.stretches:
            n = stretch.end - stretch.first
            part = residual[0][at : at + n]
            at += n
            taper = np.hanning(n)
            spectrum = np.abs(np.fft.rfft((part - part.mean()) * taper, 8 * n))
            frequency = np.fft.rfftfreq(8 * n, 1.0 / rate)
            spectrum[frequency < 2.0] = 0.0
            peak = int(np.argmax(spectrum))
            found.append(
                {
                    "run_id": stretch.run_id,
                    "first": stretch.first,
                    "frequency_hz": float(frequency[peak]),
                    "amplitude_um": float(2.0 * spectrum[peak] / taper.sum()),
                }
            )
    return found


def _plan(rungs: Sequence[models.Rung], passes: models.Passes) -> list[dict[str, Any]]:
    """Return the runs that would confirm or refute the names."""
    meta = passes.aligned[0].run.meta
    assert meta.feed_mm_min is not None
    assert meta.radius_mm is not None
    both = {"directions": ["CCW", "CW"], "repeats": _REPEATS}
    now = {"radius_mm": meta.radius_mm, "feed_mm_min": meta.feed_mm_min, **both}
    names = {r.term.instance.effect.name for r in rungs}
    plan = [
        {**now, "tells": "the noise from run to run: without it no name can be confirmed"},
        {
            **now,
            "feed_mm_min": meta.feed_mm_min / 2.0,
            "tells": "ringing keeps its frequency in Hz, gears and pitches keep their place",
        },
        {
            **now,
            "shift": "stops a quarter turn on",
            "tells": "what the stops excite moves along with them, what belongs to the place stays",
        },
    ]
    if any(name.startswith("joint_") for name in names) or has_joints(passes.aligned[0].state.geometry):
        plan.append(
            {
                **now,
                "shift": "centre 150 mm further from the base",
                "tells": "joints reverse and ripple elsewhere on the circle, axes do not",
            }
        )
    return plan
