"""What of a campaign's measured error the controller saw, and what it could not see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.features.encoder_split import DEFAULT_CYCLES_PER_REV, Cutoff, Split, seen_by_controller_um, split
from dtwin.physics import localise
from dtwin.physics.gridding import N_BINS, rows_of
from dtwin.physics.observations import Observations
from dtwin.schema import Floats, Run

DEFAULT_CUTOFF = Cutoff(cycles_per_rev=DEFAULT_CYCLES_PER_REV)


@dataclass(frozen=True)
class _EncoderSplit:
    """Measured error by who can see it.

    ``cutoff``: where quasi-static ends and dynamic begins.
    ``obs``: the runs whose controller was logged.
    ``runs_without``: runs without the controller's columns, which are left out.
    """

    cutoff: Cutoff
    obs: Observations
    split: Split
    runs_without: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        return {
            "cutoff": self.cutoff.as_dict(),
            "unit_of_replication": "run",
            "runs": len(set(self.obs.run_of.tolist())),
            "runs_without_controller": list(self.runs_without),
            "parts": self._figures(np.ones(self.obs.n_rows, dtype=bool)),
            "conditions": [
                {
                    **condition.as_dict(),
                    "runs": len(set(self.obs.run_of[rows].tolist())),
                    "cutoff_cycles_per_rev": self.cutoff.cycles(condition.radius_mm, condition.feed_mm_min),
                    **self._figures(rows),
                }
                for condition, rows in self._by_condition()
            ],
        }

    def _by_condition(self) -> list[tuple[Any, Any]]:
        numbers = sorted(set(self.obs.condition_of.tolist()))
        return [(self.obs.conditions[c], self.obs.condition_of == c) for c in numbers]

    def _figures(self, rows: Any) -> dict[str, Any]:
        out: dict[str, Any] = {k: dict(vars(p)) for k, p in self.split.sizes(rows).items()}
        out["controller_correlation"] = self.split.seen_unseen_correlation(rows)
        return out


def controller_rows_um(runs: Sequence[Run]) -> Floats | None:
    """Return the controller's following error of runs on the grid of ``observe``.

    ``runs``: in the order in which they are observed.
    Returns (rows, 360): um along the radius, NaN for runs without the columns; None when no run has them.
    """
    out = []
    for run in runs:
        seen = seen_by_controller_um(run.meta, run.samples, run.samples["angle_deg"])
        if seen is None:
            blank = np.full(N_BINS, np.nan)
            out += [blank] * len(rows_of(_alone(run, run.samples["deviation_um"]), 0.0))
        else:
            out += [row.y_um for row in rows_of(_alone(run, seen), 0.0)]
    rows = np.array(out)
    return None if np.isnan(rows).all() else rows


def encoder_split(
    obs: Observations, controller_um: Floats | None, cutoff: Cutoff = DEFAULT_CUTOFF
) -> _EncoderSplit | None:
    """Split the measured error of the runs whose controller was logged.

    Set-up terms are fitted to the measured error and to the controller's part alike, so that what
    a centre offset or the bar's zero would absorb is in neither.

    ``controller_um``, (rows, 360): from ``controller_rows_um``.
    ``cutoff``: where quasi-static ends and dynamic begins.
    None when no run has the controller's columns.
    """
    if controller_um is None:
        return None
    there = np.isfinite(controller_um).all(axis=1)
    without = {obs.runs[i].run_id for i in np.flatnonzero(~there)}
    chosen = obs.take(np.flatnonzero(there))
    seen = localise.residual_um(chosen.with_y(controller_um[there]), [])
    cycles = [cutoff.cycles(c.radius_mm, c.feed_mm_min) for c in chosen.conditions]
    parts = split(
        localise.residual_um(chosen, []), seen, chosen.mask, chosen.condition_of, np.array(cycles)[chosen.condition_of]
    )
    return _EncoderSplit(cutoff, chosen, parts, tuple(sorted(without)))


def cutoff_of(cycles_per_rev: float | None, hz: float | None) -> Cutoff:
    """Return the split that a user asked for, the usual one without.

    Raises ``InputError`` when both are given, or one is not positive.
    """
    if cycles_per_rev is None and hz is None:
        return DEFAULT_CUTOFF
    return Cutoff(cycles_per_rev, hz)


def no_controller_columns(where: str) -> InputError:
    """Return the error for a split of runs that have no controller columns."""
    return InputError(
        "no run has the controller's positions",
        code="split.no_columns",
        where=where,
        allowed="cmd_x_mm, act_x_mm and the same of the other axis of the plane",
        hint="log them beside t_s, angle_deg and deviation_um",
    )


def _alone(run: Run, values: Any) -> Run:
    kept = {n: run.samples[n] for n in ("t_s", "angle_deg") if n in run.samples}
    return replace(run, samples={**kept, "deviation_um": np.asarray(values, dtype=float)})
