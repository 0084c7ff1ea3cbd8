"""A provisional effect for structure that no effect explains: a scaling law, a formula, or a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dtwin.errors import GateRefusal
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.physics import localise
from dtwin.physics.centres import without_centre
from dtwin.physics.cross_validation import left_out_gain
from dtwin.physics.diagnosis import Diagnosis
from dtwin.physics.effect import Instance
from dtwin.physics.learned import learned_effect, learned_name
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term, set_up
from dtwin.physics.several_diagnosis import SeveralDiagnosis
from dtwin.physics.twin import predict_um
from dtwin.physics.whitening import from_harmonics, to_harmonics
from dtwin.schema import Floats
from dtwin.train.residual_formula import place_map, search_residual
from dtwin.train.symbolic import Engine
from dtwin.twins._learned import WithLearned
from dtwin.twins.of_kind import AnyTwin, AnyTwins
from dtwin.twins.seen import able_to, seen_on

_CONDITION = "a plane, radius and feed"


@dataclass(frozen=True)
class _Learned:
    """What a twin learned.

    ``twin``: the new version.
    ``gain``: share of what is left that it takes away on conditions that were left out: of the mean square, of a law
    the mean of every condition's share.
    ``left_out``: what was left out at a time, and how often.
    ``said``: what else people see of it.
    """

    twin: AnyTwin
    gain: float
    left_out: str
    said: str = ""


def learn_law(twins: AnyTwins, name: str, *, seed: int = 0) -> _Learned:
    """Add the scaling law that describes unknown structure best; ``seed``: of permutations."""
    left = _unknown(twins, name, seed)
    problem = set_up(left.obs, left.terms, [])
    for law in left.found.laws:
        effect = learned_effect(learned_name(law))
        gain = left_out_gain(problem, problem.whitened(left.obs.regressors(Instance(effect), {})))
        if gain > 0.0:
            several = len(set(left.obs.place_of.tolist())) > 1
            return _Learned(twins.add(name, effect.name), gain, f"{_CONDITION}{left.of}" if several else "a run")
    raise _does_not_hold(
        left.twin,
        "no power law holds on conditions that were left out",
        left.found.laws[0].equation if left.found.laws else "no power law is significant",
        "--map or --symbolic may; or measure more feeds and radii, or write the effect yourself",
    )


def learn_formula(twins: AnyTwins, name: str, engine: Engine, *, seed: int = 0) -> _Learned:
    """Add a formula for what is left, found by symbolic regression; ``seed``: of permutations and of the search."""
    left = _unknown(twins, name, seed)
    formula = search_residual(left.obs, left.residual_um, engine, seed)
    if formula.gain <= 0.0:
        got = f"{formula.text[:120]}, gain {100 * formula.gain:z.0f} %"
        hint = "measure more feeds or radii, or write the effect yourself"
        raise _does_not_hold(left.twin, "no formula holds on conditions that were left out", got, hint)
    twin = twins.add(name, left.library.keep(formula))
    return _Learned(twin, formula.gain, f"{_CONDITION}{left.of}, {formula.groups}", f"\nformula, µm: {formula.shown}")


def learn_map(twins: AnyTwins, name: str, *, seed: int = 0) -> _Learned:
    """Add a map of what is left at the same place of a circle at every feed; ``seed``: of permutations."""
    left = _unknown(twins, name, seed)
    places = place_map(left.obs, left.residual_um)
    if places.gain <= 0.0:
        got = f"gain {100 * places.gain:z.0f} %"
        hint = f"dtwin twin learn {name} looks for a law over feed and radius"
        raise _does_not_hold(left.twin, "what is left is not the same at every feed", got, hint)
    law = left.found.laws[0].equation if left.found.laws else ""
    other = f"dtwin twin restore {name} --version {left.twin.version}, then dtwin twin learn {name}"
    said = f"\na law may tell more of it: {law}; {other}" if law else ""
    left_out = f"a plane and radius{left.of}, {places.groups}, and each feed"
    return _Learned(twins.add(name, left.library.keep(places)), places.gain, left_out, said)


def _does_not_hold(twin: AnyTwin, message: str, got: str, hint: str) -> GateRefusal:
    where = f"twin {twin.name} version {twin.version}"
    return GateRefusal(message, code="twin.law_does_not_hold", where=where, got=got, hint=hint)


@dataclass(frozen=True)
class _Unknown:
    """Unknown structure that a twin leaves.

    ``obs``: the runs of one campaign; of several that can be learned from those of all, what the twin knows taken out.
    ``terms``: effects that stand beside it in these runs.
    ``found``: what was found out of them; of several those in which most is left.
    ``of``: how people read what is left out of them.
    """

    twin: AnyTwin
    library: WithLearned
    obs: Observations
    terms: tuple[Term, ...]
    found: Diagnosis
    of: str = ""

    @property
    def residual_um(self) -> Floats:
        """What is left, shape (rows, n)."""
        return localise.residual_um(self.obs, self.terms)


def _unknown(twins: AnyTwins, name: str, seed: int) -> _Unknown:
    twin = twins.newest(name)
    able = able_to(twins.home, twin, "laws")
    if not able:
        kind_named(Lake(twins.home.lake).campaign(twin.campaigns[0]).kind).require("laws")
    seen = seen_on(twins, name, able[0])
    diagnosis = seen.lacks(None, seed)
    if diagnosis.verdict != "unknown_effect":
        raise GateRefusal(
            "there is no unknown structure to learn",
            code="twin.nothing_to_learn",
            where=f"twin {name} version {twin.version}",
            got=f"{diagnosis.verdict}: {diagnosis.headline}",
            hint=f"dtwin twin add {name} EFFECT adds what is named"
            if diagnosis.found
            else f"dtwin twin diagnose {name}",
        )
    if not isinstance(diagnosis, SeveralDiagnosis):
        return _Unknown(twin, seen.library, seen.obs, seen.twin.terms, diagnosis)
    unknown = [test for test in diagnosis.tests if test.found.verdict == "unknown_effect"]
    told = [test.found for test in unknown if test.campaign in able]
    if not told:
        kind_named(unknown[0].obs.grid.kind if unknown else seen.obs.grid.kind).require("laws")
    worst = max(told or [diagnosis], key=lambda found: found.systematic_rms_um)
    known = [(seen.whole.on(obs.campaign.name), obs) for obs in seen.tests if obs.campaign.name in able]
    left = [obs.with_y(obs.y_um - predict_um(part, obs)) for part, obs in known]
    of = " of all campaigns" if len(left) > 1 else ""
    return _Unknown(twin, seen.library, _together(left), (), worst, of)


def _together(tests: Sequence[Observations]) -> Observations:
    """Return the runs of several tests on one grid as one: equal conditions are one, set-ups and runs stay apart.

    Where the centre of one test wanders, none of them tells of it: a centre of one cannot be held against that of another.
    """
    wander_um = max(obs.wander_um for obs in tests)
    if wander_um:
        tests = [obs.with_y(from_harmonics(without_centre(to_harmonics(obs.y_um)))) for obs in tests]
    conditions = tuple(dict.fromkeys(c for obs in tests for c in obs.conditions))
    setups = [f"{obs.campaign.name} {setup}" for obs in tests for setup in obs.setups]
    first_setup = np.cumsum([0, *(len(obs.setups) for obs in tests[:-1])])
    first_run = np.cumsum([0, *(int(obs.run_of.max()) + 1 for obs in tests[:-1])])
    return replace(
        tests[0],
        campaign=replace(tests[0].campaign, name=", ".join(obs.campaign.name for obs in tests)),
        runs=tuple(meta for obs in tests for meta in obs.runs),
        wander_um=wander_um,
        y_um=np.concatenate([obs.y_um for obs in tests]),
        mask=np.concatenate([obs.mask for obs in tests]),
        conditions=conditions,
        condition_of=np.array([conditions.index(obs.conditions[c]) for obs in tests for c in obs.condition_of]),
        setups=tuple(setups),
        setup_of=np.concatenate([obs.setup_of + first for obs, first in zip(tests, first_setup, strict=True)]),
        run_of=np.concatenate([obs.run_of + first for obs, first in zip(tests, first_run, strict=True)]),
        columns=tuple(column for obs in tests for column in obs.columns),
        feed_mm_s=np.concatenate([obs.feed_mm_s for obs in tests]),
    )
