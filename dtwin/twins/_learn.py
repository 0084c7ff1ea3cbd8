"""A provisional effect for structure that no effect explains: a scaling law, or a formula."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dtwin.errors import GateRefusal
from dtwin.kinds.registry import kind_named
from dtwin.physics import localise
from dtwin.physics.cross_validation import left_out_gain
from dtwin.physics.diagnosis import Diagnosis
from dtwin.physics.effect import Instance
from dtwin.physics.learned import learned_effect, learned_name
from dtwin.physics.problem import set_up
from dtwin.physics.twin import Twin
from dtwin.train.residual_formula import ResidualFormula, search_residual
from dtwin.train.symbolic import Engine
from dtwin.twins.measured import load
from dtwin.twins.several import require_alone

if TYPE_CHECKING:
    from dtwin.twins.verbs import Twins


def learn_law(twins: Twins, name: str, seed: int) -> tuple[Twin, float]:
    """Add the scaling law that describes unknown structure best.

    Returns ``twin``: the new version.
    Returns ``gain``: mean relative gain on conditions that were left out of its fit.
    """
    twin, diagnosis = _unknown(twins, name, seed)
    obs = load(twins.home, twin.campaign).obs
    kind_named(obs.grid.kind).require("laws")
    problem = set_up(obs, twin.terms, [])
    for law in diagnosis.laws:
        effect = learned_effect(learned_name(law))
        gain = left_out_gain(problem, problem.whitened(obs.regressors(Instance(effect), {})))
        if gain > 0.0:
            return twins.add(name, effect.name), gain
    raise GateRefusal(
        "no power law holds on conditions that were left out",
        code="twin.law_does_not_hold",
        where=f"twin {name} version {twin.version}",
        got=diagnosis.laws[0].equation if diagnosis.laws else "no power law is significant",
        hint="--symbolic searches for other formulas; or measure more feeds and radii, or write the effect yourself",
    )


def learn_formula(twins: Twins, name: str, engine: Engine, seed: int) -> tuple[Twin, ResidualFormula]:
    """Add a formula for what is left, found by symbolic regression.

    ``seed``: of permutations and of the search.
    Returns ``twin``: the new version.
    Returns ``learned``: the formula, and its gain on conditions that were left out.
    """
    twin, _ = _unknown(twins, name, seed)
    obs = load(twins.home, twin.campaign).obs
    kind_named(obs.grid.kind).require("laws")
    learned = search_residual(obs, localise.residual_um(obs, twin.terms), engine, seed)
    if learned.gain <= 0.0:
        raise GateRefusal(
            "no formula holds on conditions that were left out",
            code="twin.law_does_not_hold",
            where=f"twin {name} version {twin.version}",
            got=f"{learned.text[:120]}, gain {100 * learned.gain:z.0f} %",
            hint="measure more feeds or radii, or write the effect yourself",
        )
    return twins.add(name, twins.library.keep(learned)), learned


def _unknown(twins: Twins, name: str, seed: int) -> tuple[Twin, Diagnosis]:
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
    return twin, diagnosis
