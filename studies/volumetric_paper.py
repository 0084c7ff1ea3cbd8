"""What the source of the volumetric machine reports, beside what the virtual machine gives."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from dtwin.config import Home
from dtwin.kinds.volumetric._session import Session, session
from dtwin.kinds.volumetric._simulate import parameters_of, simulate_volumetric
from dtwin.progress import Progress
from studies.heat import judged, models_of, with_offered
from studies.paper_line import Line, by_what_is_left, left_open, worst, yes_or_no

# Printed pairs before, after, and the printed reduction in per cent.
PRINTED = (
    ("training (in-sample), distances, range", 101.0, 33.0, 68.0),
    ("training (in-sample), distances, RMS", 9.7, 2.5, 74.0),
    ("validation, distances, range", 82.0, 33.0, 59.0),
    ("validation, distances, RMS", 7.5, 2.9, 61.0),
    ("slots, mean range", 57.5, 29.5, 49.0),
    ("slots, largest range", 112.0, 54.0, 52.0),
)
_CAUSE = "coolant_tank_c"


def volumetric_paper(seed: int, progress: Progress, *, quick: bool = False, truth: str = "surface") -> list[Line]:
    """Measure both campaigns of the virtual machine, fit to one, judge on the other.

    ``seed``: of the machine.
    ``progress``: called with (done, total, what).
    ``quick``: every third cycle.
    ``truth``, surface or pockets: where the thermocouples sit.
    """
    with tempfile.TemporaryDirectory() as scratch:
        home = Home(Path(scratch) / "home")
        found = []
        for name in ("training", "validation"):
            folder = Path(scratch) / name
            simulate_volumetric(
                folder, progress, schedule=name, seed=seed, quick=quick, parameters=parameters_of(truth)
            )
            found.append(session(home, str(folder), progress))
        training, validation = found
        models, _ = models_of(training)
        own, other = judged(models, training), judged(models, validation, training)
        lines, cause = _lines(own, other), _cause_line(other, training, validation)
    if quick:
        # A third of the cycles gives other models.
        lines = left_open(lines)
    return [*lines, cause]


def _lines(own: dict[str, Any], other: dict[str, Any]) -> list[Line]:
    out = []
    for what, result, key in (
        ("training (in-sample), distances", own, "rms"),
        ("training (in-sample), distances", own, "p2p"),
        ("validation, distances", other, "rms"),
        ("validation, distances", other, "p2p"),
    ):
        label = f"{what}, {'RMS' if key == 'rms' else 'range'}"
        _, before, after, printed = next(p for p in PRINTED if p[0] == label)
        d = result["distances"]
        out.append(
            Line(
                f"{label}, µm",
                f"{before:g} -> {after:g} (-{printed:g} %)",
                f"{d[f'{key}_um']:z.1f} -> {d[f'{key}_left_um']:z.1f} (-{d[f'{key}_reduction_pct']:z.0f} %)",
                by_what_is_left(d[f"{key}_left_um"] / d[f"{key}_um"], after / before),
            )
        )
    rows = own["coefficients"]
    inputs = sorted(len(row["sensors"]) for row in rows)
    memory = sum(row["memory"] > 0 for row in rows)
    return [
        *out,
        _slot_line(other),
        Line(
            "temperatures for one error motion",
            "2 to 5",
            f"{inputs[0]} to {inputs[-1]}, median {inputs[len(inputs) // 2]}",
            yes_or_no(inputs[0] >= 2 and inputs[-1] <= 5),
        ),
        Line("error motions with memory", "2 of 24", f"{memory} of {len(rows)}", by_what_is_left(memory, 2)),
        _worse_line(other),
    ]


def _slot_line(other: dict[str, Any]) -> Line:
    slots = other["slots"]
    what = "slots in 15 h, mean and largest range, µm"
    if slots is None:
        ours = "not computed: cycles are not hourly"
        return Line(what, "57.5 -> 29.5, 112 -> 54", ours, "not judged")
    return Line(
        what,
        "57.5 -> 29.5, 112 -> 54",
        f"{slots['mean_range_um']:z.1f} -> {slots['mean_range_left_um']:z.1f}, "
        f"{slots['max_range_um']:z.0f} -> {slots['max_range_left_um']:z.0f}",
        worst(
            [
                by_what_is_left(slots["mean_range_left_um"] / slots["mean_range_um"], 29.5 / 57.5),
                by_what_is_left(slots["max_range_left_um"] / slots["max_range_um"], 54.0 / 112.0),
            ]
        ),
    )


def _worse_line(other: dict[str, Any]) -> Line:
    worse = [f"{x['line']}{x['direction']}" for x in other["lines"] if x["worse_h"]]
    what = "lines and directions that short jobs see get worse"
    return Line(what, "X line in Y, 1 to 2 h", ", ".join(worse) or "none", "not judged")


def _cause_line(other: dict[str, Any], training: Session, validation: Session) -> Line:
    """Return whether the cause that was put into the machine is found among the logged channels."""
    what, paper = "EXZ1, squareness of Z to X", "13 % explained, no cause named"
    found = next((x for x in other["unexplained"] if x["name"] == "EXZ1"), None)
    if found is None or found["cause"] is None:
        said = "explained by thermocouples" if found is None else "not explained, no cause named"
        return Line(what, paper, said, "does not" if found is None else "follows")
    offered, _ = models_of(training, offered=(found["cause"],))
    again = judged(offered, with_offered(validation, (found["cause"],)))
    row = next(r for r in again["coefficients"] if r["name"] == "EXZ1")
    return Line(
        what,
        paper,
        f"not explained; named of {len(found['tried'])} logged channels: {found['cause']} (true: {_CAUSE}); "
        f"with it {row['rms_reduction_pct']:z.0f} % in validation",
        "easier here" if found["cause"] == _CAUSE else "does not",
    )
