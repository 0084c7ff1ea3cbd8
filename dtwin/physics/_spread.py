"""What repeats differ by, and whether it depends on the condition."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from dtwin.physics.diagnosis import Spread
from dtwin.physics.effect import Effect, Instance
from dtwin.physics.gridding import Indices
from dtwin.physics.library import campaign_instances
from dtwin.physics.observations import Observations
from dtwin.physics.whitening import harmonic_numbers, to_harmonics, within_condition
from dtwin.schema import Floats
from dtwin.statistics import holm, t_tail
from dtwin.units import shown_number

_ALPHA = 0.01
_MATERIAL_EXPONENT = 0.25
# So many times what neighbouring places differ by, repeats differ by something else; and the share of it that is told as most.
_UNSTEADY, _MOST = 3.0, 0.5


def spread_of(obs: Observations, residual_um: Floats, library: Mapping[str, Effect]) -> Spread | None:
    """Return what the spread of repeats depends on, None when nothing shows.

    ``residual_um``, (rows, n): residual of the twin.
    ``library``: effects; those that act on the spread are tried.
    """
    deviation, count = within_condition(residual_um, obs.condition_of)
    # Repeats that never differ have no spread of which a logarithm could be taken.
    rows = np.flatnonzero((count > 1) & deviation.any(axis=1))
    if len(rows) < 6:
        return None
    power = (deviation[rows] ** 2).sum(axis=1) / obs.mask[rows].sum(axis=1)
    depends: dict[str, float] = {}
    feed = np.log(obs.feed_mm_s[rows])
    if np.ptp(feed) > 0.05:
        size = 0.5 * np.log(power)
        slope, _ = np.polyfit(feed, size, 1)
        if abs(slope) > _MATERIAL_EXPONENT:
            r = min(abs(float(np.corrcoef(feed, size)[0, 1])), 1.0 - 1e-12)
            dof = len(rows) - 2
            depends["feed"] = 2.0 * t_tail(r * math.sqrt(dof / (1.0 - r**2)), dof)
    geometry = obs.campaign.machine_geometry
    for instance in campaign_instances(library, obs.grid.kind, obs.planes, obs.axes, geometry):
        if instance.effect.on_spread:
            depends[instance.label] = _local(obs, deviation, rows, instance)
    if not depends:
        return None
    adjusted = dict(zip(depends, holm(list(depends.values())).tolist(), strict=True))
    named = sorted((n for n, p in adjusted.items() if p < _ALPHA), key=depends.__getitem__)
    return Spread(tuple(named), adjusted[named[0]]) if named else None


def unsteady(obs: Observations, residual_um: Floats) -> str:
    """Return in words by how much more repeats differ than neighbouring places of a run do, and in what; empty where they do not.

    Neighbouring places differ by what is in the upper half of the harmonics.

    ``residual_um``, (rows, n): residual of the twin.
    """
    deviation, count = within_condition(to_harmonics(residual_um), obs.condition_of)
    if not obs.mask.all() or not (count > 1).any():
        return ""
    power = (deviation[count > 1] ** 2).mean(axis=0)
    harmonic = harmonic_numbers(obs.n_bins)
    differ_um, scatter_um = (math.sqrt(part.mean()) for part in (power, power[harmonic > harmonic[-1] / 2]))
    if differ_um <= _UNSTEADY * scatter_um:
        return ""
    share = np.bincount(harmonic, power) / power.sum()
    names = {0: "the radius", 1: "the centre"} if obs.grid.in_plane else {0: "the zero"}
    most = [name for number, name in names.items() if share[number] > _MOST]
    said = f"repeats differ by {shown_number(differ_um, 2)} µm, neighbouring places of a run by {shown_number(scatter_um, 2)} µm"
    if most:
        return f"{said}: most of it is {most[0]}, which moves between runs"
    return f"{said}: the error itself changes between runs"


def _local(obs: Observations, deviation: Floats, rows: Indices, instance: Instance) -> float:
    """Return the p-value that the spread is larger where the effect says; the unit is the run."""
    best = 1.0
    shapes = instance.effect.shapes
    for value in shapes[0].grid if shapes else (0.0,):
        shape = {shapes[0].name: value} if shapes else {}
        profile = obs.regressors(instance, shape)[:, :, 0]
        scores = []
        for row in rows:
            mask = obs.mask[row]
            wanted = profile[row][mask] - profile[row][mask].mean()
            size = float(np.abs(wanted).sum())
            if size > 0.0:
                power = deviation[row][mask] ** 2
                scores.append(float(wanted @ power) / (size * float(power.mean())))
        if len(scores) > 5:
            error = float(np.std(scores, ddof=1)) / math.sqrt(len(scores))
            p = t_tail(float(np.mean(scores)) / max(error, 1e-300), len(scores) - 1)
            best = min(best, p * len(shapes[0].grid if shapes else (0.0,)))
    return min(best, 1.0)
