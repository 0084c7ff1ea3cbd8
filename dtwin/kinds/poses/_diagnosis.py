"""What a twin of an arm lacks: families of effects that pay on poses left out, the plainest first.

A family is one effect at all joints, less the joints at which it does not pay. Unit of replication is the block:
neighbouring poses err alike, whatever is missing, so they are held out together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dtwin.documents import finite
from dtwin.kinds.poses._effects import EFFECTS, Term, carrying, family_label
from dtwin.kinds.poses._fit import Grams, held_out_mm, left_mm
from dtwin.schema import Floats
from dtwin.statistics import f_tail, gain_tail, holm, rms, usual_size
from dtwin.units import shown_number

KIND = "poses"
_Verdict = Literal["missing_effect", "ambiguous", "unknown_effect", "nothing_missing", "need_repeats"]
_LEVELS = (
    ("joint_zero",),
    ("link_geometry",),
    ("gravity_sag",),
    ("joint_cyclic_1", "joint_cyclic_2", "joint_cyclic_3", "joint_reversal"),
    ("ambient_growth",),
    ("setup_drift",),
)
"""Families from plain to fancy: of two that tell the same, the plainer is named."""
_IN_REPEATS = ("joint_reversal", "ambient_growth", "setup_drift")
"""Effects by which repeats of a pose differ, too: they may be missing below the scatter of repeats, others not."""
_ALPHA = 0.01
# A family counts when it takes this share of the squares that are left on poses left out.
_MATERIAL = 0.005
# A joint stays in it when the squares grow by more than this share without it, with no more than this p-value over blocks:
# without the second one joint in six was named by chance.
_PAYS, _STAYS = 0.002, 0.05
# Another family tells the same when it gains nearly as much alone, and little beside the best.
_AS_GOOD, _LITTLE = 0.8, 0.2
# A fancier family takes the place of a plainer one when it gains more, has no more parameters than these besides, and
# leaves nothing to the plainer one.
_BETTER, _MORE = 1.1, 2
# Rows so many times the usual spread off, and no more of them, are told apart.
_WILD, _MOST_FAR = 8.0, 8
# Repeats tell that something is left when scatter alone leaves as much this seldom: of 120 arms without an error none did.
_SURELY, _LIKELY = 1e-3, 0.05
# An effect that takes less than this share of what no effect explains, RMS, may be a part of it: of those on outside arms 9 of 22 were false, of larger ones 4 of 85.
_SMALL = 0.5
_FOLDS = 4


@dataclass(frozen=True)
class _Candidate:
    """A family that could be added.

    ``gain``: share of the squares left on blocks held out that it takes.
    ``p_value``: of the hypothesis that it takes nothing, over blocks, after Holm over the families of its level.
    """

    effect: str
    terms: tuple[Term, ...]
    gain: float
    p_value: float
    rms_after_um: float
    left_mm2: Floats
    confounded: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """As a user writes it."""
        return family_label(self.terms)

    @property
    def pays(self) -> bool:
        """Whether it takes enough, and surely."""
        return self.gain > _MATERIAL and self.p_value < _ALPHA


@dataclass(frozen=True)
class PoseDiagnosis:
    """What is missing.

    ``group``: what the verdict is about; ``invisible``: terms that the poses cannot tell; ``idle``: terms of the twin
    that pay nothing beside the others; ``doubtful``: terms of the twin that are small beside what no effect explains.
    """

    verdict: _Verdict
    headline: str
    figures: dict[str, float]
    candidates: tuple[_Candidate, ...]
    group: tuple[_Candidate, ...]
    invisible: tuple[str, ...]
    idle: tuple[Term, ...]
    lack_of_fit_p: float
    doubtful: tuple[Term, ...] = ()

    @property
    def additions(self) -> tuple[str, ...]:
        """What to add, best first."""
        return tuple(c.label for c in self.group)

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {
            "kind": KIND,
            "verdict": self.verdict,
            "headline": self.headline,
            "residual_rms_um": self.figures["rms_after_um"],
            "held_out_rms_um": self.figures["held_out_rms_um"],
            "nested_mean_mm": self.figures.get("nested_mean_mm"),
            "noise_floor_um": finite(self.figures["noise_floor_um"]),
            "replication": "block of neighbouring poses",
            "lack_of_fit_p": finite(self.lack_of_fit_p),
            "candidates": [
                {
                    "effect": c.effect,
                    "axis": c.label.partition("@")[2],
                    "label": c.label,
                    "rms_after_um": c.rms_after_um,
                    "cv_gain": c.gain,
                    "p_value": c.p_value,
                    "in_group": c in self.group,
                    "grade": "shape-consistent" if c in self.group else None,
                    "confounded_with": list(c.confounded),
                    "remedy": EFFECTS[c.effect].remedy,
                }
                for c in self.candidates
            ],
            "invisible": list(self.invisible),
            "idle": [term.label for term in self.idle],
            "doubtful": [term.label for term in self.doubtful],
            "where": [],
            "next_experiment": self._experiment(),
        }

    def _experiment(self) -> dict[str, Any] | None:
        if self.verdict == "need_repeats":
            return {"text": "measure thirty of these poses again, later and in another order"}
        if self.verdict == "ambiguous":
            return {"text": f"poses that move the joints of {' and '.join(c.label for c in self.group)} apart"}
        return None


def pose_figures(grams: Grams, terms: Sequence[Term], after: Floats | None = None) -> dict[str, float]:
    """Return errors before and after, RMS of the distance in um, and means in mm; ``after`` (n, 3): where it is not what fits best."""
    series = grams.series
    before, held = left_mm(grams, ()), held_out_mm(grams, terms)
    after = left_mm(grams, terms) if after is None else after
    size = [np.linalg.norm(values, axis=1) for values in (before, after, held)]
    return {
        "rms_before_um": 1000.0 * rms(size[0]),
        "rms_after_um": 1000.0 * rms(size[1]),
        "held_out_rms_um": 1000.0 * rms(size[2]),
        "mean_before_mm": float(size[0].mean()),
        "mean_after_mm": float(size[1].mean()),
        "held_out_mean_mm": float(size[2].mean()),
        "noise_floor_um": 1000.0 * series.floor_of_left_mm(after),
    }


def diagnose(grams: Grams, terms: Sequence[Term], rows: NDArray[np.int64] | None = None) -> PoseDiagnosis:
    """Return what a twin with some terms lacks, and which of them are idle.

    ``rows`` (n,): numbers of the readings in their table, for those that are far off the others.
    """
    candidates = _candidates(grams, terms)
    group = _group(grams, terms, candidates)
    labels = {c.effect for c in group}
    shown = (*group, *sorted((c for c in candidates if c.effect not in labels), key=lambda c: -c.gain))
    figures = pose_figures(grams, terms)
    verdict, headline, p = _verdict(grams, group, figures)
    headline += _far_off(held_out_mm(grams, terms), rows)
    idle: tuple[Term, ...] = ()
    if terms and not group:
        idle = tuple(_idle_terms(grams, terms))
        figures["nested_mean_mm"] = nested_mean_mm(grams)
    doubtful = _doubtful(grams, terms, figures["noise_floor_um"]) if verdict == "unknown_effect" else ()
    return PoseDiagnosis(verdict, headline, figures, shown, tuple(group), _invisible(grams, terms), idle, p, doubtful)


def selected(grams: Grams) -> tuple[Term, ...]:
    """Return the terms of a twin that is discovered from nothing: see ``PoseTwins.discover``."""
    chosen: list[Term] = []
    seen = [frozenset(chosen)]
    while True:
        while group := _group(grams, chosen, _candidates(grams, chosen)):
            chosen += group[0].terms
        idle = _idle_terms(grams, chosen)
        chosen = [term for term in chosen if term not in idle]
        if not idle or frozenset(chosen) in seen:
            return tuple(chosen)
        seen.append(frozenset(chosen))


def nested_mean_mm(grams: Grams) -> float:
    """Return the mean error on blocks that were held out of the choice of terms as well as of the fit.

    Blocks are dealt to the folds in turn; for each fold the terms are chosen again without it.
    """
    blocks = np.arange(len(grams.count))
    total = 0.0
    for fold in range(_FOLDS):
        out = blocks % _FOLDS == fold
        rest = grams.without(blocks[out])
        left = rest.left_elsewhere_mm(grams.series.chosen(selected(rest)), np.isin(grams.series.block, blocks[out]))
        total += float(np.linalg.norm(left, axis=1).sum())
    return total / len(grams.series.error_mm)


def _idle_terms(grams: Grams, terms: Sequence[Term]) -> list[Term]:
    """Return the terms that pay nothing on poses left out beside the others, the most idle first."""
    kept, idle = list(terms), []
    now = _left(grams, kept)
    while kept:
        without = [_left(grams, [t for t in kept if t != term]) for term in kept]
        least = int(np.argmin([w.sum() for w in without]))
        if _needed(without[least], now):
            break
        idle.append(kept.pop(least))
        now = without[least]
    return idle


def _doubtful(grams: Grams, terms: Sequence[Term], floor_um: float) -> tuple[Term, ...]:
    """Return the terms that take, on poses left out and beside the others, little of what is left above the floor of repeats."""
    now = _left(grams, terms).sum()
    unknown = now - (1e-3 * floor_um) ** 2 * float(grams.count.sum())
    return tuple(
        term for term in terms if _left(grams, [t for t in terms if t != term]).sum() - now < _SMALL**2 * unknown
    )


def _left(grams: Grams, terms: Sequence[Term]) -> Floats:
    return grams.left_out(grams.told(grams.series.chosen(terms)))


def _invisible(grams: Grams, terms: Sequence[Term]) -> tuple[str, ...]:
    """Return the terms that the poses cannot tell beside those of the twin."""
    base = grams.told(grams.series.chosen(terms))
    others = [term for term in grams.series.slots if term not in terms]
    chosen = {term: grams.told([*base, *grams.series.chosen([term])[9:]]) for term in others}
    return tuple(term.label for term in others if len(chosen[term]) == len(base))


def _candidates(grams: Grams, terms: Sequence[Term]) -> list[_Candidate]:
    """Return every family that is not whole in the twin, less the joints at which it does not pay, level by level."""
    before, counted = _left(grams, terms), grams.count
    candidates: list[_Candidate] = []
    for level in _LEVELS:
        tried = []
        for effect in level:
            more = [term for term in grams.series.slots if term.effect == effect and term not in terms]
            if more:
                tried.append((effect, *_pruned(grams, terms, more)))
        p_values: Sequence[float] = holm([gain_tail(before, after) for _, _, after in tried]).tolist() if tried else []
        for (effect, more, after), p in zip(tried, p_values, strict=True):
            left = float(after.sum())
            gain = 1.0 - left / float(before.sum())
            size = 1000.0 * float(np.sqrt(max(left, 0.0) / counted.sum()))
            candidates.append(_Candidate(effect, tuple(more), gain, float(p), size, after))
    return candidates


def _pruned(grams: Grams, terms: Sequence[Term], more: Sequence[Term]) -> tuple[list[Term], Floats]:
    """Return a family without the joints at which it does not pay, and what is left in each block with it."""
    kept, after = list(more), _left(grams, [*terms, *more])
    while len(kept) > 1:
        without = [_left(grams, [*terms, *(t for t in kept if t != term)]) for term in kept]
        least = int(np.argmin([w.sum() for w in without]))
        if _needed(without[least], after):
            break
        after = without[least]
        kept.pop(least)
    return kept, after


def _needed(without: Floats, now: Floats) -> bool:
    """Return whether enough is left without a term, and surely, of squares in each block with and without it."""
    return float(without.sum()) > float(now.sum()) * (1.0 + _PAYS) and gain_tail(without, now) < _STAYS


def _group(grams: Grams, terms: Sequence[Term], candidates: Sequence[_Candidate]) -> list[_Candidate]:
    """Return the plainest family that pays, or a fancier one that explains it away, and those that tell the same."""
    above = _above_floor(grams, terms)
    pays = [c for c in candidates if c.pays and (above or c.effect in _IN_REPEATS)]
    if not pays:
        return []
    level = next(level for level in _LEVELS if pays[0].effect in level)
    best = max((c for c in pays if c.effect in level), key=lambda c: c.gain)

    def beside(first: _Candidate, second: _Candidate) -> float:
        """Return what the second gains beside the first, as a share of all squares."""
        both = _left(grams, [*terms, *first.terms, *second.terms])
        return float((first.left_mm2 - both).sum()) * (1.0 - first.gain) / float(first.left_mm2.sum())

    for other in sorted(pays, key=lambda c: -c.gain):
        larger = other.gain > _BETTER * best.gain and _size(grams, other) <= _size(grams, best) + _MORE
        if larger and beside(other, best) < _LITTLE * best.gain:
            best = other
            break
    alike = [
        c
        for c in pays
        if c is not best and c.gain >= _AS_GOOD * best.gain and beside(best, c) < _LITTLE * min(c.gain, best.gain)
    ]
    # What tells far more than the best one does not tell the same.
    alike = [c for c in alike if c.gain <= best.gain / _AS_GOOD]
    names = [c.label for c in (best, *alike)]
    return [replace(c, confounded=tuple(n for n in names if n != c.label)) for c in (best, *alike)]


def _above_floor(grams: Grams, terms: Sequence[Term]) -> bool:
    """Return whether more is left on poses held out than repeats of what the terms leave scatter by; so it is where no floor is known."""
    if not grams.series.repeats:
        return True
    floor_mm = grams.series.floor_of_left_mm(left_mm(grams, terms))
    return float(_left(grams, terms).sum()) > floor_mm**2 * float(grams.count.sum())


def _size(grams: Grams, candidate: _Candidate) -> int:
    """Return the number of parameters of a family."""
    return sum(grams.series.slots[t].stop - grams.series.slots[t].start for t in candidate.terms)


def _verdict(grams: Grams, group: Sequence[_Candidate], figures: dict[str, float]) -> tuple[_Verdict, str, float]:
    floor, left = figures["noise_floor_um"], figures["held_out_rms_um"]
    what = ""
    if group:
        best = group[0]
        also = f", as well as {', '.join(best.confounded)}" if best.confounded else ""
        what = f"{best.label} ({EFFECTS[best.effect].title}) takes {100 * best.gain:z.1f} % of the squares on poses held out{also}"
    if not grams.series.repeats:
        said = f"{what}; " if what else ""
        return "need_repeats", f"{said}no pose was measured twice, so no floor is known", float("nan")
    p, wrist = _beyond(grams, left / floor), _wrist(grams)
    if group:
        elbow = carrying(grams.series.poses.joints_rad.shape[1])
        sags = group[0].effect == "gravity_sag" and any(term.joint == elbow for term in group[0].terms)
        if sags and wrist and _beyond(grams, group[0].rms_after_um / floor) < _LIKELY:
            what += f"; more is left than repeats scatter by: {wrist}, and may look like that of J{elbow}"
        return ("ambiguous" if group[0].confounded else "missing_effect"), what, p
    if p < _SURELY:
        said = f"{left:z.0f} µm are left, {shown_number(left / floor, 2)} times the scatter of repeats: repeatable, and no effect here surely explains it"
        said += f"; {wrist}" if wrist else ""
        return "unknown_effect", said, p
    return "nothing_missing", f"{left:z.0f} µm are left, repeats scatter by {floor:z.0f} µm", p


def _wrist(grams: Grams) -> str:
    """Return whose sag is not looked for; empty for an arm without a wrist."""
    joints = grams.series.poses.joints_rad.shape[1]
    first = carrying(joints) + 1
    return f"sag of the wrist, J{first} to J{joints}, is not looked for" if first < joints else ""


def _far_off(left_mm: Floats, rows: NDArray[np.int64] | None) -> str:
    """Return which few rows hold most of what is left (n, 3), as the end of a headline; empty where none do."""
    size = np.linalg.norm(left_mm, axis=1)
    typical = float(np.median(size))
    far = np.flatnonzero(size > typical + _WILD * usual_size(size - typical))
    if rows is None or not 0 < len(far) <= _MOST_FAR or (size[far] ** 2).sum() < 0.5 * (size**2).sum():
        return ""
    others = 1000.0 * rms(np.delete(size, far))
    which = ", ".join(str(n) for n in rows[far])
    return f"; most of it is in {'rows' if len(far) > 1 else 'row'} {which}, the others leave {others:z.0f} µm: spoilt readings?"


def _beyond(grams: Grams, times: float) -> float:
    """Return the p-value of what is left, so many times the floor, being scatter of repeats."""
    series = grams.series
    return f_tail(times**2, (3.0 * len(series.error_mm), 3.0 * series.repeats))
