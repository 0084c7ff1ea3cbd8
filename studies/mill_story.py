"""The source thesis's mill, told right: what its R² was worth, and what a twin makes of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.acquire.virtual_mill import write_campaign
from dtwin.config import Home
from dtwin.lifecycle.evidence import compute_measured, make_champion
from dtwin.lifecycle.train import put_on_trial
from dtwin.progress import Progress
from dtwin.schema import Campaign
from dtwin.serve.bundle import Bundle
from dtwin.train.oracle import MeasuredWays
from dtwin.train.promotion import check_version
from dtwin.train.registry import RegisteredVersion, Registry
from dtwin.twins.correct import Correction, correct
from dtwin.twins.verbs import Twins
from studies.mill_story_defects import NOT_DONE, defects, uncaught
from studies.mill_story_map import LearnedSession, learn_session, register_map
from studies.mill_story_session import NONE, LaterSession, Way, later_session
from studies.thesis_mill import MACHINE, designed_campaign, geometry, session_of_the_thesis, temperatures_c, thesis_mill

# The source thesis by feed and model: accuracy on its fourth data set (table 6-3, R² of X and of Y),
# table 6-6 as printed, and what its table 6-5 gives (X + Y, mean of three): change of the mean
# absolute error in per cent, positive is better.
THESIS = tuple(
    {"feed_mm_min": feed, "model": model, "r2": r2, "printed": printed, "follows": follows}
    for feed, model, r2, printed, follows in (
        (100.0, "regression", (0.99, 0.97), -41.28, -490.7),
        (100.0, "symbolic", (1.00, 0.53), -11.64, -790.8),
        (250.0, "regression", (0.97, 0.90), -9.83, -43.1),
        (250.0, "symbolic", (0.90, 0.44), -5.05, -112.6),
        (500.0, "regression", (0.69, 0.28), 1.30, 16.9),
        (500.0, "symbolic", (0.86, 0.71), -3.11, -51.2),
    )
)
KNOWN = ("scale_mismatch", "squareness")
MAP, TWIN = "map of one session", "told right"
_LATER, _CAMPAIGN, _DEFECTS = 1000, 2000, 3000
_HOURS_OF_WORK = 40


@dataclass(frozen=True)
class _Told:
    """The twin's side of the story."""

    diagnosis: Mapping[str, Any]
    added: str
    rungs: list[dict[str, Any]]
    residual_um: float
    floor_um: float
    correction: Correction


def mill_story(
    home: Home, seed: int = 0, *, quick: bool = False, progress: Callable[[str], Progress] | None = None
) -> dict[str, Any]:
    """Tell the story; every number is measured on the virtual mill, machine clock.

    ``home``: lake, twins and registry: campaign and twin stay there to be looked at.
    ``seed``: of all sessions.
    ``quick``: two repeats instead of three.
    ``progress``: ``progress(title)`` returns what is called with (done, total, what).
    Raises ``GateRefusal`` when the twin is not confirmed well enough to move a machine.
    """
    tell = progress or (lambda title: lambda done, total, what: None)
    repeats = 2 if quick else 3
    runs = session_of_the_thesis(seed, warm_up=_HOURS_OF_WORK)
    learned = learn_session(runs)
    mapped = register_map(home, learned, geometry())
    told = _told_right(home, seed)
    put_on_trial(home, told.correction.version, "dtwin demo mill")
    right = told.correction.frozen.bundle
    ways = {MAP: Way(learned.bundle), TWIN: Way(right)}
    session = later_session(ways, seed=seed + _LATER, repeats=repeats, progress=tell("a later session"))
    registry = Registry(home)
    broken = defects(
        right, registry.metrics(told.correction.version), seed=seed + _DEFECTS, repeats=2, progress=tell("defects")
    )
    seen = temperatures_c(runs)
    return {
        "machine": MACHINE,
        "seed": seed,
        "repeats": repeats,
        "learned": _learned_dict(learned, (float(seen.min()), float(seen.max()))),
        "map_gates": _judged(home, registry, mapped, session.measured(MAP, learned.bundle)),
        "later": _later_dict(session, {MAP: learned.bundle, TWIN: right}),
        "twin": _twin_dict(told),
        "twin_gates": _judged(home, registry, told.correction.version, session.measured(TWIN, right)),
        "defects": broken,
        "nothing_catches": uncaught(broken),
        "not_done": NOT_DONE,
        "thesis": [dict(row) for row in THESIS],
    }


def _told_right(home: Home, seed: int) -> _Told:
    """Measure a designed campaign, and let the twin find what it lacks."""
    name = f"told-right-{seed}"
    folder = home.campaigns / name
    if not (folder / "campaign.toml").exists():
        campaign = Campaign(name=name, machine=MACHINE, machine_geometry=geometry())
        runs = designed_campaign(seed + _CAMPAIGN)
        write_campaign(folder, campaign, runs, thesis_mill(seed).parameters)
    twins = Twins(home)
    twins.fit(str(folder), KNOWN, name)
    compared = twins.compare(name).as_dict()
    _, found = twins.diagnose(name, seed=seed)
    added = ""
    if found.group:
        best = found.group[0]
        twins.add(name, best.effect, best.axis)
        added = best.label
    made = correct(twins, name, seed=seed)
    return _Told(
        found.as_dict(), added, twins.history(name), compared["residual_rms_um"], compared["noise_floor_um"], made
    )


def _learned_dict(learned: LearnedSession, temperature_c: tuple[float, float]) -> dict[str, Any]:
    return {
        "rows": [dict(row) for row in learned.rows],
        "mounting_share": learned.mounting_share,
        "leave_feed_out": learned.scores.as_dict(),
        "temperature_c": list(temperature_c),
    }


def _judged(home: Home, registry: Registry, version: RegisteredVersion, measured: MeasuredWays) -> dict[str, Any]:
    """Ask for promotion without evidence and with it, as a user would."""
    _, offline = check_version(registry, version)
    _, without = make_champion(home, version, "dtwin demo mill, without evidence")
    compute_measured(home, version, measured)
    path, reason = make_champion(home, version, "dtwin demo mill")
    return {
        "version": version.version,
        "offline": [dict(vars(v)) for v in offline],
        "without_evidence": without,
        "champion": path is not None,
        "with_evidence": reason,
    }


def _later_dict(session: LaterSession, served: Mapping[str, Bundle]) -> dict[str, Any]:
    ways = {}
    for way, bundle in served.items():
        rows = []
        for c in session.evidence(way, bundle).as_dict()["conditions"]:
            ratio = c["after_um"] / c["before_um"]
            shares = [c[f"{name}_ci_um"] / c[f"{name}_um"] for name in ("after", "before")]
            rows.append(
                {
                    **c,
                    "ratio": ratio,
                    "ratio_half_width": float(ratio * np.hypot(*shares)),
                    "raw_before_um": session.raw_um(NONE, c["feed_mm_min"]),
                    "raw_after_um": session.raw_um(way, c["feed_mm_min"]),
                    "halved": ratio <= 0.5,
                }
            )
        ways[way] = rows
    return {"ways": ways, "temperature_c": list(session.temperature_c)}


def _twin_dict(told: _Told) -> dict[str, Any]:
    made = told.correction
    return {
        "name": made.frozen.twin.name,
        "known": list(KNOWN),
        "residual_um": told.residual_um,
        "floor_um": told.floor_um,
        "verdict": told.diagnosis["verdict"],
        "headline": told.diagnosis["headline"],
        "added": told.added,
        "rungs": told.rungs,
        "after": made.verdict,
        "terms": [dict(vars(t)) for t in made.frozen.terms],
        "grades": [dict(vars(g)) for g in made.gradings],
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
    }
