"""The errors of tones, as evidence compares them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dtwin.errors import InputError
from dtwin.features.sine import fit_tone
from dtwin.schema import Run
from dtwin.train.run_errors import Condition, RunError
from dtwin.units import UM_PER_MM


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
