"""What a twin of an arm lacks: terms that pay on poses left out, one by one.

Unit of replication is the block: neighbouring poses err alike, whatever is missing, so they are held out together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from dtwin.kinds.poses.effects import EFFECTS, Term
from dtwin.kinds.poses.fit import Grams, held_out_mm, left_mm
from dtwin.schema import Floats
from dtwin.statistics import holm, rms, t_tail

KIND = "poses"
Verdict = Literal["missing_effect", "ambiguous", "unknown_effect", "nothing_missing", "need_repeats"]
_ALPHA = 0.01
# A term counts when it takes a hundredth of the squares that are left on poses left out.
_MATERIAL = 0.01
# Another tells the same when it gains nearly as much alone, and little beside the best.
_AS_GOOD, _LITTLE = 0.8, 0.2
# Repeats tell that something is left when it is this many times their scatter.
_BEYOND = 1.5
_SHOWN = 8


@dataclass(frozen=True)
class Candidate:
    """A term that could be added.

    Attributes
    ----------
    gain : float
        Share of the squares left on blocks held out that it takes.
    p_value : float
        Of the hypothesis that it takes nothing, over blocks, after Holm over the terms.
    """

    term: Term
    gain: float
    p_value: float
    rms_after_um: float
    confounded: tuple[str, ...] = ()


@dataclass(frozen=True)
class PoseDiagnosis:
    """What is missing. ``group``: what the verdict is about; ``invisible``: terms that the poses cannot tell."""

    verdict: Verdict
    headline: str
    figures: dict[str, float]
    candidates: tuple[Candidate, ...]
    group: tuple[Candidate, ...]
    invisible: tuple[str, ...]
    lack_of_fit_p: float

    @property
    def additions(self) -> tuple[str, ...]:
        """What to add, best first."""
        return tuple(c.term.label for c in self.group)

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        floor, p = self.figures["noise_floor_um"], self.lack_of_fit_p
        return {
            "kind": KIND,
            "verdict": self.verdict,
            "headline": self.headline,
            "residual_rms_um": self.figures["rms_after_um"],
            "held_out_rms_um": self.figures["held_out_rms_um"],
            "noise_floor_um": floor if np.isfinite(floor) else None,
            "replication": "block of neighbouring poses",
            "lack_of_fit_p": p if np.isfinite(p) else None,
            "candidates": [
                {
                    "effect": c.term.effect,
                    "axis": c.term.axis,
                    "label": c.term.label,
                    "rms_after_um": c.rms_after_um,
                    "cv_gain": c.gain,
                    "p_value": c.p_value,
                    "in_group": c in self.group,
                    "grade": "shape-consistent" if c in self.group else None,
                    "confounded_with": list(c.confounded),
                    "remedy": EFFECTS[c.term.effect].remedy,
                }
                for c in self.candidates
            ],
            "invisible": list(self.invisible),
            "where": [],
            "next_experiment": self._experiment(),
        }

    def _experiment(self) -> dict[str, Any] | None:
        if self.verdict == "need_repeats":
            return {"text": "measure thirty of these poses again, later and in another order"}
        if self.verdict == "ambiguous":
            return {"text": f"poses that move the joints of {' and '.join(c.term.label for c in self.group)} apart"}
        return None


def pose_figures(grams: Grams, terms: Sequence[Term]) -> dict[str, float]:
    """Return errors before and after, RMS of the distance in um, and means in mm."""
    series = grams.series
    before, after, held = left_mm(grams, ()), left_mm(grams, terms), held_out_mm(grams, terms)
    size = [np.linalg.norm(values, axis=1) for values in (before, after, held)]
    return {
        "rms_before_um": 1000.0 * rms(size[0]),
        "rms_after_um": 1000.0 * rms(size[1]),
        "held_out_rms_um": 1000.0 * rms(size[2]),
        "mean_before_mm": float(size[0].mean()),
        "mean_after_mm": float(size[1].mean()),
        "held_out_mean_mm": float(size[2].mean()),
        "noise_floor_um": 1000.0 * series.floor_mm,
    }


def diagnose(grams: Grams, terms: Sequence[Term]) -> PoseDiagnosis:
    """Return what a twin with some terms lacks."""
    series = grams.series
    base = grams.told(series.chosen(terms))
    before = grams.left_out(base)
    told: list[tuple[Term, list[int], Floats]] = []
    invisible = []
    for term in series.slots:
        if term in terms:
            continue
        chosen = grams.told([*base, *series.chosen([term])[9:]])
        if len(chosen) == len(base):
            invisible.append(term.label)
        else:
            told.append((term, chosen, grams.left_out(chosen)))
    counted = grams.count
    p_values = holm([_paid(before - after, counted) for _, _, after in told]) if told else np.zeros(0)
    total = float(before.sum())
    every = [
        Candidate(
            term,
            1.0 - float(after.sum()) / total,
            float(p),
            1000.0 * float(np.sqrt(max(after.sum(), 0.0) / counted.sum())),
        )
        for (term, _, after), p in zip(told, p_values, strict=True)
    ]
    every.sort(key=lambda c: -c.gain)
    pays = [c for c in every if c.gain > _MATERIAL and c.p_value < _ALPHA]
    group = _group(grams, pays, {term: (chosen, after) for term, chosen, after in told}, total)
    figures = pose_figures(grams, terms)
    shown = tuple([*group, *(c for c in every if c.term not in {g.term for g in group})][:_SHOWN])
    verdict, headline, p = _verdict(grams, group, figures)
    return PoseDiagnosis(verdict, headline, figures, shown, tuple(group), tuple(invisible), p)


def _paid(gain: Floats, count: Floats) -> float:
    """Return the one-sided p-value of a gain per pose over blocks."""
    each = gain / count
    spread = float(each.std(ddof=1)) / np.sqrt(len(each))
    return t_tail(float(each.mean()) / spread, len(each) - 1.0) if spread > 0.0 else 1.0


def _group(
    grams: Grams, pays: Sequence[Candidate], told: dict[Term, tuple[list[int], Floats]], total: float
) -> list[Candidate]:
    """Return the best candidate, and those that tell the same."""
    if not pays:
        return []
    best, alike = pays[0], []
    chosen, after = told[best.term]
    for other in pays[1:]:
        if other.gain < _AS_GOOD * best.gain:
            break
        more = grams.told([*chosen, *grams.series.chosen([other.term])[9:]])
        if (after.sum() - grams.left_out(more).sum()) / total < _LITTLE * other.gain:
            alike.append(other)
    names = [c.term.label for c in (best, *alike)]
    return [
        Candidate(c.term, c.gain, c.p_value, c.rms_after_um, tuple(n for n in names if n != c.term.label))
        for c in (best, *alike)
    ]


def _verdict(grams: Grams, group: Sequence[Candidate], figures: dict[str, float]) -> tuple[Verdict, str, float]:
    floor, left = figures["noise_floor_um"], figures["held_out_rms_um"]
    what = ""
    if group:
        best = group[0]
        also = f", as well as {', '.join(best.confounded)}" if best.confounded else ""
        title = EFFECTS[best.term.effect].title
        what = f"{best.term.label} ({title}) takes {100 * best.gain:z.1f} % of the squares on poses held out{also}"
    if not grams.series.repeats:
        said = f"{what}; " if what else ""
        return "need_repeats", f"{said}no pose was measured twice, so no floor is known", float("nan")
    p = _beyond(grams, left)
    if group:
        return ("ambiguous" if group[0].confounded else "missing_effect"), what, p
    if left > _BEYOND * floor and p < _ALPHA:
        said = f"{left:z.0f} µm are left, {left / floor:z.0f} times the scatter of repeats: repeatable, and no effect here surely explains it"
        return "unknown_effect", said, p
    return "nothing_missing", f"{left:z.0f} µm are left, repeats scatter by {floor:z.0f} µm", p


def _beyond(grams: Grams, left_um: float) -> float:
    """Return the p-value of what is left being scatter of repeats."""
    from dtwin.statistics import f_tail

    series = grams.series
    ratio = (left_um / 1000.0 / series.floor_mm) ** 2
    return f_tail(ratio, (3.0 * len(series.error_mm), 3.0 * series.repeats))
