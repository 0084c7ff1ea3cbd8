"""What a displacement may follow, and what a twin of drift lacks: sensors, lags, curves, each judged on stretches of time that were held out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from dtwin.documents import finite
from dtwin.errors import InputError
from dtwin.features.time_alone import ALPHA, MATERIAL, TIME_ALONE, share_taken
from dtwin.kinds.drift._model import Series, Term, fitted, held_out, held_out_um, left_with_time
from dtwin.kinds.drift._search import Addition, additions, best_lag, further, idle, together
from dtwin.statistics import gain_tail, rms
from dtwin.units import shown_number

KIND = "drift"
REPLICATION = "stretch of time"
_BEYOND = 1.5
"""What is left on times held out is more than noise when it is this many times it."""
_Verdict = Literal["missing_effect", "ambiguous", "unknown_effect", "nothing_missing", "need_repeats"]


@dataclass(frozen=True)
class DriftDiagnosis:
    """What is missing.

    ``group``: what the verdict is about: the best, and what takes no less for all that these times tell.
    ``idle``: terms of the twin that pay nothing beside the others.
    """

    verdict: _Verdict
    headline: str
    figures: dict[str, float]
    candidates: tuple[Addition, ...]
    group: tuple[Addition, ...]
    idle: tuple[Term, ...]

    @property
    def additions(self) -> tuple[str, ...]:
        """What to add, best first."""
        return tuple(written(one.added) for one in self.group)

    @property
    def alike(self) -> tuple[str, ...]:
        """What this log cannot tell apart: what to add, and time alone where that takes as much."""
        return (*self.additions, *([TIME_ALONE] if any(one.is_as_time for one in self.group) else []))

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        now = self.figures["held_out_rms_um"]
        return {
            "kind": KIND,
            "verdict": self.verdict,
            "headline": self.headline,
            "residual_rms_um": self.figures["rms_after_um"],
            "held_out_rms_um": now,
            "noise_floor_um": finite(self.figures["noise_floor_um"]),
            "replication": REPLICATION,
            "lack_of_fit_p": None,
            "candidates": [
                {
                    "effect": effect_of(one.added).name,
                    "axis": one.added.name,
                    "label": written(one.added),
                    "time_constant_min": one.added.tau_s / 60.0 or None,
                    "rms_after_um": now * float(np.sqrt(max(1.0 - one.gain, 0.0))),
                    "cv_gain": one.gain,
                    "p_value": one.p_value,
                    "in_group": one in self.group,
                    "grade": "shape-consistent" if one in self.group else None,
                    "confounded_with": [other for other in self.alike if other != written(one.added)]
                    if one in self.group
                    else [],
                    "remedy": effect_of(one.added).remedy,
                }
                for one in self.candidates
            ],
            "invisible": [],
            "idle": [written(term) for term in self.idle],
            "where": [],
            "next_experiment": self._experiment(),
        }

    def _experiment(self) -> dict[str, Any] | None:
        if self.verdict == "need_repeats":
            return {"text": "read the place twice each time, and number the readings in a column sample"}
        if self.verdict == "ambiguous":
            names = sorted({one.added.name for one in self.group})
            if len(names) == 1:
                return {"text": f"a log in which {names[0]} warms and cools again, more than once"}
            return {
                "text": f"a log in which {' and '.join(names)} do not warm together: other jobs, a cold morning, one source alone"
            }
        if self.verdict == "unknown_effect":
            return {"text": "log a temperature nearer to what moves, or what else changes with the time of day"}
        return None


def drift_figures_of(series: Series, terms: Sequence[Term]) -> dict[str, float]:
    """Return errors before and after, RMS in µm; before: about the mean of the log."""
    return {
        "rms_before_um": float(np.std(series.moved_um)),
        "rms_after_um": fitted(series, terms).left_um,
        "held_out_rms_um": rms(held_out_um(series, terms)),
        "noise_floor_um": series.floor_um,
    }


def diagnose(series: Series, terms: Sequence[Term]) -> DriftDiagnosis:
    """Find out what a twin of drift lacks."""
    figures = drift_figures_of(series, terms)
    tried = additions(series, terms)
    paying = [one for one in tried if one.pays]
    best = next(iter(paying), None)
    if best is not None and not best.sure:
        # It may be so once others are there.
        told = {term.channel for term in further(series, terms)}
        best = next((one for one in paying if one.added.channel in told), None)
    group = () if best is None else (best, *(one for one in paying if one is not best and one.equals(best)))
    verdict: _Verdict
    if group:
        names = [_words(one) for one in group] + [TIME_ALONE] * any(one.is_as_time for one in group)
        verdict = "missing_effect" if len(names) == 1 else "ambiguous"
        said = " or ".join(names) + (" is missing" if len(names) == 1 else ": this log does not tell which")
    else:
        verdict, said = beside_noise(series, figures["held_out_rms_um"])
        if verdict == "unknown_effect":
            known = next((one.by_time for one in tried if one.by_time is not None), None)
            before, after = held_out(series, terms).squares, left_with_time(series, terms) if known is None else known
            if gain_tail(before, after) < ALPHA and (share := share_taken(before, after)) > MATERIAL:
                said += f"; {TIME_ALONE} takes {100.0 * share:z.0f} % of the squares: something settles, or follows a body without a sensor"
    return DriftDiagnosis(verdict, said, figures, tuple(tried), group, idle(series, terms))


def explained_together(series: Series, terms: Sequence[Term]) -> tuple[Term, ...]:
    """Return what a search finds in the place of terms that begins with every sensor and explains all but noise, or that goes on
    past what is not sure; nothing where terms do as well.
    """
    explained: tuple[Term, ...] = ()
    if beside_noise(series, rms(held_out_um(series, terms)))[0] == "unknown_effect":
        explained = together(series, terms, _BEYOND * _noise_um(series))
    return explained or further(series, terms)


def _noise_um(series: Series) -> float:
    """Return the noise of a reading; without readings that were repeated at once its bound by those that follow each other."""
    return series.floor_um if np.isfinite(series.floor_um) else series.next_um


def beside_noise(series: Series, left_um: float) -> tuple[_Verdict, str]:
    """Return the verdict on what is left (µm RMS) on times held out when no effect surely explains it, and why."""
    floor, noise = _noise_um(series), "the noise of a reading"
    if not np.isfinite(series.floor_um):
        noise = "what readings that follow each other scatter by"
        if not left_um > _BEYOND * floor:
            return "need_repeats", "no reading was repeated at once, so that nobody knows what is noise"
    if left_um > _BEYOND * floor:
        said = f"{left_um:z.1f} µm are left on times held out, {left_um / floor:z.1f} times {noise}"
        return "unknown_effect", f"{said}; no sensor, lag or curve surely explains it alone"
    return "nothing_missing", f"what is left on times held out, {left_um:z.1f} µm, is noise ({floor:z.1f} µm)"


def _words(one: Addition) -> str:
    late = f", {shown_number(one.added.tau_s / 60.0)} min" if one.added.tau_s else ""
    return f"{one.said}{late} ({written(one.added)})"


@dataclass(frozen=True)
class _Effect:
    """One cause; ``term`` is the kind of its column, ``group`` of what it is on pages, ``per`` what there is one of it for."""

    name: str
    title: str
    term: str
    unit: str
    remedy: str
    group: str = "heat"
    per: str = "sensor"

    @property
    def parameters(self) -> tuple[tuple[str, str], ...]:
        """Names and units of what is fitted."""
        return (("per_kelvin", self.unit), *((("time_constant", "s"),) if self.term in ("lag", "lag2") else ()))


EFFECTS = {
    effect.name: effect
    for effect in (
        _Effect(
            "follows",
            "Moves with a temperature at once",
            "steady",
            "um/K",
            "Cool or warm up what the sensor sits on; or correct it.",
        ),
        _Effect(
            "lag",
            "Follows a temperature late: what moves lies behind the sensor",
            "lag",
            "um/K",
            "Put the sensor into what moves (a pocket in the casting); or correct it with the lag.",
        ),
        _Effect(
            "second_lag",
            "Follows a temperature through two lags of the same time constant",
            "lag2",
            "um/K",
            "Put the sensor into what moves; or correct it with both lags.",
        ),
        _Effect(
            "sensor_curve",
            "The scale of a sensor is not straight, or what it stands for is not",
            "curve",
            "um/K^2",
            "Calibrate the sensor: the constants of a thermistor.",
            "instrument",
        ),
    )
}
_BY_TERM = {effect.term: effect for effect in EFFECTS.values()}
_MOVES = ("steady", "lag", "lag2")


def effect_of(term: Term) -> _Effect:
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
