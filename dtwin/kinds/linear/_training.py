"""One training on a positioning campaign: tables and networks, judged by runs that were left out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dtwin.errors import InputError
from dtwin.kinds.linear._bundle import ROOM_MM, Flanks, deployed_bundle, flanks_bundle, flanks_of
from dtwin.kinds.linear._gates import positioning_gates, screw_metrics
from dtwin.kinds.linear._judging import HELD_OUT, explained_share, noise_floor_um, scores_of, stacked, without_run
from dtwin.kinds.linear._models import (
    MM_PER_IN,
    Averages,
    Bidirectional,
    DualNet,
    PositionModel,
    Uncorrected,
    Unidirectional,
    averages_of,
    fit_dual,
)
from dtwin.lake.store import Lake
from dtwin.positioning.check import phases_of
from dtwin.positioning.matrix import LinearTest, linear_test
from dtwin.progress import StageProgress, silent
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.graph_code import to_text
from dtwin.statistics import rms
from dtwin.train.latency import bundle_latency
from dtwin.train.results import Candidate, Training, TrainingReport
from dtwin.train.symbolic import Engine

_TABLE = "table and backlash"
_FEWEST_RUNS = 2
_FEWEST_PHASES, _FEWEST_TURNS = 5, 8
_MOST_ORDERS = 5
# As published, for 157 whole turns; a neuron of the slow network needs five of them.
_NEURONS, _FEWEST_NEURONS, _TURNS_PER_NEURON = (30, 8), 3, 5
_Family = Literal["baseline", "neural", "symbolic"]
_FAMILIES: dict[str, _Family] = {"pair": "neural", "flanks": "symbolic"}


@dataclass(frozen=True)
class _Screw:
    """What the targets of a campaign show of a screw."""

    pitch_mm: float
    reach_mm: tuple[float, float]
    phases: int


def screw_of(test: LinearTest, where: str) -> _Screw:
    """Return what a test shows of the screw."""
    if not test.pitch_mm or len(test.position_mm) < 2:
        scale = test.pitch_mm == 0.0
        raise InputError(
            "these equations are of a screw, and a linear scale measures the axis"
            if scale
            else "the pitch of the screw is needed",
            code="lathe.pitch",
            where=where,
            got="screw_pitch_mm = 0" if scale else "",
            hint="dtwin twin correct makes a correction of its twin, without a screw"
            if scale
            else "screw_pitch_mm under [campaign.machine_geometry]",
        )
    averages = averages_of(test)
    phases = phases_of(test.position_mm, test.pitch_mm)
    turns = len(averages.every(test.pitch_mm).position_mm)
    if phases < _FEWEST_PHASES or turns < _FEWEST_TURNS:
        raise InputError(
            "the targets do not show the screw",
            code="lathe.targets",
            where=where,
            got=f"{phases} angles of the screw, {turns} targets at whole turns",
            allowed=f"at least {_FEWEST_PHASES} angles and {_FEWEST_TURNS} whole turns",
            hint="a step of a tenth of the pitch: dtwin plan says what a step can show",
        )
    ends = float(averages.position_mm[0]), float(averages.position_mm[-1])
    return _Screw(test.pitch_mm, ends, phases)


def fit_pair(averages: Averages, screw: _Screw, seed: int) -> DualNet:
    """Train the published pair, with fewer neurons where the screw makes few turns. ``averages``: mean errors."""
    turns = len(averages.every(screw.pitch_mm).position_mm)
    slow = min(_NEURONS[0], max(_FEWEST_NEURONS, turns // _TURNS_PER_NEURON))
    return fit_dual(averages, screw.pitch_mm / MM_PER_IN, seed, hidden=(slow, _NEURONS[1]))


def flanks_from(pair: DualNet, averages: Averages, screw: _Screw) -> Flanks:
    """Return the slow network of a pair with a closing cyclic error for each flank.

    ``averages``: what the cyclic errors are fitted to.
    ``screw``: says how many harmonics can be told.
    """
    orders = min(_MOST_ORDERS, (screw.phases - 1) // 2)
    return flanks_of(pair.full, averages, screw.pitch_mm, orders, screw.reach_mm)


def serving_bundle(model: PositionModel, machine: str, screw: _Screw, axis: str = "Z") -> Bundle | None:
    """Return the equation of a model, None when it is none."""
    if isinstance(model, DualNet):
        return deployed_bundle(model, "lathe-pair", machine, screw.reach_mm, axis)
    if isinstance(model, Flanks):
        low, high = screw.reach_mm
        return flanks_bundle(model, "lathe-flanks", machine, (low - ROOM_MM, high + ROOM_MM), axis)
    return None


def train_positioning(
    lake: Lake, name: str, *, seed: int = 1, engine: Engine | None = None, progress: StageProgress = silent
) -> Training:
    """Train every candidate on a positioning campaign.

    Every run, one sweep up and one down, is left out in turn: the unit of replication is the run.
    Runs with a data-quality error are left out altogether.

    ``engine``: not used: no equation is searched for, their forms are given.
    """
    campaign, versions = lake.campaign(name), dict(lake.versions())
    test = _usable_test(lake, name)
    screw = screw_of(test, f"campaign {name}")
    left = _held_out(test, screw, seed, progress)
    floor = noise_floor_um(test)
    models = _fitted(averages_of(test), screw, seed)
    candidates = [
        _candidate(name_, model, test, left[name_], floor, campaign.machine, screw) for name_, model in models.items()
    ]
    candidates.sort(key=lambda c: c.held_out.rms_um)
    error = stacked(test)[2]
    report = TrainingReport(
        machine=campaign.machine,
        campaign=name,
        table_versions=versions,
        noise_floor_um=floor,
        rms_before_um=rms(error),
        n_runs=error.shape[1],
        n_rows=error.size,
        candidates=tuple(_with_table_score(candidates)),
        proposed=_proposed(candidates),
        seed=seed,
        told=tuple([*_what_was_seen(test, screw, engine), *_not_proposed(candidates)]),
    )
    geometry = {"type": "lathe"} | dict(campaign.machine_geometry)
    return Training(report, geometry, ((test.axis, *screw.reach_mm),))


def _usable_test(lake: Lake, name: str) -> LinearTest:
    rows = [r for r in lake.runs(name) if r["n_errors"] == 0 and r["status"] == "complete"]
    runs = [lake.load(row) for row in rows]
    both = [run for run in runs if set(run.samples["direction"]) == {"forward", "reverse"}]
    axes = {str(run.meta.condition.get("axis", "Z")) for run in both}
    if len(both) < _FEWEST_RUNS or len(axes) != 1:
        raise InputError(
            "a model of the position cannot be judged",
            code="train.grid",
            where=f"campaign {name}",
            got=f"{len(both)} usable runs of axis {', '.join(axes) or '-'}",
            allowed=f"{_FEWEST_RUNS} runs or more, up and down, of one axis",
            hint="repeat the test: runs = 2 in the plan; dtwin check says what is wrong with a run",
        )
    return linear_test(both)


def _fitted(averages: Averages, screw: _Screw, seed: int) -> dict[str, PositionModel]:
    pair = fit_pair(averages, screw, seed)
    return {
        "zero": Uncorrected(),
        _TABLE: Unidirectional(averages),
        "two tables": Bidirectional(averages),
        "pair": pair,
        "flanks": flanks_from(pair, averages, screw),
    }


def _held_out(test: LinearTest, screw: _Screw, seed: int, progress: StageProgress) -> dict[str, Floats]:
    """Return what each model leaves of runs that it did not see, shape (2 targets, runs)."""
    direction, position, error = stacked(test)
    n = error.shape[1]
    left: dict[str, list[Floats]] = {}
    for run in range(n):
        averages = averages_of(without_run(test, run))
        for name, model in _fitted(averages, screw, seed).items():
            expected = model.error_um(direction, position)
            left.setdefault(name, []).append(error[:, run] - expected)
        progress("runs left out", run + 1, n, f"run {run + 1}")
    return {name: np.column_stack(columns) for name, columns in left.items()}


def _candidate(
    name: str, model: PositionModel, test: LinearTest, left: Floats, floor: float, machine: str, screw: _Screw
) -> Candidate:
    direction, position, error = stacked(test)
    rest = error - model.error_um(direction, position)[:, None]
    bundle = serving_bundle(model, machine, screw, test.axis)
    refused = () if bundle is None else _refusals(bundle, screw)
    size = len(bundle.tick_graph.nodes) if bundle is not None else _entries(model)
    return Candidate(
        name=name,
        family=_FAMILIES.get(name, "baseline"),
        promotable=bundle is not None,
        complexity=size,
        scores={HELD_OUT: scores_of(test, left)},
        train_rms_um=rms(rest),
        latency=None if bundle is None else bundle_latency(bundle),
        equation=_SAID.get(name, ""),
        exports={} if bundle is None else {"tick.txt": to_text(bundle.tick_graph)},
        bundle=None if bundle is None else bundle.to_dict(),
        findings=refused,
        numbers={
            **screw_metrics(screw.pitch_mm, screw.reach_mm),
            "refused_gates": float(len(refused)),
            "explained_share": explained_share(error, left, floor),
        },
    )


def _with_table_score(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Give every candidate the held-out error of the table that a control can do by itself."""
    table = next(c for c in candidates if c.name == _TABLE).held_out.rms_um
    return [Candidate(**{**vars(c), "numbers": {**c.numbers, "table_rms_um": table}}) for c in candidates]


def _proposed(candidates: Sequence[Candidate]) -> str:
    """Return the equation that the fewest positioning gates refuse, and of these the best."""
    equations = [c for c in candidates if c.promotable]
    return min(equations, key=lambda c: (c.numbers["refused_gates"], c.held_out.rms_um)).name


def _not_proposed(candidates: Sequence[Candidate]) -> list[str]:
    return [
        f"{c.name} is not proposed, it fails: {'; '.join(f.split(': ')[1] for f in c.findings)}"
        for c in candidates
        if c.promotable and c.findings
    ]


def _refusals(bundle: Bundle, screw: _Screw) -> tuple[str, ...]:
    verdicts = positioning_gates(bundle, screw.pitch_mm, screw.reach_mm)
    return tuple(f"fails: {v.gate}: {v.reason}" for v in verdicts if not v.passed)


def _what_was_seen(test: LinearTest, screw: _Screw, engine: Engine | None) -> Iterator[str]:
    runs = test.forward_um.shape[1]
    yield (
        f"every run, one sweep up and down over {len(test.position_mm)} targets, was left out in "
        f"turn; the noise floor is what {runs} runs disagree by at the same target and direction, "
        f"and a mean of {runs - 1} runs cannot leave less than "
        f"{noise_floor_um(test) * np.sqrt(runs / (runs - 1)):z.2f} µm"
    )
    yield f"the targets meet the screw at {screw.phases} angles"
    yield "all runs have the same targets: what a candidate does between them is tried in the loop"
    if engine is not None:
        yield f"no equation was searched for with {engine.name}: their forms are given"


def _entries(model: PositionModel) -> int:
    if isinstance(model, Bidirectional):
        return 2 * len(model.averages.position_mm)
    return len(model.averages.position_mm) + 1 if isinstance(model, Unidirectional) else 0


_SAID = {
    "pair": "error = slow network(direction, position) + cyclic network(direction, position in the turn)\n"
    "tick.txt holds every number",
    "flanks": "slide = min(max(slide before, position + forward flank), position + reverse flank)\n"
    "error = slide - position\n"
    "each flank = slow network(position) + harmonics of the screw's turn,\n"
    "taken where the correction puts the screw; tick.txt holds every number",
}
