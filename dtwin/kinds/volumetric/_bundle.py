"""Thermal models of error motions as one equation of temperatures and positions."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from dtwin import __version__
from dtwin.errors import InputError
from dtwin.kinds.volumetric._chain import coefficient
from dtwin.kinds.volumetric._thermal_model import ThermalModel
from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits

_POSITION_HZ, _TEMPERATURE_HZ = 100.0, 1.0 / 30.0
# Heat moves slowly, axes at rapid traverse do not: 100 um over a second's way. Dropped at the edge of the
# box, the correction of a whole season would jump; it fades instead.
_SAFETY = SafetyLimits(clamp_um=250.0, slew_um_s=100.0, stale_s=0.1, outside="shrink", shrink_span=0.25)
_BEYOND_C = 2.0
_LINEAR = {"X": ("y", "z"), "Z": ("y",), "0": ("x", "y", "z"), "Y": ()}


def volumetric_bundle(
    models: Sequence[ThermalModel],
    strokes_mm: Mapping[str, tuple[float, float]],
    begun_c: Mapping[str, float],
    seen_c: Mapping[str, tuple[float, float]],
    name: str,
    machine: str,
    switched_off: Collection[str] = (),
) -> Bundle:
    """Return the error of the tool point from what thermocouples and scales read.

    ``models``: one for each error motion, without memory: the previous cycle is not there in serving.
    ``strokes_mm``: ends of the strokes, the validity box of the positions.
    ``begun_c``: what each thermocouple read in the reference: the correction is zero there.
    ``seen_c``: what each read in training; 2 degC more are allowed.
    ``switched_off``: error motions that are worse than none.
    """
    remembering = [model.name for model in models if model.memory]
    kept = [model for model in models if model.name not in switched_off]
    if remembering or not kept:
        raise InputError(
            "these models cannot be served",
            code="volumetric.bundle",
            got=", ".join(remembering)[:120] or "all are switched off",
            allowed="models without memory, at least one of them better than none",
        )
    builder = GraphBuilder()
    position = {axis: builder.input(f"{axis}_mm") for axis in "xyz"}
    sensors = sorted({sensor for model in kept for sensor in model.sensors})
    rise = {sensor: builder.input(sensor) - begun_c[sensor] for sensor in sensors}
    motions = {
        model.name: builder.total([rise[s] * float(k) for s, k in zip(model.sensors, model.per_k, strict=True)])
        for model in kept
    }
    parts: dict[str, list[Expression | float]] = {axis: [] for axis in "xyz"}
    for motion, value in motions.items():
        for axis, factor in _acts(builder, motion, position, strokes_mm).items():
            parts[axis].append(value * factor)
    graph = builder.graph({f"error_{axis}_um": builder.total(parts[axis] or [0.0]) for axis in "xyz"})
    inputs = [Input(f"{axis}_mm", "mm", "base", _POSITION_HZ, "controller", *strokes_mm[axis]) for axis in "xyz"]
    inputs += [
        Input(s, "degC", "none", _TEMPERATURE_HZ, "covariate", seen_c[s][0] - _BEYOND_C, seen_c[s][1] + _BEYOND_C)
        for s in sensors
    ]
    return create_bundle(
        corrects="volumetric",
        name=name,
        machine=machine,
        model_version=1,
        inputs=tuple(inputs),
        outputs=tuple(Output(f"error_{axis}_um", f"base_{axis}") for axis in "xyz"),
        tick_graph=graph,
        safety=_SAFETY,
        provenance=Provenance(code_version=__version__, evidence="none"),
    )


def is_volumetric_bundle(bundle: Bundle) -> bool:
    """Tell whether a bundle corrects the tool point by temperatures."""
    return any(i.source == "covariate" and i.unit == "degC" for i in bundle.inputs)


def _acts(
    builder: GraphBuilder, name: str, position: Mapping[str, Expression], strokes_mm: Mapping[str, tuple[float, float]]
) -> dict[str, Expression]:
    """Return the factor of an error motion in each coordinate that it changes."""
    what = coefficient(name)
    profile = _profile(builder, what.axis, what.order, position, strokes_mm)
    if what.letter in "XYZ":
        return {what.letter.lower(): profile}
    turn = np.zeros(3)
    turn["ABC".index(what.letter)] = 1.0
    out = {}
    for axis in _LINEAR[what.axis]:
        arm = np.zeros(3)
        arm["xyz".index(axis)] = 1e-3
        for number, share in enumerate(np.cross(turn, arm).tolist()):
            if share:
                out["xyz"[number]] = profile * position[axis] * share
    return out


def _profile(
    builder: GraphBuilder,
    axis: str,
    order: int,
    position: Mapping[str, Expression],
    strokes_mm: Mapping[str, tuple[float, float]],
) -> Expression:
    if order == 0:
        return builder.constant(1.0)
    low, high = strokes_mm[axis.lower()]
    travel = (position[axis.lower()] * 2.0 - (low + high)) / (high - low)
    powers = np.polynomial.legendre.leg2poly(np.eye(order + 1)[order]).tolist()
    terms: list[Expression | float] = [powers[0]]
    terms += [builder.power(travel, n) * powers[n] for n in range(1, order + 1) if powers[n]]
    return builder.total(terms)
