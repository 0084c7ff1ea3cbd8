"""Positioning errors as bundles: the pair of networks as deployed, and an equation that is safe to serve; what
it says along its axis, for tables of controls.

The deployed one takes a flag for the direction. The other needs none: it remembers where the slide
rests between two flanks, as the play itself does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dtwin import __version__
from dtwin.kinds.linear._models import MM_PER_IN, UM_PER_IN, Averages, DualNet
from dtwin.kinds.linear._small_net import SmallNet
from dtwin.machines.printed_network import MAPPED_MM, PITCH_IN, LatheNetwork, Layer
from dtwin.schema import Floats
from dtwin.serve.band import COVARIANCE, Band
from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits, State
from dtwin.train.twin_axes import AXES, AxisErrors
from dtwin.units import UM_PER_MM

RATE_HZ = 100.0
# Beyond the map the ends are held; the axis may go this much further while it turns round.
ROOM_MM = 25.0
# Below every place that an axis can start from.
_FAR_MM = 2500.0
POSITION, _DIRECTION, MEMORY = "position_mm", "direction_1", "slide_mm"
# What older bundles ask for.
_INCHES = "position_in"
SAFETY = SafetyLimits(clamp_um=250.0, slew_um_s=2000.0, stale_s=0.025)


def is_positioning_bundle(bundle: Bundle) -> bool:
    """Tell whether a bundle corrects the position of one axis."""
    return bool({POSITION, _INCHES} & set(bundle.tick_inputs))


def told(position_mm: Floats, direction: Floats) -> dict[str, Floats]:
    """Return what the loop of an axis tells a bundle, by name of the input, shape (n,) each."""
    return {POSITION: position_mm, _INCHES: position_mm / MM_PER_IN, _DIRECTION: direction}


def axis_number(bundle: Bundle) -> int:
    """Return which axis a bundle corrects: 0, 1 or 2."""
    (output,) = bundle.outputs
    return ("base_x", "base_y", "base_z").index(output.frame)


def _output(axis: str) -> Output:
    return Output(f"error_{axis.lower()}_um", f"base_{axis.lower()}")


def _position(travel_mm: tuple[float, float]) -> Input:
    return Input(POSITION, "mm", "none", RATE_HZ, "controller", *travel_mm)


def printed_pair(network: LatheNetwork) -> DualNet:
    """Return the printed networks as a trained pair would be."""
    return DualNet(_as_net(network.full), _as_net(network.cyclic), PITCH_IN)


def deployed_bundle(
    pair: DualNet, name: str, machine: str, reach_mm: tuple[float, float] = MAPPED_MM, axis: str = "Z"
) -> Bundle:
    """Return the equation as the published program evaluates it, to the error instead of its negative.

    The remainder of the position by the pitch is taken by subtracting halved lengths, which is exact.
    Like C's it has the sign of the position.

    ``reach_mm``: validity box of the position.
    """
    builder = GraphBuilder()
    direction, position = builder.input(_DIRECTION), builder.input(POSITION) / MM_PER_IN
    reverse = builder.apply("step", direction - 0.5)
    turned = _remainder(builder, position, pair.pitch_in, max(map(abs, reach_mm)) / MM_PER_IN)
    slow = pair.full.expression(builder, (reverse, position))
    fast = pair.cyclic.expression(builder, (reverse, turned))
    output = _output(axis)
    graph = builder.graph({output.name: (slow + fast) * UM_PER_IN})
    return create_bundle(
        corrects="linear",
        name=name,
        machine=machine,
        model_version=1,
        inputs=(Input(_DIRECTION, "1", "none", RATE_HZ, "controller", 0.0, 1.0), _position(reach_mm)),
        outputs=(output,),
        tick_graph=graph,
        safety=SAFETY,
        provenance=Provenance(code_version=__version__, evidence="none"),
    )


@dataclass(frozen=True)
class _Harmonics:
    """A cyclic error over one turn of the screw that closes, in um.

    ``constant``: mean.
    ``sine``, ``cosine``, (orders,): amplitudes of orders 1, 2 ...
    """

    constant: float
    sine: Floats
    cosine: Floats

    def evaluate(self, position_mm: Floats, pitch_mm: float) -> Floats:
        """Return the cyclic error in um, shape (n,)."""
        angle = np.outer(2.0 * np.pi * np.asarray(position_mm) / pitch_mm, self._orders())
        waves: Floats = np.sin(angle) @ self.sine + np.cos(angle) @ self.cosine
        return waves + self.constant

    def expression(self, builder: GraphBuilder, waves: Sequence[tuple[Expression, Expression]]) -> Expression:
        """Return the cyclic error as a term of a graph, of (sine, cosine) by order."""
        terms: list[Expression | float] = [self.constant]
        for (sine, cosine), a, b in zip(waves, self.sine.tolist(), self.cosine.tolist(), strict=True):
            terms += [sine * a, cosine * b]
        return builder.total(terms)

    def _orders(self) -> Floats:
        return np.arange(1.0, len(self.sine) + 1.0)


def _fit_harmonics(position_mm: Floats, error_um: Floats, pitch_mm: float, orders: int) -> _Harmonics:
    """Fit a cyclic error by least squares.

    ``position_mm``, ``error_um``, (n,): positions at enough angles of the screw, and what is left at them.
    """
    angle = np.outer(2.0 * np.pi * position_mm / pitch_mm, np.arange(1.0, orders + 1.0))
    design = np.hstack([np.ones((len(position_mm), 1)), np.sin(angle), np.cos(angle)])
    coefficients = np.linalg.lstsq(design, error_um, rcond=None)[0]
    return _Harmonics(float(coefficients[0]), coefficients[1 : orders + 1], coefficients[orders + 1 :])


@dataclass(frozen=True)
class Flanks:
    """Both limits of slide minus screw: a slow network and a closing cyclic error for each.

    ``full``: inputs are direction and position, in inches.
    ``forward``, ``reverse``: of the flank that pushes up, and of the other.
    ``reach_mm``: mapped travel; beyond it the ends are held.
    """

    full: SmallNet
    forward: _Harmonics
    reverse: _Harmonics
    pitch_mm: float
    reach_mm: tuple[float, float]

    def error_um(self, direction: Floats, position_mm: Floats) -> Floats:
        """Return the error once the slide rests on a flank, shape (n,)."""
        x = np.clip(position_mm, *self.reach_mm)
        cyclic = np.where(
            np.asarray(direction) >= 0.5,
            self.reverse.evaluate(x, self.pitch_mm),
            self.forward.evaluate(x, self.pitch_mm),
        )
        return _slow_um(self.full, direction, x) + cyclic


def _slow_um(full: SmallNet, direction: Floats, position_mm: Floats) -> Floats:
    """Return what a network says of direction and position, shape (n,)."""
    return UM_PER_IN * full.evaluate(np.column_stack([direction, position_mm / MM_PER_IN]))


def flanks_of(
    full: SmallNet, averages: Averages, pitch_mm: float, orders: int, reach_mm: tuple[float, float]
) -> Flanks:
    """Return a slow network with the closing cyclic error that the averages ask for.

    ``full``: inputs are direction and position, in inches.
    ``averages``: mean errors at enough angles of the screw.
    ``orders``: harmonics of the turn.
    """
    x = averages.position_mm
    rest = [
        error - _slow_um(full, np.full(len(x), way), x)
        for way, error in ((0.0, averages.forward_um), (1.0, averages.reverse_um))
    ]
    forward, reverse = (_fit_harmonics(x, r, pitch_mm, orders) for r in rest)
    return Flanks(full, forward, reverse, pitch_mm, reach_mm)


def flanks_bundle(flanks: Flanks, name: str, machine: str, travel_mm: tuple[float, float], axis: str = "Z") -> Bundle:
    """Return the equation of two fitted flanks, with a memory for the play.

    ``travel_mm``: travel of the axis, the validity box.
    """
    builder = GraphBuilder()
    limits = [
        lambda position, way=way, cyclic=cyclic: _flank(builder, flanks, way, cyclic, position)
        for way, cyclic in ((0.0, flanks.forward), (1.0, flanks.reverse))
    ]
    return remembering_bundle(builder, limits, name, machine, travel_mm, axis=axis)


_Limit = Callable[[Expression], Expression]


def remembering_bundle(
    builder: GraphBuilder,
    limits: Sequence[_Limit],
    name: str,
    machine: str,
    travel_mm: tuple[float, float],
    safety: SafetyLimits = SAFETY,
    table_versions: Mapping[str, int] | None = None,
    axis: str = "Z",
    half_um: Expression | None = None,
) -> Bundle:
    """Return an equation with a memory for the play: no flag, no seam, ends held.

    The slide stays where it is until a flank reaches it, so the correction never changes by more than
    the axis has moved. Beyond the mapped travel the flanks are those of its end, while the play goes on:
    an overshoot there must turn the slide round. The map was measured with the screw at the target; a
    corrected screw stands elsewhere, so each flank is taken where the correction puts the screw. Before
    the first motion the slide is taken to rest as after coming from below.

    ``limits``: lower and upper limit of slide minus screw in um, as a term of the graph, at a position of the screw
    in mm. They hold their ends.
    ``travel_mm``: travel of the axis, the validity box.
    ``half_um``: half width (k = 2) of the error, as a term of the graph; None when it is not known.
    """
    position = builder.input(POSITION)
    output = _output(axis)
    lower, upper = (position + limit(position - limit(position) / UM_PER_MM) / UM_PER_MM for limit in limits)
    lifted = builder.apply("max", builder.state(MEMORY), lower)
    slide = builder.apply("min", lifted, upper)
    graph = builder.graph({output.name: (slide - position) * UM_PER_MM}, {MEMORY: slide})
    return create_bundle(
        corrects="linear",
        name=name,
        machine=machine,
        model_version=1,
        inputs=(_position(travel_mm),),
        outputs=(output,),
        states=(State(MEMORY, "mm", travel_mm[0] - _FAR_MM),),
        tick_graph=graph,
        safety=safety,
        provenance=Provenance(code_version=__version__, evidence="none", table_versions=dict(table_versions or {})),
        band=None if half_um is None else Band(COVARIANCE, builder.graph({output.name: half_um})),
    )


def held(builder: GraphBuilder, position: Expression, reach_mm: tuple[float, float]) -> Expression:
    """Return a position that stays at the end of the mapped travel beyond it."""
    low, high = reach_mm
    return builder.apply("min", builder.apply("max", position, low), high)


def _flank(builder: GraphBuilder, flanks: Flanks, way: float, cyclic: _Harmonics, position: Expression) -> Expression:
    """Return one flank's limit in um at a position of the screw in mm."""
    x = held(builder, position, flanks.reach_mm)
    waves = []
    for order in range(1, len(cyclic.sine) + 1):
        angle = x * (2.0 * np.pi * order / flanks.pitch_mm)
        waves.append((builder.apply("sin", angle), builder.apply("cos", angle)))
    slow = flanks.full.expression(builder, (builder.constant(way), x / MM_PER_IN)) * UM_PER_IN
    return slow + cyclic.expression(builder, waves)


def _as_net(layer: Layer) -> SmallNet:
    weights = np.column_stack([layer.reverse_bias - layer.forward_bias, layer.position_weight])
    return SmallNet(weights, layer.forward_bias, layer.output_weight, layer.output_bias)


def _remainder(builder: GraphBuilder, value: Expression, by: float, most: float) -> Expression:
    """Return the remainder of a value up to twice ``most``; every difference is exact."""
    part = by
    while 2.0 * part <= most:
        part *= 2.0
    rest = abs(value)
    while part >= by:
        rest = rest - builder.apply("step", rest - part) * part
        part /= 2.0
    return rest * builder.apply("sign", value)


# Beyond every axis: the slide rests on the flank of its direction.
_FARTHEST_MM = 1e6


def axis_errors(bundle: Bundle) -> AxisErrors:
    """Return the errors that a positioning bundle takes away, by direction; beyond the map its ends are held."""
    remembers = MEMORY in bundle.initial_state
    (position,) = (i for i in bundle.inputs if i.name.startswith("position_"))
    unit_mm = 1.0 if position.name == POSITION else MM_PER_IN
    room_mm = ROOM_MM if remembers else 0.0
    low, high = position.low * unit_mm + room_mm, position.high * unit_mm - room_mm

    def um(position_mm: Floats) -> tuple[Floats, Floats]:
        places = np.clip(position_mm, low, high)
        forward, reverse = (
            np.array([_told_um(bundle, row, state) for row in _rows(told(places, np.full(places.shape, flag)))])
            for flag, state in ((0.0, {MEMORY: -_FARTHEST_MM}), (1.0, {MEMORY: _FARTHEST_MM}))
        )
        return forward, reverse

    return AxisErrors(AXES[axis_number(bundle)], (low, high), um)


def _rows(columns: Mapping[str, Floats]) -> list[dict[str, float]]:
    return [dict(zip(columns, row, strict=True)) for row in np.column_stack(list(columns.values())).tolist()]


def _told_um(bundle: Bundle, inputs: Mapping[str, float], state: Mapping[str, float]) -> float:
    (output,) = bundle.outputs
    return bundle.tick_graph.evaluate(inputs, state)[0][output.name]
