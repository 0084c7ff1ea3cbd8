"""What the runs of a campaign in the lake say: figures, findings, curves."""

from __future__ import annotations

from typing import Any

from dtwin.acquire.amending import amendment_findings
from dtwin.acquire.quality import judge_campaign, without_samples
from dtwin.config import Home
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.physics.circular import fit_circle, residual_um
from dtwin.progress import Progress, silent
from dtwin.report.checking import run_result
from dtwin.schema import Floats, Run, of_one_way

_MOST_CURVES = 6


def campaign_figures(home: Home, campaign: str, progress: Progress = silent) -> dict[str, Any]:
    """Return figures and findings of every run of a campaign in the lake.

    Returns ``campaign``, ``machine``, ``kind``, ``runs`` as ``dtwin check`` gives them, and ``findings`` of the whole.
    Raises ``InputError`` when the campaign is unknown.
    """
    lake = Lake(home.lake)
    known = lake.campaign(campaign)
    rows = lake.runs(campaign)
    results, light = [], []
    for done, row in enumerate(rows, start=1):
        run = lake.load(row, signals=False)
        results.append(run_result(run))
        light.append(without_samples(run))
        progress(done, len(rows), run.meta.run_id)
    return {
        "campaign": campaign,
        "machine": known.machine,
        "kind": known.kind,
        "runs": results,
        "findings": [
            finding.as_dict()
            for finding in [*judge_campaign(light), *amendment_findings(lake.runs(campaign, left_out=True))]
        ],
    }


def error_curves(home: Home, campaign: str) -> dict[str, dict[str, tuple[Floats, Floats]]]:
    """Return the error over the path angle of the first run of each condition.

    ``campaign``: name of a circular campaign; another kind gives nothing.
    Returns by condition and direction: angles in degrees, errors in um after the run's own centre and radius, each of
    shape (n,).
    """
    lake = Lake(home.lake)
    curves: dict[str, dict[str, tuple[Floats, Floats]]] = {}
    for row in of_one_way(lake.runs(campaign)):
        if not (kind_named(row["kind"]).goes_round and row["radius_mm"]):
            continue
        feed = f" F{row['feed_mm_min']:g}" if row["feed_mm_min"] else ""
        name = f"{row['plane']} R{row['radius_mm']:g}{feed}"
        ways = curves.get(name, {}) if name in curves or len(curves) < _MOST_CURVES else None
        if ways is not None and row["direction"] not in ways:
            ways[row["direction"]] = _centred(lake.load(row, signals=False))
            curves[name] = ways
    return curves


def _centred(run: Run) -> tuple[Floats, Floats]:
    angle, deviation = run.arc
    radius = float(run.meta.radius_mm or 0.0)
    return angle, residual_um(angle, deviation, radius, fit_circle(angle, deviation, radius))
