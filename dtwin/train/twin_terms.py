"""The effects of a twin as terms of a bundle: which can be carried, and how each becomes an expression."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

from dtwin.errors import InputError
from dtwin.physics.problem import Term
from dtwin.physics.twin import Twin
from dtwin.schema import Floats
from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.train.traced import NotTraceable, expressions_of

_Made = TypeVar("_Made")

# Effects whose ``correctable`` names something else than an offset of position.
_NOT_BY_OFFSETS: Mapping[str, str] = {
    "reversal_spike": "over before an offset has arrived; friction compensation of the control",
    "friction": "torque, not position, is missing; friction compensation of the control",
    "reversal_ringing": "rings faster than an offset acts; input shaping",
    "structural_resonance": "its ringing is faster than an offset acts; stiffen or damp the mode",
    "stick_slip": "differs from pass to pass",
}


@dataclass(frozen=True)
class TermChoice:
    """What becomes of one effect of a twin. ``how``: how an offset corrects it, or why it is left out."""

    label: str
    included: bool
    how: str


def choose(term: Term) -> TermChoice:
    """Say whether offsets of position can correct an effect at all."""
    effect = term.instance.effect
    why = ""
    if effect.setup:
        why = "belongs to the mounting of the instrument, not to the machine"
    elif effect.source == "learned":
        why = "a description of the residual whose cause is not known"
    elif effect.name in _NOT_BY_OFFSETS:
        why = _NOT_BY_OFFSETS[effect.name]
    elif effect.on_spread:
        why = "differs from pass to pass"
    elif not effect.correctable:
        why = "offsets of position cannot correct it"
    if why:
        return TermChoice(term.label, False, why)
    return TermChoice(term.label, True, effect.correctable)


@dataclass(frozen=True)
class TwinBundle:
    """A twin's correction, frozen.

    ``bundle``: what would be served: the predicted error, to be applied with its sign changed; of tones the correction
    itself.
    ``terms``: every effect of the twin, included or left out with the reason.
    ``twin``: the twin reduced to what is included.
    """

    bundle: Bundle
    terms: tuple[TermChoice, ...]
    twin: Twin


@dataclass(frozen=True)
class _Carried(Generic[_Made]):
    """The part of a twin that a bundle carries.

    ``choices``: every effect of the twin, included or left out with the reason.
    ``twin``: the twin reduced to what is included.
    ``traced``: what each effect of the reduced twin became.
    """

    choices: tuple[TermChoice, ...]
    twin: Twin
    traced: tuple[_Made, ...]


def carried(twin: Twin, trace: Callable[[Term], _Made]) -> _Carried[_Made]:
    """Turn the effects of a twin that offsets of position can correct into something else.

    ``trace``: turns one effect into expressions, or raises ``NotTraceable`` with the reason.
    Raises ``InputError`` when nothing is left to correct.
    """
    choices, kept, traced = [], [], []
    for term in twin.terms:
        choice = choose(term)
        if choice.included:
            try:
                traced.append(trace(term))
                kept.append(term)
            except NotTraceable as error:
                choice = TermChoice(term.label, False, f"cannot be served: {error}")
        choices.append(choice)
    if not kept:
        told = "; ".join(f"{c.label}: {c.how}" for c in choices)
        raise InputError(
            "the twin has no effect that offsets of position can correct",
            code="correct.nothing",
            where=f"twin {twin.name} version {twin.version}",
            got=told or "a twin without effects",
        )
    return _Carried(tuple(choices), replace(twin, terms=tuple(kept)), tuple(traced))


def weighted(term: Term, state: Any, builder: GraphBuilder, weights: Floats) -> Expression:
    """Return what an effect does at a traced state, in um: its columns times its parameters.

    ``state``: with stand-ins for what serving tells.
    ``weights``, shape (parameters,): its fitted parameters.
    Raises ``NotTraceable`` when the effect does what a bundle cannot.
    """
    columns = traced_columns(term, state, builder)
    # Columns that are zero need no node.
    return builder.total(
        [
            float(w) * c
            for c, w in zip(columns, weights, strict=True)
            if not (builder.node(c).op == "const" and builder.node(c).value == 0.0)
        ]
    )


def traced_columns(term: Term, state: Any, builder: GraphBuilder) -> list[Expression]:
    """Return the regressors of an effect at a traced state, one for each parameter.

    Raises ``NotTraceable`` when the effect does what a bundle cannot.
    """
    return expressions_of(_regressors(term, state), builder, len(term.instance.effect.parameters))


def _regressors(term: Term, state: Any) -> Any:
    effect, axis = term.instance.effect, term.instance.axis
    try:
        return effect.regressors(state, axis, term.shape)
    except (NotTraceable, InputError) as error:
        raise NotTraceable(_told(error)) from error
    except Exception as error:
        raise NotTraceable(f"{type(error).__name__}: {error}") from error


def _told(error: Exception) -> str:
    if isinstance(error, InputError):
        return f"{error.message} ({error.got})" if error.got else error.message
    return str(error)
