"""Effects of a machine, whatever instrument looks at it: which of them are the same cause, and what is shared."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from dtwin.errors import InputError
from dtwin.physics.effect import Effect, Instance
from dtwin.physics.library import instances
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.screw import PITCH
from dtwin.physics.state import AXES_OF, has_joints
from dtwin.physics.twin import acts

# Waves along an axis: campaigns have no common zero, so that each has its own phase and all have one amplitude.
_WAVES = frozenset(
    (
        "cyclic_error",
        "cyclic_error_by_direction",
        "periodic_error",
        "pitch_error",
        "screw_error",
        "screw_error_by_direction",
    )
)
_LEAD, _CURVE = "scale", "pitch_error"
# What belongs to the instrument, the day, or the stretch of the axis that was measured.
_OWN = frozenset(
    (
        "thermal_drift",
        "thermal_shift",
        "warming_growth",
        "instrument_artefact",
        "learned_bump",
        "learned_end",
        "learned_step",
        "measurement_delay",
        "slow_take_up",
        "worn_screw",
    )
)
# The first order of a screw's turn is what a circle shows as a cyclic error.
_CAUSES = {
    "cyclic_error": "screw",
    "screw_error": "screw",
    "cyclic_error_by_direction": "screw_by_direction",
    "screw_error_by_direction": "screw_by_direction",
}


def cause_of(effect: Effect) -> str:
    """Return what of the machine an effect measures; its name where no other effect measures it."""
    return effect.cause or _CAUSES.get(effect.name, effect.name)


def key_of(term: Term) -> tuple[str, str]:
    """Return cause and axis: terms with the same key are one thing."""
    return cause_of(term.instance.effect), term.instance.axis


def own_term(term: Term, terms: Iterable[Term]) -> Term:
    """Return the term of a machine that is the same thing as one of a campaign; that one where none is."""
    return next((own for own in terms if key_of(own) == key_of(term)), term)


def is_wave(term: Term) -> bool:
    """Tell whether campaigns share the amplitude of a term and nothing else."""
    return term.instance.effect.name in _WAVES


def is_shared(term: Term, terms: Iterable[Term]) -> bool:
    """Tell whether the parameters of a term are the same in all campaigns of the machine.

    ``terms``: all of the machine. Where the lead of an axis is a curve, its mean is that of the stretch that was measured.
    """
    if cause_of(term.instance.effect) == _LEAD:
        return not any(t.instance.effect.name == _CURVE and t.instance.axis == term.instance.axis for t in terms)
    return term.instance.effect.name not in _WAVES | _OWN


def seen_by(term: Term, obs: Observations, library: Mapping[str, Effect]) -> Term | None:
    """Return a term of the machine as a campaign sees it; None where it does nothing there."""
    mine = term.instance.effect
    family = [mine, *(e for e in library.values() if e is not mine and cause_of(e) == cause_of(mine))]
    effect = next((e for e in family if obs.grid.kind in e.kinds), None)
    if effect is None:
        return None
    instance = Instance(effect, term.instance.axis)
    if not acts(obs, instance):
        return None
    shape = {name: value for name, value in term.shape.items() if name in effect.start_shape}
    return Term(instance, effect.start_shape | shape)


def machine_terms(
    names: Sequence[str], library: Mapping[str, Effect], campaigns: Sequence[Observations], axis: str = ""
) -> list[Term]:
    """Return effects by name, on every axis where a campaign of the machine sees them.

    The difference of two axes that a circle shows is taken apart into the axes where another campaign sees one of them.

    ``names``: names; ``name:axis`` takes one axis. Names of one cause are one term.
    ``axis``: take this axis only.
    Raises ``InputError`` when there is no such effect, or no campaign sees it.
    """
    out: dict[tuple[str, str], Term] = {}
    for wanted in names:
        name, _, own = wanted.partition(":")
        effect = library[name]
        if effect.setup:
            continue
        places = _places(effect, library, campaigns)
        where = own or axis
        chosen = [i for i in places if not where or i.axis == where or i.axis in AXES_OF.get(where, ())]
        terms = [Term(i, i.effect.start_shape | _stated_pitch(i, campaigns)) for i in chosen]
        terms = [t for t in terms if any(seen_by(t, obs, library) is not None for obs in campaigns)]
        if not where and effect.per == "machine_and_axis":
            terms = terms[:1]
        if not terms:
            raise _nowhere(effect, where, places, campaigns)
        for term in terms:
            out.setdefault(key_of(term), term)
    return list(out.values())


def _stated_pitch(instance: Instance, campaigns: Sequence[Observations]) -> dict[str, float]:
    """Return the pitch that a campaign of the axis states, where an effect does not seek it by itself: circles must not guess it."""
    if PITCH not in instance.effect.stated:
        return {}
    stated = (obs.campaign.machine_geometry.get(PITCH) for obs in campaigns if obs.axes == (instance.axis,))
    return next(({"pitch_mm": float(mm)} for mm in stated if isinstance(mm, int | float) and mm > 0.0), {})


def _places(effect: Effect, library: Mapping[str, Effect], campaigns: Sequence[Observations]) -> list[Instance]:
    family = [e for e in library.values() if cause_of(e) == cause_of(effect)]
    kinds = {kind for e in family for kind in e.kinds}
    campaigns = [obs for obs in campaigns if obs.grid.kind in kinds] or campaigns
    planes = tuple(dict.fromkeys(plane for obs in campaigns for plane in obs.planes))
    axes = tuple(sorted({axis for obs in campaigns for axis in obs.axes}))
    joints = any(has_joints(obs.campaign.machine_geometry) for obs in campaigns)
    as_difference = next((e for e in family if e.per == "plane_or_axis"), None)
    if as_difference is None:
        return instances(effect, [p for p in planes if p in AXES_OF] or planes, axes, joints=joints)
    out: dict[str, Instance] = {}
    for plane in planes:
        pair = AXES_OF.get(plane, (plane,))
        others = {a for other in planes if other != plane for a in AXES_OF.get(other, (other,))}
        if len(pair) > 1 and not others & set(pair):
            out[plane] = Instance(as_difference, plane)
        else:
            out |= {a: Instance(effect, a) for a in pair}
    return list(out.values())


def _nowhere(effect: Effect, where: str, places: Sequence[Instance], campaigns: Sequence[Observations]) -> InputError:
    absent = [n for n in effect.needs if not any(n in obs.logged for obs in campaigns)]
    on = ", ".join(i.axis or "the machine" for i in places)
    kinds = f"campaigns of kind {', '.join(effect.kinds)}"
    return InputError(
        "none of these campaigns sees an effect",
        code="effect.where",
        where=", ".join(obs.campaign.name for obs in campaigns),
        got=f"{effect.name} {where}".strip(),
        allowed=f"campaigns that log {', '.join(absent)}" if absent else f"{kinds}; on {on}" if on else kinds,
    )
