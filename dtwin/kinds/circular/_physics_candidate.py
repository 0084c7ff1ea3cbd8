"""The fitted physics library as a candidate: scores, bundle, exports, latency."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dtwin import __version__
from dtwin.features.motion import PATH_INPUT_UNITS, PATH_INPUTS
from dtwin.kinds.circular._library import Library, equation_text, weighted_sum
from dtwin.kinds.circular.physics_fit import DEAD_SHARE, PhysicsFit
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.export import to_c, to_latex, to_python
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits, State
from dtwin.train.dataset import TICK_HZ
from dtwin.train.results import FRESH_RUN, Candidate, Scores
from dtwin.train.rows import Rows

_BOX_MARGIN = 0.02


def physics_candidate(
    fit: PhysicsFit,
    scores: Mapping[str, Scores],
    fresh_run_um: float,
    machine: str,
    *,
    horizon_s: float,
    table_versions: dict[str, int],
) -> Candidate:
    """Return the proposed equation of a physics fit.

    ``scores``: of equations that were found and fitted without what they predict.
    ``fresh_run_um``: error to expect of a fresh run of a trained condition.
    ``horizon_s``: known delay between a correction and the motion it causes; the equation looks as far ahead along the
    commanded motion.
    ``table_versions``: versions of the lake's tables, for the bundle's provenance.
    """
    design = fit.design[:, list(fit.chosen)]
    rest = fit.rows.target_um - design @ fit.weights
    names = [fit.library.names[i] for i in fit.chosen]
    weights = dict(zip(names, fit.weights.tolist(), strict=True))
    bundle = _physics_bundle(fit, machine, horizon_s=horizon_s, table_versions=table_versions)
    graph = bundle.tick_graph
    return Candidate(
        name="physics-library",
        family="symbolic",
        promotable=True,
        complexity=len(graph.nodes),
        scores=scores,
        train_rms_um=fit.rows.rms_um(rest),
        equation=equation_text(fit.library, weights),
        exports={
            "equation.txt": equation_text(fit.library, weights),
            "equation.tex": to_latex(graph),
            "equation.py": to_python(graph),
            "equation.c": to_c(graph, bundle.tick_inputs, tuple(bundle.initial_state), ("radial_um",)),
        },
        bundle=bundle.to_dict(),
        findings=tuple(_findings(fit, design)),
        front=tuple(vars(point) for point in fit.front),
        numbers={
            "terms": float(len(fit.chosen)),
            FRESH_RUN: fresh_run_um,
            "alignment_shift_ms": 1000.0 * fit.lag_shift_s,
            "horizon_ms": 1000.0 * horizon_s,
        },
    )


def _physics_bundle(fit: PhysicsFit, machine: str, *, horizon_s: float, table_versions: dict[str, int]) -> Bundle:
    """Freeze the chosen terms into a bundle. ``horizon_s``: how far joint angles are taken ahead."""
    library = Library(fit.library.gears, fit.library.modes, horizon_s=horizon_s)
    terms = list(library.atoms.values())
    chosen = zip(fit.weights.tolist(), (terms[i] for i in fit.chosen), strict=True)
    outputs = {"radial_um": weighted_sum(library.builder, list(chosen))}
    live = library.live_states(outputs)
    graph = library.builder.graph(outputs, {k: library.updates[k] for k in live})
    low, high = _box(fit.rows)
    used = set(graph.inputs)
    inputs = [
        Input(n, PATH_INPUT_UNITS[n], "path", TICK_HZ, "path", float(low[i]), float(high[i]))
        for i, n in enumerate(PATH_INPUTS)
        if n in used
    ]
    largest, steepest = _extent(fit)
    return create_bundle(
        corrects="circular",
        name="physics-library",
        machine=machine,
        model_version=0,
        inputs=inputs,
        outputs=[Output("radial_um", "path_radial", "error")],
        tick_graph=graph,
        states=[State(k, _state_unit(k), library.initial[k]) for k in live],
        safety=SafetyLimits(clamp_um=1.25 * largest, slew_um_s=max(2000.0, 2.0 * steepest)),
        provenance=Provenance(code_version=__version__, table_versions=dict(table_versions)),
    )


def _state_unit(name: str) -> str:
    if name.startswith("flank"):
        return "rad"
    return "1" if name.startswith("was") else "m/min"


def _box(rows: Rows) -> tuple[Floats, Floats]:
    """Return the validity box: what the controller did in training, a little widened."""
    low = np.min([run.inputs.min(axis=0) for run in rows.runs], axis=0).astype(float)
    high = np.max([run.inputs.max(axis=0) for run in rows.runs], axis=0).astype(float)
    # An input that never moved still has rounding errors of its own.
    margin = _BOX_MARGIN * (high - low) + 1e-6 * np.maximum(1.0, np.abs(high))
    low, high = low - margin, high + margin
    # What rings grows with the feed from zero: between standstill and the slowest trained feed
    # the equation interpolates.
    low[PATH_INPUTS.index("programmed_feed_mm_min")] = 0.0
    low[PATH_INPUTS.index("commanded_speed_mm_s")] = -1.0
    return low, high


def _extent(fit: PhysicsFit) -> tuple[float, float]:
    """Return the largest predicted error in um and its steepest change in um/s."""
    # Zero for the terms that are not chosen: columns of them would be copies of nearly everything.
    every = np.zeros(fit.design.shape[1])
    every[list(fit.chosen)] = fit.weights
    predicted = fit.design @ every + fit.absorbed @ every
    same_run = np.diff(fit.rows.of_run) == 0
    ticks = np.concatenate([run.arc for run in fit.rows.runs])
    dt_s = np.diff(ticks) / TICK_HZ
    slope = np.abs(np.diff(predicted)[same_run] / dt_s[same_run])
    return float(np.abs(predicted).max()), float(np.quantile(slope, 0.9999))


def _findings(fit: PhysicsFit, design: Floats) -> list[str]:
    """Say which terms do nothing."""
    share = np.std(design, axis=0) * np.abs(fit.weights) / max(float(np.std(fit.rows.target_um)), 1e-12)
    return [
        f"{fit.library.names[i]} contributes {100 * s:.2g} % of the error's spread: nearly constant or never firing"
        for i, s in zip(fit.chosen, share, strict=True)
        if s < DEAD_SHARE
    ]
