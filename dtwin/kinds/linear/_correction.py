"""A twin of an axis as a correction: its bundle, each effect a term of the two flanks that the slide rests on, judged by runs that were left out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.linear._bundle import POSITION, ROOM_MM, SAFETY, held, remembering_bundle
from dtwin.kinds.linear._gates import screw_metrics
from dtwin.kinds.linear._grid import WAYS, Stroke
from dtwin.kinds.linear._judging import (
    HELD_OUT,
    explained_share,
    noise_floor_um,
    runs_left_out,
    scores_of,
    stacked,
    table_rms_um,
)
from dtwin.physics.gridding import Indices
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.screw import PITCH
from dtwin.physics.state import State
from dtwin.physics.twin import Twin, frozen_residual_um, predict_um
from dtwin.positioning.check import FEWEST_PHASES, phases_of
from dtwin.positioning.matrix import LinearTest
from dtwin.schema import Floats
from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.serve.graph_code import to_text
from dtwin.serve.interface import SafetyLimits
from dtwin.statistics import rms
from dtwin.train.latency import bundle_latency
from dtwin.train.results import Candidate
from dtwin.train.traced import NotTold, NotTraceable, TracedAlong
from dtwin.train.twin_band import parameter_factor, squared
from dtwin.train.twin_terms import TwinBundle, carried, traced_columns, weighted
from dtwin.twins.correct import LITTLE, NAME, Judged
from dtwin.twins.path_way import BY_SHAPE, MEAN_IS_TOLD, TwinWay
from dtwin.twins.seen import Seen
from dtwin.units import is_number

_FEWEST_RUNS = 2


def _freeze_axis(twin: Twin, obs: Observations, home: Home) -> TwinBundle:
    """Freeze a twin of an axis, when there are runs enough to judge it by."""
    _test_of_runs(obs)
    return flanks_twin_bundle(twin, obs)


def _judge_axis(frozen: TwinBundle, seen: Seen, home: Home) -> Judged:
    """Fit the twin without one run of this axis at a time, and predict it.

    The unit of replication is the run, one sweep up and one down. The zero of the laser is taken from
    the runs that were not left out, as it is for tables.

    ``home``: not used: the runs say everything.
    """
    obs = seen.obs
    test = _test_of_runs(obs)
    left = runs_left_out(test, lambda run: _foretold_um(frozen, seen, run))
    error = stacked(test)[2]
    floor = noise_floor_um(test)
    reach = _reach_mm(obs)
    rest = frozen_residual_um(frozen.twin, obs)
    bundle = frozen.bundle
    candidate = Candidate(
        name=NAME,
        family="symbolic",
        promotable=True,
        complexity=len(bundle.tick_graph.nodes),
        scores={HELD_OUT: scores_of(test, left)},
        train_rms_um=rms(rest[obs.mask]),
        latency=bundle_latency(bundle),
        equation=_equation(frozen.twin),
        exports={"tick.txt": to_text(bundle.tick_graph)},
        bundle=bundle.to_dict(),
        numbers={
            **screw_metrics(_pitch_mm(obs), reach),
            "explained_share": explained_share(error, left, floor),
            "table_rms_um": table_rms_um(test),
        },
    )
    return Judged(candidate, floor, rms(error), ((obs.axes[0], *reach),))


def _test_of_runs(obs: Observations) -> LinearTest:
    """Return the readings of a campaign in matrices, targets that some run missed left out."""
    both = [_rows(obs, run) for run in np.unique(obs.run_of).tolist()]
    ways = [obs.sense[rows].tolist() for rows in both]
    if len(both) < _FEWEST_RUNS or any(sorted(way) != [-1.0, 1.0] for way in ways):
        raise InputError(
            "a correction of a position cannot be judged",
            code="correct.runs",
            where=obs.campaign.name,
            got=f"{len(both)} runs, {ways.count([1.0, -1.0])} of them up and down",
            allowed=f"{_FEWEST_RUNS} runs or more, each up and down: one is left out in turn",
            hint="repeat the test: runs = 2 in the plan",
        )
    everywhere = obs.mask.all(axis=0)
    errors = {
        sense: np.column_stack([obs.y_um[r[obs.sense[r] == sense][0]][everywhere] for r in both])
        for sense in (1.0, -1.0)
    }
    return LinearTest(
        obs.grid.points[everywhere],
        errors[1.0],
        errors[-1.0],
        int(np.count_nonzero(~everywhere)),
        _pitch_mm(obs),
        obs.axes[0],
    )


_test_of_runs.__test__ = False  # type: ignore[attr-defined]


def _rows(obs: Observations, run: int) -> Indices:
    return np.flatnonzero(obs.run_of == run)


def _foretold_um(frozen: TwinBundle, seen: Seen, run: int) -> Floats:
    """Return what the other runs let expect of a run, in the order of ``stacked``."""
    obs = seen.obs
    number = np.unique(obs.run_of)[run]

    def other_rows(test: Observations) -> Indices:
        mine = test.campaign.name == obs.campaign.name
        return np.flatnonzero(test.run_of != number) if mine else np.arange(test.n_rows)

    others, own = obs.take(other_rows(obs)), _rows(obs, number)
    again = seen.refit(other_rows)
    kept = replace(again, terms=tuple(t for t in again.terms if t.label in frozen.twin.labels))
    zero_um = float((others.y_um - predict_um(kept, others))[others.mask].mean())
    here = obs.take(own[np.argsort(-obs.sense[own])])
    everywhere = obs.mask.all(axis=0)
    return np.asarray(predict_um(kept, here)[:, everywhere].ravel() + zero_um)


def _equation(twin: Twin) -> str:
    lines = [f"  {t.label}: {t.instance.effect.formula}" for t in twin.terms]
    return "\n".join(
        [
            "slide = min(max(slide before, position + forward flank), position + reverse flank)",
            "error = slide - position",
            "each flank = the sum over the twin's effects, in its direction,",
            "taken where the correction puts the screw; tick.txt holds every number",
            *lines,
        ]
    )


WAY = TwinWay(_freeze_axis, _judge_axis, BY_SHAPE, MEAN_IS_TOLD, LITTLE, {"type": "lathe"})


_CLAMP_SHARE = 1.25
_LEAST_CLAMP_UM = 1.0
# The two limits may touch: rounding must not be taken for a negative play.
_TOUCH_UM = 1e-6


def flanks_twin_bundle(twin: Twin, obs: Observations) -> TwinBundle:
    """Freeze the effects of a twin of an axis that a correction with memory can answer.

    ``twin``: fitted to positioning tests in both directions.
    ``obs``: the runs that it was fitted to: their targets are the mapped travel.
    """
    _require_both_ways(twin, obs)
    _pitch_mm(obs)
    builder = GraphBuilder()
    flanks = _Flanks(builder, twin, obs)
    kept = carried(twin, flanks.require)
    flanks = replace(flanks, twin=kept.twin)
    _require_play(kept.twin, obs)
    low, high = _reach_mm(obs)
    bundle = remembering_bundle(
        builder,
        [partial(flanks.limit_um, way=way) for way in WAYS],
        f"twin-{twin.name}",
        twin.machine,
        (low - ROOM_MM, high + ROOM_MM),
        _safety(kept.twin, obs),
        {k: v for k, v in twin.data.items() if isinstance(v, int)},
        obs.axes[0],
        flanks.half_um(parameter_factor(twin, kept.twin, obs)),
    )
    return TwinBundle(replace(bundle, model_version=0), kept.choices, kept.twin)


def _reach_mm(obs: Observations) -> tuple[float, float]:
    """Return the mapped travel."""
    return float(obs.grid.points[0]), float(obs.grid.points[-1])


def _pitch_mm(obs: Observations) -> float:
    """Return the travel in one turn of the screw; 0 where the axis is measured by a linear scale."""
    told = obs.campaign.machine_geometry.get(PITCH)
    pitch = float(told) if is_number(told) else 0.0
    if is_number(told) and pitch == 0.0:
        return pitch
    phases = phases_of(obs.grid.points, pitch) if pitch > 0.0 else 0
    if phases < FEWEST_PHASES:
        state = f"dtwin amend {obs.campaign.name} --because REASON --set machine_geometry.{PITCH}"
        raise InputError(
            "the targets do not show the screw",
            code="lathe.targets",
            where=obs.campaign.name,
            got=f"{phases} angles of the screw" if phases else f"no {PITCH}",
            allowed=f"{PITCH} under [campaign.machine_geometry], and at least {FEWEST_PHASES} angles",
            hint=(
                "a step that does not divide the pitch: dtwin plan says what a step can show"
                if phases
                else f"{state}=10"
            )
            + f"; where a linear scale measures the axis: {state}=0",
        )
    return pitch


@dataclass(frozen=True)
class _Flanks:
    """The sum of a twin's effects at a traced position, by direction."""

    builder: GraphBuilder
    twin: Twin
    obs: Observations

    def require(self, term: Term) -> None:
        """Refuse an effect that cannot be written down for a position and a direction alone."""
        if term.instance.effect.needs:
            needs = ", ".join(term.instance.effect.needs)
            raise NotTraceable(f"it needs {needs}, and the loop of an axis is told its position only")
        position = self.builder.input(POSITION)
        for way in WAYS:
            slow, fast = (self._effect_um(term, position, way, faster) for faster in (1.0, 2.0))
            if slow.index != fast.index:
                raise NotTraceable("it changes with the feed, and the loop of an axis is told its position only")

    def limit_um(self, position: Expression, way: str) -> Expression:
        """Return slide minus screw in um with the screw at a position in mm."""
        return self.builder.total([self._effect_um(term, position, way) for term in self.twin.terms])

    def half_um(self, factor: Floats | None) -> Expression | None:
        """Return the half width (k = 2) of the error at a position: that of the less certain flank.

        ``factor``: from ``parameter_factor``.
        """
        if factor is None:
            return None
        position = self.builder.input(POSITION)
        squares = []
        for way in WAYS:
            state = _traced_state(self.builder, position, self.obs, way, 1.0)
            columns = [c for term in self.twin.terms for c in traced_columns(term, state, self.builder)]
            squares.append(squared(self.builder, columns, factor))
        return self.builder.apply("sqrt", self.builder.apply("max", *squares))

    def _effect_um(self, term: Term, position: Expression, way: str, faster: float = 1.0) -> Expression:
        state = _traced_state(self.builder, position, self.obs, way, faster)
        return weighted(term, state, self.builder, self.twin.values(term))


def _traced_state(builder: GraphBuilder, position: Expression, obs: Observations, way: str, faster: float) -> Any:
    """Return the state of a sweep with a stand-in for the position."""
    number, condition = next((i, c) for i, c in enumerate(obs.conditions) if c.direction == way)
    row = int(np.flatnonzero(obs.condition_of == number)[0])
    feed_mm_s = faster * condition.feed_mm_min / 60.0
    real: State = obs.grid.state(obs.runs[row], condition, feed_mm_s, obs.campaign.machine_geometry)
    (axis,) = real.axes
    points = real.position_mm[axis]
    centre_mm = float(obs.grid.points[0] - points[0])
    x: Any = TracedAlong(held(builder, position, _reach_mm(obs)) - centre_mm, points)
    one: Floats = np.ones(1)
    untold: Any = NotTold("its place among the targets")
    return replace(
        real,
        position_mm={axis: x},
        velocity_mm_s={axis: real.direction * feed_mm_s * one},
        acceleration_mm_s2={axis: 0.0 * one},
        sensitivity={axis: one},
        since_reversal_s={axis: (real.radius_mm + real.direction * x) / feed_mm_s},
        last_end={axis: -real.direction * one},
        angle_rad=untold,
    )


def _require_both_ways(twin: Twin, obs: Observations) -> None:
    ways = {c.direction for c in obs.conditions if isinstance(c, Stroke)}
    if len(obs.axes) != 1 or ways != set(WAYS):
        raise InputError(
            "a correction of an axis cannot be made of these runs",
            code="correct.axis",
            where=f"twin {twin.name}, campaign {twin.campaign}",
            got=f"axis {', '.join(obs.axes)}, {' and '.join(sorted(ways))}",
            allowed="one axis, measured forward and reverse: the play must be known",
        )


def _require_play(twin: Twin, obs: Observations) -> None:
    """Refuse flanks that cross: no slide rests on a lower limit above its upper one."""
    predicted = predict_um(twin, obs)
    masked = np.where(obs.mask, predicted, np.nan)
    forward, reverse = (np.nanmean(masked[obs.sense == sign], axis=0) for sign in (1.0, -1.0))
    play = reverse - forward
    if float(np.nanmin(play)) < -_TOUCH_UM:
        where = int(np.nanargmin(play))
        raise InputError(
            "the play that the twin foretells is negative somewhere: no memory can carry it",
            code="correct.play",
            where=f"twin {twin.name}, {obs.grid.points[where]:z.1f} mm",
            got=f"the slide {-float(play[where]):z.2f} µm further ahead going up than going down",
            allowed="reverse errors at or above forward errors along the whole travel",
            hint=f"dtwin twin diagnose {twin.name}: backlash may be missing; or the control takes "
            "away more play than there is",
        )


def _safety(twin: Twin, obs: Observations) -> SafetyLimits:
    largest = float(np.abs(predict_um(twin, obs)[obs.mask]).max())
    return replace(SAFETY, clamp_um=max(_CLAMP_SHARE * largest, _LEAST_CLAMP_UM))
