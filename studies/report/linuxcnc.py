"""What LinuxCNC measured before and after, as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dtwin.report.text import table
from dtwin.units import shown_number

_WAYS = ("none", "live", "table")


def linuxcnc_text(found: Mapping[str, Any]) -> str:
    """Return the story in three parts.

    ``found``: what ``linuxcnc_story`` returned.
    """
    return "\n\n".join([_named(found), _corrected(found), _judged(found)])


def _named(found: Mapping[str, Any]) -> str:
    lines = [
        f"1 of 3  {found['runs']} circles on LinuxCNC, recorded by its own sampler at 1 kHz "
        f"without a gap; the twin begins with {', '.join(found['known'])}"
    ]
    lines += [f"  {d['verdict']}: {d['headline']}" for d in found["diagnoses"]]
    rows = [
        (e["effect"], e["name"], f"{shown_number(e['value'], 4)} ± {shown_number(e['uncertainty'], 2)}", e["unit"])
        for e in found["estimates"]
    ]
    if found["objections"]:
        lines.append("  on trial only: " + "; ".join(found["objections"]))
    return "\n".join([*lines, table(("corrected", "parameter", "value (k = 2)", "unit"), rows)])


def _corrected(found: Mapping[str, Any]) -> str:
    rows = [
        (
            f"{r['feed_mm_min']:g} {r['direction']}",
            r["none"]["runs"],
            *(f"{r[w]['rms_um']:z.2f} ± {r[w]['half_width_um']:z.2f}" for w in _WAYS),
            *(f"{r[w]['rms_um'] / r['none']['rms_um']:z.2f}" for w in _WAYS[1:]),
        )
        for r in found["results"]
    ]
    head = ("feed, mm/min", "runs", "before, µm", "live, µm", "tables, µm", "live / before", "tables / before")
    served = found["served"]
    lines = [
        f"2 of 3  circles of {found['radius_mm']:g} mm, a radius that the twin has not seen, bar mounted anew",
        "(RMS of the bar with one centre and radius for all circles of a way, 95 % interval of the "
        "mean, the run as unit; before and live in random order in one session; tables are read at LinuxCNC's start "
        "only: a session of their own)",
        table(head, rows),
        f"live: {served['circles']} circles, guard {_counts(served['acted'])}; "
        f"largest {served['largest_um']:z.1f} µm; dropped by the controller's watchdog "
        f"{served['watchdog_trips']} times",
    ]
    if served["interrupted"]:
        lines.append(
            f"in {served['interrupted']} of them the computer was too busy to correct throughout; "
            "they are in the table as they were"
        )
    lines += [f"not in the tables: {k}: {v}" for k, v in found["table_left_out"].items()]
    return "\n".join(lines)


def _judged(found: Mapping[str, Any]) -> str:
    state = "champion" if found["champion"] else "not champion"
    return "\n".join(
        [
            f"3 of 3  promotion with these live runs as evidence: {state}; {found['reason']}",
            "The control is real, its machine is not. Time is simulated real time: positions are "
            "sound, jitter is not a real machine's. Nothing was tried on a real machine.",
        ]
    )


def _counts(acted: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in acted.items())
