"""Free symbolic regression as a candidate."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from dtwin import __version__
from dtwin.features.motion import PATH_INPUT_UNITS, PATH_INPUTS
from dtwin.schema import Floats
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.export import to_c, to_latex, to_python, to_text
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits
from dtwin.train.candidates import held_out_groups, score
from dtwin.train.dataset import TICK_HZ
from dtwin.train.formula import unit_findings
from dtwin.train.results import Candidate
from dtwin.train.rows import Rows
from dtwin.train.symbolic import SUBSAMPLE, Engine, FittedFormula, refit

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


def symbolic_candidate(
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
