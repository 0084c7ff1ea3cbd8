"""Run-out over speed without a phase: what repeats tell, and what they cannot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.kinds.rotation._heads import OVER_SPEED
from dtwin.kinds.rotation._laws import CONSTANT, FEWEST_SPEEDS, Law, groups_of, law_of
from dtwin.schema import Floats, Run
from dtwin.statistics import f_tail

_CHANCE = 0.01


@dataclass(frozen=True)
class SpeedGroup:
    """Run-outs at one speed, in µm."""

    speed_rpm: float
    runout_um: Floats


@dataclass(frozen=True)
class RunOut:
    """Run-outs of a probe over speed.

    ``repeat_um``: standard deviation of one run-out by repeats, NaN without.
    ``differs_p``: probability that speeds alike differ as much, by the repeats; NaN without.
    ``unexplained_p``: the same of what the law leaves.
    """

    run_id: str
    probe: str
    groups: tuple[SpeedGroup, ...]
    repeat_um: float
    dof: int
    differs_p: float
    law: Law | None
    unexplained_p: float


def groups_in(run: Run) -> tuple[SpeedGroup, ...]:
    """Return the run-outs of a table by speed, ascending."""
    speed, runout = run.samples["speed_rpm"], run.samples["runout_um"]
    group = groups_of(speed)
    return tuple(SpeedGroup(float(speed[group == g].mean()), runout[group == g]) for g in np.unique(group))


def is_over_speed(run: Run) -> bool:
    """Return whether a run is a table of run-outs."""
    return run.meta.condition.get("form") == OVER_SPEED or "runout_um" in run.samples


def run_outs(runs: Sequence[Run]) -> list[RunOut]:
    """Return what the tables of run-outs tell."""
    return [_told(run) for run in runs if is_over_speed(run) and not any(f.severity == "error" for f in run.findings)]


def _told(run: Run) -> RunOut:
    groups = groups_in(run)
    dof = sum(len(g.runout_um) - 1 for g in groups)
    within = sum(float(np.sum((g.runout_um - g.runout_um.mean()) ** 2)) for g in groups)
    variance = within / dof if dof else float("nan")
    speed, runout = run.samples["speed_rpm"], run.samples["runout_um"]
    between = sum(len(g.runout_um) * (g.runout_um.mean() - runout.mean()) ** 2 for g in groups)
    differs = float("nan")
    if dof and len(groups) > 1:
        differs = f_tail(between / (len(groups) - 1) / max(variance, 1e-300), (len(groups) - 1.0, float(dof)))
    law = None
    unexplained = differs
    if len(groups) >= FEWEST_SPEEDS and runout.max() > 0.0 and speed.max() > 0.0:
        law = law_of(runout[:, None], speed, run.samples["t_s"], variance if dof else 0.0)
    if law is not None and law.name != CONSTANT and dof and law.rivals[0] in ("speed", "square"):
        # What the means of the speeds are off the law.
        power = 1 if law.rivals[0] == "speed" else 2
        design = np.column_stack([np.ones(len(speed)), (speed / speed.max()) ** power])
        left = runout - design @ np.linalg.lstsq(design, runout, rcond=None)[0]
        lack = max(0.0, float(left @ left) - within) / max(len(groups) - 2, 1)
        unexplained = f_tail(lack / max(variance, 1e-300), (max(len(groups) - 2.0, 1.0), float(dof)))
    probe = str(run.meta.condition.get("probe", run.meta.run_id))
    return RunOut(run.meta.run_id, probe, groups, variance**0.5, dof, differs, law, unexplained)


def runout_sentences(told: RunOut) -> list[tuple[str, str, str]]:
    """Return code, severity and text of what a table of run-outs tells."""
    first, last = told.groups[0], told.groups[-1]
    largest = max(told.groups, key=lambda g: float(g.runout_um.mean()))
    means = [float(g.runout_um.mean()) for g in told.groups]
    span = f"{first.speed_rpm:g} to {last.speed_rpm:g} rpm"
    no_phase = (
        "a run-out has neither phase nor mean: unbalance, a bearing that runs warm, loss of preload and the form of the target are not told "
        "apart by it; log the displacement with the angle"
    )
    if len(told.groups) < 2:
        return []
    changes = told.law is not None and told.law.name != CONSTANT
    if not told.dof and not changes:
        return [
            (
                "rotation.runout_unknown",
                "info",
                f"{told.probe}: without repeats nothing is known of its change over speed",
            )
        ]
    if not changes and not told.differs_p < _CHANCE:
        moved = max(means) - min(means)
        return [
            (
                "rotation.runout_constant",
                "info",
                f"{told.probe}: from {span} run-out changes by no more than its repeats do ({moved:z.3g} µm between means)",
            )
        ]
    out = []
    if changes and told.law is not None:
        words = {
            "speed": "the speed",
            "square": "the square of the speed",
            "time": "the order of the rows: warming, or wear",
        }
        named = " or ".join(words[name] for name in told.law.rivals)
        more = "" if told.law.name else "; which, cannot be told with these speeds"
        code = "rotation.runout_time" if told.law.rivals == ("time",) else "rotation.runout_speed"
        out.append(
            (
                code,
                "warning",
                f"{told.probe}: run-out changes by {told.law.change:z.3g} µm with {named}{more}; {no_phase}",
            )
        )
    inside = largest not in (first, last)
    if told.unexplained_p < _CHANCE and inside:
        text = (
            f"{told.probe}: run-out differs between speeds by more than repeats and a steady law explain, and is largest at {largest.speed_rpm:g} rpm "
            f"({max(means):z.3g} µm): a resonance looks so; measure between its neighbours"
        )
        out.append(("rotation.runout_peak", "warning", text))
    return out or [
        (
            "rotation.runout_differs",
            "warning",
            f"{told.probe}: run-out differs between speeds by more than repeats do; {no_phase}",
        )
    ]
