"""Error motions that move more than their uncertainty, and what of them temperatures tell on hours left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dtwin.features.time_alone import left_with_time, needed
from dtwin.kinds.volumetric._drivers import MUCH
from dtwin.kinds.volumetric._heat_series import HeatSeries
from dtwin.kinds.volumetric._thermal_model import fit_thermal, inflation
from dtwin.kinds.volumetric.motions import HeatTerm
from dtwin.schema import Floats
from dtwin.statistics import chi2_tail, rms, t_tail

# A motion counts when it adds a quarter of the floor at the balls: 3 % of the residual.
MATERIAL = 0.25
# Share of what can be seen of a motion that temperatures must tell on hours left out.
_EXPLAINED = 0.3
# Another temperature is the cause when the thermocouples leave this many times as much.
_CLEARER = 2.0
ALPHA = 0.01


@dataclass(frozen=True)
class Mover:
    """An error motion that moves more than its uncertainty.

    ``seen_um``: RMS at the balls of what the twin does not explain of it.
    ``rms_after_um``: RMS of the whole residual at the balls if hours left out are any guide.
    ``gain``: share of it, beyond its uncertainty, that temperatures tell on hours left out.
    ``p_value``: of the hypothesis that they tell nothing, after Holm.
    ``channel``: temperature logged beside the thermocouples that tells it, when they do not.
    ``bodies``: bodies each of which tells it alone; more than one cannot be told apart.
    ``alike``: for each body of ``sensors`` what tells as much in its place.
    ``as_time``: bodies, or a temperature logged beside them, that tell no more than time alone does; where nothing else
    tells the motion, the figures are those with them.
    ``largest_inflation``: variance inflation among ``sensors``.
    ``in_twin``: whether the twin has it, driven by other temperatures.
    """

    motion: str
    seen_um: float
    rms_after_um: float
    gain: float
    p_value: float
    sensors: tuple[str, ...]
    channel: str | None
    bodies: tuple[str, ...]
    alike: Mapping[str, tuple[str, ...]]
    as_time: tuple[str, ...]
    largest_inflation: float
    in_twin: bool

    @property
    def told(self) -> bool:
        """Whether temperatures tell it on hours left out."""
        return self.gain >= _EXPLAINED and self.p_value < ALPHA

    @property
    def explained(self) -> bool:
        """Whether thermocouples tell it."""
        return self.told and self.channel is None

    @property
    def is_as_time(self) -> bool:
        """Whether time alone tells as much as what tells it."""
        return bool(self.as_time) and not self.sensors

    @property
    def is_sure(self) -> bool:
        """Whether thermocouples tell it, and no other body, nor time alone, tells as much."""
        return self.explained and not self.is_as_time and len(self.bodies) < 2

    @property
    def label(self) -> str:
        """What to add, or the motion alone."""
        return self.addition or self.motion

    @property
    def addition(self) -> str:
        """What to add to the twin; empty when nothing that was logged would help."""
        if not self.told:
            return ""
        if self.channel is not None:
            return HeatTerm(self.motion, (self.channel,)).label
        sources = self.as_time if self.is_as_time else self.sensors
        return HeatTerm(self.motion, sources if self.in_twin or self.is_as_time else ()).label


def mover_of(series: HeatSeries, left: Floats, column: int, own: tuple[str, ...], moved: Floats | None = None) -> Mover:
    """Return what temperatures tell of a motion.

    ``left``, (n, m): what is left of the motions.
    ``own``: temperatures that drive it in the twin.
    ``moved``, (n,): the part of it that is asked about; all of it without.
    """
    name, motion = series.names[column], left[:, column] if moved is None else moved
    drivers = series.driven(name, motion)
    expected, sensors, as_time = drivers.expected, drivers.model.sensors, drivers.as_time
    tested = drivers.by_any
    if as_time and not sensors:
        expected = drivers.by_any
    channel = _clearer_channel(series, motion, motion - expected, column, own)
    if channel is not None:
        is_as_time = _is_as_time(series, motion, own, channel)
        if not (is_as_time and sensors):
            expected = tested = _with_channel(series, motion, (*own, channel))
            sensors, as_time = ((), (channel,)) if is_as_time else ((channel,), ())
        channel = None if is_as_time else channel
    rest = motion - expected
    after = left.copy()
    after[:, column] += rest - motion
    gain = _gain(series, motion, rest, column)
    thermocouples_do = channel is None and bool(sensors) and gain >= _EXPLAINED
    return Mover(
        name,
        seen_um(series, motion, column),
        series.rms_um(after),
        gain,
        _tells_p(motion, tested),
        sensors,
        channel,
        _bodies(series, motion, column) if thermocouples_do else (),
        drivers.alike if channel is None else {},
        as_time,
        float(inflation(series.rises(sensors)).max()) if len(sensors) > 1 else 1.0,
        bool(own),
    )


def beside_others(series: HeatSeries, left: Floats) -> list[tuple[int, Floats]]:
    """Return motions that move only when the others are taken to stand still, until what is left is noise.

    Balls tell less of a motion by itself, since its noise goes with that of others. Returns columns and how they move, (n,).
    """
    precise = np.linalg.inv(series.covariance)
    each = np.einsum("nii->ni", precise)
    beside: dict[int, Floats] = {}
    left = left.copy()
    while fit_p(series, left) < ALPHA and len(beside) < left.shape[1]:
        moved = np.einsum("nij,nj->ni", precise, left - left.mean(axis=0)) / each
        gain = (moved**2 * each).sum(axis=0)
        gain[list(beside)] = 0.0
        best = int(np.argmax(gain))
        beside[best] = moved[:, best]
        left[:, best] -= moved[:, best]
    return list(beside.items())


def beside_others_mover(series: HeatSeries, left: Floats, column: int, own: tuple[str, ...], moved: Floats) -> Mover:
    """Return what temperatures tell of a motion that moves so beside others at rest."""
    known = np.einsum("nii->ni", np.linalg.inv(series.covariance))[:, :, None]
    return mover_of(replace(series, covariance=np.eye(left.shape[1]) / known), left, column, own, moved)


def fit_p(series: HeatSeries, left: Floats) -> float:
    """Return the p-value of motions that all stand still, correlations of their noise counted."""
    centred = left - left.mean(axis=0)
    solved = np.linalg.solve(series.covariance, centred[:, :, None])[:, :, 0]
    return chi2_tail(float((centred * solved).sum()), (len(left) - 1) * left.shape[1])


def _clearer_channel(series: HeatSeries, motion: Floats, rest: Floats, column: int, own: tuple[str, ...]) -> str | None:
    """Return the temperature logged beside the thermocouples that tells a motion far better."""
    channels: list[tuple[float, str]] = []
    for channel in series.offered:
        if channel in own:
            continue
        expected = _with_channel(series, motion, (*own, channel))
        with_it = motion - expected
        tells = _tells_p(motion, expected) < ALPHA
        if tells and _gain(series, motion, with_it, column) >= _EXPLAINED:
            channels.append((series.share_um(with_it, column), channel))
    best = min(channels, default=None)
    if best is None or series.share_um(rest, column) < _CLEARER * best[0]:
        return None
    return best[1]


def _is_as_time(series: HeatSeries, motion: Floats, own: Sequence[str], channel: str) -> bool:
    """Tell whether a course of time leaves as little as a temperature does of hours left out, beside those of the twin."""

    def squares(rise: Floats) -> Floats:
        left = motion - _told(series, motion, np.column_stack([series.rises(own), rise]))
        return np.array([float((left[span] ** 2).sum()) for span in series.spans()])

    by_time = left_with_time(series.hour, squares)
    return not needed(by_time, squares(series.rise_c[channel]), MUCH)


def _with_channel(series: HeatSeries, motion: Floats, names: Sequence[str]) -> Floats:
    """Return what these temperatures, all of them used, tell of hours left out."""
    return _told(series, motion, series.rises(names))


def _told(series: HeatSeries, motion: Floats, rise: Floats) -> Floats:
    """Return what columns (n, k) tell of hours left out."""
    expected = np.zeros(len(motion))
    for span in series.spans():
        kept = np.delete(np.arange(len(motion)), span)
        per_k = np.linalg.lstsq(rise[kept], motion[kept], rcond=None)[0]
        expected[span] = rise[span] @ per_k
    return expected


def _bodies(series: HeatSeries, motion: Floats, column: int) -> tuple[str, ...]:
    """Return the bodies whose thermocouples alone leave a motion that stands still."""
    alone = []
    for body, sensors in series.bodies.items():
        rise = series.rises(sensors)
        model = fit_thermal(series.names[column], motion, rise, sensors)
        left = motion - model.run(series.rises(model.sensors))
        if still_p(series, left, column) > ALPHA:
            alone.append(body)
    return tuple(alone)


def still_p(series: HeatSeries, left: Floats, column: int) -> float:
    """Return the p-value of a motion that stands still; where it stands is the reference's noise."""
    ratio = (left - left.mean()) / series.uncertainty_of(column)
    return chi2_tail(float(ratio @ ratio), len(left) - 1)


def seen_um(series: HeatSeries, left: Floats, column: int) -> float:
    """Return what moves of a motion beyond its uncertainty, as RMS at the balls."""
    noise = series.share_um(series.uncertainty_of(column), column)
    return float(np.sqrt(max(series.share_um(left, column) ** 2 - noise**2, 0.0)))


def _gain(series: HeatSeries, motion: Floats, rest: Floats, column: int) -> float:
    """Return the share of what can be seen that is gone."""
    noise = float((series.uncertainty_of(column) ** 2).mean())
    before = max(rms(motion) ** 2 - noise, 1e-12)
    return float(min((rms(motion) ** 2 - rms(rest) ** 2) / before, 1.0))


def _tells_p(motion: Floats, expected: Floats) -> float:
    """Return the one-sided p-value of a correlation between two series that last."""
    one, other = motion - motion.mean(), expected - expected.mean()
    power = float(np.linalg.norm(one) * np.linalg.norm(other))
    if power <= 0.0:
        return 1.0
    lasts = np.clip(_lag(one) * _lag(other), 0.0, 0.98)
    n = max(len(one) * (1.0 - lasts) / (1.0 + lasts), 4.0)
    r = float(np.clip(one @ other / power, -1.0 + 1e-12, 1.0 - 1e-12))
    return t_tail(r * np.sqrt((n - 2.0) / (1.0 - r**2)), n - 2.0)


def _lag(centred: Floats) -> float:
    return float(centred[1:] @ centred[:-1] / (centred @ centred))
