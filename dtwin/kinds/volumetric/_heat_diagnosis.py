"""What a twin of heat lacks: which error motions, which temperatures tell them, which do not.

Each error motion is identified in every cycle with its uncertainty, so that a motion that moves more
than that is seen by itself. Cycles are not independent, heat lasts: whether temperatures explain a
motion is judged on spans of hours that were left out as a whole, and the p-value counts as many cycles
as the autocorrelation leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from dtwin.features.time_alone import TIME_ALONE
from dtwin.kinds.volumetric._heat_series import HeatSeries
from dtwin.kinds.volumetric._movers import (
    ALPHA,
    MATERIAL,
    Mover,
    beside_others,
    beside_others_mover,
    fit_p,
    mover_of,
    seen_um,
    still_p,
)
from dtwin.kinds.volumetric.heat_twin import KIND, HeatFit, heat_figures
from dtwin.kinds.volumetric.motions import HeatTerm, family_of, motion_words
from dtwin.statistics import holm
from dtwin.units import shown_number

_Verdict = Literal["missing_effect", "ambiguous", "unknown_effect", "nothing_missing"]


@dataclass(frozen=True)
class HeatDiagnosis:
    """What is missing in a twin of heat.

    ``figures``: errors at the balls, as :func:`dtwin.kinds.volumetric.heat_twin.heat_figures` has them.
    ``lack_of_fit_p``: of the hypothesis that the twin leaves nothing but noise of the motions.
    ``movers``: motions that count, best first.
    ``group``: those that the verdict is about.
    ``quiet``: motions that move, but by less than counts.
    ``one_body``: thermocouples whose names differ by their number alone, where there are no others.
    """

    verdict: _Verdict
    headline: str
    figures: dict[str, float]
    lack_of_fit_p: float
    movers: tuple[Mover, ...]
    group: tuple[Mover, ...]
    quiet: tuple[str, ...]
    one_body: tuple[str, ...] = ()
    where: tuple[dict[str, Any], ...] = ()
    next_experiment: dict[str, Any] | None = None
    idle: tuple[HeatTerm, ...] = ()

    @property
    def additions(self) -> tuple[str, ...]:
        """What to add to the twin, best first; what time alone tells as well is for the user to say."""
        return tuple(m.addition for m in self.group if m.addition and not m.is_as_time)

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {
            "kind": KIND,
            "verdict": self.verdict,
            "headline": self.headline,
            "residual_rms_um": self.figures["rms_after_um"],
            "systematic_rms_um": self.figures["systematic_rms_um"],
            "noise_floor_um": self.figures["noise_floor_um"],
            "floor_kind": "identified motions",
            "replication": "cycle",
            "lack_of_fit_p": self.lack_of_fit_p,
            "candidates": [self._candidate(mover) for mover in self.movers],
            "where": [dict(place) for place in self.where],
            "channels": sorted({m.channel for m in self.group if m.channel and m.told}),
            "laws": [],
            "closest": None,
            "invisible": [],
            "untestable": {},
            "outlier_runs": [],
            "variance": {},
            "quiet": list(self.quiet),
            "one_body": list(self.one_body),
            "next_experiment": self.next_experiment,
        }

    def _candidate(self, mover: Mover) -> dict[str, Any]:
        family = family_of(mover.motion)
        term = HeatTerm(mover.motion)
        alike = [HeatTerm(mover.motion, (body,)).label for body in mover.bodies if len(mover.bodies) > 1]
        return {
            "effect": mover.motion,
            "axis": term.axis,
            "label": mover.label,
            "family": family.name,
            "title": motion_words(mover.motion),
            "rms_after_um": mover.rms_after_um,
            "seen_um": mover.seen_um,
            "cv_gain": mover.gain,
            "p_value": mover.p_value,
            "in_group": mover in self.group,
            "grade": _grade(mover),
            "confounded_with": [TIME_ALONE] if mover.is_as_time else alike,
            "temperatures": list(mover.sensors),
            "alike": {body: list(others) for body, others in mover.alike.items() if others},
            "as_time_alone": list(mover.as_time),
            "explained_by": mover.channel if mover.told else None,
            "largest_inflation": mover.largest_inflation,
            "add": mover.addition or None,
            "remedy": family.remedy,
        }


def diagnose_heat(series: HeatSeries, fitted: HeatFit, where: Sequence[dict[str, Any]]) -> HeatDiagnosis:
    """Find out what a twin lacks."""
    left = series.values - fitted.expected
    still = holm([still_p(series, left[:, i], i) for i in range(len(series.names))])
    moving = [i for i in range(len(series.names)) if still[i] < ALPHA]
    counts = [i for i in moving if seen_um(series, left[:, i], i) >= MATERIAL * series.floor_um]
    models = {model.name: model.sensors for model in fitted.models}
    figures, p_value = heat_figures(series, left), fit_p(series, left)
    movers = [mover_of(series, left, i, models.get(series.names[i], ())) for i in counts]
    rejected = p_value < ALPHA and figures["systematic_rms_um"] >= MATERIAL * figures["noise_floor_um"]
    if rejected and not movers:
        movers = [
            beside_others_mover(series, left, i, models.get(series.names[i], ()), moved)
            for i, moved in beside_others(series, left)
        ]
    explained_p = holm([m.p_value for m in movers])
    movers = [replace(m, p_value=float(p)) for m, p in zip(movers, explained_p, strict=True)]
    movers.sort(key=lambda m: m.rms_after_um)
    verdict, group = _verdict(movers)
    return HeatDiagnosis(
        verdict,
        _headline(verdict, group, movers, figures, None if counts else p_value),
        figures,
        p_value,
        tuple(movers),
        group,
        tuple(series.names[i] for i in moving if i not in counts),
        series.thermocouples if len(series.bodies) == 1 < len(series.thermocouples) else (),
        tuple(where),
        _experiment(verdict, group, small=not counts),
    )


def _verdict(movers: Sequence[Mover]) -> tuple[_Verdict, tuple[Mover, ...]]:
    """Return the verdict and its motions: what is sure first, what nobody can help last."""
    explained = [m for m in movers if m.explained]
    sure = tuple(m for m in explained if m.is_sure)
    if sure:
        return "missing_effect", sure
    helped = [m for m in movers if m.addition and not m.is_as_time]
    if helped and helped[0].explained:
        return "ambiguous", tuple(m for m in explained if not m.is_as_time)
    unsure = [m for m in movers if not m.explained or m.is_as_time]
    if unsure:
        group = tuple(sorted(unsure, key=lambda m: (m not in helped, -m.seen_um)))
        return ("ambiguous" if all(m.is_as_time for m in unsure) else "unknown_effect"), group
    return "nothing_missing", ()


def _grade(mover: Mover) -> str | None:
    """Return how well a name is confirmed: by its shape, or also by one cause on hours left out."""
    if not mover.addition:
        return None
    return "law-confirmed" if mover.channel or len(mover.bodies) == 1 else "shape-consistent"


def _experiment(verdict: _Verdict, group: Sequence[Mover], *, small: bool) -> dict[str, Any] | None:
    """Return what to measure next. ``small``: whether no motion counts by itself."""
    if verdict == "ambiguous":
        best, bodies = group[0], group[0].bodies
        if best.is_as_time:
            text = f"measure on until {_listed(best.as_time)} has warmed and cooled again, more than once: time alone does not follow that"
            return {"text": text, "heat_alone": [], "watch": [m.motion for m in group]}
        text = (
            f"heat {bodies[0]} alone, with {_listed(bodies[1:])} at rest, then the other way round; "
            f"a cycle an hour: {best.motion} follows the one that drives it"
        )
        return {"text": text, "heat_alone": list(bodies), "watch": [m.motion for m in group]}
    unknown = [m.motion for m in group if not m.addition or m.is_as_time] if verdict == "unknown_effect" else []
    if not unknown:
        return None
    text = "measure on, for more cycles tell smaller motions; or " if small else ""
    text += (
        f"put a thermocouple on what has none (foundation, tanks, spindle, scales): what moves "
        f"{_listed(unknown)} is not measured, or lags far behind what is"
    )
    return {"text": text, "heat_alone": [], "watch": unknown}


def _headline(
    verdict: _Verdict, group: Sequence[Mover], movers: Sequence[Mover], figures: dict[str, float], p_value: float | None
) -> str:
    """Return the verdict in words. ``p_value``: of the whole fit; None where a motion counts by itself."""
    together = ""
    if p_value is not None and p_value < ALPHA:
        left = figures["systematic_rms_um"]
        together = (
            f"all motions together leave {shown_number(left, 2)} µm more than noise at the balls (p {p_value:.1g})"
        )
    if verdict == "nothing_missing":
        least = MATERIAL * figures["noise_floor_um"]
        none = f"no error motion moves by more than {shown_number(least, 2)} µm at the balls beyond the twin"
        return f"{none}; {together}" if together else none
    if together:
        return f"{together}, each by itself none; with the others at rest {_headline(verdict, group, movers, figures, None)}"
    best = group[0]
    what = f"{best.motion} ({motion_words(best.motion)}: {family_of(best.motion).title})"
    others = f"; {len(group) - 1} more" if len(group) > 1 else ""
    lacks = "lacks temperatures" if best.in_twin else "is missing"
    if verdict == "missing_effect":
        unknown = [m.motion for m in movers if not m.explained]
        also = f"; not explained by thermocouples: {', '.join(unknown)}" if unknown else ""
        return f"{what} {lacks}, {100 * best.gain:z.0f} % of it is told on hours left out{others}{also}"
    if best.is_as_time:
        return f"{what} moves, and {_listed(best.as_time)} tells it, but so does {TIME_ALONE}{others}"
    if verdict == "ambiguous":
        return f"{what} {lacks}, but {_listed(best.bodies)} each tell it alone, equally well{others}"
    if best.addition:
        return f"{what} moves, and no thermocouple tells it; {best.channel} does{others}"
    return f"{what} moves, and nothing that was logged tells it{others}"


def _listed(names: Sequence[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
