"""Which run to measure next, and what a plan could detect before it is measured."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.physics.candidates import Candidates, applicable
from dtwin.physics.diagnosis import Diagnosis
from dtwin.physics.effect import Effect
from dtwin.physics.grid import PathCondition
from dtwin.physics.gridding import CIRCLE, Condition
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term, least_visible, set_up, unweighted, weighted_like
from dtwin.physics.whitening import PureError
from dtwin.plan import Plan, ends_deg
from dtwin.schema import PLANES, Campaign, Direction, Floats, Plane, RunMeta
from dtwin.statistics import f_quantile, f_tail

REPEATS = 3
_POWER = 0.8
_HOPELESS = 0.5
_ALPHA = 0.04
_SOON_MIN = 10.0
_SETUP_S = 600.0
_BOTH: tuple[Direction, Direction] = ("CCW", "CW")


@dataclass(frozen=True)
class Proposal:
    """Runs that would separate pairs of candidates.

    Attributes:
        conditions: What to measure, each ``REPEATS`` times.
        minutes: Estimated time on the machine.
        powers: Probability that they are told apart, for each pair.
    """

    text: str
    conditions: tuple[Condition, ...]
    minutes: float
    powers: tuple[float, ...] = ()

    @property
    def separated(self) -> int:
        """Number of pairs that are probably told apart."""
        return sum(power >= _POWER for power in self.powers)


@dataclass(frozen=True)
class Detectable:
    """What a plan could detect of one effect.

    Attributes:
        amplitude: Size of its first parameter that is detected with a power of 80 %, inf when invisible.
        rms_um: Visible RMS at that size.
        typical: Size on an ordinary machine.
    """

    label: str
    amplitude: float
    unit: str
    rms_um: float
    typical: float

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return dict(vars(self))


def next_experiment(
    obs: Observations, known: Sequence[Term], diagnosis: Diagnosis, library: Mapping[str, Effect]
) -> dict[str, Any] | None:
    """Return the runs that would separate most of what cannot be told apart.

    Within ten minutes where that separates anything; otherwise the cheapest runs that do.

    Args:
        known: Effects of the twin.

    Returns:
        ``text``, ``separates``, ``conditions``, ``repeats``, ``minutes``, ``expected_power`` and ``advice``; None when
        there is nothing to separate.
    """
    if diagnosis.verdict == "need_repeats":
        minutes = sum(c.seconds for c in obs.conditions) * (REPEATS - 1) / 60.0
        return {
            "text": f"measure every condition {REPEATS} times, in random order",
            "separates": [],
            "conditions": [c.as_dict() for c in obs.conditions if isinstance(c, Condition)],
            "repeats": REPEATS - 1,
            "minutes": minutes,
            "expected_power": None,
            "advice": "repeats show the noise floor; without them nothing can be named",
        }
    groups = [[s.label for s in group] for group in diagnosis.found or (diagnosis.group,)]
    if not any(len(group) > 1 for group in groups):
        groups = [list(group) for group in diagnosis.undecided]
        known = [term for term in known if term.label not in {group[0] for group in groups}]
    pairs = _pairs(obs, known, library, groups)
    if not pairs:
        return None
    sizes = [_size(obs, [*known, *beside], one) for one, _, beside in pairs]
    tried = [made for p in _proposals(obs) if (made := _with_powers(p, obs, known, pairs, sizes)) is not None]
    best = min(tried, key=_rank, default=None)
    advice = pairs[0][0].instance.effect.separate_by
    if best is None or max(best.powers) < _HOPELESS:
        # Only one of two may know what would tell it from the other.
        advice = " ".join(dict.fromkeys((advice, pairs[0][1][0].instance.effect.separate_by)))
        return {
            "text": advice,
            "separates": _labels(pairs[0]),
            "conditions": [],
            "repeats": 0,
            "minutes": None,
            "expected_power": max(best.powers) if best else 0.0,
            "advice": advice,
        }
    likely = max(_POWER if best.separated else 0.0, _HOPELESS)
    told = [(pair, power) for pair, power in zip(pairs, best.powers, strict=True) if power >= likely]
    words = ", ".join(
        f"{labels[0]} from {' + '.join(labels[1:])} with a probability of {100 * power:z.0f} %"
        for labels, power in ((_labels(pair), power) for pair, power in told)
    )
    return {
        "text": f"{best.text}, {REPEATS} times: tells {words}, about {best.minutes:z.0f} min",
        "separates": list(dict.fromkeys(label for pair, _ in told for label in _labels(pair))),
        "conditions": [c.as_dict() for c in best.conditions],
        "repeats": REPEATS,
        "minutes": best.minutes,
        "expected_power": told[0][1],
        "advice": advice,
    }


def _with_powers(
    proposal: Proposal,
    obs: Observations,
    known: Sequence[Term],
    pairs: Sequence[tuple[Term, Sequence[Term], Sequence[Term]]],
    sizes: Sequence[tuple[PureError, Floats] | None],
) -> Proposal | None:
    """Return a proposal with what it would tell; None where the arm does not reach its circles."""
    try:
        powers = [
            0.0 if size is None else _power(obs, [*known, *beside], one, two, proposal.conditions, *size)
            for (one, two, beside), size in zip(pairs, sizes, strict=True)
        ]
    except InputError as error:
        if error.code != "kinematics.unreachable":
            raise
        return None
    return replace(proposal, powers=tuple(powers))


def _pairs(
    obs: Observations, known: Sequence[Term], library: Mapping[str, Effect], groups: Sequence[Sequence[str]]
) -> list[tuple[Term, list[Term], list[Term]]]:
    """Return, of every group, the first effect, the second on all its axes, and what was found besides.

    What only together is a rival, such as two bowed guideways, is taken together.
    """
    out = []
    for group in groups:
        if len(group) < 2:
            continue
        rivals = [label for label in group[1:] if label.split()[0] == group[1].split()[0]]
        first = _terms(obs, known, library, group[:1])
        second = _terms(obs, known, library, rivals)
        others = [other[0] for other in groups if other is not group and other]
        if first and second:
            out.append((first[0], second, _terms(obs, known, library, others)))
    return out


def _labels(pair: tuple[Term, Sequence[Term], Sequence[Term]]) -> list[str]:
    return [pair[0].label, *(term.label for term in pair[1])]


def _rank(proposal: Proposal) -> tuple[bool, bool, float, float]:
    """Order proposals: what separates within ten minutes, as much as possible, comes first."""
    useless, late = not proposal.separated, proposal.minutes > _SOON_MIN
    cost = proposal.minutes
    first = -proposal.separated if not late else cost
    return useless, late, first if not useless else -max(proposal.powers, default=0.0), cost


def planned_observations(plan: Plan, logged: Mapping[str, Floats] | None = None) -> Observations:
    """Return the runs of a plan with nothing in them, upright ones over the arc of their programs.

    ``logged``: columns besides ``time_h``, (runs,).
    """
    rows = [
        (t, way, Condition(t.plane, t.radius_mm, t.feed_mm_min, way)) for t in plan.tests for way in plan.directions
    ]
    time_h = np.cumsum([0.0, *(c.seconds for _, _, c in rows[:-1])]) / 3600.0
    metas = tuple(
        RunMeta(
            f"{test.test_id}-{direction.lower()}",
            plane=test.plane,
            direction=direction,
            radius_mm=test.radius_mm,
            feed_mm_min=test.feed_mm_min,
            repeat=test.repeat,
            setup=test.setup,
        )
        for test, direction, _ in rows
    )
    per_row = tuple({"time_h": h, **{k: float(v[i]) for k, v in (logged or {}).items()}} for i, h in enumerate(time_h))
    obs = _empty(Campaign(plan.name, plan.machine), metas, [c for _, _, c in rows], per_row)
    return replace(obs, mask=np.stack([_programmed(c.plane) for _, _, c in rows]))


def _programmed(plane: Plane) -> NDArray[np.bool_]:
    """Return which angles of a circle a program runs over: shape (points,)."""
    begin, end = ends_deg(plane)
    return (CIRCLE.points - begin) % 360.0 <= end - begin


def detectable(obs: Observations, library: Mapping[str, Effect], *, noise_um: float) -> list[Detectable]:
    """Return the size of each effect that a design would detect with a power of 80 %.

    What was measured in the runs does not matter. ``noise_um``: RMS of one run about the mean of its condition, assumed
    alike at all harmonics: low harmonics usually repeat less well, so the truth is somewhat worse.
    """
    problem = unweighted(obs, [])
    tried, _ = applicable(library, obs, [])
    dof = float(obs.n_rows - len(obs.conditions))
    out = []
    for instance in tried:
        effect = instance.effect
        term = Term(instance, effect.start_shape)
        columns = problem.whitened(obs.regressors(instance, term.shape))
        # Of what has a size for each direction across an axis, the first that these circles show.
        shown = int(np.argmax(columns.any(axis=0)))
        first = columns[:, shown : shown + 1]
        visible, share = problem.visible(first, least=least_visible(term))
        parameter = effect.parameters[shown]
        size = math.inf
        rms_um = math.nan
        if visible.shape[1] and dof >= 2.0:
            unit = math.sqrt(float((first**2).sum() * share[0]))
            needed = math.sqrt(_needed(dof, len(tried))) * noise_um
            size = needed / unit
            rms_um = needed / math.sqrt(obs.mask.sum())
        out.append(Detectable(instance.label, size, parameter.unit, rms_um, parameter.typical))
    return sorted(out, key=lambda d: d.amplitude / d.typical)


def _needed(dof: float, n_tests: int) -> float:
    """Return the noncentrality that a test of one column detects with a power of 80 %."""
    limit = f_quantile(_ALPHA / n_tests, (1, dof))

    def missing(noncentrality: float) -> float:
        return f_tail(limit, (1, dof), noncentrality) - _POWER

    return float(scipy.optimize.brentq(missing, 0.01, 500.0 + 5.0 * limit))


def _terms(
    obs: Observations, known: Sequence[Term], library: Mapping[str, Effect], labels: Sequence[str]
) -> list[Term]:
    tried, _ = applicable(library, obs, known)
    by_label = {instance.label: instance for instance in tried}
    return [Term(by_label[label], by_label[label].effect.start_shape) for label in labels if label in by_label]


def _proposals(obs: Observations) -> list[Proposal]:
    """Return what could be measured besides: direction, feeds, a radius, planes of a circle."""
    out = []
    conditions = [c for c in obs.conditions if isinstance(c, Condition)]
    if not conditions:
        return []
    places = list(dict.fromkeys((c.plane, c.radius_mm, c.feed_mm_min) for c in conditions))
    missing = [
        Condition(plane, radius, feed, direction)
        for plane, radius, feed in places
        for direction in _BOTH
        if Condition(plane, radius, feed, direction) not in conditions
    ]
    if missing:
        out.append(_proposal("measure the other direction too", missing, new_setup=False))
    feeds = sorted({c.feed_mm_min for c in conditions})
    radii = sorted({c.radius_mm for c in conditions})
    plane = conditions[0].plane
    for feed, words in ((2 * feeds[-1], "double the highest feed"), (feeds[0] / 2, "halve the feed")):
        here = [Condition(plane, radii[0], feed, d) for d in _BOTH]
        out.append(_proposal(f"{words} ({feed:g} mm/min)", here, new_setup=False))
    for radius in (2 * radii[-1], radii[0] / 2):
        here = [Condition(plane, radius, feed, d) for feed in (feeds[0], feeds[-1]) for d in _BOTH]
        text = f"another radius ({radius:g} mm)"
        out.append(_proposal(text, list(dict.fromkeys(here)), new_setup=True))
    for other in sorted(set(PLANES) - {c.plane for c in conditions}):
        here = [Condition(other, radii[0], feed, d) for feed in (feeds[0], feeds[-1]) for d in _BOTH]
        text = f"another plane ({other})"
        out.append(_proposal(text, list(dict.fromkeys(here)), new_setup=True))
    return out


def _proposal(text: str, conditions: list[Condition], *, new_setup: bool) -> Proposal:
    seconds = REPEATS * sum(c.seconds for c in conditions) + (_SETUP_S if new_setup else 0.0)
    return Proposal(text, tuple(conditions), seconds / 60.0)


def _size(obs: Observations, known: Sequence[Term], wanted: Term) -> tuple[PureError, Floats] | None:
    """Return the noise of the runs, and the sizes that an effect has in them, shape (parameters,); None without noise."""
    problem = set_up(obs, known, [])
    if problem.noise is None:
        return None
    columns = problem.whitened(obs.regressors(wanted.instance, wanted.shape))
    left = columns - problem.basis @ (problem.basis.T @ columns)
    return problem.noise, np.asarray(np.linalg.lstsq(left, problem.residual.ravel(), rcond=1e-8)[0])


def _power(
    obs: Observations,
    known: Sequence[Term],
    wanted: Term,
    rivals: Sequence[Term],
    conditions: Sequence[Condition],
    noise: PureError,
    size: Floats,
) -> float:
    """Return the probability that rivals together are rejected, in whatever shape, when the wanted effect is the truth."""
    grown = _grown(obs, conditions)
    design = weighted_like(grown, known, noise)
    profile = design.whitened(grown.regressors(wanted.instance, wanted.shape)) @ size
    left_over = 1.0
    # Rivals of an effect have its shapes in common.
    for shape in Candidates(obs, [r.instance for r in rivals]).grid(rivals[0].instance):
        other = [design.whitened(grown.regressors(r.instance, shape)) for r in rivals]
        imitated, _ = design.visible(np.concatenate(other, axis=1), least=min(map(least_visible, rivals)))
        seen, share = design.visible(profile[:, None], imitated, least_visible(wanted))
        left_over = min(left_over, share[0] if seen.shape[1] else 0.0)
    if not left_over:
        return 0.0
    variance = float(np.nanmean(noise.variance))
    noncentrality = float((profile**2).sum() * left_over) / variance
    dof = float(grown.n_rows - len(grown.conditions))
    limit = f_quantile(0.05, (1, dof))
    return f_tail(limit, (1, dof), min(noncentrality, 1e4))


def _grown(obs: Observations, conditions: Sequence[Condition]) -> Observations:
    """Return the runs with more of them, empty, in the set-ups that they would have, over the arcs that were measured in their planes."""
    means = {name: float(np.mean([np.mean(c[name]) for c in obs.columns])) for name in obs.logged}
    setups = {obs.conditions[int(c)].mounted: meta.setup for meta, c in zip(obs.runs, obs.condition_of, strict=True)}
    metas, cells = list(obs.runs), [obs.conditions[i] for i in obs.condition_of]
    columns, masks = list(obs.columns), list(obs.mask)
    for condition in conditions:
        seen = [mask for mask, cell in zip(obs.mask, cells, strict=False) if cell.plane == condition.plane]
        for repeat in range(REPEATS):
            masks.append(np.any(seen, axis=0) if seen else _programmed(condition.plane))
            setup = setups.get(condition.mounted, "new")
            metas.append(
                RunMeta(
                    f"next-{len(metas)}",
                    plane=condition.plane,
                    direction=condition.direction,
                    radius_mm=condition.radius_mm,
                    feed_mm_min=condition.feed_mm_min,
                    repeat=100 + repeat,
                    setup=setup,
                )
            )
            cells.append(condition)
            columns.append(means)
    return replace(_empty(obs.campaign, tuple(metas), cells, tuple(columns)), mask=np.array(masks))


def _empty(
    campaign: Campaign,
    metas: tuple[RunMeta, ...],
    cells: Sequence[PathCondition],
    columns: tuple[Mapping[str, Any], ...],
) -> Observations:
    conditions = list(dict.fromkeys(cells))
    keys = [(m.setup, c.mounted) for m, c in zip(metas, cells, strict=True)]
    setups = list(dict.fromkeys(keys))
    n = len(metas)
    return Observations(
        campaign=campaign,
        runs=metas,
        y_um=np.zeros((n, CIRCLE.n)),
        mask=np.ones((n, CIRCLE.n), dtype=bool),
        conditions=tuple(conditions),
        condition_of=np.array([conditions.index(c) for c in cells]),
        setups=tuple(f"{name} {mounted}" for name, mounted in setups),
        setup_of=np.array([setups.index(key) for key in keys]),
        run_of=np.arange(n),
        columns=columns,
        feed_mm_s=np.array([c.feed_mm_min / 60.0 for c in cells]),
    )
