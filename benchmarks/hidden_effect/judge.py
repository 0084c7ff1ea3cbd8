"""Put one case to the tool and mark the answer."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from cases import Case
from causes import Cause

from dtwin.errors import GateRefusal
from dtwin.physics import localise
from dtwin.physics.diagnose import diagnose
from dtwin.physics.diagnosis import Diagnosis, Suspect
from dtwin.physics.effect import Instance
from dtwin.physics.fit import Fit, fit
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations, observe
from dtwin.physics.problem import Term
from dtwin.physics.twin import chosen_terms, frozen_residual_um, twin_of
from dtwin.train.residual_formula import place_map, place_map_effect

NAMING = ("missing_effect", "ambiguous")
ALARMS = (*NAMING, "unknown_effect")
LIBRARY = Library()
# As many as `dtwin twin discover` adds at most.
RUNGS = 24
MOST_IN_GROUP, MOST_EVERYDAY = 3, 4
SAME = {
    # A mode far above what excites it gives way to inertia; only its ringing is another matter.
    "circular": {f"structural_resonance {axis}": {"inertial_compliance"} for axis in "XY"},
    # One axis grows as the machine does; held at an end, its zero moves as well.
    "linear": {"thermal_growth": {"thermal_growth X", "thermal_shift"}},
}
# Leaving a feed out costs a second search.
HELD_OUT_EVERY = 4


def answer(case: Case) -> dict[str, Any]:
    """Return the tool's answer to a case and the mark."""
    obs = observe(case.campaign, case.runs)
    known = list(fit(obs, chosen_terms(case.known, LIBRARY, obs)).terms)
    began = time.process_time()
    found = diagnose(obs, known, LIBRARY, seed=case.number)
    spent = time.process_time() - began
    out: dict[str, Any] = {
        "truth": [cause.label for cause in case.hidden],
        "known": list(case.known),
        "verdict": found.verdict,
        "group": [s.label for s in found.group],
        "channels": [c.name for c in found.channels],
        "closest": found.closest,
        "lack_of_fit_p": found.lack_of_fit_p,
        "floor_um": found.noise_floor_um,
        "outliers": list(found.outlier_runs),
        "seconds": spent,
    }
    if case.row.right == "all":
        out["rungs"] = _discovered(obs, known, found, case)
    if case.row.right == "every":
        out |= _every(case, obs, found)
    out["right"] = _is_right(case, found, out)
    out["wrong_name"] = _is_wrong_name(case, found)
    if case.row.held_out and found.group:
        out["held_out"] = _held_out(obs, known, found)
    if case.row.right == "name" and case.truths and obs.n_rows > 3:
        out["coverage"] = _coverage(case, obs, known)
    return out


def accepted(case: Case) -> list[set[str]]:
    """Return, for each hidden effect, the labels that are right."""
    also = SAME.get(case.row.kind, {})
    return [{cause.label, *cause.also} | also.get(cause.label, set()) for cause in case.hidden]


def _is_right(case: Case, found: Diagnosis, out: dict[str, Any]) -> bool:
    group = {s.label for s in found.group}
    effects = {s.effect for s in found.group}
    truths = [cause.label for cause in case.hidden]
    checks = {
        "nothing": found.verdict not in ALARMS,
        "absorbed": found.verdict not in ALARMS,
        "name": found.verdict in NAMING and all(names & group for names in accepted(case)),
        "all": all(any(t in named for named in out.get("rungs", ())) for t in truths),
        "unknown": found.verdict == "unknown_effect" or _is_known_otherwise(case, found),
        "lagging": found.verdict == "unknown_effect" or _is_growth(case, found),
        "channel": found.verdict == "unknown_effect" and _channel(case) in out["channels"],
        "group": {"squareness", "servo_mismatch"} <= effects and found.verdict == "ambiguous",
        "confounded": found.verdict == "ambiguous" and {"thermal_growth", "thermal_drift"} <= effects,
        "every": out.get("named") == len(case.hidden) - len(case.row.unknown[:1]),
        "need_repeats": found.verdict == "need_repeats",
        "spread": found.verdict == "variance_effect" or found.spread is not None,
    }
    if truths == ["thermal_growth"] and case.row.right == "name" and case.row.kind == "circular":
        return found.verdict in NAMING and "thermal_growth" in effects
    return bool(checks[case.row.right])


def _channel(case: Case) -> str:
    """Return the channel behind what is hidden."""
    return case.hidden[0].label if case.row.kind != "circular" and case.hidden else "coolant_v"


def _is_wrong_name(case: Case, found: Diagnosis) -> bool:
    if found.verdict not in NAMING:
        return False
    if case.row.right == "lagging":
        return not _is_growth(case, found)
    if case.row.right == "unknown":
        return not _is_known_otherwise(case, found)
    group = {s.label for s in found.group}
    return not any(group & names for names in accepted(case))


def _is_known_otherwise(case: Case, found: Diagnosis) -> bool:
    """Tell whether nothing is named but what is right, too, of a cause that no effect of the library is made for."""
    also = {name for cause in case.hidden for name in cause.also}
    return bool(found.found) and all(also & {s.label for s in group} for group in found.found)


def _is_growth(case: Case, found: Diagnosis) -> bool:
    """Tell whether nothing is named but that the axis which lags behind its temperature grows, with that or with time."""
    names = {f"{effect} {c.label[-1]}" for c in case.hidden for effect in ("thermal_growth", "warming_growth")}
    return bool(found.found) and all(names & {s.label for s in group} for group in found.found)


def discovered(
    obs: Observations, found: Diagnosis, number: int
) -> Iterator[tuple[list[list[str]], list[Term], Diagnosis]]:
    """Yield all groups that ``dtwin twin discover`` has named from nothing after each round, their terms, and the diagnosis.

    ``found``: the first diagnosis.
    """
    large = found.found
    groups = [[s.label for s in group] for group in large]
    terms = _with_added(obs, [], large) if large else []
    yield groups, terms, found
    while large and len(groups) < RUNGS:
        found = diagnose(obs, terms, LIBRARY, seed=number)
        large = found.to_add([term.label for term in terms], [obs])
        groups = [*groups, *([s.label for s in group] for group in large)]
        terms = _with_added(obs, terms, large) if large else terms
        yield groups, terms, found


def _every(case: Case, obs: Observations, found: Diagnosis) -> dict[str, Any]:
    """Return what the first diagnosis named of many, how well a held-out feed fits, and what ``discover`` named in all."""
    rounds = list(discovered(obs, found, case.number))
    out = marked(case, obs, *rounds[0])
    groups, terms, last = rounds[-1]
    if groups != rounds[0][0]:
        out["discover"] = marked(case, obs, groups, terms, last)
    else:
        out["discover"] = {**out, "unresolved": _says_unresolved(case, groups, last)}
    if case.row.kind == "circular" and case.number % HELD_OUT_EVERY == 0 and not case.row.everyday:
        out["held_out_um"], out["held_out_map_um"] = _untold_held_out(obs, case)
    return out


def marked(
    case: Case, obs: Observations, groups: list[list[str]], terms: Sequence[Term], found: Diagnosis
) -> dict[str, Any]:
    """Return what of many causes was named, how many names are false, and how well sizes fit.

    ``groups``, ``terms``, ``found``: what was named, as terms, and the last diagnosis.
    """
    truths = {
        cause.label: names
        for cause, names in zip(case.hidden, accepted(case), strict=True)
        if cause.label not in case.row.unknown
    }
    small = [group for group in groups if _small(group, case.row.everyday)]
    missed = [name for name, n in truths.items() if not any(n & set(g) for g in small)]
    right_names = [*accepted(case), set(case.also)]
    false = [group for group in groups if not any(set(group) & n for n in right_names)]
    out: dict[str, Any] = {
        "groups": groups,
        "named": len(truths) - len(missed),
        "missed": missed,
        "of": len(truths),
        "false": len(false),
        "false_groups": false,
        "unresolved": _says_unresolved(case, groups, found),
    }
    if case.row.kind != "circular":
        return out | {"covered": []}
    right = tuple(c for c in case.hidden if any(c.label == group[0] for group in groups))
    others = _but(terms, right)
    out["covered"] = _coverage(replace(case, hidden=right), obs, others) if case.truths else []
    return out


def _says_unresolved(case: Case, groups: list[list[str]], found: Diagnosis) -> bool:
    also = {name for cause in case.hidden for name in cause.also}
    return found.unresolved is not None or any(also & set(group) for group in groups)


def _small(group: Sequence[str], everyday: bool) -> bool:
    """Tell whether a group is small enough to count; one feed and radius tell less apart."""
    if everyday:
        return len({label.split()[0] for label in group}) <= MOST_EVERYDAY
    return len(group) <= MOST_IN_GROUP


def _terms(obs: Observations, found: Diagnosis) -> list[Term]:
    return _with_added(obs, [], found.found) if found.found else []


def _but(terms: Sequence[Term], right: Sequence[Cause]) -> list[Term]:
    return [t for t in terms if t.label not in {cause.label for cause in right}]


def _untold_held_out(obs: Observations, case: Case) -> tuple[float, float]:
    """Return the systematic RMS on the middle feed, found and fitted without it; and with a map of what was left."""
    feeds = np.array([m.feed_mm_min for m in obs.runs], dtype=float)
    middle = np.isclose(feeds, np.median(feeds))
    train, held = obs.take(np.flatnonzero(~middle)), obs.take(np.flatnonzero(middle))
    terms = _terms(train, diagnose(train, [], LIBRARY, seed=case.number))
    fitted = fit(train, terms)
    plain = _left_um(fitted, train, held)
    try:
        found = place_map(train, localise.residual_um(train, fitted.terms))
    except GateRefusal:
        # Of one place nothing can be left out.
        return plain, plain
    if found.gain <= 0.0:
        return plain, plain
    learned = Term(Instance(place_map_effect("learned_map", found.text)), {})
    return plain, _left_um(fit(train, [*terms, learned]), train, held)


def _left_um(fitted: Fit, train: Observations, held: Observations) -> float:
    twin = twin_of(fitted, train, name="t", version=1, action="exam", data={})
    return float(localise.systematic_rms_um(held, frozen_residual_um(twin, held)))


def _discovered(obs: Observations, known: Sequence[Term], found: Diagnosis, case: Case) -> list[list[str]]:
    """Return the groups that the loop of diagnose and add names, one after the other."""
    named: list[list[str]] = []
    terms = list(known)
    while found.verdict in NAMING and found.found and len(named) < RUNGS:
        named += [[s.label for s in group] for group in found.found]
        terms = _with_added(obs, terms, found.found)
        found = diagnose(obs, terms, LIBRARY, seed=case.number)
    return named


def _with_added(obs: Observations, terms: Sequence[Term], groups: Sequence[tuple[Suspect, ...]]) -> list[Term]:
    names = [f"{b.effect}:{b.axis}" if b.axis else b.effect for b, *_ in groups]
    return list(fit(obs, [*terms, *chosen_terms(names, LIBRARY, obs)]).terms)


def _held_out(obs: Observations, known: Sequence[Term], found: Diagnosis) -> list[float]:
    """Return systematic RMS on the middle feed before and after, fitted to the other feeds."""
    feeds = np.array([m.feed_mm_min for m in obs.runs], dtype=float)
    middle = np.isclose(feeds, np.median(feeds))
    train, held = obs.take(np.flatnonzero(~middle)), obs.take(np.flatnonzero(middle))
    return [_left_um(fit(train, terms), train, held) for terms in (known, [*known, *_added(train, found)])]


def _added(obs: Observations, found: Diagnosis) -> list[Term]:
    best = found.group[0]
    return chosen_terms([f"{best.effect}:{best.axis}" if best.axis else best.effect], LIBRARY, obs)


def _coverage(case: Case, obs: Observations, known: Sequence[Term]) -> list[list[Any]]:
    """Return name, truth, estimate and stated uncertainty where a truth is defined."""
    names = []
    for cause in case.hidden:
        effect, _, axis = cause.label.partition(" ")
        names.append(f"{effect}:{axis}" if axis else effect)
    result = fit(obs, [*known, *chosen_terms(names, LIBRARY, obs)])
    out: list[list[Any]] = []
    for e in result.estimates:
        key = f"{e.effect}|{e.axis}|{e.name}"
        if key in case.truths and e.identifiable:
            out.append([key, float(case.truths[key]), e.value, e.uncertainty])
    return out
