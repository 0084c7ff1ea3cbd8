"""What pages show of twins: computed once for each version, reduced to what is drawn."""

from __future__ import annotations

import math
import threading
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.documents import read_document
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named, kinds
from dtwin.physics import localise
from dtwin.physics.effect import Instance
from dtwin.physics.fit import fit
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.twin import Twin
from dtwin.pipeline.kept import kept, sheet_of_campaign, variation_of
from dtwin.report.twin_plots import harmonic_amplitudes_um
from dtwin.schema import Floats, require_name
from dtwin.twins.measured import Comparison, Loaded, load, pure_rms_um
from dtwin.twins.of_kind import paths_of
from dtwin.twins.registration import version_name
from dtwin.workbench._bench import Bench

FLOOR_WORDS = {
    "repeats": "from repeats of the same condition; unit of replication: the run",
    "within_run": "from inside single runs: a lower bound",
    "none": "not known: no condition was repeated",
}


@dataclass(frozen=True)
class _Floor:
    """The noise floor of a campaign.

    ``um``: RMS of one run about the mean of its condition; NaN when it is not known.
    ``kind``: where it comes from; ``within_run`` is a lower bound.
    """

    um: float
    kind: str

    @property
    def known(self) -> bool:
        """Whether there is a number."""
        return math.isfinite(self.um)

    @property
    def words(self) -> str:
        """Where it comes from, in words."""
        return FLOOR_WORDS[self.kind]


@dataclass(frozen=True)
class _View:
    """A twin against its runs, ready to draw.

    ``key``: twin, version and table version that it was made from.
    ``measured_um``, ``residual_um``, (conditions, n): means over the repeats; NaN where nothing was measured.
    """

    key: tuple[str | int, ...]
    comparison: Comparison
    result: Mapping[str, Any]
    measured_um: Floats
    residual_um: Floats

    @property
    def obs(self) -> Observations:
        """The runs."""
        return self.comparison.obs

    @property
    def twin(self) -> Twin:
        """The twin."""
        return self.comparison.twin

    @property
    def floor_um(self) -> float:
        """RMS of one run about the mean of its condition; NaN without repeats."""
        return float(self.result["noise_floor_um"])

    @property
    def labels(self) -> list[str]:
        """Names of the conditions."""
        return [str(c) for c in self.obs.conditions]


def _observed(bench: Bench, campaign: str) -> Observations:
    """Return the runs of a campaign of the lake on the grid.

    Raises ``InputError`` when there is no such campaign, or it has no usable run.
    """
    return _loaded(bench, campaign).obs


_making: defaultdict[str, threading.Lock] = defaultdict(threading.Lock)


def campaign_sheet_of(bench: Bench, campaign: str, machine: str) -> dict[str, Any]:
    """Return the test sheet of a campaign of this machine."""
    # Rows are read of those tests alone that can tell it.
    telling = {kind.name for kind in kinds() if kind.offers("variation")}
    drifts = [one.name for one in bench.campaigns() if one.machine == machine and one.kind in telling]
    variation = variation_of(bench.home, machine, [row for name in drifts for row in bench.run_rows(name)])
    # Asked for twice while it is made, it is made once.
    with _making[campaign]:
        return sheet_of_campaign(bench.home, campaign, machine, bench.stamp(campaign), variation)


def said_together_in(bench: Bench, campaign: str) -> list[dict[str, Any]]:
    """Return what samples of all runs of a campaign say together; nothing of one without a test sheet, or that is gone."""
    known = next((one for one in bench.campaigns() if one.name == campaign), None)
    if known is None or not kind_named(known.kind).offers("sheet"):
        return []
    return campaign_sheet_of(bench, campaign, known.machine)["findings"]


def campaign_floor(bench: Bench, campaign: str) -> _Floor:
    """Return what repeats of a campaign disagree by, centre and radius of set-ups taken out.

    It is kept in a file: finding it reads every run.
    """
    stamp = bench.stamp(campaign)
    um = bench.cache.get(
        ("floor", campaign, stamp),
        lambda: kept(bench.home, "floors", campaign, stamp, lambda: _floor_um(bench, campaign)),
    )
    return _Floor(math.nan, "none") if um is None else _Floor(um, "repeats")


def _floor_um(bench: Bench, campaign: str) -> float | None:
    try:
        obs = _observed(bench, campaign)
    except InputError:
        return None
    um = pure_rms_um(obs, localise.residual_um(obs, []))
    return um if math.isfinite(um) else None


def version_file(bench: Bench, name: str, version: int) -> Path:
    """Return the file of a version of a twin."""
    return bench.twins.root / require_name(name, "the twin") / f"{version_name(version)}.json"


def view(bench: Bench, name: str, version: int | None = None, on: str = "") -> _View:
    """Return a twin against runs.

    ``version``: the newest without.
    ``on``: campaign of other runs of the machine, for the newest version, or one of several of the fit; empty for the first.
    """
    twin = paths_of(bench.home, bench.library, name, version)
    campaign = on or twin.campaigns[0]
    made = version_file(bench, name, twin.version).stat().st_mtime_ns
    key = ("view", name, twin.version, made, campaign, bench.stamp(campaign))

    def compared() -> _View:
        return _viewed(key, bench.twins.compared(twin, _loaded(bench, campaign)))

    return bench.cache.get(key, compared)


def diagnosis_of(bench: Bench, name: str, version: int) -> dict[str, Any] | None:
    """Return the diagnosis of a version, None when it was not diagnosed yet."""
    path = version_file(bench, name, version).with_suffix(".diagnosis.json")
    return read_document(path) if path.exists() else None


def floor_of(bench: Bench, view: _View) -> _Floor:
    """Return the noise floor: from repeats, else the lower bound of a diagnosis, else none."""
    if math.isfinite(view.floor_um):
        return _Floor(view.floor_um, "repeats")
    same = view.obs.campaign.name == view.twin.campaign
    diagnosis = diagnosis_of(bench, view.twin.name, view.twin.version) if same else None
    diagnosis = diagnosis or {}
    own = [one for one in diagnosis.get("campaigns", ()) if one["campaign"] == view.twin.campaign]
    diagnosis = own[0] if own else diagnosis
    lower = diagnosis.get("noise_floor_um")
    if diagnosis.get("floor_kind") == "within_run" and lower is not None:
        return _Floor(float(lower), "within_run")
    return _Floor(math.nan, "none")


def chosen_conditions(view: _View, wanted: Sequence[int]) -> list[int]:
    """Return valid numbers of conditions; the one with the largest residual without any."""
    here = [c for c in dict.fromkeys(wanted) if 0 <= c < len(view.obs.conditions)]
    return here or [int(np.argmax(np.nanmean(view.residual_um**2, axis=1)))]


def both_ways(view: _View, number: int) -> list[int]:
    """Return a condition with the one that differs from it by its direction only."""
    conditions = view.obs.conditions
    shape = [(c.plane, c.radius_mm, c.feed_mm_min) for c in conditions]
    return [number, *(other for other in range(len(shape)) if other != number and shape[other] == shape[number])]


def overlay(view: _View, conditions: Sequence[int], show: Sequence[str], runs: Sequence[str]) -> dict[str, Floats]:
    """Return curves by name.

    ``conditions``: conditions, means over their repeats.
    ``show``: of ``measured``, ``twin``, ``residual``.
    ``runs``: single runs besides, as measured.
    """
    curves: dict[str, Floats] = {}
    for number in conditions:
        suffix = f" {view.labels[number]}" if len(conditions) > 1 else ""
        measured, left = view.measured_um[number], view.residual_um[number]
        for kind, values in (("measured", measured), ("twin", measured - left), ("residual", left)):
            if kind in show:
                curves[kind + suffix] = values
    for row, meta in enumerate(view.obs.runs):
        if meta.run_id in runs:
            name = f"run {meta.run_id}"
            turn = sum(known.startswith(name) for known in curves)
            values = _masked(view.comparison.before_um, view.obs)[row]
            curves[f"{name} turn {turn + 1}" if turn else name] = values
    return curves


def runs_of(view: _View, conditions: Sequence[int]) -> list[str]:
    """Return the runs of conditions, in the order of measurement."""
    rows = np.flatnonzero(np.isin(view.obs.condition_of, conditions))
    return list(dict.fromkeys(view.obs.runs[int(row)].run_id for row in rows))


def floor_harmonics_um(view: _View) -> Floats | None:
    """Return the amplitude by which repeats disagree at each harmonic, shape (n // 2 + 1,).

    Mean square over the rows of what each differs from the mean of its condition, with the
    degrees of freedom of the means taken out; None without repeats over full turns.
    """
    obs = view.obs
    full = obs.mask.all(axis=1)
    total, dof = np.zeros(obs.n_bins // 2 + 1), 0
    for number in range(len(obs.conditions)):
        rows = view.comparison.residual_um[(obs.condition_of == number) & full]
        if len(rows) > 1:
            total += (harmonic_amplitudes_um(rows - rows.mean(axis=0)) ** 2).sum(axis=0)
            dof += len(rows) - 1
    return np.asarray(np.sqrt(total / dof)) if dof else None


def taken_away_um(bench: Bench, view: _View, label: str) -> Floats:
    """Return what adding an effect would take from the mean residual of every condition.

    ``label``: effect with axis, for example ``backlash X``.
    Returns (conditions, n): NaN where nothing was measured.
    """
    name, _, axis = label.partition(" ")
    instance = Instance(bench.library[name], axis)
    if label in view.twin.labels:
        raise InputError("the twin has this effect already", code="twin.has_effect", got=label)

    def refitted() -> Floats:
        obs = view.obs
        term = Term(instance, instance.effect.start_shape)
        left = fit(obs, [*view.twin.terms, term]).residual_um
        change = view.comparison.residual_um - left
        return _with_gaps(localise.condition_means(obs, change), obs)

    return bench.cache.get(("signature", label, *view.key), refitted)


def _loaded(bench: Bench, campaign: str) -> Loaded:
    key = ("observed", campaign, bench.stamp(campaign))
    return bench.cache.get(key, lambda: load(bench.home, campaign))


def _viewed(key: tuple[str | int, ...], comparison: Comparison) -> _View:
    obs = comparison.obs
    return _View(
        key,
        comparison,
        comparison.as_dict(),
        _with_gaps(localise.condition_means(obs, comparison.before_um), obs),
        _with_gaps(localise.condition_means(obs, comparison.residual_um), obs),
    )


def _with_gaps(means: Floats, obs: Observations) -> Floats:
    seen = np.array([obs.mask[obs.condition_of == c].any(axis=0) for c in range(len(means))])
    return np.where(seen, means, np.nan)


def _masked(values: Floats, obs: Observations) -> Floats:
    return np.where(obs.mask, values, np.nan)
