"""The displacement as an equation of temperatures, at once or late, that can be served, and what it leaves of recorded logs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from dtwin import __version__
from dtwin.errors import InputError
from dtwin.kinds.drift._data import longest_first
from dtwin.kinds.drift._diagnosis import sensors_of
from dtwin.kinds.drift._model import Fitted, Series, held_out_um, steady
from dtwin.kinds.drift._search import missing
from dtwin.kinds.drift._series import moved_um, series_of
from dtwin.lake.store import Lake
from dtwin.progress import StageProgress, silent
from dtwin.schema import Floats, Run
from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits, State
from dtwin.serve.runtime import CompiledBundle
from dtwin.statistics import rms
from dtwin.train.champion_error import ChampionError, HeldOut, as_served, held_out, require_inputs, require_trained
from dtwin.train.gates import Verdict, slow_gates
from dtwin.train.latency import bundle_latency
from dtwin.train.results import Candidate, Scores, Training, TrainingReport
from dtwin.train.symbolic import Engine

_HELD_OUT = "stretches"
_BEYOND_C = 2.0
_CLAMP_SHARE = 1.25
_TIME, _LAST = "timestamp_s", "last_s"
_RATE_HZ = 1.0
# Of what may be asked for without a word: a stretch that hardly moved cannot be made better.
_STILL = 0.25


def obstacle(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return why rows of the lake cannot train an equation, or nothing."""
    return "" if len(_axes(str(row["condition_json"]) for row in rows)) == 1 else _NO_AXIS


_NO_AXIS = 'no run, or not each, states which axis moved: condition = { axis = "Z" }'


def train_drift(
    lake: Lake, name: str, *, seed: int = 1, engine: Engine | None = None, progress: StageProgress = silent
) -> Training:
    """Train equations on the longest sound log, judged by stretches of time that were left out, and told on the others.

    ``seed``: logged; nothing here is random.
    ``engine``: not used: the forms are given.
    """
    campaign, versions = lake.campaign(name), dict(lake.versions())
    rows = [r for r in lake.runs(name) if r["n_errors"] == 0]
    axes = _axes(str(row["condition_json"]) for row in rows)
    if len(axes) != 1:
        raise InputError(
            "the logs do not say which axis moved",
            code="train.axis",
            where=f"campaign {name}",
            got=", ".join(sorted(axes)) or "no axis",
            allowed='condition = { axis = "Z" } in every [[run]], the same one',
        )
    runs = longest_first([lake.load(row) for row in rows])
    series = series_of(runs[0])
    base = steady(series)
    progress("candidates", 1, 2, "temperatures at once")
    steps = missing(series, base)
    if not base.terms and not steps:
        raise InputError(
            "no temperature of the log says anything of what moved",
            code="train.nothing",
            where=f"campaign {name}, log {runs[0].meta.run_id}",
            got=f"{np.std(series.moved_um):z.2f} µm RMS, sensors {', '.join(sensors_of(series))}",
            allowed="a displacement that follows a temperature",
            hint="dtwin check tells what is in the log",
        )
    progress("candidates", 2, 2, "what that lacks")
    forms = {"temperatures at once": base, **({"temperatures late": steps[-1].fitted} if steps else {})}
    (axis,) = axes
    made = [log_candidate(title, form, series, campaign.machine, axis, versions) for title, form in forms.items()]
    candidates = sorted([_zero(series), *made], key=lambda c: c.held_out.rms_um)
    report = TrainingReport(
        machine=campaign.machine,
        campaign=name,
        table_versions=versions,
        noise_floor_um=series.floor_um,
        rms_before_um=rms(moved_since(series)),
        n_runs=len(runs),
        n_rows=len(series.t_s),
        candidates=tuple(candidates),
        proposed=min((c for c in candidates if c.promotable), key=lambda c: c.held_out.rms_um).name,
        seed=seed,
        told=tuple(_told(runs, forms)),
        floor_is="what readings of one sample differ by",
    )
    return Training(report, campaign.machine_geometry, ((name, 0.0, 0.0),))


def drift_gates(bundle: Bundle, metrics: Mapping[str, float]) -> list[Verdict]:
    """Judge a bundle by everything that needs no other log."""
    return slow_gates(bundle, metrics, _HELD_OUT, "stretches of time")


def _drift_bundle(
    model: Fitted, series: Series, name: str, machine: str, axis: str, table_versions: Mapping[str, int]
) -> Bundle:
    """Return the error of an axis from what its sensors read: zero where the log began.

    A lag goes on by the time stamps of the machine's states, whatever their rate; it begins as if the temperatures had
    long stood still.
    """
    builder = GraphBuilder()
    late = [term for term in model.terms if term.kind.startswith("lag")]
    states: list[State] = []
    updates: dict[str, Expression] = {}
    if late:
        now = builder.input(_TIME)
        gap = builder.apply("max", now - builder.state(_LAST), 0.0)
        states.append(State(_LAST, "s", -1e9))
        updates[_LAST] = now
    parts: list[Expression | float] = []
    for term, value in zip(model.terms, model.value[1:].tolist(), strict=True):
        read = builder.input(term.channel)
        for number in range({"lag": 1, "lag2": 2}.get(term.kind, 0)):
            kept = f"{term.channel.removesuffix('_c')}_{number + 1}_c"
            before = builder.state(kept)
            share = 1.0 - builder.apply("exp", gap * (-1.0 / term.tau_s))
            read = before + share * (read - before)
            states.append(State(kept, "degC", 0.0))
            updates[kept] = read
        if term.kind == "curve":
            read = builder.apply("square", read - float(series.temperatures_c[term.channel].mean()))
        parts.append((read - float(series.column(term)[0])) * value)
    output = f"error_{axis.lower()}_um"
    graph = builder.graph({output: builder.total(parts or [0.0])}, updates)
    channels = sorted({term.channel for term in model.terms})
    inputs = [_input(channel, series.temperatures_c[channel]) for channel in channels]
    if late:
        inputs.append(Input(_TIME, "s", "none", _RATE_HZ, "controller", 0.0, 1e11))
    largest = float(np.abs(moved_since(series)).max())
    return create_bundle(
        corrects="drift",
        name=name.replace(" ", "-"),
        machine=machine,
        model_version=0,
        inputs=inputs,
        outputs=[Output(output, f"base_{axis.lower()}")],
        tick_graph=graph,
        states=states,
        safety=SafetyLimits(max(1.0, _CLAMP_SHARE * largest), 100.0, 0.1, outside="shrink", shrink_span=0.25),
        provenance=Provenance(code_version=__version__, table_versions=dict(table_versions)),
    )


def _input(channel: str, values: Floats) -> Input:
    low, high = float(values.min()) - _BEYOND_C, float(values.max()) + _BEYOND_C
    return Input(channel, "degC", "none", _RATE_HZ, "covariate", low, high)


def log_candidate(
    title: str, model: Fitted, series: Series, machine: str, axis: str, table_versions: Mapping[str, int]
) -> Candidate:
    """Return a model of a log as an equation, judged by stretches of time that were left out of its fit."""
    bundle = _drift_bundle(model, series, title, machine, axis, table_versions) if model.terms else None
    equation = " ".join(f"{v:+.4g} µm/K {t.label}" for t, v in zip(model.terms, model.value[1:], strict=True))
    return Candidate(
        name=title,
        family="symbolic",
        promotable=bundle is not None,
        complexity=0 if bundle is None else len(bundle.tick_graph.nodes),
        scores={_HELD_OUT: _scores(series, held_out_um(series, model.terms))},
        train_rms_um=model.left_um,
        latency=None if bundle is None else bundle_latency(bundle),
        equation=equation,
        bundle=None if bundle is None else bundle.to_dict(),
    )


def _zero(series: Series) -> Candidate:
    moved = moved_since(series)
    return Candidate("zero", "baseline", False, 0, {_HELD_OUT: _scores(series, moved)}, rms(moved))


def moved_since(series: Series) -> Floats:
    """Return how far the place has moved since the log began."""
    return series.moved_um - float(series.moved_um[series.t_s == series.t_s[0]].mean())


def _scores(series: Series, left: Floats) -> Scores:
    moved = moved_since(series)
    usual = rms(moved)
    ratios = {}
    for block in np.unique(series.block):
        here = series.block == block
        was = rms(moved[here])
        if was > _STILL * usual:
            begun = series.t_s[here][0] / 3600.0
            ratios[f"from {begun:z.1f} h"] = rms(left[here]) / was
    worst = max(ratios, key=lambda where: ratios[where]) if ratios else ""
    r2 = 1.0 - float((left**2).sum() / ((moved - moved.mean()) ** 2).sum())
    blocks = int(series.block.max()) + 1
    return Scores(_HELD_OUT, r2, rms(left), float(np.mean(np.abs(left))), ratios.get(worst, 0.0), worst, blocks, 1)


def _told(runs: Sequence[Run], forms: Mapping[str, Fitted]) -> Iterator[str]:
    yield f"fitted to {runs[0].meta.run_id}, the longest log; each of its stretches of time was left out in turn"
    yield "a lag begins anew, as if temperatures had long stood still, after a restart and where segment_id falls"
    best = min(forms.values(), key=lambda model: model.held_out_um)
    for run in runs[1:]:
        other = series_of(run)
        if all(term.channel in other.temperatures_c for term in best.terms):
            foretold = sum(v * other.column(t) for t, v in zip(best.terms, best.value[1:], strict=True))
            left = other.moved_um - np.asarray(foretold)
            kept = float(np.std(left) / np.std(other.moved_um))
            yield f"of log {run.meta.run_id}, which was not fitted, {100 * kept:z.0f} % of the motion is left"


def _axes(conditions: Iterable[str]) -> set[str]:
    told = {str(json.loads(text).get("axis", "")).upper() for text in conditions}
    return told if told <= {"X", "Y", "Z"} else set()


_TIME_NAME = "timestamp_s"
_FRAMES = ("base_x", "base_y", "base_z")


def logs_error(lake: Lake, rows: Sequence[dict[str, Any]], bundle: Bundle, *_: object) -> ChampionError:
    """Return a bundle's error over all readings; each log begins at its own zero, and its lags begin anew."""
    runs = [lake.load(row) for row in rows]
    known = set.intersection(*({n for n in run.samples if n.startswith("temperature_")} for run in runs))
    require_inputs(bundle, (*known, _TIME_NAME), _FRAMES, "temperatures that every log has, and one axis")
    axis = bundle.outputs[0].frame[-1].upper()
    require_trained([{"condition_json": json.dumps({"axis": axis})}], rows, "axis")
    before, after, outside = zip(*(_left(bundle, run) for run in runs), strict=True)
    floors = [series_of(run).floor_um for run in runs]
    return ChampionError(
        rms_um=rms(np.concatenate(after)),
        before_um=rms(np.concatenate(before)),
        noise_floor_um=rms(np.array(floors)),
        outside_box_share=float(np.mean(np.concatenate(outside))),
        n_runs=len(runs),
    )


def logs_held_out(known: Sequence[Mapping[str, Any]], fresh: Sequence[Mapping[str, Any]]) -> HeldOut:
    """Return the error to be expected: with stretches of time left out, of the axis that was trained."""
    require_trained(known, fresh, "axis")
    return held_out(_HELD_OUT)


def _left(bundle: Bundle, run: Run) -> tuple[Floats, Floats, Any]:
    """Return what a log moves since it began, without and with the bundle, and where it was outside its range."""
    told = {name: np.asarray(values, float) for name, values in run.samples.items() if name.startswith("temperature_")}
    told[_TIME_NAME] = 1e9 + run.samples["t_s"]
    asked = CompiledBundle(bundle).run(np.column_stack([told[name] for name in bundle.tick_inputs]))[:, 0]
    sent, outside = as_served(bundle, told, asked)
    first = run.samples["t_s"] == run.samples["t_s"][0]
    moved = moved_um(run)
    left = moved - sent
    return moved - moved[first].mean(), left - left[first].mean(), outside
