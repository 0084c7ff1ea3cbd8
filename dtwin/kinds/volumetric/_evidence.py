"""What an equation of heat is worth in other campaigns of the machine, hour by hour, and what thermal models leave."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from dtwin.config import Home
from dtwin.errors import GateRefusal
from dtwin.kinds.volumetric._identify import Balls
from dtwin.kinds.volumetric._session import REFERENCE_CYCLES, Session, session_in
from dtwin.kinds.volumetric._thermal_model import ThermalModel, independent
from dtwin.lake.store import Lake
from dtwin.progress import Progress, silent
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.safety import box_factor
from dtwin.statistics import rms, t_quantile
from dtwin.train.closed_loop import WITH, WITHOUT, Evidence
from dtwin.train.registry import RegisteredVersion, Registry

_DAY_H = 24.0
# A span has at least so many cycles: fewer say nothing of their scatter.
_FEWEST_CYCLES = 8
_CLOCK = "measured without it, the prediction taken off afterwards"


def volumetric_evidence(home: Home, version: RegisteredVersion, *, progress: Progress = silent) -> Evidence:
    """Judge a registered version by every other ball-array campaign of its machine in the lake.

    Campaigns during which a correction was in force judge nothing: they have been corrected already.

    A correction of micrometres does not change the heat, so that it is taken off what was measured. Where a
    temperature lies outside of the validity box it fades, as in serving. Nothing was served: only a
    virtual machine is judged so.
    """
    registry, lake = Registry(home), Lake(home.lake)
    bundle = Bundle.from_dict(registry.bundle(version))
    trained = str(registry.read_json(version, "conditions.json")[0][0])
    others = [name for name in lake.campaigns() if name != trained and _judges(lake, name, version)]
    if not others:
        raise GateRefusal(
            "no other campaign of the machine can judge the equation",
            code="promote.campaign",
            where=f"machine {version.machine}",
            got=f"{trained} only, which it was fitted to",
            hint="measure under another schedule and ingest it: dtwin simulate --machine volumetric "
            "--schedule validation --out summer",
        )
    conditions = [c for name in others for c in _judged_hours(bundle, session_in(lake, name, progress))]
    runs = [
        {
            "way": WITHOUT,
            "campaign": name,
            "run_id": row["run_id"],
            "started": row["started"],
            "content_sha256": row["content_sha256"],
        }
        for name in others
        for row in lake.runs(name)
    ]
    return Evidence(
        "virtual",
        version.machine,
        bundle.model_sha256,
        {WITHOUT: tuple(others), WITH: ()},
        tuple(conditions),
        tuple(runs),
        0,
        (
            "Changes of the distances between balls. Better and worse are said of the share that "
            "each cycle keeps of its error, by a 95 % interval that counts as many cycles as their "
            "correlation leaves.",
        ),
        {"clock": _CLOCK},
    )


def _judged_hours(bundle: Bundle, measured: Session) -> list[dict[str, Any]]:
    """Return what an equation leaves of a campaign, day by day, in the form that gates read.

    Where cycles are far apart, several days are taken together.

    ``bundle``: corrects the tool point by temperatures.
    ``measured``: another campaign than that of its fit.
    """
    correction, trusted = corrections(bundle, measured)
    was = [rms(distance_changes_um(where, moved)) for where, moved in measured.moved]
    pairs = zip(measured.moved, correction, strict=True)
    left = [rms(distance_changes_um(where, moved - off)) for (where, moved), off in pairs]
    noise = [rms(changes) for changes in changes_left_um(measured, measured.values)]
    apart_h = float(np.median(np.diff(measured.hour)))
    span_h = _DAY_H * math.ceil(_FEWEST_CYCLES * apart_h / _DAY_H)
    day = np.floor((measured.hour - measured.hour[0]) / span_h).astype(int)
    # The first cycles are the reference: there is nothing to take away.
    day[:REFERENCE_CYCLES] = -1
    return [
        _condition(measured, span_h * d, span_h, *(np.array(v)[day == d] for v in (was, left, noise, trusted)))
        for d in np.unique(day[day >= 0])
        if np.count_nonzero(day == d) > 1
    ]


def _judges(lake: Lake, name: str, version: RegisteredVersion) -> bool:
    known = lake.campaign(name)
    free = not known.machine_geometry.get("corrected", False)
    return known.machine == version.machine and known.kind == "volumetric" and free


def corrections(bundle: Bundle, measured: Session) -> tuple[list[Floats], list[float]]:
    """Return what the guard lets through at the balls since the reference, and how far it trusts."""
    compiled = CompiledBundle(bundle)
    temperatures = [i for i in bundle.inputs if i.source == "covariate"]
    names = [i.name for i in temperatures]
    read = measured.rise_of(names) + measured.begun_of(names)
    low, high = (np.array([getattr(i, end) for i in temperatures]) for end in ("low", "high"))
    limits = bundle.safety
    span = limits.shrink_span if limits.outside == "shrink" else 0.0

    def trust(temperature_c: Floats) -> float:
        return max(float(box_factor(temperature_c, low, high, span)), 0.0)

    def sent(place_mm: Floats, temperature_c: Floats) -> Floats:
        given = {f"{axis}_mm": place_mm[:, k] for k, axis in enumerate("xyz")}
        given |= {n: np.full(len(place_mm), t) for n, t in zip(names, temperature_c, strict=True)}
        asked = compiled.run(np.column_stack([given[name] for name in bundle.tick_inputs]))
        trusted = asked * trust(temperature_c)
        length = np.linalg.norm(trusted, axis=1, keepdims=True)
        return trusted * np.minimum(1.0, limits.clamp_um / np.maximum(length, 1e-9))

    first = read[:REFERENCE_CYCLES].mean(axis=0)
    corrected = [
        sent(where.position_mm, now) - sent(where.position_mm, first)
        for (where, _), now in zip(measured.moved, read, strict=True)
    ]
    return corrected, [trust(now) for now in read]


def _condition(
    measured: Session, since_h: float, span_h: float, was: Floats, left: Floats, noise: Floats, trusted: Floats
) -> dict[str, Any]:
    ci = [_half_width(values) for values in (was, left)]
    # With and without are of the same cycles, whose heat differs more than the correction does: what
    # counts is the share that each cycle keeps.
    kept = np.log(left / was)
    change, half = float(kept.mean()), _half_width(kept)
    begin = float(measured.hour[0]) + since_h
    return {
        "campaign": measured.campaign,
        "from_h": begin,
        "to_h": begin + span_h,
        "trained": False,
        "before_um": float(was.mean()),
        "after_um": float(left.mean()),
        "before_ci_um": ci[0],
        "after_ci_um": ci[1],
        "growth_ci_um": _half_width(left - was),
        "floor_um": float(noise.mean()),
        "n_without": len(was),
        "n_with": len(was),
        "reduction": 1.0 - float(left.mean() / was.mean()),
        "better": change < -half,
        "worse": change > half,
        "acted": {"outside_box": float(np.mean(trusted < 1.0))},
    }


def _half_width(values: Floats) -> float:
    """Return half the 95 % interval of a mean of cycles that are not independent."""
    n = min(max(independent(values), 2.0), float(len(values)))
    return t_quantile(0.975, n - 1.0) * float(values.std(ddof=1)) / math.sqrt(n)


def predicted(models: Sequence[ThermalModel], measured: Session) -> Floats:
    """Return the error motions that the models expect, in free run, shape (cycles, coefficients)."""
    return np.column_stack([model.run(measured.rise_of(model.sensors)) for model in models])


def distance_changes_um(where: Balls, moved_um: Floats) -> Floats:
    """Return how the distances between balls of the same pose change, shape (pairs,).

    ``moved_um``, (n, 3): how the tool point moves there.
    """
    changes_um = []
    for pose in sorted(set(where.pose.tolist()) - {0}):
        rows = np.flatnonzero(where.pose == pose)
        one, other = np.triu_indices(len(rows), 1)
        apart = where.position_mm[rows][one] - where.position_mm[rows][other]
        unit = apart / np.linalg.norm(apart, axis=1)[:, None]
        changes_um.append(((moved_um[rows][one] - moved_um[rows][other]) * unit).sum(axis=1))
    return np.concatenate(changes_um)


def changes_left_um(measured: Session, expected: Floats) -> list[Floats]:
    """Return what is left of the changes of distances between balls, cycle by cycle, shape (pairs,) each.

    ``expected``, (cycles, coefficients): error motions that are taken off.
    """
    return [
        distance_changes_um(where, moved - measured.artefact.predicted_um(where, values))
        for (where, moved), values in zip(measured.moved, expected, strict=True)
    ]
