"""Free symbolic regression as a candidate."""

from __future__ import annotations

import numpy as np

from dtwin import __version__
from dtwin.features.motion import PATH_INPUT_UNITS, PATH_INPUTS
from dtwin.schema import Floats
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.export import to_c, to_latex, to_python, to_text
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits
from dtwin.train.candidates import HELD_OUT, folds, score
from dtwin.train.dataset import TICK_HZ
from dtwin.train.formula import unit_findings
from dtwin.train.latency import bundle_latency
from dtwin.train.results import Candidate
from dtwin.train.rows import Rows
from dtwin.train.symbolic import SUBSAMPLE, Engine, FittedFormula, refit

# What a short formula could use: angles, senses, speed, time. Levers and unit vectors are left
# to the physics library.
INPUTS = (
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


def symbolic_candidate(
    rows: Rows, engine: Engine, machine: str, *, seed: int, table_versions: dict[str, int]
) -> Candidate:
    """Search on a subsample, refit every constant, and propose the formula of the front's elbow.

    Parameters
    ----------
    rows : Rows
        Rows of a campaign.
    engine : Engine
        Search engine.
    machine : str
        Machine that the bundle is for.
    seed : int
        Seed of search and subsample.
    table_versions : dict of str to int
        Versions of the lake's tables.
    """
    rng = np.random.default_rng(seed)
    scored = np.flatnonzero(rows.scored)
    some = rng.choice(scored, min(SUBSAMPLE, scored.size), replace=False)
    more = rng.choice(scored, min(_REFIT_ROWS, scored.size), replace=False)
    columns = _columns(rows)
    found = engine.search({n: c[some] for n, c in columns.items()}, rows.target_um[some], seed)
    fitted = refit(found, {n: c[more] for n, c in columns.items()}, rows.target_um[more])
    best = _elbow(fitted)
    scores = {}
    for group in HELD_OUT:
        predicted = np.zeros(rows.n)
        for inside, outside in folds(rows, group):
            train = more[inside[more]]
            again = refit(
                [f for f in found if f.complexity == found[fitted.index(best)].complexity][:1],
                {n: c[train] for n, c in columns.items()},
                rows.target_um[train],
            )
            model = again[0] if again else best
            values = model.formula.values(
                {n: c[outside] for n, c in columns.items()}, model.constants
            )
            predicted[outside] = np.nan_to_num(values)
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
        latency=bundle_latency(bundle),
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


def _columns(rows: Rows) -> dict[str, Floats]:
    table = np.concatenate([run.inputs[run.arc] for run in rows.runs]).astype(float)
    return {name: table[:, PATH_INPUTS.index(name)] for name in INPUTS}


def _elbow(fitted: list[FittedFormula]) -> FittedFormula:
    """Return the smallest formula within two per cent of the best one."""
    limit = 1.02 * min(f.rms for f in fitted)
    return min((f for f in fitted if f.rms <= limit), key=lambda f: f.complexity)


def _bundle(
    rows: Rows, best: FittedFormula, engine: str, machine: str, table_versions: dict[str, int]
) -> Bundle:
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
        name=f"symbolic-{engine}",
        machine=machine,
        model_version=0,
        inputs=inputs,
        outputs=[Output("radial_um", "path_radial", "error")],
        tick_graph=graph,
        safety=SafetyLimits(clamp_um=max(1.0, min(500.0, 1.25 * float(predicted.max())))),
        provenance=Provenance(code_version=__version__, table_versions=dict(table_versions)),
    )
