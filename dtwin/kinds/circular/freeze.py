"""A twin as a bundle: its compensable effects, as one radial error along the path."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dtwin import __version__
from dtwin.features.path_inputs import PATH_INPUT_UNITS
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.state import circular_state
from dtwin.physics.twin import Twin, predict_um
from dtwin.schema import PLANES, RunMeta
from dtwin.serve.band import Band
from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits
from dtwin.train.dataset import TICK_HZ
from dtwin.train.traced import NotTraceable, Traced
from dtwin.train.twin_band import band, half_width, parameter_factor
from dtwin.train.twin_terms import TwinBundle, carried, traced_columns, weighted

_ANGLE, _DIRECTION, _SPEED = "path_angle_rad", "direction_sign", "commanded_speed_mm_s"
_RADIUS, _PLANE = "radius_mm", "plane_id"
OUTPUT = "radial_um"
_CONTROLLER_UNITS = {_RADIUS: "mm", _PLANE: "1"}
_MARGIN = 1e-6
_FARTHEST_RAD = 1e4
_CLAMP_SHARE = 1.25
_LOWEST_SLEW_UM_S = 2000.0
_N_JOINTS = 6
# Wider than any robot moves: plane, radius and feed are what bounds the correction.
_JOINT_RANGES: dict[str, tuple[float, float]] = {
    **{f"q{j}_rad": (-7.0, 7.0) for j in range(1, _N_JOINTS + 1)},
    **{f"qd{j}_rad_s": (-7.0, 7.0) for j in range(1, _N_JOINTS + 1)},
    **{f"lever_{j}_mm_rad": (-3000.0, 3000.0) for j in range(1, _N_JOINTS + 1)},
}


def twin_bundle(twin: Twin, obs: Observations, *, horizon_s: float = 0.0) -> TwinBundle:
    """Freeze the effects of a twin that offsets of position can correct.

    ``obs``: the runs that it was fitted to: logged channels and their means come from there.
    ``horizon_s``: known delay between a correction and the motion that it causes; the error is predicted as far ahead
    along the path.
    Raises ``InputError`` when nothing is left to correct.
    """
    builder = GraphBuilder()
    logged = _Logged(builder, obs)
    path = _Path(twin, builder, logged, horizon_s)
    reduced = carried(twin, path.error)
    parts: dict[str, list[Expression]] = {plane: [] for plane in twin.box.planes}
    for made in reduced.traced:
        for plane, expression in made.items():
            parts[plane].append(expression)
    errors = {p: builder.total(e) for p, e in parts.items() if e}
    total = _by_plane(builder, errors, twin.box.planes)
    graph = builder.graph({OUTPUT: total})
    inputs = _inputs(set(graph.inputs), twin, obs)
    bundle = create_bundle(
        corrects="circular",
        name=f"twin-{twin.name}",
        machine=twin.machine,
        model_version=0,
        inputs=inputs,
        outputs=[Output(OUTPUT, "path_radial", "error")],
        tick_graph=graph,
        safety=_safety(reduced.twin, obs),
        provenance=Provenance(
            code_version=__version__, table_versions={k: v for k, v in twin.data.items() if isinstance(v, int)}
        ),
        band=_band(path, reduced.twin, obs),
    )
    return TwinBundle(bundle, reduced.choices, reduced.twin)


def wrong_way(bundle: Bundle) -> Bundle:
    """Return the bundle with its sign lost: the predicted error is added instead of taken away."""
    outputs = tuple(replace(o, role="correction") for o in bundle.outputs)
    return replace(bundle, outputs=outputs)


class _Logged(Mapping[str, Any]):
    """Logged channels as inputs, and their rise above the campaign's mean."""

    def __init__(self, builder: GraphBuilder, obs: Observations) -> None:
        self.builder, self.obs = builder, obs
        # Of a run, and known while the machine works; the time of a session is neither.
        self.names = tuple(n for n in obs.logged if all(n in m.covariates for m in obs.runs))

    def __contains__(self, name: object) -> bool:
        return self._source(str(name)) is not None

    def __getitem__(self, name: str) -> Traced:
        source = self._source(name)
        if source is None:
            raise NotTraceable(f"it needs {name}, which is not known while the machine works")
        value = Traced([self.builder.input(source)])
        if source == name:
            return value
        return value - self.obs.means[source]

    def __iter__(self) -> Any:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def _source(self, name: str) -> str | None:
        if name in self.names:
            return name
        plain = name.removesuffix("_rise_c") + "_c"
        return plain if name.endswith("_rise_c") and plain in self.names else None


@dataclass(frozen=True)
class _Path:
    """A twin's effects along a traced path, by plane."""

    twin: Twin
    builder: GraphBuilder
    logged: _Logged
    horizon_s: float

    def error(self, term: Term) -> dict[str, Expression]:
        """Return the predicted radial error of a term in every plane in which it acts."""
        weights = self.twin.values(term)
        radial = self._along(lambda state: [weighted(term, state, self.builder, weights)])
        out = {plane: both[0] for plane, both in radial.items() if not self._constant(both[0])}
        if not out:
            raise NotTraceable("it acts in none of the planes that were measured")
        return out

    def regressors(self, term: Term) -> dict[str, list[Expression]]:
        """Return the regressors of a term in every plane."""
        return self._along(lambda state: traced_columns(term, state, self.builder))

    def _along(self, make: Callable[[Any], list[Expression]]) -> dict[str, list[Expression]]:
        """Return what is made of the state in every plane, of the direction in which the machine goes."""
        builder, logged = self.builder, self.logged
        speed, radius = Traced([builder.input(_SPEED)]), Traced([builder.input(_RADIUS)])
        sign = builder.input(_DIRECTION)
        angle = builder.input(_ANGLE)
        if self.horizon_s:
            ahead = speed.columns[0] / radius.columns[0]
            angle = angle + sign * ahead * self.horizon_s
        forward = builder.apply("step", sign)
        joints = _traced_joints(builder, self.horizon_s)
        out: dict[str, list[Expression]] = {}
        for plane in self.twin.box.planes:
            ways = []
            for direction in ("CCW", "CW"):
                meta: Any = RunMeta("traced", plane=plane, direction=direction, radius_mm=radius)  # type: ignore[arg-type]
                state = circular_state(
                    meta,
                    Traced([angle]),  # type: ignore[arg-type]
                    feed_mm_s=speed,  # type: ignore[arg-type]
                    columns=logged,
                    geometry={},
                )
                # What a robot's joints do is an input here, not computed from its geometry.
                state.__dict__["joints"] = joints
                ways.append(make(state))
            out[plane] = [
                ccw if ccw.index == cw.index else cw + forward * (ccw - cw) for ccw, cw in zip(*ways, strict=True)
            ]
        return out

    def _constant(self, term: Expression) -> bool:
        return self.builder.node(term).op == "const"


def _band(path: _Path, kept: Twin, obs: Observations) -> Band | None:
    """Return how uncertain the error along the path is; None when the runs do not tell."""
    factor = parameter_factor(path.twin, kept, obs)
    if factor is None:
        return None
    columns = [path.regressors(term) for term in kept.terms]
    halves = {
        plane: half_width(path.builder, [column for by_plane in columns for column in by_plane[plane]], factor)
        for plane in kept.box.planes
    }
    return band(path.builder, OUTPUT, _by_plane(path.builder, halves, kept.box.planes))


def _by_plane(builder: GraphBuilder, errors: Mapping[str, Expression], measured: Sequence[str]) -> Expression:
    """Return the error of the plane that the machine is in; zero where no effect acts."""
    if len(measured) == 1:
        return next(iter(errors.values()))
    number = builder.input(_PLANE)
    total: Expression | float = 0.0
    for plane, error in errors.items():
        place = PLANES.index(plane)
        here = builder.apply("step", number - (place - 0.5))
        gone = builder.apply("step", number - (place + 0.5))
        total = total + (here - gone) * error
    assert isinstance(total, Expression)
    return total


def _inputs(used: set[str], twin: Twin, obs: Observations) -> list[Input]:
    box = twin.box
    ids = [PLANES.index(p) for p in box.planes]
    signs = [1.0 if d == "CCW" else -1.0 for d in box.directions]
    # Between standstill and the slowest feed the effects interpolate.
    ranges: dict[str, tuple[float, float]] = {
        _ANGLE: (-_FARTHEST_RAD, _FARTHEST_RAD),
        _DIRECTION: (min(signs), max(signs)),
        _SPEED: (0.0, box.feed_mm_min[1] / 60.0 * 1.02),
        _RADIUS: box.radius_mm,
        _PLANE: (min(ids), max(ids)),
    }
    # Whether or not the equation uses them: outside of what was measured nothing is corrected.
    wanted = [_ANGLE, _DIRECTION, _SPEED, _RADIUS, _PLANE]
    joints = [name for name in _JOINT_RANGES if name in used]
    ranges |= {name: _JOINT_RANGES[name] for name in joints}
    channels = sorted(used - set(wanted) - set(joints))
    for name in channels:
        values = [float(m.covariates[name]) for m in obs.runs]
        ranges[name] = (min(values), max(values))
    out = []
    for name in [*wanted, *joints, *channels]:
        low, high = ranges[name]
        margin = _MARGIN * max(1.0, abs(low), abs(high))
        unit = PATH_INPUT_UNITS.get(name) or _CONTROLLER_UNITS.get(name) or name.rsplit("_", 1)[1]
        source = "path" if name in PATH_INPUT_UNITS else "controller"
        if name in channels:
            source = "covariate"
        frame = "path" if source == "path" else "none"
        out.append(Input(name, unit, frame, TICK_HZ, source, low - margin, high + margin))
    return out


def _safety(twin: Twin, obs: Observations) -> SafetyLimits:
    """Return a clamp above what is predicted, and a slew limit above its smooth part."""
    predicted = predict_um(twin, obs)
    largest = float(np.abs(predicted[obs.mask]).max())
    steps = np.abs(np.diff(predicted, axis=1))
    # One bin is a degree; jumps at reversals are what the slew limit is for.
    per_rad = np.quantile(steps, 0.99, axis=1) / math.radians(1.0)
    radii = np.array([m.radius_mm or 1.0 for m in obs.runs])
    steepest = float((per_rad * obs.feed_mm_s / radii).max())
    return SafetyLimits(clamp_um=max(_CLAMP_SHARE * largest, 1.0), slew_um_s=max(_LOWEST_SLEW_UM_S, 2.0 * steepest))


@dataclass(frozen=True)
class _TracedJoints:
    """What effects of joints ask a state for.

    ``q_rad``, ``qd_rad_s``, ``lever_mm``: tables of one row: angle, speed, and change of the radius per radian of each
    joint.
    """

    q_rad: Traced
    qd_rad_s: Traced
    lever_mm: Traced

    @property
    def gravity_nmm(self) -> Traced:
        """Refuse: the path inputs do not hold moments."""
        raise NotTraceable("it needs the moments of the joints, which serving does not compute")


def _traced_joints(builder: GraphBuilder, horizon_s: float) -> _TracedJoints:
    """Return the joints where they will be when a correction takes effect."""
    numbers = range(1, _N_JOINTS + 1)
    speed = [builder.input(f"qd{j}_rad_s") for j in numbers]
    angle = [builder.input(f"q{j}_rad") for j in numbers]
    if horizon_s:
        angle = [q + horizon_s * qd for q, qd in zip(angle, speed, strict=True)]
    lever = [builder.input(f"lever_{j}_mm_rad") for j in numbers]
    return _TracedJoints(Traced(angle, table=True), Traced(speed, table=True), Traced(lever, table=True))
