"""What a served bundle leaves of recorded runs: and the error of every run: the forms in which every kind of campaign gives them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.schema import Floats, Run
from dtwin.serve.bundle import Bundle
from dtwin.units import shown_number


@dataclass(frozen=True)
class ChampionError:
    """The champion's error on runs, as if it had been served to them.

    ``rms_um``, ``before_um``: set-up-corrected error with the champion, and without any model.
    ``noise_floor_um``: what repeats disagree by; NaN without repeats.
    ``outside_box_share``: share of the rows at which serving would have sent no full correction.
    """

    rms_um: float
    before_um: float
    noise_floor_um: float
    outside_box_share: float
    n_runs: int


@dataclass(frozen=True)
class HeldOut:
    """Which error that was registered with a version is to be expected on new runs.

    ``metric``: name of the logged figure.
    ``left_out``: what was left out for it, as a word: ``run``, ``hours`` ...
    """

    metric: str
    left_out: str


def held_out(left_out: str) -> HeldOut:
    """Return the error with runs, hours, frequencies ... left out."""
    return HeldOut(f"leave_{left_out}_out.rms_um", left_out)


def as_served(bundle: Bundle, inputs: Mapping[str, Floats], asked_um: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the error that serving takes away, and where it takes away none, shape (rows,) each.

    ``inputs``: what the validity box judges, by name, shape (rows,) each.
    ``asked_um``: the only output of the bundle; clamped, and zero outside the validity box.
    """
    outside = ~np.isfinite(asked_um)
    for needed in bundle.inputs:
        values = inputs[needed.name]
        outside |= (values < needed.low) | (values > needed.high)
    limit = bundle.safety.clamp_um
    sign = 1.0 if bundle.outputs[0].role == "error" else -1.0
    return np.where(outside, 0.0, sign * np.clip(np.nan_to_num(asked_um), -limit, limit)), outside


def require_inputs(bundle: Bundle, known: Sequence[str], frames: Sequence[str], allowed: str) -> None:
    """Refuse a bundle that asks for what recorded runs do not tell, or corrects something else.

    ``known``: inputs that runs tell; ``frames``: what one output may be given in.
    """
    strange = [i.name for i in bundle.inputs if i.name not in known]
    strange += [output.frame for output in bundle.outputs if output.frame not in frames]
    if strange or len(bundle.outputs) != 1:
        raise InputError(
            "this champion cannot be judged on recorded runs",
            code="drift.bundle",
            where=f"machine {bundle.machine} version {bundle.model_version}",
            got=", ".join(strange) or f"{len(bundle.outputs)} outputs",
            allowed=allowed,
        )


def new_values(known: Sequence[Mapping[str, Any]], fresh: Sequence[Mapping[str, Any]], name: str) -> list[str]:
    """Return the values of a condition that only the fresh ones among rows of ``runs`` have."""
    first, later = ({str(_stated(row).get(name)) for row in rows} for rows in (known, fresh))
    return sorted(later - first)


def require_trained(known: Sequence[Mapping[str, Any]], fresh: Sequence[Mapping[str, Any]], name: str) -> None:
    """Refuse rows of ``runs`` with a value of a condition on which the champion was never trained."""
    strange = new_values(known, fresh, name)
    if strange:
        told = ", ".join(strange)
        raise InputError(f"the champion was never trained on {told}", code="drift.condition", got=told[:80])


def _stated(row: Mapping[str, Any]) -> Mapping[str, Any]:
    return {**row, **json.loads(row["condition_json"])}


def um_text(value_um: float) -> str:
    """Return micrometres for people: one decimal, two digits below one."""
    return shown_number(value_um, 2) if 0.0 < value_um < 1.0 else f"{value_um:z.1f}"


Condition = Mapping[str, str | float]


@dataclass(frozen=True)
class RunError:
    """The error of one run under one condition.

    ``run``: place of the run among those that were given.
    ``condition``: what was set; runs of equal conditions are repeats.
    ``direction``: sense of the motion; runs of one condition differ by it without disagreeing.
    ``rest_um``, shape (n,): the error at places that the repeats share, its RMS about ``size_um``.
    """

    run: int
    condition: Condition
    direction: str
    size_um: float
    rest_um: Floats = field(repr=False)


def run_errors(runs: Sequence[Run]) -> list[RunError]:
    """Return the errors of runs of one kind, what belongs to the set-up taken out.

    ``runs``: all without a correction, or all with the same: the instrument's mounting is fitted to them together.
    """
    kinds = sorted({run.meta.kind for run in runs})
    if not kinds:
        return []
    if len(kinds) > 1:
        raise InputError("runs of several kinds are not compared", code="evidence.kind", got=", ".join(kinds))
    return kind_named(kinds[0]).run_errors(runs)


def measured_sha256(run: Run) -> str:
    """Return a hash of what the instrument measured, whatever the run is called.

    Two runs with the same one are copies: no instrument reads thousands of samples alike twice.
    """
    digest = hashlib.sha256()
    for name in sorted(run.samples):
        values = run.samples[name]
        if name != "t_s" and values.dtype != object:
            digest.update(np.ascontiguousarray(np.round(values, 6)).tobytes())
    return digest.hexdigest()
