"""The set of effects that explains a campaign best, where the laws of the library hold only to within a misfit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dtwin.physics._dictionary import Dictionary, dictionary_for
from dtwin.physics._hunt import MISFIT, Hunt, repeat_variance
from dtwin.physics.candidates import Candidates
from dtwin.physics.localise import condition_means
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, Term, weighted_like
from dtwin.physics.whitening import from_harmonics, inverse_root, smoothed
from dtwin.schema import Floats

_ROUNDS = 3
# What happens so near to a reversal hangs on a fraction of a millisecond.
_NEAR_REVERSAL_DEG = 2.6
# So many times the mean square of what is left elsewhere is sharp.
_SHARP = 1.5


@dataclass(frozen=True)
class Best:
    """The effects that explain a campaign best.

    ``library``: the candidates for what told them: the campaign; without the neighbourhood of reversals when the library's
    laws do not hold to within the noise, there or everywhere.
    ``everywhere``: the effects that explain the whole campaign best.
    ``exact``: whether those leave no more than noise.
    """

    terms: list[Term]
    library: Candidates
    everywhere: list[Term]
    exact: bool


def best_set(
    problem: Problem, dictionary: Dictionary, known: Sequence[Term], beside: Callable[[Problem], Problem]
) -> Best:
    """Return the effects that explain a campaign best, and the observations that told.

    ``problem``: whitened campaign with what the twin knows.
    ``dictionary``: the library beside it.
    ``beside``: takes out of a problem what is neither the twin's nor the library's.

    Note:
        The first round takes the noise of the repeats. Where the best set leaves more, the laws of
        the library are not exact: what is left, harmonic by harmonic, then counts as noise, so that
        a further effect must stand out of the misfit as well.
    """
    noise = problem.noise
    assert noise is not None
    level = repeat_variance(problem)
    obs, library = problem.obs, dictionary.candidates
    hunt = Hunt(problem, dictionary, level)
    chosen = hunt.run([])
    everywhere = [entry.term for entry in chosen]
    for number in range(_ROUNDS - 1):
        if hunt.left(chosen) < MISFIT * level * obs.mask.sum():
            break
        if number == 0 and obs.grid.kind == "circular":
            obs = away_from_reversals(obs)
            library = Candidates(obs, library.instances)
        terms = [entry.term for entry in chosen]
        before = beside(weighted_like(obs, known, noise))
        weights, level = _misfit_as_noise(before, terms)
        problem = beside(weighted_like(obs, known, replace(noise, weights=weights)))
        hunt = Hunt(problem, Dictionary(problem, library), level)
        chosen = hunt.run(hunt.dictionary.add(terms))
    terms = [entry.term for entry in chosen]
    exact = obs is problem.obs and obs.several_speeds and hunt.left(chosen) < MISFIT * level * obs.mask.sum()
    if obs is problem.obs and obs.grid.kind == "circular" and is_sharp(problem, terms):
        library = Candidates(away_from_reversals(obs), library.instances)
    return Best(terms, library, everywhere, exact)


def _near_reversal(obs: Observations) -> NDArray[np.bool_]:
    angle = np.degrees(obs.grid.phase_rad)
    return np.abs((angle + 45.0) % 90.0 - 45.0) < _NEAR_REVERSAL_DEG


def away_from_reversals(obs: Observations) -> Observations:
    """Return a campaign of circles without what lies near the ends of the axes."""
    mask = obs.mask & ~_near_reversal(obs)[None, :]
    return replace(obs, mask=mask, y_um=np.where(mask, obs.y_um, 0.0))


def is_sharp(problem: Problem, terms: Sequence[Term]) -> bool:
    """Tell whether what effects leave, on the mean of the repeats, is larger near reversals."""
    obs = problem.obs
    rows = _left(problem, terms) / problem.weights
    power = condition_means(obs, from_harmonics(rows) * obs.mask) ** 2
    near = _near_reversal(obs)
    return bool(power[:, near].mean() > _SHARP * power[:, ~near].mean())


def _left(problem: Problem, terms: Sequence[Term]) -> Floats:
    """Return what a set leaves, whitened, shape (rows, n)."""
    obs = problem.obs
    dictionary = dictionary_for(problem, terms)
    rest = problem.residual.ravel() - dictionary.fitted(dictionary.add(terms))
    return np.asarray(rest.reshape(obs.n_rows, obs.n_bins))


def _misfit_as_noise(problem: Problem, terms: Sequence[Term]) -> tuple[Floats, float]:
    """Return the weights that make what a set leaves white, and its variance then."""
    obs = problem.obs
    rows: Floats = _left(problem, terms) / problem.weights
    weights = inverse_root(smoothed((rows**2).mean(axis=0)))
    return weights, float(((rows * weights) ** 2).sum() / obs.mask.sum())
