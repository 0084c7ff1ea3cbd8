"""LinuxCNC from the first circle to the proof: measure, name, correct live and by table, measure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from dtwin.acquire.linuxcnc_circles import DIRECTIONS, MACHINE, CirclePlan, run_circles, run_of, write_circles
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.lifecycle.evidence import compute_measured, make_champion
from dtwin.lifecycle.export import Request, export, source_of
from dtwin.lifecycle.train import put_on_trial
from dtwin.machines.linuxcnc.circles import Circle, Trace
from dtwin.machines.linuxcnc.configuration import MillFaults
from dtwin.machines.linuxcnc.instance import LinuxcncSession, require_linuxcnc
from dtwin.pipeline.linuxcnc_correction import LiveCorrection, LiveTrace, named, served_figures
from dtwin.progress import Progress
from dtwin.schema import Floats, Run
from dtwin.serve.bundle import Bundle
from dtwin.statistics import rms, t_quantile
from dtwin.train.oracle import MeasuredWays, numbered
from dtwin.twins.correct import Correction, correct
from dtwin.twins.verbs import Twins

KNOWN = ("scale_mismatch", "squareness", "servo_mismatch")
CLOCK = "LinuxCNC's servo thread in simulated real time (1 kHz), serving on the wall clock"
NONE, LIVE, TABLE = "none", "live", "table"
WAYS = (NONE, LIVE, TABLE)
_MOST_ADDED = 3
# Another mounting of the bar than in the campaign.
_LATER = MillFaults(mounting_x=-0.009, mounting_y=0.015)
_TABLE_TRAVEL_MM = (-60.0, 60.0)


@dataclass(frozen=True)
class StorySize:
    """How much is measured.

    ``campaign``: circles that the twin is fitted to.
    ``radius_mm``: of the circles of the proof; not one of the campaign.
    ``repeats``: of every circle of the proof.
    """

    campaign: CirclePlan
    radius_mm: float
    repeats: int


FULL = StorySize(CirclePlan(), 30.0, 3)
QUICK = StorySize(CirclePlan(radii_mm=(20.0, 35.0), feeds_mm_min=(4000.0, 6000.0)), 27.0, 3)


def linuxcnc_story(
    home: Home, seed: int = 0, *, size: StorySize = FULL, progress: Callable[[str], Progress] | None = None
) -> dict[str, Any]:
    """Tell the story; every number is measured by LinuxCNC's own sampler.

    ``home``: campaign, twin and registry stay there to be looked at.
    ``seed``: of orders and noise.
    ``size``: how much is measured.
    ``progress``: ``progress(title)`` returns what is called with (done, total, what).
    Raises ``MissingPart`` when LinuxCNC cannot run here.
    Raises ``GateRefusal`` when an offline gate refuses the correction.
    """
    require_linuxcnc()
    tell = progress or (lambda title: lambda done, total, what: None)
    name = f"linuxcnc-{seed}-{'quick' if size is QUICK else 'full'}"
    folder = home.campaigns / name
    if not (folder / "campaign.toml").exists():
        circles = size.campaign.circles(seed)
        tell("campaign")(0, len(circles), f"{size.campaign.duration_s:z.0f} s")
        with LinuxcncSession(seed=seed) as session:
            write_circles(folder, run_circles(session, circles), session.faults, name)
    twins = Twins(home)
    twins.fit(str(folder), KNOWN, name)
    diagnoses, added = _completed(twins, name, seed)
    # What speaks against it is told, and keeps it from being promoted.
    made = correct(twins, name, trial=True, seed=seed)
    put_on_trial(home, made.version, "dtwin demo linuxcnc")
    bundle = made.frozen.bundle
    tables, left_out = compensation_tables(home, made)
    proof = [Circle("XY", size.radius_mm, feed, d) for feed in size.campaign.feeds_mm_min for d in DIRECTIONS]
    turns, served, measured = _proof(bundle, tables, proof, size.repeats, seed, tell)
    results = [_result(turns, circle) for circle in proof]
    compute_measured(home, made.version, MeasuredWays(numbered(measured), CLOCK))
    champion, reason = make_champion(home, made.version, "dtwin demo linuxcnc")
    return {
        "machine": MACHINE,
        "campaign": name,
        "runs": len(size.campaign.circles(seed)),
        "seed": seed,
        "repeats": size.repeats,
        "radius_mm": size.radius_mm,
        "known": list(KNOWN),
        "diagnoses": diagnoses,
        "added": added,
        "verdict": made.verdict,
        "objections": list(made.objections),
        "terms": [dict(vars(t)) for t in made.frozen.terms],
        "estimates": [
            {
                "effect": f"{e.effect} {e.axis}".strip(),
                "name": e.name,
                "value": e.value,
                "uncertainty": e.uncertainty,
                "unit": e.unit,
            }
            for e in made.frozen.twin.estimates
        ],
        "table_left_out": left_out,
        "results": results,
        "served": served,
        "champion": champion is not None,
        "reason": reason,
    }


def _completed(twins: Twins, name: str, seed: int) -> tuple[list[dict[str, Any]], list[str]]:
    """Diagnose and add what is named, until nothing is missing or it cannot be named."""
    diagnoses: list[dict[str, Any]] = []
    added: list[str] = []
    for _ in range(_MOST_ADDED + 1):
        _, found = twins.diagnose(name, seed=seed)
        diagnoses.append({"verdict": found.verdict, "headline": found.headline})
        if found.verdict != "missing_effect" or len(added) == _MOST_ADDED:
            break
        best = found.group[0]
        if best.grade != "law-confirmed":
            break
        twins.add(name, best.effect, best.axis)
        added.append(best.label)
    return diagnoses, added


def compensation_tables(home: Home, made: Correction) -> tuple[dict[str, str], dict[str, str]]:
    """Return the text of each axis's compensation file, and what such a file cannot hold.

    ``home``: where the correction is registered.
    ``made``: the correction.
    """
    source = source_of(home, made.frozen.twin.name, None)
    tables: dict[str, str] = {}
    left_out: dict[str, str] = {}
    for axis in "XY":
        try:
            written = export(source, Request("comp", axis=axis, travel_mm=_TABLE_TRAVEL_MM))
        except InputError as nothing:
            if nothing.code != "export.effects":
                raise
            left_out[axis] = str(nothing.got)
            continue
        left_out |= written.left_out
        tables[axis] = written.text
    return tables, left_out


def _proof(
    bundle: Bundle,
    tables: Mapping[str, str],
    circles: Sequence[Circle],
    repeats: int,
    seed: int,
    tell: Callable[[str], Progress],
) -> tuple[dict[str, list[Trace]], dict[str, Any], list[Run]]:
    """Run the circles without and with live correction interleaved, then with the tables."""
    rng = np.random.default_rng([seed, 29])
    jobs = [(way, c) for way in (NONE, LIVE) for c in circles for _ in range(repeats)]
    jobs = [jobs[i] for i in rng.permutation(len(jobs))]
    turns: dict[str, list[Trace]] = {way: [] for way in WAYS}
    served: list[LiveTrace] = []
    measured: list[Run] = []
    line = tell("without and with live correction")
    with LinuxcncSession(_LATER, seed=seed + 1) as session:
        live = LiveCorrection(session, bundle)
        for done, (way, circle) in enumerate(jobs, start=1):
            started = datetime.now(UTC).isoformat()
            if way == LIVE:
                served.append(live.run(circle))
                turns[way].append(served[-1].trace)
            else:
                turns[way] += run_circles(session, [circle])
            run = run_of(turns[way][-1], "e", 1, "later", started)
            under = bundle.model_sha256 if way == LIVE else run.meta.correction
            measured.append(replace(run, meta=replace(run.meta, correction=under)))
            line(done, len(jobs), named(circle))
    # LinuxCNC reads tables at its start only: they cannot be interleaved inside a session.
    tabled = [circles[i % len(circles)] for i in rng.permutation(len(circles) * repeats)]
    tell("with compensation tables")(0, len(tabled), "")
    with LinuxcncSession(_LATER, tables, seed=seed + 2) as session:
        turns[TABLE] = run_circles(session, tabled)
    return turns, served_figures(served), measured


def _result(turns: Mapping[str, Sequence[Trace]], circle: Circle) -> dict[str, Any]:
    """Return what each way leaves of one circle, the run as unit."""
    found: dict[str, Any] = {"feed_mm_min": circle.feed_mm_min, "direction": circle.direction}
    for way in WAYS:
        rms = _rms_um(turns[way])
        groups: dict[Circle, list[float]] = {}
        for value, turn in zip(rms, turns[way], strict=True):
            groups.setdefault(turn.circle, []).append(float(value))
        chosen = np.array(groups[circle])
        spread = _half_width_um([np.array(g) for g in groups.values()])
        found[way] = {
            "rms_um": float(chosen.mean()),
            # All circles of a way share one spread between repeats.
            "half_width_um": spread * float(np.sqrt(len(rms) / len(chosen))),
            "runs": len(chosen),
            "each_um": chosen.tolist(),
        }
    return found


def _rms_um(turns: Sequence[Trace]) -> Floats:
    """Return the RMS of every turn, the centre and radius of the session's mounting taken out."""
    angle = [np.radians(t.angle_deg) for t in turns]
    design = [np.column_stack([np.ones_like(a), np.cos(a), np.sin(a)]) for a in angle]
    # One mounting for all turns of a way: a turn more at a slow feed weighs no more than a fast one.
    normal = sum((d.T @ d / len(d) for d in design), np.zeros((3, 3)))
    right = sum((d.T @ t.deviation_um / len(d) for d, t in zip(design, turns, strict=True)), np.zeros(3))
    mounting = np.linalg.solve(normal, right)
    return np.array([rms(t.deviation_um - d @ mounting) for d, t in zip(design, turns, strict=True)])


def _half_width_um(groups: Sequence[Floats]) -> float:
    """Return the half width of the 95 % interval of the mean, from the spread inside groups."""
    n = sum(len(g) for g in groups)
    freedom = n - len(groups)
    if freedom < 1:
        return float("inf")
    spread = sum((len(g) - 1) * float(np.var(g, ddof=1)) for g in groups if len(g) > 1)
    return t_quantile(0.975, freedom) * float(np.sqrt(spread / freedom / n))
