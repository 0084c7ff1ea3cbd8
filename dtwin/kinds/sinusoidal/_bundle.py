"""Equations of a tone's error as a bundle of two rates: a window tells gain and lag, a tick makes the sine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from dtwin import __version__
from dtwin.features.tone_window import COMMAND_AMPLITUDE, COMMAND_PHASE, TONE_FEATURES, tone_columns
from dtwin.kinds.sinusoidal._groups import SENT_RMS, ToneGroups
from dtwin.kinds.sinusoidal._laws import Law
from dtwin.serve.band import Band
from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.graph import Graph
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits, State
from dtwin.units import unit_of

SERVO_HZ = 8000.0
PHASE, AMPLITUDE = COMMAND_PHASE, COMMAND_AMPLITUDE
OUTPUT = "correction_z_um"
# The sine follows a new window over this time: no step.
_FOLLOW_S = 0.25
Action = Literal["inverse", "subtract", "printed"]
ACTIONS: tuple[Action, ...] = ("inverse", "subtract", "printed")
ROOM = 1.15
# Of five seconds at 1 kHz: a sine has 1.41, a sine with half its power in noise 3.2, noise alone 3.7.
MOST_CREST = 3.2


def is_tone_bundle(bundle: Bundle) -> bool:
    """Tell whether a bundle corrects tones."""
    return PHASE in bundle.tick_inputs


def tone_bundle(
    amplitude: Law,
    phase: Law,
    groups: ToneGroups,
    name: str,
    machine: str,
    action: Action = "inverse",
    table_versions: dict[str, int] | None = None,
) -> Bundle:
    """Freeze two equations.

    ``inverse`` divides the command by the gain that window and sent command tell together, so that a
    linear slide is right after one window, whatever was sent before. ``subtract`` takes the exact error
    vector off the command, as the source describes in words; the error of a corrected motion is a smaller
    one, so it must be iterated, and may diverge. ``printed`` is the source's equation, amplitude error times
    a sine with the phase error, which is not the error vector.

    ``amplitude``, ``phase``: amplitude error in um and lag in degrees, from features.
    ``groups``: what they were fitted to; gives the validity box.
    """
    inputs = _inputs(amplitude, phase, groups)
    boxes = {i.name: (i.low, i.high) for i in inputs}
    largest = float(groups.amplitude_um.max())
    reach = float(np.max(groups.amplitude_error_um + np.radians(groups.phase_error_deg) * largest))
    return two_rate_bundle(
        _window_graph(amplitude, phase, boxes), inputs, groups, reach, name, machine, action, table_versions
    )


def two_rate_bundle(
    window_graph: Graph,
    inputs: Sequence[Input],
    groups: ToneGroups,
    reach_um: float,
    name: str,
    machine: str,
    action: Action = "inverse",
    table_versions: Mapping[str, int] | None = None,
    band: Band | None = None,
) -> Bundle:
    """Freeze a window that tells gain and lag with the tick that makes the sine of them.

    ``window_graph``: from features to ``amplitude_error_um``, ``phase_error_rad`` and ``gain_1``.
    ``inputs``: of both graphs: the validity box.
    ``groups``: give the window and the highest frequency.
    ``reach_um``: largest correction that is expected, um.
    ``name``, ``machine``, ``action``, ``table_versions``: as for :func:`tone_bundle`.
    ``band``: of the correction; None when it is not known.
    """
    clamp = max(1.0, ROOM * reach_um)
    return create_bundle(
        corrects="sinusoidal",
        name=name,
        machine=machine,
        model_version=0,
        inputs=inputs,
        outputs=[Output(OUTPUT, "base_z", "correction")],
        states=[State("sent_re_1", "1", 1.0), State("sent_im_1", "1", 0.0)],
        window=groups.contract,
        window_graph=window_graph,
        tick_graph=_tick_graph(action),
        safety=SafetyLimits(
            clamp_um=clamp,
            slew_um_s=clamp * 2.0 * np.pi * 1.5 * float(groups.frequency_hz.max()),
            stale_s=3.0 / SERVO_HZ,
            window_stale_s=1.5,
        ),
        provenance=Provenance(code_version=__version__, table_versions=dict(table_versions or {})),
        band=band,
    )


def command_inputs(groups: ToneGroups) -> list[Input]:
    """Return what a tick and a window must know of the command, whatever tells the error.

    ``groups``: give the validity box. A sent tone is smaller than the commanded one where the slide overshoots.
    """
    rate = groups.contract.rate_hz / groups.contract.hop
    smallest, largest = float(groups.amplitude_um.min()), float(groups.amplitude_um.max())
    return [
        Input(PHASE, "rad", "path", SERVO_HZ, "controller", -7.0, 7.0),
        Input(AMPLITUDE, "um", "path", SERVO_HZ, "controller", 0.0, ROOM * largest),
        Input(SENT_RMS, "um", "path", rate, "feature", 0.3 * smallest, ROOM * largest),
    ]


def _inputs(amplitude: Law, phase: Law, groups: ToneGroups) -> list[Input]:
    rate = groups.contract.rate_hz / groups.contract.hop
    channel = groups.contract.channels[1]
    crest = tone_columns(channel)[TONE_FEATURES.index("crest_factor")]
    used = sorted({*amplitude.features, *phase.features} - {crest})
    columns = groups.columns
    inputs = [
        *command_inputs(groups),
        # Dead in an equation, alive here: it tells a tone from noise.
        Input(crest, "1", "sensor", rate, "feature", 1.0, MOST_CREST),
    ]
    for name in used:
        low, high = float(columns[name].min()), float(columns[name].max())
        room = (1.0 - 1.0 / ROOM) * abs(low)
        inputs.append(Input(name, unit_of(name) or "1", "sensor", rate, "feature", low - room, 1.02 * high))
    return inputs


def _window_graph(amplitude: Law, phase: Law, boxes: dict[str, tuple[float, float]]) -> Graph:
    builder = GraphBuilder()
    features: dict[str, Expression] = {}
    for name in sorted({*amplitude.features, *phase.features, SENT_RMS}):
        low, high = boxes[name]
        # Held at the edge of the box: the guard refuses what is outside, the memory must stay finite.
        features[name] = builder.apply("min", builder.apply("max", builder.input(name), low), high)
    error = amplitude.build(builder, features)
    return builder.graph(
        {
            "amplitude_error_um": error,
            "phase_error_rad": phase.build(builder, features) * (np.pi / 180.0),
            "gain_1": 1.0 + error / (features[SENT_RMS] * np.sqrt(2.0)),
        }
    )


def _tick_graph(action: Action) -> Graph:
    """Return what turns gain and lag into a sine; the memory holds sent over commanded as a vector."""
    builder = GraphBuilder()
    angle, size = builder.input(PHASE), builder.input(AMPLITUDE)
    lag, gain = builder.input("phase_error_rad"), builder.input("gain_1")
    if action == "printed":
        wave = builder.apply("sin", angle - lag)
        memory = {name: builder.state(name) for name in ("sent_re_1", "sent_im_1")}
        return builder.graph({OUTPUT: -builder.input("amplitude_error_um") * wave}, memory)
    cosine, sine = builder.apply("cos", lag), builder.apply("sin", lag)
    if action == "inverse":
        real, imaginary = cosine / gain, sine / gain
    else:
        told = 1.0 + builder.input("amplitude_error_um") / builder.apply("max", size, 0.1)
        real, imaginary = 2.0 - told * cosine, told * sine
    share = 1.0 - float(np.exp(-1.0 / (SERVO_HZ * _FOLLOW_S)))
    updates = {}
    for name, wanted in (("sent_re_1", real), ("sent_im_1", imaginary)):
        before = builder.state(name)
        updates[name] = before + share * (wanted - before)
    waves = builder.apply("sin", angle), builder.apply("cos", angle)
    added = (updates["sent_re_1"] - 1.0) * waves[0] + updates["sent_im_1"] * waves[1]
    return builder.graph({OUTPUT: size * added}, updates)
