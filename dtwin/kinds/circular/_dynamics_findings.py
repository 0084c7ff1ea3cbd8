"""What a reader must know before believing the dynamic parts of a campaign."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dtwin.features.dynamics.figures import ACCEPTED_DIFFERENCE
from dtwin.features.dynamics.turns import MOST_READINGS
from dtwin.schema import Finding

_MOST_TAKEN, _MOST_BIAS = 0.01, 0.5


def findings_of(result: Mapping[str, Any], measured: int) -> list[Finding]:
    """Return what a reader must know before believing the figures.

    ``result``: as :class:`Split` holds it.
    ``measured``: fewest readings per revolution of a run, before resampling.
    """
    rows = result["rows"]
    findings: list[Finding] = []

    def say(code: str, message: str, **numbers: float) -> None:
        findings.append(Finding(f"dynamics.{code}", "warning", message, numbers))

    lobes = result["two_lobes"]
    if lobes and lobes["taken"] > _MOST_TAKEN:
        say(
            "eats_features",
            f"the filter takes {100 * lobes['taken']:z.0f} % of a real two-lobe error for dynamics "
            f"(leaves {100 * lobes['gain']:z.0f} %, {lobes['lag_deg']:z.1f} deg late): raise Q or the "
            "cutoff, or use the twin",
            taken=lobes["taken"],
        )
    fastest = max(r["feed_mm_min"] for r in rows)
    taken = float(np.mean([r["dc3_um"] for r in rows if r["feed_mm_min"] == fastest]))
    one_feed = fastest == min(r["feed_mm_min"] for r in rows)
    if one_feed:
        say("one_feed", "one feed only: nothing slower to compare with, the reference is these runs")
    elif result["bias"]["dc3_um"] > _MOST_BIAS * taken:
        say(
            "static_taken",
            f"{result['bias']['dc3_um']:z.2f} µm RMS are taken out of the slow runs, {taken:z.2f} µm out "
            "of the fastest: the twin lacks an effect (dtwin twin diagnose), the filter smooths too "
            "much, or the reference is not slow enough",
            slow_um=result["bias"]["dc3_um"],
            fast_um=taken,
        )
    if len({row["direction"] for row in rows}) < 2:
        say(
            "one_direction",
            "one direction only: servo mismatch and squareness, lateral play and backlash look the "
            "same, and a lag of the filter looks like an error of the machine",
        )
    if measured < MOST_READINGS:
        say(
            "few_readings",
            f"{measured} readings per revolution; {MOST_READINGS} or more are needed to tell "
            "vibration from a real short feature",
            readings=float(measured),
        )
    shaken = [r for r in rows if r["vibration_um"] > r["after_um"]]
    if shaken:
        say(
            "vibration_exceeds",
            f"in {len(shaken)} of {len(rows)} runs vibration exceeds the circular deviation that is "
            "left: their static figures are not reliable",
            runs=float(len(shaken)),
        )
    apart = [r for r in rows if r["difference"] > ACCEPTED_DIFFERENCE]
    if apart and not one_feed:
        worst = max(apart, key=lambda r: r["difference"])
        say(
            "differs_from_reference",
            f"in {len(apart)} of {len(rows)} runs the circular deviation differs from the slow "
            f"reference by more than {100 * ACCEPTED_DIFFERENCE:z.0f} %, most in {worst['run']} "
            f"({100 * worst['difference']:z.0f} %): what changes with the feed was not all taken out",
            worst=worst["difference"],
        )
    grown = [r for r in rows if r["dc1_um"] < 0.0]
    if grown:
        say(
            "deviation_grew",
            f"in {len(grown)} of {len(rows)} runs the circular deviation is larger after than before",
            runs=float(len(grown)),
        )
    return findings
