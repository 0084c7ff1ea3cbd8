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

import numpy as np

from dtwin.kinds.volumetric._heat_series import HeatSeries
from dtwin.kinds.volumetric._heat_twin import KIND, HeatFit, heat_figures
from dtwin.kinds.volumetric._motions import HeatTerm, family_of, motion_words
from dtwin.kinds.volumetric._thermal_model import fit_thermal, inflation
from dtwin.schema import Floats
from dtwin.statistics import chi2_tail, holm, rms, t_tail

Verdict = Literal["missing_effect", "ambiguous", "unknown_effect", "nothing_missing"]
# A motion counts when it adds a quarter of the floor at the balls: 3 % of the residual.
MATERIAL = 0.25
# Share of what can be seen of a motion that temperatures must tell on hours left out.
EXPLAINED = 0.4
# Another temperature is the cause when the thermocouples leave this many times as much.
_CLEARER = 2.0
_ALPHA = 0.01


@dataclass(frozen=True)
class Mover:
    """An error motion that moves more than its uncertainty.

    ``seen_um``: RMS at the balls of what the twin does not explain of it.
    ``rms_after_um``: RMS of the whole residual at the balls if hours left out are any guide.
    ``gain``: share of it, beyond its uncertainty, that temperatures tell on hours left out.
    ``p_value``: of the hypothesis that they tell nothing, after Holm.
    ``channel``: temperature logged beside the thermocouples that tells it, when they do not.
    ``bodies``: bodies each of which tells it alone; more than one cannot be told apart.
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
    largest_inflation: float
    in_twin: bool

    @property
    def told(self) -> bool:
        """Whether temperatures tell it on hours left out."""
        return self.gain >= EXPLAINED and self.p_value < _ALPHA

    @property
    def explained(self) -> bool:
        """Whether thermocouples tell it."""
        return self.told and self.channel is None

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
        return HeatTerm(self.motion, self.sensors if self.in_twin else ()).label


@dataclass(frozen=True)
class HeatDiagnosis:
    """What is missing in a twin of heat.

    ``figures``: errors at the balls, as :func:`dtwin.kinds.volumetric._heat_twin.heat_figures` has them.
    ``lack_of_fit_p``: of the hypothesis that the twin leaves nothing but noise of the motions.
    ``movers``: motions that count, best first.
    ``group``: those that the verdict is about.
    ``quiet``: motions that move, but by less than counts.
    """

    verdict: Verdict
    headline: str
    figures: dict[str, float]
    lack_of_fit_p: float
    movers: tuple[Mover, ...]
    group: tuple[Mover, ...]
    quiet: tuple[str, ...]
    where: tuple[dict[str, Any], ...] = ()
    next_experiment: dict[str, Any] | None = None

    @property
    def additions(self) -> tuple[str, ...]:
        """What to add to the twin, best first."""
        return tuple(m.addition for m in self.group if m.addition)

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
            "next_experiment": self.next_experiment,
        }

    def _candidate(self, mover: Mover) -> dict[str, Any]:
        family = family_of(mover.motion)
        term = HeatTerm(mover.motion)
        alike = mover.bodies if len(mover.bodies) > 1 else ()
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
            "confounded_with": [HeatTerm(mover.motion, (body,)).label for body in alike],
            "temperatures": list(mover.sensors),
            "explained_by": mover.channel if mover.told else None,
            "largest_inflation": mover.largest_inflation,
            "add": mover.addition or None,
            "remedy": family.remedy,
        }


def diagnose_heat(series: HeatSeries, fitted: HeatFit, where: Sequence[dict[str, Any]]) -> HeatDiagnosis:
    """Find out what a twin lacks."""
    left = series.values - fitted.expected
    still = holm([_still_p(series, left[:, i], i) for i in range(len(series.names))])
    moving = [i for i in range(len(series.names)) if still[i] < _ALPHA]
    counts = [i for i in moving if _seen_um(series, left[:, i], i) >= MATERIAL * series.floor_um]
    models = {model.name: model.sensors for model in fitted.models}
    movers = [_mover(series, left, i, models.get(series.names[i], ())) for i in counts]
    explained_p = holm([m.p_value for m in movers])
    movers = [replace(m, p_value=float(p)) for m, p in zip(movers, explained_p, strict=True)]
    movers.sort(key=lambda m: m.rms_after_um)
    verdict, group = _verdict(movers)
    figures = heat_figures(series, left)
    return HeatDiagnosis(
        verdict,
        _headline(verdict, group, movers, figures),
        figures,
        _fit_p(series, left),
        tuple(movers),
        group,
        tuple(series.names[i] for i in moving if i not in counts),
        tuple(where),
        _experiment(verdict, group),
    )


def _verdict(movers: Sequence[Mover]) -> tuple[Verdict, tuple[Mover, ...]]:
    """Return the verdict and its motions: what is sure first, what nobody can help last."""
    explained = [m for m in movers if m.explained]
    sure = tuple(m for m in explained if len(m.bodies) < 2)
    if sure:
        return "missing_effect", sure
    helped = [m for m in movers if m.addition]
    if helped and helped[0].explained:
        return "ambiguous", tuple(explained)
    unknown = [m for m in movers if not m.explained]
    if unknown:
        return "unknown_effect", tuple(sorted(unknown, key=lambda m: (not m.addition, -m.seen_um)))
    return "nothing_missing", ()


def _mover(series: HeatSeries, left: Floats, column: int, own: tuple[str, ...]) -> Mover:
    """Return what temperatures tell of a motion."""
    name, motion = series.names[column], left[:, column]
    model, expected = series.driven(name, motion, series.thermocouples)
    rest = motion - expected
    channel = _clearer_channel(series, motion, rest, column, own)
    sensors: tuple[str, ...] = model.sensors
    if channel is not None:
        rest, sensors = motion - _with_channel(series, motion, (*own, channel)), (channel,)
    after = left.copy()
    after[:, column] = rest
    gain = _gain(series, motion, rest, column)
    thermocouples_do = channel is None and gain >= EXPLAINED
    return Mover(
        name,
        _seen_um(series, motion, column),
        series.rms_um(after),
        gain,
        _tells_p(motion, motion - rest),
        sensors,
        channel,
        _bodies(series, motion, column) if thermocouples_do else (),
        float(inflation(series.rises(sensors)).max()) if len(sensors) > 1 else 1.0,
        bool(own),
    )


def _clearer_channel(series: HeatSeries, motion: Floats, rest: Floats, column: int, own: tuple[str, ...]) -> str | None:
    """Return the temperature logged beside the thermocouples that tells a motion far better."""
    channels: list[tuple[float, str]] = []
    for channel in series.offered:
        if channel in own:
            continue
        expected = _with_channel(series, motion, (*own, channel))
        with_it = motion - expected
        tells = _tells_p(motion, expected) < _ALPHA
        if tells and _gain(series, motion, with_it, column) >= EXPLAINED:
            channels.append((series.share_um(with_it, column), channel))
    best = min(channels, default=None)
    if best is None or series.share_um(rest, column) < _CLEARER * best[0]:
        return None
    return best[1]


def _with_channel(series: HeatSeries, motion: Floats, names: Sequence[str]) -> Floats:
    """Return what these temperatures, all of them used, tell of hours left out."""
    rise = series.rises(names)
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
        model = fit_thermal(series.names[column], motion, rise, sensors, static=True)
        left = motion - model.run(series.rises(model.sensors))
        if _still_p(series, left, column) > _ALPHA:
            alone.append(body)
    return tuple(alone)


def _still_p(series: HeatSeries, left: Floats, column: int) -> float:
    """Return the p-value of a motion that stands still; where it stands is the reference's noise."""
    ratio = (left - left.mean()) / series.uncertainty_of(column)
    return chi2_tail(float(ratio @ ratio), len(left) - 1)


def _fit_p(series: HeatSeries, left: Floats) -> float:
    """Return the p-value of motions that all stand still, correlations of their noise counted."""
    centred = left - left.mean(axis=0)
    solved = np.linalg.solve(series.covariance, centred[:, :, None])[:, :, 0]
    return chi2_tail(float((centred * solved).sum()), (len(left) - 1) * left.shape[1])


def _seen_um(series: HeatSeries, left: Floats, column: int) -> float:
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


def _grade(mover: Mover) -> str | None:
    """Return how well a name is confirmed: by its shape, or also by one cause on hours left out."""
    if not mover.addition:
        return None
    return "law-confirmed" if mover.channel or len(mover.bodies) == 1 else "shape-consistent"


def _experiment(verdict: Verdict, group: Sequence[Mover]) -> dict[str, Any] | None:
    if verdict == "ambiguous":
        bodies = group[0].bodies
        text = (
            f"heat {bodies[0]} alone, with {_listed(bodies[1:])} at rest, then the other way round; "
            f"a cycle an hour: {group[0].motion} follows the one that drives it"
        )
        return {"text": text, "heat_alone": list(bodies), "watch": [m.motion for m in group]}
    unknown = [m.motion for m in group if not m.addition] if verdict == "unknown_effect" else []
    if not unknown:
        return None
    text = (
        f"put a thermocouple on what has none (foundation, tanks, spindle, scales): what moves "
        f"{_listed(unknown)} is not measured, or lags far behind what is"
    )
    return {"text": text, "heat_alone": [], "watch": unknown}


def _headline(verdict: Verdict, group: Sequence[Mover], movers: Sequence[Mover], figures: dict[str, float]) -> str:
    floor = figures["noise_floor_um"]
    if verdict == "nothing_missing":
        return f"no error motion moves by more than {MATERIAL * floor:.2g} µm at the balls beyond the twin"
    best = group[0]
    what = f"{best.motion} ({motion_words(best.motion)}: {family_of(best.motion).title})"
    others = f"; {len(group) - 1} more" if len(group) > 1 else ""
    lacks = "lacks temperatures" if best.in_twin else "is missing"
    if verdict == "missing_effect":
        unknown = [m.motion for m in movers if not m.explained]
        also = f"; not explained by thermocouples: {', '.join(unknown)}" if unknown else ""
        return f"{what} {lacks}, {100 * best.gain:z.0f} % of it is told on hours left out{others}{also}"
    if verdict == "ambiguous":
        return f"{what} {lacks}, but {_listed(best.bodies)} each tell it alone, equally well{others}"
    if best.addition:
        return f"{what} moves, and no thermocouple tells it; {best.channel} does{others}"
    return f"{what} moves, and nothing that was logged tells it{others}"


def _listed(names: Sequence[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
