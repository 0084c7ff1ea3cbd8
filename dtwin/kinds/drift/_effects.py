"""What a displacement may follow, by names that a user writes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from dtwin.errors import InputError
from dtwin.kinds.drift._model import Series, Term
from dtwin.kinds.drift._search import best_lag


@dataclass(frozen=True)
class Effect:
    """One cause; ``term`` is the kind of its column."""

    name: str
    title: str
    term: str
    unit: str
    remedy: str


EFFECTS = {
    effect.name: effect
    for effect in (
        Effect(
            "follows",
            "Moves with a temperature at once",
            "steady",
            "um/K",
            "Cool or warm up what the sensor sits on; or correct it.",
        ),
        Effect(
            "lag",
            "Follows a temperature late: what moves lies behind the sensor",
            "lag",
            "um/K",
            "Put the sensor into what moves (a pocket in the casting); or correct it with the lag.",
        ),
        Effect(
            "second_lag",
            "Follows a temperature through two lags of the same time constant",
            "lag2",
            "um/K",
            "Put the sensor into what moves; or correct it with both lags.",
        ),
        Effect(
            "sensor_curve",
            "The scale of a sensor is not straight, or what it stands for is not",
            "curve",
            "um/K^2",
            "Calibrate the sensor: the constants of a thermistor.",
        ),
    )
}
_BY_TERM = {effect.term: effect for effect in EFFECTS.values()}
_MOVES = ("steady", "lag", "lag2")


def effect_of(term: Term) -> Effect:
    """Return the effect that a term is of."""
    return _BY_TERM[term.kind]


def written(term: Term) -> str:
    """Return a term as a user writes it."""
    return f"{effect_of(term).name}@{term.name}"


def sensors_of(series: Series) -> tuple[str, ...]:
    """Return the sensors of a log by their short names."""
    return tuple(Term("steady", channel).name for channel in series.temperatures_c)


def asked(series: Series, names: Iterable[str], axis: str = "") -> tuple[Term, ...]:
    """Return effects by name, ``lag@frame``, of every sensor where none is named; time constants are still to be found.

    Raises ``InputError`` when there is no such effect or sensor.
    """
    sensors = sensors_of(series)
    out: list[Term] = []
    for wanted in names:
        name, _, own = wanted.replace(":", "@").partition("@")
        if name not in EFFECTS:
            raise InputError("unknown effect", code="effect.unknown", got=wanted[:60], allowed=", ".join(EFFECTS))
        told = [part for part in (own or axis).split("+") if part] or list(sensors)
        for sensor in told:
            if sensor not in sensors:
                raise InputError(
                    "no such sensor", code="effect.axis", got=f"{name}@{sensor}"[:60], allowed=", ".join(sensors)
                )
            out.append(Term(EFFECTS[name].term, f"temperature_{sensor}_c"))
    return tuple(dict.fromkeys(out))


def joined(series: Series, terms: Sequence[Term], more: Sequence[Term]) -> tuple[Term, ...]:
    """Return terms with others, their time constants found; of one sensor the newest way to follow it holds."""
    kept = {(term.kind in _MOVES, term.channel): term for term in terms}
    kept |= {(term.kind in _MOVES, term.channel): term for term in more}
    out = list(kept.values())
    late = [i for i, term in enumerate(out) if term.kind in ("lag", "lag2") and term.tau_s == 0.0]
    # Of several that are new each is found beside the others, and then once more.
    for _ in range(2 if len(late) > 1 else 1):
        for i in late:
            others = [
                Term("steady", t.channel) if t.kind in _MOVES and t.tau_s == 0.0 else t
                for j, t in enumerate(out)
                if j != i
            ]
            out[i] = best_lag(series, others, out[i])
    return tuple(out)


def same(one: Term, other: Term) -> bool:
    """Tell whether two terms are one effect of one sensor, whatever the time constant."""
    return (one.kind, one.channel) == (other.kind, other.channel)
