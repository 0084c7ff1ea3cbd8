"""What a champion leaves of the amplitude of recorded tones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.kinds.sinusoidal._bundle import AMPLITUDE, PHASE
from dtwin.kinds.sinusoidal._check import HEARD
from dtwin.kinds.sinusoidal._groups import (
    HELD_OUT,
    SENT_CREST,
    SENT_FREQUENCY,
    SENT_RMS,
    ToneGroups,
    load_tone_groups,
    noise_floor_um,
)
from dtwin.lake.store import Lake
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle
from dtwin.statistics import rms
from dtwin.train.champion_error import ChampionError, HeldOut, held_out, new_values, require_inputs, require_trained

_TOLD = "amplitude_error_um"


def tones_error(lake: Lake, rows: Sequence[dict[str, Any]], bundle: Bundle, *_: object) -> ChampionError:
    """Return a bundle's amplitude error over the tones that the accelerometer hears, as training states it."""
    everything = load_tone_groups(lake, list(rows))
    groups = everything.only(everything.heard >= HEARD)
    if not groups.n:
        raise InputError("the accelerometer hears none of these tones", code="drift.heard", got=f"{everything.n} tones")
    named = _told(groups)
    require_inputs(bundle, (*named, PHASE), ("base_z",), "features of command and accelerometer, one output along Z")
    if _TOLD not in bundle.intermediates:
        raise InputError(
            "this champion does not tell an amplitude error", code="drift.bundle", got=", ".join(bundle.intermediates)
        )
    compiled = CompiledBundle(bundle)
    asked = np.zeros(groups.n)
    inside = np.ones(groups.n, bool)
    for needed in bundle.inputs:
        # Every phase of the command comes up.
        if needed.name != PHASE:
            inside &= (named[needed.name] >= needed.low) & (named[needed.name] <= needed.high)
    for number in range(groups.n):
        compiled.window(np.array([named[name][number] for name in bundle.feature_inputs]))
        asked[number] = compiled.told[_TOLD]
    served = np.where(inside, asked, 0.0)
    return ChampionError(
        rms_um=rms(groups.amplitude_error_um - served),
        before_um=rms(groups.amplitude_error_um),
        noise_floor_um=noise_floor_um(groups)[0],
        outside_box_share=float(np.mean(~inside)),
        n_runs=groups.n,
    )


def tones_held_out(known: Sequence[Mapping[str, Any]], fresh: Sequence[Mapping[str, Any]]) -> HeldOut:
    """Return the error to be expected: with frequencies left out when new ones are there, else with amplitudes."""
    require_trained(known, fresh, "axis")
    frequency, amplitude = HELD_OUT
    return held_out(frequency if new_values(known, fresh, frequency) else amplitude)


def _told(groups: ToneGroups) -> dict[str, Floats]:
    sent = {SENT_RMS: groups.sent_rms_um, SENT_FREQUENCY: groups.frequency_hz}
    crest = {SENT_CREST: np.full(groups.n, np.sqrt(2.0)), AMPLITUDE: groups.amplitude_um}
    return {**groups.columns, **sent, **crest}
