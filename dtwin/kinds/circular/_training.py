"""One training: from a campaign in the lake to candidates, compared and registered."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

from sklearn.exceptions import ConvergenceWarning

from dtwin.errors import InputError
from dtwin.kinds.circular._physics_candidate import physics_candidate, symbolic_candidate
from dtwin.kinds.circular._term_columns import TermColumns
from dtwin.kinds.circular.physics_fit import fit_physics, leave_out, predicted_fresh, predicted_left_out
from dtwin.lake.store import Lake
from dtwin.progress import StageProgress
from dtwin.train.candidates import RECIPES, Recipe, baselines, held_out_groups, score, train_recipe
from dtwin.train.dataset import load_ticks
from dtwin.train.inputs import generic_inputs
from dtwin.train.latency import latency_of
from dtwin.train.results import Candidate, Training, TrainingReport
from dtwin.train.rows import gather, noise_floor_um, thinned
from dtwin.train.side_by_side import side_by_side
from dtwin.train.symbolic import Engine, OperonEngine

# Comparison models look at fewer rows than the physics library, to be ready in seconds.
_COMPARED_EVERY = 6


def train_campaign(
    lake: Lake,
    name: str,
    *,
    seed: int = 1,
    engine: Engine | None = None,
    recipes: Sequence[Recipe] = RECIPES,
    progress: StageProgress | None = None,
) -> Training:
    """Train every candidate on a campaign.

    Runs with a data-quality error are left out. The versions of the tables are recorded, so
    that the same rows can be read again.

    ``engine``: free symbolic search; Operon by default.
    """
    tell = progress or (lambda *_: None)
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
    runs = load_ticks(lake, campaign, rows_, lambda d, n, w: tell("align runs", d, n, w))
    rows, columns = gather(runs), TermColumns(runs)
    compared = thinned(rows, _COMPARED_EVERY)
    with warnings.catch_warnings(), side_by_side() as (pool, step):
        # A comparison model that has not converged is judged as it is.
        warnings.simplefilter("ignore", ConvergenceWarning)
        whole = pool.submit(fit_physics, rows, columns, step)
        folds = leave_out(rows, held_out_groups(rows), columns, pool, step)
        symbolic = pool.submit(
            symbolic_candidate, compared, engine or OperonEngine(), campaign.machine, seed=seed, table_versions=versions
        )
        inputs = generic_inputs(compared)
        usable = [r for r in recipes if r.columns != "sensor" or inputs.sensor.any()]
        jobs = [pool.submit(train_recipe, compared, inputs, recipe, seed) for recipe in usable]
        left_out = predicted_left_out(
            folds, lambda d, n, w: tell("fit the whole, and without what is predicted", d, n, w)
        )
        fit = whole.result()
        scores = {group: score(rows, predicted, group) for group, predicted in left_out.items()}
        fresh_um = score(rows, predicted_fresh(fit), "run_id").rms_um
        floor, freedom = noise_floor_um(rows)
        found = baselines(compared)
        for done, (job, recipe) in enumerate(zip(jobs, usable, strict=True), start=1):
            found.append(job.result())
            tell("comparison models", done, len(usable), recipe.name)
        found.append(symbolic.result())
    found.append(
        physics_candidate(fit, scores, fresh_um, campaign.machine, horizon_s=horizon_s, table_versions=versions)
    )
    # With nothing else running: what a model takes is a matter of microseconds.
    found = [replace(c, latency=latency_of(c)) for c in found]
    found.sort(key=lambda c: c.held_out.rms_um)
    report = TrainingReport(
        machine=campaign.machine,
        campaign=name,
        table_versions=versions,
        noise_floor_um=floor,
        noise_floor_dof=freedom,
        rms_before_um=rows.rms_um(rows.target_um),
        n_runs=len(runs),
        n_rows=rows.n,
        candidates=tuple(found),
        proposed=_proposed(found),
        seed=seed,
    )
    trained = sorted({(r["plane"], r["radius_mm"], r["feed_mm_min"]) for r in rows_})
    return Training(report, geometry, tuple(trained), fit)


def _proposed(candidates: Sequence[Candidate]) -> str:
    """Return the promotable candidate with the smallest held-out error."""
    promotable = [c for c in candidates if c.promotable]
    return min(promotable, key=lambda c: c.held_out.rms_um).name
