"""A provisional effect for structure that no effect explains: a scaling law, a formula, or a map."""

from __future__ import annotations

from dataclasses import dataclass

from dtwin.errors import GateRefusal
from dtwin.kinds.registry import kind_named
from dtwin.physics import localise
from dtwin.physics.cross_validation import left_out_gain
from dtwin.physics.diagnosis import Diagnosis
from dtwin.physics.effect import Instance
from dtwin.physics.learned import learned_effect, learned_name
from dtwin.physics.observations import Observations
from dtwin.physics.problem import set_up
from dtwin.physics.twin import Twin
from dtwin.train.place_map import place_map
from dtwin.train.residual_formula import search_residual
from dtwin.train.symbolic import Engine
from dtwin.twins.measured import load
from dtwin.twins.several import require_alone
from dtwin.twins.verbs import Twins

_CONDITION = "a plane, radius and feed"


@dataclass(frozen=True)
class Learned:
    """What a twin learned.

    ``twin``: the new version.
    ``gain``: share of what is left that it takes away on conditions that were left out: of the mean square, of a law
    the mean of every condition's share.
    ``left_out``: what was left out at a time, and how often.
    ``said``: what else people see of it.
    """

    twin: Twin
    gain: float
    left_out: str
    said: str = ""


def learn_law(twins: Twins, name: str, *, seed: int = 0) -> Learned:
    """Add the scaling law that describes unknown structure best; ``seed``: of permutations."""
    twin, diagnosis, obs = _unknown(twins, name, seed)
    problem = set_up(obs, twin.terms, [])
    for law in diagnosis.laws:
        effect = learned_effect(learned_name(law))
        gain = left_out_gain(problem, problem.whitened(obs.regressors(Instance(effect), {})))
        if gain > 0.0:
            several = len(set(obs.place_of.tolist())) > 1
            return Learned(twins.add(name, effect.name), gain, _CONDITION if several else "a run")
    raise _does_not_hold(
        twin,
        "no power law holds on conditions that were left out",
        diagnosis.laws[0].equation if diagnosis.laws else "no power law is significant",
        "--map or --symbolic may; or measure more feeds and radii, or write the effect yourself",
    )


def learn_formula(twins: Twins, name: str, engine: Engine, *, seed: int = 0) -> Learned:
    """Add a formula for what is left, found by symbolic regression; ``seed``: of permutations and of the search."""
    twin, _, obs = _unknown(twins, name, seed)
    found = search_residual(obs, localise.residual_um(obs, twin.terms), engine, seed)
    if found.gain <= 0.0:
        got = f"{found.text[:120]}, gain {100 * found.gain:z.0f} %"
        hint = "measure more feeds or radii, or write the effect yourself"
        raise _does_not_hold(twin, "no formula holds on conditions that were left out", got, hint)
    twin = twins.add(name, twins.library.keep(found))
    return Learned(twin, found.gain, f"{_CONDITION}, {found.groups}", f"\nformula, µm: {found.shown}")


def learn_map(twins: Twins, name: str, *, seed: int = 0) -> Learned:
    """Add a map of what is left at the same place of a circle at every feed; ``seed``: of permutations."""
    twin, diagnosis, obs = _unknown(twins, name, seed)
    found = place_map(obs, localise.residual_um(obs, twin.terms))
    if found.gain <= 0.0:
        got = f"gain {100 * found.gain:z.0f} %"
        hint = f"dtwin twin learn {name} looks for a law over feed and radius"
        raise _does_not_hold(twin, "what is left is not the same at every feed", got, hint)
    law = diagnosis.laws[0].equation if diagnosis.laws else ""
    other = f"dtwin twin restore {name} --version {twin.version}, then dtwin twin learn {name}"
    said = f"\na law may tell more of it: {law}; {other}" if law else ""
    left_out = f"a plane and radius, {found.groups}, and each feed"
    return Learned(twins.add(name, twins.library.keep(found)), found.gain, left_out, said)


def _does_not_hold(twin: Twin, message: str, got: str, hint: str) -> GateRefusal:
    where = f"twin {twin.name} version {twin.version}"
    return GateRefusal(message, code="twin.law_does_not_hold", where=where, got=got, hint=hint)


def _unknown(twins: Twins, name: str, seed: int) -> tuple[Twin, Diagnosis, Observations]:
    require_alone(twins.newest(name), "learning a law")
    twin, diagnosis = twins.diagnose(name, seed=seed)
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
    obs = load(twins.home, twin.campaign).obs
    kind_named(obs.grid.kind).require("laws")
    return twin, diagnosis, obs
