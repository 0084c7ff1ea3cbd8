"""What a machine lacks, by several of its campaigns: each diagnosed by itself, and settled by the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from dtwin.physics._merged_groups import Group, graded, key_of_suspect, merged, refuted_names
from dtwin.physics.contradictions import Contradiction, without_contradictions
from dtwin.physics.diagnose import diagnose
from dtwin.physics.diagnosis import Diagnosis, Suspect, Verdict
from dtwin.physics.effect import Effect
from dtwin.physics.experiment import next_experiment
from dtwin.physics.fit import Estimate
from dtwin.physics.joint import Joint, MachineTest, joint
from dtwin.physics.machine_terms import cause_of, key_of, machine_terms
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.several import fit_several
from dtwin.physics.several_sizes import nothing_of
from dtwin.physics.several_twin import SeveralTwin, pooled_figures, started_of
from dtwin.physics.twin import predict_um
from dtwin.physics.undecided import doubts_of, undecided_together

_PLACES = 5
# A size is there from three of its standard uncertainties on; sizes have k = 2.
_THERE = 1.5
_QUIET: tuple[Verdict, ...] = ("unknown_effect", "need_repeats", "variance_effect", "nothing_missing")


@dataclass(frozen=True)
class SeveralDiagnosis(Diagnosis):
    """What several campaigns say together; what a :class:`Diagnosis` has is of all of them.

    ``tests``: what each campaign says by itself.
    ``settled``: what they say of each other.
    ``contradictions``: of the twin: sizes that campaigns do not agree on.
    ``explained``: effects that would explain a contradiction, and which.
    ``of_campaign``: where each effect was found or considered.
    """

    tests: tuple[MachineTest, ...] = ()
    settled: Joint = field(default_factory=lambda: Joint((), ()))
    contradictions: tuple[Contradiction, ...] = ()
    explained: Mapping[str, str] = field(default_factory=dict)
    ruled_out: tuple[str, ...] = ()
    of_campaign: Mapping[str, str] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        document = super().as_dict()
        for suspect, stored in zip(self.suspects, document["candidates"], strict=True):
            stored["campaign"] = self.of_campaign.get(suspect.label, "")
        document["campaigns"] = [
            {
                "campaign": test.campaign,
                "kind": test.obs.grid.kind,
                "started": test.started,
                "verdict": test.found.verdict,
                "headline": test.found.headline,
                "residual_rms_um": test.found.residual_rms_um,
                "systematic_rms_um": test.found.systematic_rms_um,
                "noise_floor_um": test.found.noise_floor_um,
                "floor_kind": test.found.floor_kind,
                "lack_of_fit_p": test.found.lack_of_fit_p,
                "found": [[suspect.label for suspect in group] for group in test.found.found],
            }
            for test in self.tests
        ]
        document |= self.settled.as_dict()
        document["contradictions"] = [c.as_dict() for c in self.contradictions]
        document["explained"] = dict(self.explained)
        document["ruled_out"] = list(self.ruled_out)
        return document


def diagnose_several(
    twin: SeveralTwin,
    campaigns: Sequence[Observations],
    library: Mapping[str, Effect],
    *,
    seed: int = 0,
    alone: Sequence[Diagnosis | None] = (),
) -> SeveralDiagnosis:
    """Find out what a twin of several campaigns lacks.

    Each campaign is diagnosed beside what the twin has, the sizes free in it, so that what campaigns disagree on is a
    contradiction and no new name. Groups that one cannot tell apart are judged by the others.

    ``campaigns``: those of the twin, in its order.
    ``alone``: what is known of each by itself, beside what the twin has.
    """
    tests = []
    for obs, told in zip(campaigns, alone or [None] * len(campaigns), strict=True):
        known = twin.on(obs.campaign.name).terms
        diagnosis = told or diagnose(obs, known, library, seed=seed)
        tests.append(MachineTest(obs.campaign.name, started_of(obs), obs, diagnosis, known))
    settled = joint(tests, library)
    groups, ruled_out = merged(twin.terms, tests, settled, library)
    groups, denied = _shown_together(twin, groups, campaigns, library)
    denied = list(dict.fromkeys([*refuted_names(tests, settled, library), *denied]))
    if not groups and any(test.found.found for test in tests):
        # What the others deny does not explain what a campaign shows, and something does.
        asked = [_without_denied(test, library, seed) for test in tests]
        settled = joint(asked, library)
        groups, _ = merged(twin.terms, asked, settled, library)
        groups, _ = _shown_together(twin, groups, campaigns, library)
    explained: dict[str, str] = {}
    better: list[Group] = []
    for contradiction in twin.contradictions:
        for group, where in _explaining(twin, contradiction, campaigns, library, seed):
            if group[0].label not in explained:
                better.append((group, where))
                explained[group[0].label] = f"{contradiction.effect} {contradiction.axis}".rstrip()
    # What a campaign shows beside a size that it gets wrong is asked again when that is right.
    wrong = {where for _, where in better}
    groups = [*better, *(diagnosis for diagnosis in groups if diagnosis[1] not in wrong)]
    return _concluded(twin, tests, settled, groups, denied, explained, ruled_out, library)


def _without_denied(test: MachineTest, library: Mapping[str, Effect], seed: int) -> MachineTest:
    """Return what a campaign shows when it is asked without all that it found."""
    denied = {s.effect for group in test.found.found for s in group}
    if test.found.verdict == "need_repeats" or not denied:
        return test
    rest = {name: effect for name, effect in library.items() if name not in denied}
    return replace(test, found=diagnose(test.obs, test.known, rest, seed=seed))


def _shown_together(
    twin: SeveralTwin, groups: list[Group], campaigns: Sequence[Observations], library: Mapping[str, Effect]
) -> tuple[list[Group], list[str]]:
    """Leave out the names that one campaign finds and all together do not; return what is left, and those names.

    Each is sized in one fit of all campaigns beside everything else that was found: what only one campaign can see may be what
    others call by another name.
    """
    alone = {key_of_suspect(group[0], library) for group, _ in groups if len(group) == 1}
    if not alone:
        return groups, []
    known = {key_of(term) for term in twin.terms}
    more = [
        term
        for group, _ in groups
        for term in machine_terms([group[0].effect], library, campaigns, group[0].axis)
        if key_of(term) not in known
    ]
    terms = {key_of(term): term for term in (*twin.terms, *more)}
    absent = nothing_of(fit_several(campaigns, list(terms.values()), library))
    denied = [group[0].label for group, _ in groups if len(group) == 1 and key_of_suspect(group[0], library) in absent]
    return [(group, where) for group, where in groups if len(group) > 1 or group[0].label not in denied], denied


def _absent(terms: Sequence[Term], sizes: Sequence[Estimate]) -> set[tuple[str, str]]:
    """Return the keys of the effects that are nothing to within their uncertainty, wherever they have a size."""
    told: dict[tuple[str, str], list[Estimate]] = {}
    for e in sizes:
        if e.identifiable:
            told.setdefault((e.effect, e.axis), []).append(e)
    own = {key_of(term): told.get((term.instance.effect.name, term.instance.axis), []) for term in terms}
    return {
        key for key, mine in own.items() if mine and all(abs(e.value) <= _THERE * e.uncertainty_at_shape for e in mine)
    }


def _explaining(
    twin: SeveralTwin, apart: Contradiction, campaigns: Sequence[Observations], library: Mapping[str, Effect], seed: int
) -> list[Group]:
    """Return effects that make a contradiction vanish: found in a campaign where the size is what the others say."""
    term = next(
        (t for t in twin.terms if t.instance.effect.name == apart.effect and t.instance.axis == apart.axis), None
    )
    if term is None:
        return []
    sides = set(apart.campaigns), set(apart.others)
    for obs in campaigns:
        own, theirs = sides if obs.campaign.name in sides[0] else sides[::-1]
        if obs.campaign.name not in own or not theirs:
            continue
        mine = twin.on(obs.campaign.name)
        seen = next((t for t in mine.terms if key_of(t) == key_of(term)), None)
        source = next(
            (p for p in twin.parts if p.campaign in theirs and any(key_of(t) == key_of(term) for t in p.terms)), None
        )
        if seen is None or source is None or not set(seen.instance.effect.confusables):
            continue
        there = next(t for t in source.terms if key_of(t) == key_of(term))
        alone = replace(
            mine,
            terms=(seen,),
            estimates=tuple(
                replace(e, effect=seen.instance.effect.name, axis=seen.instance.axis)
                for e in source.estimates
                if (e.effect, e.axis) == (there.instance.effect.name, there.instance.axis)
            ),
        )
        rest = [t for t in mine.terms if t is not seen]
        diagnosis = diagnose(obs.with_y(obs.y_um - predict_um(alone, obs)), rest, library, seed=seed)
        groups = [
            kept
            for group in diagnosis.found
            if diagnosis.verdict != "need_repeats"
            and (kept := tuple(s for s in group if _reconciles(twin, s, term, campaigns, library)))
        ]
        if groups:
            return [(graded(group), obs.campaign.name) for group in groups]
    return []


def _reconciles(
    twin: SeveralTwin, suspect: Suspect, term: Term, campaigns: Sequence[Observations], library: Mapping[str, Effect]
) -> bool:
    """Tell whether campaigns agree on a term once another effect stands beside it."""
    known = {key_of(t) for t in twin.terms}
    beside = machine_terms([suspect.effect], library, campaigns, suspect.axis)
    more = [t for t in beside if key_of(t) not in known]
    if not more:
        return False
    fitted = fit_several(campaigns, [*twin.terms, *more], library)
    _, apart = without_contradictions(fitted, [started_of(obs) for obs in campaigns])
    return not any(cause_of(library[c.effect]) == cause_of(term.instance.effect) for c in apart)


def _concluded(
    twin: SeveralTwin,
    tests: Sequence[MachineTest],
    settled: Joint,
    groups: Sequence[Group],
    denied: Sequence[str],
    explained: Mapping[str, str],
    ruled_out: tuple[str, ...],
    library: Mapping[str, Effect],
) -> SeveralDiagnosis:
    diagnoses = [test.found for test in tests]
    p_values = [f.lack_of_fit_p for f in diagnoses if f.lack_of_fit_p == f.lack_of_fit_p]
    figures = pooled_figures(
        [
            {
                "rms_before_um": f.residual_rms_um,
                "rms_after_um": f.residual_rms_um,
                "systematic_rms_um": f.systematic_rms_um,
                "noise_floor_um": f.noise_floor_um,
            }
            for f in diagnoses
        ],
        [float(test.obs.mask.sum()) for test in tests],
    )
    named = [replace(s, in_group=i == 0) for i, (group, _) in enumerate(groups) for s in group]
    where = {s.label: campaign for group, campaign in groups for s in group}
    labels = set(where)
    for test in tests:
        for s in test.found.suspects:
            if s.label not in labels:
                labels.add(s.label)
                where[s.label] = test.campaign
                named.append(replace(s, in_group=False))
    unclear = next((test for test in tests if any(c == test.campaign and len(g) > 1 for g, c in groups)), None)
    known_of = {test.campaign: test.known for test in tests}
    worst = max(
        (f for f in diagnoses if f.unresolved),
        key=lambda f: f.unresolved.systematic_rms_um if f.unresolved else 0.0,
        default=None,
    )
    alone = [doubts_of(test, library) for test in tests]
    hidden = _hidden(twin, tests, alone, library)
    doubts = undecided_together(tests, alone, library, _absent(twin.terms, twin.estimates))
    asked = replace(unclear.found, found=tuple(g for g, c in groups if c == unclear.campaign)) if unclear else None
    if unclear is None and doubts:
        unclear = next(test for test in tests if doubts[0][0] in {term.label for term in test.known})
        asked = replace(unclear.found, found=(), suspects=(), undecided=doubts)
    return SeveralDiagnosis(
        verdict=_verdict(diagnoses, groups, settled),
        headline=_headline(tests, groups, denied, twin.contradictions),
        residual_rms_um=figures["rms_after_um"],
        systematic_rms_um=figures["systematic_rms_um"],
        noise_floor_um=figures["noise_floor_um"],
        floor_kind=max((f.floor_kind for f in diagnoses), key=("none", "within_run", "repeats").index),
        lack_of_fit_p=min(1.0, len(p_values) * min(p_values)) if p_values else float("nan"),
        suspects=tuple(named),
        found=tuple(group for group, _ in groups),
        unresolved=worst.unresolved if worst else None,
        where=tuple(
            sorted(
                ({**place, "campaign": test.campaign} for test in tests for place in test.found.where),
                key=lambda place: -float(place["residual_rms_um"]),
            )[:_PLACES]
        ),
        channels=tuple(channel for f in diagnoses for channel in f.channels),
        laws=worst.laws if worst else (),
        closest=next((f.closest for f in diagnoses if f.closest), None),
        invisible=tuple(sorted(label for label, why in hidden.items() if not why)),
        untestable={label: why for label, why in hidden.items() if why},
        outlier_runs=tuple(f"{test.campaign} {run}" for test in tests for run in test.found.outlier_runs),
        told=(),
        places=_places(tests),
        spread=next((f.spread for f in diagnoses if f.spread), None),
        next_experiment=next_experiment(unclear.obs, known_of[unclear.campaign], asked, library)
        if unclear and asked
        else None,
        undecided=doubts,
        tests=tuple(tests),
        settled=settled,
        contradictions=twin.contradictions,
        explained=explained,
        ruled_out=ruled_out,
        of_campaign=where,
    )


def _places(tests: Sequence[MachineTest]) -> tuple[Mapping[str, Any], ...]:
    """Return what happens at one place of an axis that no other campaign along an axis measured: each has its own travel."""
    alone = Counter(axis for test in tests if test.obs.there_and_back for axis in test.obs.axes)
    return tuple(place for test in tests for place in test.found.places if alone[place["axis"]] == 1)


def _hidden(
    twin: SeveralTwin,
    tests: Sequence[MachineTest],
    doubts: Sequence[Mapping[str, tuple[str, ...]]],
    library: Mapping[str, Effect],
) -> dict[str, str]:
    """Return the effects that no campaign of a kind that could show them shows, and why where something was not logged.

    ``doubts``: of each test. In the place of a size that another one tells, too, an effect shows: both contradict each other.
    """
    has = {cause_of(t.instance.effect) for t in twin.terms}
    told = Counter(key_of(term) for test in tests for term in test.known)
    shown = {
        label
        for test, doubt in zip(tests, doubts, strict=True)
        for term in test.known
        if told[key_of(term)] > 1
        for label in doubt.get(term.label, ())
    }
    labels = dict.fromkeys(label for test in tests for label in (*test.found.invisible, *test.found.untestable))
    out = {}
    for label in labels:
        name, _, axis = label.partition(" ")
        effect = library[name]
        able = [
            t.found
            for t in tests
            if t.obs.grid.kind in effect.kinds and (not axis or axis in (*t.obs.axes, *t.obs.planes))
        ]
        if (
            label not in shown
            and cause_of(effect) not in has
            and all(label in f.invisible or label in f.untestable for f in able)
        ):
            out[label] = next((f.untestable[label] for f in able if label in f.untestable), "")
    return out


def _verdict(diagnoses: Sequence[Diagnosis], groups: Sequence[Group], settled: Joint) -> Verdict:
    if groups:
        return "missing_effect" if len(groups[0][0]) == 1 else "ambiguous"
    if any(shared.apart for shared in settled.shared):
        return "unknown_effect"
    said = {f.verdict for f in diagnoses}
    return next((verdict for verdict in _QUIET if verdict in said), "nothing_missing")


def _headline(
    tests: Sequence[MachineTest], groups: Sequence[Group], denied: Sequence[str], apart: Sequence[Contradiction]
) -> str:
    if groups:
        names = "; ".join(" or ".join(s.label for s in group) for group, _ in groups)
        single = all(len(group) == 1 for group, _ in groups)
        said = f"{names} {'is' if len(groups) == 1 else 'are'} missing" if single else names
    else:
        quiet: dict[str, list[str]] = {}
        for test in tests:
            if not test.found.found:
                quiet.setdefault(test.found.headline, []).append(test.campaign)
        said = "; ".join(f"{', '.join(names)}: {line}" for line, names in quiet.items()) or "nothing that all agree on"
    if denied:
        said += f"; one campaign alone would name {', '.join(denied)}, all that see it together do not"
    for one in apart:
        said += f"; {', '.join(one.campaigns)} contradicts {', '.join(one.others)} on {one.effect} {one.axis}".rstrip()
    return said
