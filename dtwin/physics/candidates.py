"""What could be missing: every effect of the library, at the shape that suits the residual."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from dtwin.physics import localise
from dtwin.physics._reference_lines import over
from dtwin.physics._score import NoiseLevel, Score, score_test
from dtwin.physics.effect import Effect, Instance
from dtwin.physics.gridding import CIRCLE, Indices, bin_angle_rad
from dtwin.physics.library import campaign_instances
from dtwin.physics.observations import Observations
from dtwin.physics.problem import INVISIBLE, Problem, Term, least_visible, squares
from dtwin.physics.screw import ORDERS, PITCH
from dtwin.physics.state import AXES_OF
from dtwin.physics.whitening import from_harmonics
from dtwin.schema import Floats

_PITCH_MM = (2.0, 60.0)
# Along an axis: the graduation of a magnetic or inductive scale; screws turn once in at most so many millimetres.
_SHORTEST_MM, _SCREW_MM = 0.9, 40.0
# Steps between targets that differ by less, as a share of their mean, are equal.
_EVEN = 0.2
# How often the best of all lengths may fit by chance; numbers of a mean, a wave and its length.
_BY_CHANCE, _WAVE = 0.01, 4
# Steps between targets that a wave takes at least to be resolved; what it may leave of what one of those leaves.
_RESOLVED, _CLEARLY = 2.0, 0.5
# Runs of fewer numbers; how often noise is simulated for them, and the share of it that is called something.
_FEW_BINS, _DRAWS, _AT = 100, 2000, 0.05
_Complexes = NDArray[np.complex128]
_Key = tuple[str, tuple[tuple[str, float], ...]]
_NOT_CHANGED = {"radius": "the radius was not changed", "amplitude": "the amplitude was not changed"}


@dataclass(frozen=True)
class Candidate:
    """An effect that may be missing, tested against the residual.

    ``term``: effect, axis and the shape that suits best.
    ``visible``, (rows * n, k): orthonormal columns that the known effects cannot imitate.
    ``share``: visible share of its sum of squares.
    ``score``: test against the residual; the p-value counts the shapes that were tried.
    """

    term: Term
    visible: Floats
    share: float
    score: Score

    def with_p_value(self, p_value: float) -> Candidate:
        """Return the same with another p-value."""
        return replace(self, score=replace(self.score, p_value=p_value))


@dataclass
class Candidates:
    """The library, evaluated once for a campaign.

    ``instances``: effects and axes to try.
    """

    obs: Observations
    instances: Sequence[Instance]
    _columns: dict[_Key, tuple[Floats, Indices]] = field(default_factory=dict)

    def only(self, instances: Sequence[Instance]) -> Candidates:
        """Return another library for the same campaign; what was evaluated is shared."""
        return Candidates(self.obs, instances, self._columns)

    def take_in(self, term: Term, rows: Floats, of: Indices) -> None:
        """Keep the columns of a term, as ``harmonics`` returns them."""
        self._columns[_key(term)] = rows, of

    def tested_term(self, problem: Problem, term: Term, level: NoiseLevel) -> Candidate | None:
        """Test an effect in one shape; None when it cannot be seen beside what is known."""
        candidate = self.together(problem, term, level)
        if candidate is None or not term.instance.effect.within_condition or candidate.visible.shape[1] == 1:
            return candidate
        return candidate.with_p_value(min(candidate.score.p_value, self._one_by_one(problem, term, level)))

    def _one_by_one(self, problem: Problem, term: Term, level: NoiseLevel) -> float:
        """Return the p-value of the most significant column of what moves between runs, by Bonferroni.

        All together, the shifts and the length of a set-up leave few runs hardly a degree of freedom.
        """
        columns = self.whitened(problem, term)
        alone = [problem.visible(columns[:, [j]], least=least_visible(term))[0] for j in range(columns.shape[1])]
        seen = [one for one in alone if one.shape[1]]
        p_values = [score_test(problem, one, problem.residual, level, within=True).p_value for one in seen]
        return len(seen) * min(p_values, default=1.0)

    def at(self, problem: Problem, candidate: Candidate, term: Term, level: NoiseLevel) -> Candidate:
        """Return a candidate at another shape; its p-value stays that of all shapes tried."""
        tested = self.together(problem, term, level)
        return candidate if tested is None else tested.with_p_value(candidate.score.p_value)

    def together(self, problem: Problem, term: Term, level: NoiseLevel) -> Candidate | None:
        """Test all columns of an effect in one shape together; None when none can be seen beside what is known."""
        visible, share = self._visible(problem, term)
        if not visible.shape[1]:
            return None
        within = term.instance.effect.within_condition
        return Candidate(term, visible, share, score_test(problem, visible, problem.residual, level, within=within))

    def given(self, problem: Problem, terms: Iterable[Term]) -> Problem:
        """Return a problem with further effects known, without what nothing can be seen of beside those before."""
        terms = list(terms)
        if not terms:
            return problem
        made = [self.whitened(problem, term) for term in terms]
        return problem.with_known(made, [least_visible(term) for term in terms])

    def size_um(self, plain: Problem, term: Term) -> float:
        """Return the RMS of what an effect would explain in a problem without weights."""
        visible = self.visible(plain, term)
        total = float(((visible.T @ plain.residual.ravel()) ** 2).sum())
        return float((total / plain.obs.mask.sum()) ** 0.5)

    def visible(self, problem: Problem, term: Term) -> Floats:
        """Return the columns of a term that nothing known can imitate."""
        return problem.visible(self.whitened(problem, term), least=least_visible(term))[0]

    def numbers(self, term: Term) -> int:
        """Return how many numbers an effect has in these runs: parameters of what moves, and shapes."""
        rows, _ = self.harmonics(term)
        return int(rows.any(axis=(0, 1)).sum()) + len(term.instance.effect.shapes)

    def whitened(self, problem: Problem, term: Term) -> Floats:
        """Return the whitened columns of a term, shape (rows * n, k)."""
        rows, of = self.harmonics(term)
        return problem.weighted(rows, of).reshape(-1, rows.shape[2])

    def harmonics(self, term: Term) -> tuple[Floats, Indices]:
        """Return the different rows of a term's columns, and which of them each row is."""
        key = _key(term)
        if key not in self._columns:
            self._columns[key] = self.obs.distinct_harmonics(term.instance, term.shape)
        return self._columns[key]

    def _visible(self, problem: Problem, term: Term) -> tuple[Floats, float]:
        whitened = self.whitened(problem, term)
        if not whitened.any():
            return np.empty((len(whitened), 0)), 0.0
        visible, share = problem.visible(whitened, least=least_visible(term))
        return visible, float(share.max())

    def grid(self, instance: Instance) -> list[Mapping[str, float]]:
        """Return every combination of the shape parameters' grids."""
        effect, several, on_circles = instance.effect, self.obs.several_speeds, self.obs.grid is CIRCLE
        grid: list[Mapping[str, float]] = [
            dict(zip((s.name for s in effect.shapes), values, strict=True))
            for values in itertools.product(
                *(
                    (s.start,) if s.by_speed and not several else s.grid[:: s.step_on_circles if on_circles else 1]
                    for s in effect.shapes
                )
            )
        ]
        grid = [{**shape, **over(effect, [self.obs])} for shape in grid]
        if effect.also_tried_on and self.obs.grid.kind not in effect.also_tried_on:
            return grid
        sized = [s.name for s in effect.shapes if s.as_large]
        return [
            *grid,
            *(
                s
                for s in effect.also_tried
                if (several or effect.is_told_at_one_speed(s)) and all(s[name] <= self._most_um for name in sized)
            ),
        ]

    @cached_property
    def _most_um(self) -> float:
        """From the least to the most of what turns with the direction beside the set-up, of anything where no run was turned."""
        obs = self.obs
        means = localise.condition_means(obs, localise.residual_um(obs, []))
        index = {c: i for i, c in enumerate(obs.conditions)}
        odd = [(means[i] - means[index[c.turned]]) / 2.0 for c, i in index.items() if c.turned in index]
        return float(np.ptp(odd or means, axis=1).max())


def _key(term: Term) -> _Key:
    return term.label, tuple(sorted(term.shape.items()))


def applicable(
    library: Mapping[str, Effect], obs: Observations, known: Sequence[Term]
) -> tuple[list[Instance], dict[str, str]]:
    """Return what may be missing, and why the rest of the library cannot be judged.

    ``known``: effects that the twin has.
    """
    have = {term.label for term in known}
    geometry = obs.campaign.machine_geometry
    untestable: dict[str, str] = {}
    out = []
    for instance in campaign_instances(library, obs.grid.kind, obs.planes, obs.axes, geometry):
        effect = instance.effect
        absent = [name for name in effect.needs if name not in obs.logged]
        if effect.setup or effect.on_spread or instance.label in have:
            continue
        silent = [name for name in effect.stated if name not in geometry]
        if silent:
            untestable[instance.label] = f"{', '.join(silent)} is not stated in the machine's geometry"
        elif effect.told_by and len({c.swept.get(effect.told_by) for c in obs.conditions}) == 1:
            untestable[instance.label] = _NOT_CHANGED[effect.told_by]
        elif absent:
            untestable[instance.label] = f"{', '.join(absent)} was not logged"
        elif effect.within_condition and _never_changed(obs, effect):
            untestable[instance.label] = f"{', '.join(effect.needs)} did not change"
        else:
            out.append(instance)
    return out, untestable


def _never_changed(obs: Observations, effect: Effect) -> bool:
    needs = effect.needs
    return bool(needs) and all(np.ptp(obs.centred_columns[n]) == 0.0 for n in needs)


def likely_pitches(obs: Observations, residual: Floats, instance: Instance, n: int = 3) -> list[float]:
    """Return the pitches at which the residual repeats most along an axis.

    ``residual``, (rows, n): whitened coefficients of the residual.
    """
    axis = instance.axis
    odd = instance.effect.law.direction == "odd"
    theta = bin_angle_rad()
    angle_domain = from_harmonics(residual)
    if obs.grid is not CIRCLE:
        return _pitches_along(obs, angle_domain * (obs.sense[:, None] if odd else 1.0), n)
    rate = _pitch_rates(obs)
    total = np.zeros(len(rate), dtype=complex)
    for plane, radius, sign_of_row, rows in _by_radius(obs):
        if axis not in AXES_OF[plane]:
            continue
        along = np.cos(theta) if axis == AXES_OF[plane][0] else np.sin(theta)
        across = np.sin(theta) if axis == AXES_OF[plane][0] else -np.cos(theta)
        mean = np.zeros(obs.n_bins)
        for row in rows:
            # The first axis moves against its positive sense where sin is positive in CCW.
            sense = -sign_of_row[row] * np.sign(across) if odd else 1.0
            mean += sense * angle_domain[row]
        total += (mean * along) @ _waves((radius * along).tobytes(), rate.tobytes())
    return _peaks(rate, np.abs(total), n) or [10.0]


def _peaks(rate: Floats, power: Floats, n: int) -> list[float]:
    """Return the lengths of the n largest peaks of a spectrum over cycles per mm."""
    peaks = np.flatnonzero((power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:])) + 1
    return [float(1.0 / rate[i]) for i in peaks[np.argsort(-power[peaks])[:n]]]


def _pitches_along(obs: Observations, um: Floats, n: int) -> list[float]:
    """Return the same of targets along an axis, none where they stand at equal distances: there a wave is another as well.

    Nor of runs one way only, nor longer than any screw's pitch: that is a pitch error. Of many lengths one fits any
    targets: it must explain more than the best would by chance once in a hundred. What turns with a screw of a stated
    pitch is an effect of its own.
    """
    at_mm, travel_mm = obs.grid.points, float(np.ptp(obs.grid.points))
    steps_mm = np.diff(np.sort(at_mm))
    if not obs.there_and_back or np.ptp(steps_mm) < _EVEN * steps_mm.mean():
        return []
    rate = np.arange(1.0 / travel_mm, 1.0 / _SHORTEST_MM, 1.0 / (8.0 * travel_mm))
    mean = (um * obs.mask).sum(axis=0)
    power = np.abs((mean - mean.mean()) @ _waves(at_mm.tobytes(), rate.tobytes()))
    resolved = rate < 1.0 / (_RESOLVED * steps_mm.mean())
    # A longer wave that does nearly as well is the one that is there.
    longer = max((_explained(mean, at_mm / mm) for mm in _peaks(rate[resolved], power[resolved], n)), default=0.0)
    stated_mm = obs.campaign.machine_geometry.get(PITCH)
    if isinstance(stated_mm, int | float) and stated_mm > 0.0:
        turns = np.arange(1, ORDERS + 1) / stated_mm
        power[(np.abs(rate[:, None] - turns) < 1.0 / travel_mm).any(axis=1)] = 0.0
    chance = (_BY_CHANCE / independent_pitches(obs)) ** (2.0 / max(len(at_mm) - _WAVE, 1))
    may_leave = {True: chance, False: min(chance, _CLEARLY * (1.0 - longer))}
    shares: dict[float, float] = {}
    for part, left in may_leave.items():
        here = (resolved == part) & (rate > 1.0 / _SCREW_MM)
        explained = {mm: _explained(mean, at_mm / mm) for mm in _peaks(rate[here], power[here], n)}
        shares |= {mm: share for mm, share in explained.items() if share > 1.0 - left}
    return sorted(shares, key=shares.__getitem__, reverse=True)[:n]


def _explained(um: Floats, turns: Floats) -> float:
    """Return the share of values at targets, as a mean square about their mean, that a wave explains."""
    waves = np.stack([np.ones(len(turns)), np.cos(2.0 * np.pi * turns), np.sin(2.0 * np.pi * turns)], axis=1)
    left = um - waves @ np.linalg.lstsq(waves, um, rcond=None)[0]
    return 1.0 - float((left**2).sum()) / max(float(((um - um.mean()) ** 2).sum()), 1e-300)


@lru_cache(maxsize=32)
def _waves(at_mm: bytes, rate: bytes) -> _Complexes:
    """Return exp(-2 pi i x r) for every place and rate; a campaign asks for few of them often."""
    return np.asarray(np.exp(-2j * np.pi * np.outer(np.frombuffer(at_mm), np.frombuffer(rate))))


def _by_radius(obs: Observations) -> list[tuple[str, float, dict[int, float], list[int]]]:
    groups: dict[tuple[str, float], list[int]] = {}
    for row, condition in enumerate(obs.condition_of):
        c = obs.conditions[int(condition)]
        groups.setdefault((c.plane, c.radius_mm), []).append(row)
    sign = dict(enumerate(obs.sense.tolist()))
    return [(plane, radius, sign, rows) for (plane, radius), rows in groups.items()]


def _pitch_rates(obs: Observations) -> Floats:
    """Return the cycles per mm to try: an eighth of a turn apart at the largest radius."""
    largest = max(c.radius_mm for c in obs.conditions)
    return np.arange(1.0 / _PITCH_MM[1], 1.0 / _PITCH_MM[0], 1.0 / (16.0 * largest))


def independent_pitches(obs: Observations) -> float:
    """Return how many pitches the runs tell apart."""
    if obs.grid is not CIRCLE:
        return float(np.ptp(obs.grid.points)) * (1.0 / _SHORTEST_MM - 1.0 / _PITCH_MM[1])
    largest = max(c.radius_mm for c in obs.conditions)
    return 2.0 * largest * (1.0 / _PITCH_MM[0] - 1.0 / _PITCH_MM[1])


def independent(visible: Sequence[Floats], obs: Observations) -> float:
    """Return how many independent tests a family of columns stands for.

    By their overlap, which counts too few where what overlaps in one direction differs in another: down to a third for the
    shapes of a tone's effect. Where runs have few numbers, by the smallest p-value of simulated noise.

    ``visible``, (n, k_i): orthonormal columns of each.
    """
    if len(visible) < 2:
        return 1.0
    columns = np.concatenate(visible, axis=1)
    return independent_by_products(columns.T @ columns, np.array([v.shape[1] for v in visible]), obs)


def independent_by_products(gram: Floats, sizes: Indices, obs: Observations) -> float:
    """Return what :func:`independent` does, by the products of the columns, shape (sum k_i, sum k_i), and each k_i."""
    first = np.cumsum(sizes) - sizes
    if obs.n_bins < _FEW_BINS:
        values, vectors = np.linalg.eigh(gram)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        drawn = np.random.default_rng(0).standard_normal((_DRAWS, len(values))) @ root.T
        gains = np.add.reduceat(drawn**2, first, axis=1)
        p_values = [chdtrc(float(k), gains[:, sizes == k].max(axis=1)) for k in np.unique(sizes)]
        return float(max(1.0, np.log1p(-_AT) / np.log1p(-np.quantile(np.min(p_values, axis=0), _AT))))
    overlap = np.add.reduceat(np.add.reduceat(gram**2, first, axis=0), first, axis=1)
    overlap /= np.minimum(sizes[:, None], sizes[None, :])
    return float(max(1.0, len(sizes) ** 2 / (overlap**2).sum()))


def probes(problem: Problem) -> Floats:
    """Return columns that stand for all that could be tested, shape (rows * n, k).

    Harmonics 0 to 8 and narrow windows round the circle, even and odd in direction.
    """
    obs = problem.obs
    theta = obs.grid.phase_rad
    sign = obs.sense
    waves = [f(h * theta) for h in range(2, 9) for f in (np.cos, np.sin)]
    windows = [
        np.exp(-(((np.degrees(theta) - centre + 180.0) % 360.0 - 180.0) ** 2) / 200.0) for centre in range(0, 360, 30)
    ]
    columns = [parity[:, None] * profile for profile in (*waves, *windows) for parity in (np.ones_like(sign), sign)]
    whitened = problem.whitened(np.where(obs.mask[:, :, None], np.stack(columns, axis=2), 0.0))
    left = whitened - problem.basis @ (problem.basis.T @ whitened)
    seen = squares(left) > INVISIBLE * squares(whitened)
    return np.asarray(left[:, seen] / np.sqrt(squares(left[:, seen])))
