"""The error of every run of a campaign, in the form in which runs are compared with each other."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.schema import Floats, Run

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
