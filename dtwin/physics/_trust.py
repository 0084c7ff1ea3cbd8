"""Which of the effects found may be a part of something unknown that looks like them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dtwin.physics import localise
from dtwin.physics._laws import share_that_follows
from dtwin.physics._rivals import Found
from dtwin.physics._search import Search
from dtwin.physics.observations import Observations
from dtwin.physics.whitening import from_harmonics, harmonic_numbers, to_harmonics
from dtwin.schema import Floats

# An effect so many times larger than what moves like it and is not resolved is itself.
_LARGER = 3.0
# What warms up for a tenth of a test stands, in the mean, for so many times what it moves.
_STILL = 5.0
# The same of what turns with the direction, in runs there and back: a pass in which all of it happens is followed by one back.
_STILL_BOTH_WAYS = 1.0
# Of the shapes of several effects, by their singular values, what is less is none.
_SHAPE = 0.25
# Half of an effect, or of the mean square of what is left.
_HALF = 0.5
# An effect that is a smaller share of what is left hangs on it, whatever it follows.
_TINY = 0.25
# Spectra that agree less are of different things.
_APART = 0.4


def trusted(search: Search, doubted: Sequence[Found], much: bool) -> list[Found]:
    """Return the effects that are not a part of something unknown that looks like them.

    What is unknown is what is left, where that is much, and what the effects do whose laws do not
    hold. An effect that moves with the condition as that does must be larger than those, and much
    larger than what is left; otherwise its part is unknown as well. Where its harmonics are others,
    or its amplitude follows its own law and not that of what is unknown, it is none of it, unless
    it is tiny beside it.
    """
    obs = search.plain.obs
    unknown = localise.in_angle(search.plain) * float(much)
    least_um = _TINY * _rms_um(localise.condition_means(obs, unknown))
    unknown = _LARGER * unknown + sum_um(doubted, obs)
    kept = [f for f in search.found if f not in doubted]
    # What moves with a channel, but not as the library says, may also stand still in part.
    moving = [f for f in doubted if f.top.term.instance.effect.within_condition]
    if moving:
        moved_um = sum(f.size_um for f in moving)
        shapes = _shapes(moving, obs)
        kept = [f for f in kept if f.size_um > _still(f, obs) * moved_um or _share_in(f, shapes, obs) < _APART]
    while True:
        means = localise.condition_means(obs, unknown)
        doubtful = [
            f
            for f in kept
            if f.size_um < _rms_um(means) * _alike(f, means, obs)
            and (f.size_um < least_um or not (alike_in_harmonics(f, means, obs) < _APART or _is_other(f, means, obs)))
        ]
        if not doubtful:
            return kept
        kept = [f for f in kept if f not in doubtful]
        unknown = unknown + sum_um(doubtful, obs)


def _still(effect: Found, obs: Observations) -> float:
    """Return how many times what moves with a channel may look like an effect in the mean of all runs."""
    turns = effect.top.term.instance.effect.law.direction == "odd"
    return _STILL_BOTH_WAYS if turns and obs.there_and_back else _STILL


def _rms_um(means: Floats) -> float:
    return float(np.sqrt((means**2).sum() / max(float((means != 0.0).sum()), 1.0)))


def sum_um(effects: Sequence[Found], obs: Observations) -> Floats:
    """Return what effects do together, shape (rows, n)."""
    return sum((does_um(f, obs) for f in effects), np.zeros(obs.y_um.shape))


def does_um(effect: Found, obs: Observations) -> Floats:
    return np.asarray(from_harmonics(effect.fitted_um) * obs.mask)


def _shapes(effects: Sequence[Found], obs: Observations) -> Floats:
    """Return what effects look like along the path, whatever their size in a condition: orthonormal, shape (n, k)."""
    does = [does_um(f, obs) for f in effects]
    alike = np.concatenate([d / max(float(np.linalg.norm(d)), 1e-300) for d in does])
    _, sizes, shapes = np.linalg.svd(alike, full_matrices=False)
    return np.asarray(shapes[sizes > _SHAPE * sizes[0]].T)


def _share_in(effect: Found, shapes: Floats, obs: Observations) -> float:
    """Return the share of an effect, as a mean square, that looks like these shapes in any size."""
    does = does_um(effect, obs)
    return float(((does @ shapes) ** 2).sum() / max(float((does**2).sum()), 1e-300))


def _alike(effect: Found, means: Floats, obs: Observations) -> float:
    """Return the share, as an amplitude, of condition means that moves with the condition as an effect."""
    does = localise.condition_means(obs, does_um(effect, obs))
    amplitude = np.sqrt((does**2).mean(axis=1))
    if effect.top.term.instance.effect.law.direction == "odd":
        amplitude = amplitude * np.array([c.sense for c in obs.conditions])
    along = amplitude @ means / max(float(np.linalg.norm(amplitude)), 1e-300)
    return float(np.sqrt((along**2).sum() / max(float((means**2).sum()), 1e-300)))


def alike_in_harmonics(effect: Found, means: Floats, obs: Observations) -> float:
    """Return how far condition means have the harmonics of an effect, from 0 to 1; 1 where they have many.

    What has many harmonics can leave others than those that an effect takes of it.
    """
    power = _harmonics(means, obs)
    own = _harmonics(localise.condition_means(obs, does_um(effect, obs)), obs)
    return _overlap(own, power) if power.max() > _HALF else 1.0


def _harmonics(means: Floats, obs: Observations) -> Floats:
    """Return the share of each harmonic in the mean square of condition means."""
    power = np.bincount(harmonic_numbers(obs.n_bins), (to_harmonics(means) ** 2).mean(axis=0))
    return np.asarray(power / max(float(power.sum()), 1e-300))


def _overlap(first: Floats, second: Floats) -> float:
    """Return how far two spectra agree, from 0 to 1, after Bhattacharyya."""
    return float(np.sqrt(first * second).sum())


def _is_other(effect: Found, means: Floats, obs: Observations) -> bool:
    """Tell whether no half of an effect can be a part of condition means that moves as these do."""
    if effect.top.term.instance.effect.within_condition:
        return False
    sense = np.array([c.sense for c in obs.conditions])
    for signs in (np.ones(len(sense)), sense):
        amplitude = np.sqrt((means**2).mean(axis=1)) * signs
        share, uncertainty = share_that_follows(effect, amplitude[obs.condition_of])
        if share + 2.0 * uncertainty > _HALF:
            return False
    return True
