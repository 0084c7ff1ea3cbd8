"""Positioning errors as bundles: the pair of networks as deployed, and an equation that is safe to serve.

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
from dtwin.machines.printed_network import MAPPED_IN, PITCH_IN, LatheNetwork, Layer
from dtwin.schema import Floats
from dtwin.serve.band import COVARIANCE, Band
from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits, State

RATE_HZ = 100.0
# Beyond the map the ends are held; the axis may go this much further while it turns round.
ROOM_IN = 1.0
# Below every place that an axis can start from.
_FAR_IN = 100.0
POSITION, _DIRECTION = "position_mm", "direction_1"
# What bundles from before 2026-12 ask for.
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


def _position(travel_in: tuple[float, float]) -> Input:
    low, high = (end * MM_PER_IN for end in travel_in)
    return Input(POSITION, "mm", "none", RATE_HZ, "controller", low, high)


def printed_pair(network: LatheNetwork) -> DualNet:
    """Return the printed networks as a trained pair would be."""
    return DualNet(_as_net(network.full), _as_net(network.cyclic), PITCH_IN)


def deployed_bundle(
    pair: DualNet, name: str, machine: str, reach_in: tuple[float, float] = MAPPED_IN, axis: str = "Z"
) -> Bundle:
    """Return the equation as the published program evaluates it, to the error instead of its negative.

    The remainder of the position by the pitch is taken by subtracting halved lengths, which is exact.
    Like C's it has the sign of the position.

    ``reach_in``: validity box of the position.
    """
    builder = GraphBuilder()
    direction, position = builder.input(_DIRECTION), builder.input(POSITION) / MM_PER_IN
    reverse = builder.apply("step", direction - 0.5)
    turned = _remainder(builder, position, pair.pitch_in, reach_in[1])
    slow = pair.full.expression(builder, (reverse, position))
    fast = pair.cyclic.expression(builder, (reverse, turned))
    output = _output(axis)
    graph = builder.graph({output.name: (slow + fast) * UM_PER_IN})
    return create_bundle(
        corrects="linear",
        name=name,
        machine=machine,
        model_version=1,
        inputs=(Input(_DIRECTION, "1", "none", RATE_HZ, "controller", 0.0, 1.0), _position(reach_in)),
        outputs=(output,),
        tick_graph=graph,
        safety=SAFETY,
        provenance=Provenance(code_version=__version__, evidence="none"),
    )


@dataclass(frozen=True)
class _Harmonics:
    """A cyclic error over one turn of the screw that closes, in inches.

    ``constant``: mean.
    ``sine``, ``cosine``, (orders,): amplitudes of orders 1, 2 ...
    """

    constant: float
    sine: Floats
    cosine: Floats

    def evaluate(self, position_in: Floats, pitch_in: float) -> Floats:
        """Return the cyclic error in inches, shape (n,)."""
        angle = np.outer(2.0 * np.pi * np.asarray(position_in) / pitch_in, self._orders())
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


def fit_harmonics(position_in: Floats, error_in: Floats, pitch_in: float, orders: int) -> _Harmonics:
    """Fit a cyclic error by least squares.

    ``position_in``, ``error_in``, (n,): positions at enough angles of the screw, and what is left at them.
    """
    angle = np.outer(2.0 * np.pi * position_in / pitch_in, np.arange(1.0, orders + 1.0))
    design = np.hstack([np.ones((len(position_in), 1)), np.sin(angle), np.cos(angle)])
    found = np.linalg.lstsq(design, error_in, rcond=None)[0]
    return _Harmonics(float(found[0]), found[1 : orders + 1], found[orders + 1 :])


@dataclass(frozen=True)
class Flanks:
    """Both limits of slide minus screw: a slow network and a closing cyclic error for each.

    ``full``: inputs are direction and position.
    ``forward``, ``reverse``: of the flank that pushes up, and of the other.
    ``reach_in``: mapped travel; beyond it the ends are held.
    """

    full: SmallNet
    forward: _Harmonics
    reverse: _Harmonics
    pitch_in: float
    reach_in: tuple[float, float]

    def error_in(self, direction: Floats, position_in: Floats) -> Floats:
        """Return the error in inches once the slide rests on a flank, shape (n,)."""
        x = np.clip(position_in, *self.reach_in)
        cyclic = np.where(
            np.asarray(direction) >= 0.5,
            self.reverse.evaluate(x, self.pitch_in),
            self.forward.evaluate(x, self.pitch_in),
        )
        return self.full.evaluate(np.column_stack([direction, x])) + cyclic


def flanks_of(
    full: SmallNet, averages: Averages, pitch_in: float, orders: int, reach_in: tuple[float, float]
) -> Flanks:
    """Return a slow network with the closing cyclic error that the averages ask for.

    ``full``: inputs are direction and position.
    ``averages``: mean errors at enough angles of the screw.
    ``orders``: harmonics of the turn.
    """
    x = averages.position_in
    rest = [
        error - full.evaluate(np.column_stack([np.full(len(x), way), x]))
        for way, error in ((0.0, averages.forward_in), (1.0, averages.reverse_in))
    ]
    forward, reverse = (fit_harmonics(x, r, pitch_in, orders) for r in rest)
    return Flanks(full, forward, reverse, pitch_in, reach_in)


def flanks_bundle(flanks: Flanks, name: str, machine: str, travel_in: tuple[float, float], axis: str = "Z") -> Bundle:
    """Return the equation of two fitted flanks, with a memory for the play.

    ``travel_in``: travel of the axis, the validity box.
    """
    builder = GraphBuilder()
    limits = [
        lambda position, way=way, cyclic=cyclic: _flank(builder, flanks, way, cyclic, position)
        for way, cyclic in ((0.0, flanks.forward), (1.0, flanks.reverse))
    ]
    return remembering_bundle(builder, limits, name, machine, travel_in, axis=axis)


Limit = Callable[[Expression], Expression]


def remembering_bundle(
    builder: GraphBuilder,
    limits: Sequence[Limit],
    name: str,
    machine: str,
    travel_in: tuple[float, float],
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

    ``limits``: lower and upper limit of slide minus screw in inches, as a term of the graph, at a position of the screw
    in inches. They hold their ends.
    ``travel_in``: travel of the axis, the validity box.
    ``half_um``: half width (k = 2) of the error, as a term of the graph; None when it is not known.
    """
    position = builder.input(POSITION) / MM_PER_IN
    output = _output(axis)
    lower, upper = (position + limit(position - limit(position)) for limit in limits)
    lifted = builder.apply("max", builder.state("slide_in"), lower)
    slide = builder.apply("min", lifted, upper)
    graph = builder.graph({output.name: (slide - position) * UM_PER_IN}, {"slide_in": slide})
    return create_bundle(
        corrects="linear",
        name=name,
        machine=machine,
        model_version=1,
        inputs=(_position(travel_in),),
        outputs=(output,),
        states=(State("slide_in", "in", travel_in[0] - _FAR_IN),),
        tick_graph=graph,
        safety=safety,
        provenance=Provenance(code_version=__version__, evidence="none", table_versions=dict(table_versions or {})),
        band=None if half_um is None else Band(COVARIANCE, builder.graph({output.name: half_um})),
    )


def held(builder: GraphBuilder, position: Expression, reach_in: tuple[float, float]) -> Expression:
    """Return a position that stays at the end of the mapped travel beyond it."""
    low, high = reach_in
    return builder.apply("min", builder.apply("max", position, low), high)


def _flank(builder: GraphBuilder, flanks: Flanks, way: float, cyclic: _Harmonics, position: Expression) -> Expression:
    """Return one flank's limit at a position of the screw."""
    x = held(builder, position, flanks.reach_in)
    waves = []
    for order in range(1, len(cyclic.sine) + 1):
        angle = x * (2.0 * np.pi * order / flanks.pitch_in)
        waves.append((builder.apply("sin", angle), builder.apply("cos", angle)))
    slow = flanks.full.expression(builder, (builder.constant(way), x))
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
