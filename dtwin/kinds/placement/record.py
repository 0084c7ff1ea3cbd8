"""Placements of parts by a robot: where each was put, and what a rule flagged."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from dtwin.kinds.kind import Kind
from dtwin.units import shown_number

if TYPE_CHECKING:
    from dtwin.schema import Finding, Floats, Run


_LEAST_UM, _MOST_UM = 1.0, 1e5
"""Between these lies the largest error of a robot that places parts."""
_FEWEST, _TIMES_USUAL = 5, 20.0
"""Placements that tell what is usual, and how many times that one lies off that is none of them."""


class _Placement(Kind):
    name = "placement"
    columns = ("t_s", "error_x_um", "error_y_um")

    def judge_run(self, run: Run) -> list[Finding]:
        from dtwin.acquire.quality import judge_clock, judge_flagged

        # Placements are events: minutes between them are no lost samples.
        clock = [finding for finding in judge_clock(run) if finding.code != "clock.dropout"]
        return [*clock, *judge_flagged(run), *_sizes(run)]

    def training_obstacle(self, rows: Sequence[Mapping[str, Any]]) -> str:
        return "placements train no equation"


def _sizes(run: Run) -> list[Finding]:
    """Return what errors of another unit look like, and a direction that was not measured."""
    from dtwin.schema import Finding

    errors = {name: run.samples[name] for name in _Placement.columns if name.startswith("error_")}
    by_way = {name: float(abs(values).max()) for name, values in errors.items()}
    largest = max(by_way.values())
    few = len(run.samples["t_s"]) < _FEWEST
    other = {
        n: most
        for n, most in by_way.items()
        if most > _MOST_UM or (0.0 < most < _LEAST_UM and (not few or largest < _LEAST_UM))
    }
    if other:
        told = " and ".join(f"{shown_number(most)} µm of {name}" for name, most in other.items())
        text = (
            f"the largest error is {told}: is it another unit? A robot places within {_LEAST_UM:g} to {_MOST_UM:g} µm"
        )
        return [Finding("placement.units", "error", text, {"largest_um": largest})]
    still = [
        n for n, values in errors.items() if largest and len(values) > 1 and float(values.max()) == float(values.min())
    ]
    text = f"{' and '.join(still)} is the same at every placement: this direction was not measured"
    return [*[Finding("placement.still", "warning", text)] * bool(still), *_far(run, errors)]


def _far(run: Run, errors: Mapping[str, Floats]) -> Iterator[Finding]:
    """Yield placements that lie far off all others, which no rule flagged."""
    import numpy as np

    from dtwin.schema import Finding

    kept = np.flatnonzero(run.samples.get("flag_1", np.zeros(len(run.samples["t_s"]))) == 0.0)
    for name, values in errors.items():
        off = abs(values[kept] - np.median(values[kept])) if len(kept) >= _FEWEST else np.zeros(0)
        usual = float(np.median(off)) if off.size else 0.0
        far = kept[off > _TIMES_USUAL * usual] if usual > 0.0 else kept[:0]
        if far.size:
            text = f"{name} of row {', '.join(str(n + 1) for n in far[:5])} lies up to {shown_number(off.max(), 4)} µm off the others, half of which lie within {shown_number(usual)}: a part that slipped, or a reading of another one"
            yield Finding("placement.far", "warning", text, {"off_um": float(off.max())})


KIND = _Placement()
