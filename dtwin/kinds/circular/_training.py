"""One training: from a campaign in the lake to candidates, compared and registered: the fitted physics library, symbolic regression."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning

from dtwin import __version__
from dtwin.errors import InputError
from dtwin.features.path_inputs import PATH_INPUT_UNITS, PATH_INPUTS
from dtwin.kinds.circular._library import Library, equation_text, weighted_sum
from dtwin.kinds.circular._physics_fit import (
    DEAD_SHARE,
    PhysicsFit,
    fit_physics,
    leave_out,
    predicted_fresh,
    predicted_left_out,
)
from dtwin.kinds.circular._term_columns import TermColumns
from dtwin.lake.store import Lake
from dtwin.progress import StageProgress, silent
from dtwin.schema import Floats
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.graph_code import to_c, to_latex, to_python, to_text
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits, State
from dtwin.train.campaign_rows import Rows, gather, noise_floor_um, thinned
from dtwin.train.comparison_models import RECIPES, Recipe, baselines, held_out_groups, score, train_recipe
from dtwin.train.dataset import TICK_HZ, load_ticks
from dtwin.train.formula import unit_findings
from dtwin.train.inputs import generic_inputs
from dtwin.train.latency import latency_of
from dtwin.train.results import FRESH_RUN, Candidate, Scores, Training, TrainingReport
from dtwin.train.side_by_side import side_by_side
from dtwin.train.symbolic import SUBSAMPLE, Engine, FittedFormula, OperonEngine, refit
from dtwin.units import shown_number

# Comparison models look at fewer rows than the physics library, to be ready in seconds.
_COMPARED_EVERY = 6


def train_campaign(
    lake: Lake,
    name: str,
    *,
    seed: int = 1,
    engine: Engine | None = None,
    recipes: Sequence[Recipe] = RECIPES,
    progress: StageProgress = silent,
) -> Training:
    """Train every candidate on a campaign.

    Runs with a data-quality error are left out. The versions of the tables are recorded, so
    that the same rows can be read again.

    ``engine``: free symbolic search; Operon by default.
    """
    campaign = lake.campaign(name)
    rows_ = [r for r in lake.runs(name) if r["n_errors"] == 0 and r["status"] == "complete"]
    if len({r["feed_mm_min"] for r in rows_}) < 2:
        raise InputError(
            "a model cannot be judged on one feed",
            code="train.grid",
            where=f"campaign {name}",
            got=f"{len(rows_)} usable runs",
            hint="measure at least two feeds; dtwin plan --check says what a plan cannot tell",
        )
    versions = dict(lake.versions())
    geometry = campaign.machine_geometry
    horizon_s = float(geometry.get("correction_delay_s", 0.0))
    runs = load_ticks(lake, campaign, rows_, lambda d, n, w: progress("align runs", d, n, w))
    rows, columns = gather(runs), TermColumns(runs)
    compared = thinned(rows, _COMPARED_EVERY)
    with warnings.catch_warnings(), side_by_side() as (pool, step):
        # A comparison model that has not converged is judged as it is.
        warnings.simplefilter("ignore", ConvergenceWarning)
        whole = pool.submit(fit_physics, rows, columns, step)
        folds = leave_out(rows, held_out_groups(rows), columns, pool, step)
        symbolic = pool.submit(
            _symbolic_candidate,
            compared,
            engine or OperonEngine(),
            campaign.machine,
            seed=seed,
            table_versions=versions,
        )
        inputs = generic_inputs(compared)
        usable = [r for r in recipes if r.columns != "sensor" or inputs.sensor.any()]
        jobs = [pool.submit(train_recipe, compared, inputs, recipe, seed) for recipe in usable]
        left_out = predicted_left_out(
            folds, lambda d, n, w: progress("fit the whole, and without what is predicted", d, n, w)
        )
        fit = whole.result()
        scores = {group: score(rows, predicted, group) for group, predicted in left_out.items()}
        fresh_um = score(rows, predicted_fresh(fit), "run_id").rms_um
        floor, freedom = noise_floor_um(rows)
        candidates = baselines(compared)
        for done, (job, recipe) in enumerate(zip(jobs, usable, strict=True), start=1):
            candidates.append(job.result())
            progress("comparison models", done, len(usable), recipe.name)
        candidates.append(symbolic.result())
    candidates.append(
        _physics_candidate(fit, scores, fresh_um, campaign.machine, horizon_s=horizon_s, table_versions=versions)
    )
    # With nothing else running: what a model takes is a matter of microseconds.
    candidates = [replace(c, latency=latency_of(c)) for c in candidates]
    candidates.sort(key=lambda c: c.held_out.rms_um)
    report = TrainingReport(
        machine=campaign.machine,
        campaign=name,
        table_versions=versions,
        noise_floor_um=floor,
        noise_floor_dof=freedom,
        rms_before_um=rows.rms_um(rows.target_um),
        n_runs=len(runs),
        n_rows=rows.n,
        candidates=tuple(candidates),
        proposed=_proposed(candidates),
        seed=seed,
    )
    trained = sorted({(r["plane"], r["radius_mm"], r["feed_mm_min"]) for r in rows_})
    return Training(report, geometry, tuple(trained))


def _proposed(candidates: Sequence[Candidate]) -> str:
    """Return the promotable candidate with the smallest held-out error."""
    promotable = [c for c in candidates if c.promotable]
    return min(promotable, key=lambda c: c.held_out.rms_um).name


_BOX_MARGIN = 0.02


def _physics_candidate(
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
        f"{fit.library.names[i]} contributes {shown_number(100 * s, 2)} % of the error's spread: nearly constant or never firing"
        for i, s in zip(fit.chosen, share, strict=True)
        if s < DEAD_SHARE
    ]


# What a short formula could use: angles, senses, speed, time. Levers and unit vectors are left
# to the physics library.
_INPUTS = (
    "path_angle_rad",
    "direction_sign",
    "q1_rad",
    "q2_rad",
    "q3_rad",
    "q4_rad",
    "qd1_rad_s",
    "qd2_rad_s",
    "qd3_rad_s",
    "commanded_speed_mm_s",
    "segment_time_s",
    "radial_x_1",
    "radial_y_1",
    "radial_z_1",
)
_REFIT_ROWS = 6000
# Of the largest prediction: what the bundle clamps to, and what a formula is judged with.
_CLAMP_MARGIN = 1.25


def _symbolic_candidate(
    rows: Rows, engine: Engine, machine: str, *, seed: int, table_versions: dict[str, int]
) -> Candidate:
    """Search on a subsample, refit every constant, and propose the formula of the front's elbow.

    The scores are those of formulas that were searched, chosen and refitted without what they
    predict.
    """
    columns = _columns(rows)
    fitted = _searched(rows, columns, np.ones(rows.n, dtype=bool), engine, seed)
    best = _elbow(fitted)
    scores = {}
    for group in held_out_groups(rows):
        predicted = np.zeros(rows.n)
        for inside, outside in rows.folds(group):
            again = _elbow(_searched(rows.blind(inside), columns, inside, engine, seed))
            values = again.formula.values(columns, again.constants) + np.zeros(rows.n)
            most = _CLAMP_MARGIN * np.abs(values[inside & rows.scored]).max()
            predicted[outside] = np.clip(np.nan_to_num(values[outside]), -most, most)
        scores[group] = score(rows, predicted, group)
    rest = rows.target_um - np.broadcast_to(best.formula.values(columns, best.constants), rows.n)
    bundle = _bundle(rows, best, engine.name, machine, table_versions)
    graph = bundle.tick_graph
    units = unit_findings(best.formula, PATH_INPUT_UNITS)
    return Candidate(
        name=f"symbolic-{engine.name}",
        family="symbolic",
        promotable=True,
        complexity=len(graph.nodes),
        scores=scores,
        train_rms_um=rows.rms_um(rows.without_setups(rest)),
        equation=to_text(graph),
        exports={
            "equation.txt": to_text(graph),
            "equation.tex": to_latex(graph),
            "equation.py": to_python(graph),
            "equation.c": to_c(graph, bundle.tick_inputs, (), ("radial_um",)),
        },
        bundle=bundle.to_dict(),
        findings=tuple(f"units: {finding}" for finding in units),
        front=tuple({"nodes": f.complexity, "rms_um": f.rms} for f in fitted),
    )


def _searched(
    rows: Rows, columns: Mapping[str, Floats], inside: NDArray[np.bool_], engine: Engine, seed: int
) -> list[FittedFormula]:
    """Return the front of a search over some rows, constants refitted on more of them."""
    rng = np.random.default_rng(seed)
    usable = np.flatnonzero(inside & rows.scored)
    some = rng.choice(usable, min(SUBSAMPLE, usable.size), replace=False)
    more = rng.choice(usable, min(_REFIT_ROWS, usable.size), replace=False)
    formulas = engine.search({n: c[some] for n, c in columns.items()}, rows.target_um[some], seed)
    return refit(formulas, {n: c[more] for n, c in columns.items()}, rows.target_um[more])


def _columns(rows: Rows) -> dict[str, Floats]:
    table = np.concatenate([run.inputs[run.arc] for run in rows.runs]).astype(float)
    return {name: table[:, PATH_INPUTS.index(name)] for name in _INPUTS}


def _elbow(fitted: list[FittedFormula]) -> FittedFormula:
    """Return the smallest formula within two per cent of the best one."""
    limit = 1.02 * min(f.rms for f in fitted)
    return min((f for f in fitted if f.rms <= limit), key=lambda f: f.complexity)


def _bundle(rows: Rows, best: FittedFormula, engine: str, machine: str, table_versions: dict[str, int]) -> Bundle:
    builder = GraphBuilder()
    graph = builder.graph({"radial_um": best.formula.build(builder, best.constants.tolist())})
    columns = _columns(rows)
    inputs = [
        Input(n, PATH_INPUT_UNITS[n], "path", TICK_HZ, "path", float(c.min()), float(c.max()))
        for n, c in columns.items()
        if n in graph.inputs
    ]
    predicted = np.abs(best.formula.values(columns, best.constants))
    return create_bundle(
        corrects="circular",
        name=f"symbolic-{engine}",
        machine=machine,
        model_version=0,
        inputs=inputs,
        outputs=[Output("radial_um", "path_radial", "error")],
        tick_graph=graph,
        safety=SafetyLimits(clamp_um=max(1.0, min(500.0, _CLAMP_MARGIN * float(predicted.max())))),
        provenance=Provenance(code_version=__version__, table_versions=dict(table_versions)),
    )
