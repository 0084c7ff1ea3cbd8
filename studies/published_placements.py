"""The source thesis's tables of 3-D motion and of placements, computed again from what is printed."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dtwin.config import published_table
from dtwin.schema import Floats
from studies.sphere_evidence import difference

FEEDS = ("1000", "3000", "6000")
MOTIONS = ("MoveL", "MoveJ")
_PLACEMENTS = 10


def recomputed() -> dict[str, Any]:
    """Return what follows from the printed numbers beside what is printed.

    Returns JSON-ready: ``xyz`` and, for both motions, ``mean_sd``, ``zeros``, ``offset``, ``centring``, ``radial`` and
    ``limit``.
    """
    data = tomllib.loads(published_table("cobot_placements.toml").read_text("utf-8"))
    return {
        "xyz": _xyz(data["xyz"]),
        **{
            motion: {
                "mean_sd": _mean_sd(data[motion]),
                "zeros": _zeros(data[motion]),
                "offset": _offset(data[motion]),
                "centring": _centring(data[motion]),
                "radial": _radial(data[motion]),
                "limit": _limit(data[motion]),
            }
            for motion in MOTIONS
        },
    }


def _xyz(table: Mapping[str, Any]) -> dict[str, Any]:
    rows = []
    for feed in FEEDS:
        before, after = (np.array(table[way][feed]) for way in ("nc", "wc"))
        change, wide = difference(before, after)
        rows.append(
            {
                "feed_mm_min": float(feed),
                "before_mm": float(before.mean()),
                "after_mm": float(after.mean()),
                "reduction_pct": 100.0 * (1.0 - float(after.mean() / before.mean())),
                "printed_pct": table["printed_reduction_pct"][feed],
                "change_mm": change,
                "half_width_mm": wide,
                "mae_over_sd": float(before.mean()) / table["printed_sd"]["nc"][feed],
            }
        )
    return {
        "rows": rows,
        "mean_reduction_pct": float(np.mean([r["reduction_pct"] for r in rows])),
        "printed_mean_pct": table["printed_mean_reduction_pct"],
        "sinusoid": 2.0 * np.sqrt(2.0) / np.pi,
        "gaussian": float(np.sqrt(2.0 / np.pi)),
    }


def _mean_sd(table: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The column "Mean SD" is the spread of the three standard deviations, not their mean."""
    return [
        {
            "condition": name,
            "printed": values[3],
            "mean": float(np.mean(values[:3])),
            "spread": float(np.std(values[:3])),
        }
        for name, values in table["sd"].items()
    ]


def _zeros(table: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Deviations after removal: properly, and with removed values counted as raw zeros."""
    used = _offset_used(table)
    rows = []
    for name, printed in table["sd_removed"].items():
        raw = np.array(table["anomalies"][name])
        for axis in (0, 1):
            mean, sd = table["mean"][name][axis], table["sd"][name][axis]
            gone = raw[:, axis] - used[axis]
            rows.append(
                {
                    "condition": f"{name} {'xy'[axis]}",
                    "with_all": sd,
                    "printed": printed[axis],
                    "removed": _sd_without(mean, sd, gone),
                    "as_zeros": _sd_replaced(mean, sd, gone, -used[axis]),
                }
            )
    return rows


def _offset_used(table: Mapping[str, Any]) -> Floats:
    """Return the offset that was subtracted: the stated one is the mean of all that was measured,
    so whatever mean the printed values still have was not taken off.
    """
    return np.array(table["offset"], dtype=float) - _mean_left(table)


def _mean_left(table: Mapping[str, Any]) -> Floats:
    means = [table["mean"][f"{feed}-{way}"] for feed in FEEDS for way in ("nc", "wc")]
    return np.asarray(np.mean(np.array(means, dtype=float), axis=0))


def _sums(mean: float, sd: float) -> tuple[float, float]:
    """Return sum and sum of squares; the printed deviations divide by n, not by n - 1."""
    return _PLACEMENTS * mean, _PLACEMENTS * (sd**2 + mean**2)


def _sd_of(n: int, total: float, squares: float) -> float:
    return float(np.sqrt(max(squares / n - (total / n) ** 2, 0.0)))


def _sd_without(mean: float, sd: float, gone: Floats) -> float:
    total, squares = _sums(mean, sd)
    n = _PLACEMENTS - len(gone)
    return _sd_of(n, total - float(gone.sum()), squares - float(np.sum(gone**2)))


def _sd_replaced(mean: float, sd: float, gone: Floats, by: float) -> float:
    total, squares = _sums(mean, sd)
    total += len(gone) * by - float(gone.sum())
    squares += len(gone) * by**2 - float(np.sum(gone**2))
    return _sd_of(_PLACEMENTS, total, squares)


def _offset(table: Mapping[str, Any]) -> dict[str, Any]:
    return {"printed": table["offset"], "mean_left": _mean_left(table).tolist(), "used": _offset_used(table).tolist()}


def _centring(table: Mapping[str, Any]) -> dict[str, Any]:
    rows = table["all"]
    sizes = {way: float(np.hypot(*rows[way])) for way in rows if isinstance(rows[way], list)}
    return {
        **sizes,
        "sum": (np.array(rows["nc"]) + np.array(rows["wc"])).tolist(),
        "printed_removed_pct": rows["printed_reduction_removed_pct"],
        "removed_pct": _less(sizes["nc_removed"], sizes["wc_removed"]),
    }


def _radial(table: Mapping[str, Any]) -> dict[str, Any]:
    """Per feed and on average: as printed, and with the offset that the text states."""
    shift = np.array(table["offset"]) - _offset_used(table)
    rows = []
    for feed in FEEDS:
        nc, wc = (np.array(table["mean"][f"{feed}-{way}"]) for way in ("nc", "wc"))
        stated = [float(np.hypot(*(v - shift))) for v in (nc, wc)]
        printed = [table["radial_removed"][f"{feed}-{way}"] for way in ("nc", "wc")]
        rows.append(
            {
                "feed_mm_min": float(feed),
                "all_pct": _less(float(np.hypot(*nc)), float(np.hypot(*wc))),
                "removed_pct": _less(*printed),
                "stated_offset_pct": _less(*stated),
                "all_mm": [float(np.hypot(*nc)), float(np.hypot(*wc))],
                "removed_mm": printed,
                "stated_offset_mm": stated,
            }
        )
    averages = {
        key: _less(*np.array([r[f"{key}_mm"] for r in rows]).mean(axis=0).tolist())
        for key in ("all", "removed", "stated_offset")
    }
    return {"rows": rows, "average_pct": averages, "printed_average_pct": table["printed_average_reduction_pct"]}


def _limit(table: Mapping[str, Any]) -> dict[str, Any]:
    """Readings at a round number, twice the same: the end of a travel, not a place."""
    at_end = [
        [x, y]
        for rows in table["anomalies"].values()
        for x, y in rows
        if abs(abs(x) - 2.5) < 1e-3 and abs(abs(y) - 2.5) < 1e-3
    ]
    apart: Sequence[float] = np.ptp(np.array(at_end), axis=0).tolist() if at_end else []
    return {"readings_mm": at_end, "apart_mm": apart}


def _less(before: float, after: float) -> float:
    return 100.0 * (1.0 - after / before)
