"""How much of a machine's error each cause makes, and what would be left after its remedy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.physics import localise
from dtwin.physics.machine_terms import own_term
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.twin import Twin
from dtwin.schema import Floats


@dataclass(frozen=True)
class Share:
    """What one effect of a twin makes of the error of a campaign.

    ``label``, ``title``, ``remedy``: the effect as commands take it, its name in words, and what to do about it.
    ``rms_um``: RMS of what it does, set-ups taken out, by plane or axis, with "" for the whole campaign.
    ``uncertainty_um``: of the RMS of the whole, expanded, k = 2, from those of its parameters, taken as uncorrelated;
    NaN without repeats.
    ``left_um``: RMS of the error when it is gone, set-ups taken out.
    ``largest_um``: largest difference of the mean of a condition then: of circles the largest circular deviation.
    """

    label: str
    title: str
    remedy: str
    rms_um: dict[str, float]
    uncertainty_um: float
    left_um: float
    largest_um: float

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return dict(vars(self))


@dataclass(frozen=True)
class Budget:
    """The causes of a campaign's error, the largest first.

    ``error_um``, ``largest_um``: RMS of the error, set-ups taken out, and largest difference of the mean of a
    condition.
    ``left_um``, ``left_largest_um``: the same when all effects are gone.
    ``unexplained_um``: RMS of what repeats agree on of it; the twin does not know it.
    """

    shares: tuple[Share, ...]
    error_um: float
    largest_um: float
    left_um: float
    left_largest_um: float
    unexplained_um: float

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {**vars(self), "shares": [share.as_dict() for share in self.shares]}


def budget(twin: Twin, obs: Observations, terms: Sequence[Term] = ()) -> Budget:
    """Return how much each effect of a twin makes of the error of a campaign.

    Effects may undo each other: shares are no parts of a sum.

    ``obs``: runs, not necessarily those of the fit.
    ``terms``: of the twin of several campaigns that it is a part of, which name the causes.
    """
    shares = sorted(
        (_share(twin, term, obs, own_term(term, terms)) for term in twin.terms), key=lambda share: -share.rms_um[""]
    )
    every = sum((_does_um(twin, term, obs) for term in twin.terms), np.zeros(obs.y_um.shape))
    left = _without_setup(obs, obs.y_um - every)
    before = _without_setup(obs, obs.y_um)
    return Budget(
        tuple(shares),
        obs.rms(before),
        _largest(obs, before),
        obs.rms(left),
        _largest(obs, left),
        localise.systematic_rms_um(obs, left),
    )


def _share(twin: Twin, term: Term, obs: Observations, named: Term) -> Share:
    columns = obs.regressors(term.instance, term.shape)
    values = twin.values(term)
    does = _without_setup(obs, columns @ values)
    left = _without_setup(obs, obs.y_um - columns @ values)
    planes = np.array([obs.conditions[c].plane for c in obs.condition_of])
    by_plane = {p: obs.take(np.flatnonzero(planes == p)).rms(does[planes == p]) for p in obs.planes}
    return Share(
        named.label,
        f"{named.instance.effect.title} {named.instance.axis}".rstrip(),
        named.instance.effect.remedy,
        {"": obs.rms(does), **by_plane},
        _uncertainty_um(twin, term, obs, columns, does),
        obs.rms(left),
        _largest(obs, left),
    )


def _uncertainty_um(twin: Twin, term: Term, obs: Observations, columns: Floats, does: Floats) -> float:
    """Return the expanded uncertainty of the RMS of an effect: how it changes with each of its parameters."""
    name, axis = term.instance.effect.name, term.instance.axis
    widths = [e.uncertainty_at_shape for e in twin.estimates if (e.effect, e.axis) == (name, axis)]
    total = obs.rms(does) * float(obs.mask.sum())
    if total <= 0.0:
        return float("nan")
    parts = [_without_setup(obs, columns[:, :, k] * width) for k, width in enumerate(widths)]
    return float(np.hypot.reduce([(part * does)[obs.mask].sum() / total for part in parts]))


def _does_um(twin: Twin, term: Term, obs: Observations) -> Floats:
    return np.asarray(obs.regressors(term.instance, term.shape) @ twin.values(term))


def _without_setup(obs: Observations, values_um: Floats) -> Floats:
    return localise.residual_um(obs.with_y(values_um), [])


def _largest(obs: Observations, values_um: Floats) -> float:
    """Return the largest peak-to-valley of the mean of a condition, where all its runs were measured."""
    means = localise.condition_means(obs, values_um)
    out = 0.0
    for number, mean in enumerate(means):
        seen = obs.mask[obs.condition_of == number].all(axis=0)
        out = max(out, float(np.ptp(mean[seen]))) if seen.any() else out
    return out
