"""What a champion leaves of the amplitude of recorded tones, and their errors as evidence compares them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.features.sine import fit_tone
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
from dtwin.schema import Floats, Run
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle
from dtwin.statistics import rms
from dtwin.train.champion_error import (
    ChampionError,
    Condition,
    HeldOut,
    RunError,
    held_out,
    new_values,
    require_inputs,
    require_trained,
)
from dtwin.units import UM_PER_MM

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


def tone_errors(runs: Sequence[Run]) -> list[RunError]:
    """Return the errors of tones.

    The error of a tone is the length of the difference of two vectors, tool and command.
    """
    errors = []
    for number, run in enumerate(runs):
        stated = run.meta.condition
        axis, frequency = str(stated.get("axis", "Z")), float(stated["frequency_hz"])
        names = [f"{part}_{axis.lower()}_mm" for part in ("cmd", "tool")]
        missing = [name for name in names if name not in run.samples]
        if missing:
            raise InputError(
                "a run does not tell where the tool was",
                code="evidence.columns",
                where=f"run {run.meta.run_id}",
                got=", ".join(run.samples),
                allowed=", ".join(missing),
            )
        command, tool = (
            fit_tone(run.samples["t_s"], run.samples[name] * UM_PER_MM, frequency).phasor for name in names
        )
        error = tool - command
        condition: Condition = {"axis": axis, "frequency_hz": frequency, "amplitude_um": float(stated["amplitude_um"])}
        # In the command's own direction, whatever the instant at which the record began.
        turned = error * np.conj(command) / abs(command)
        rest = math.sqrt(2.0) * np.array([turned.real, turned.imag])
        errors.append(RunError(number, condition, "", abs(error), rest))
    return errors
