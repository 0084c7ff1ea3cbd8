"""Positioning along an axis: the record of the kind, and what ``dtwin lathe`` calls."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dtwin.offered import offered

if TYPE_CHECKING:
    from dtwin.kinds.linear._bundle import is_positioning_bundle as is_positioning_bundle
    from dtwin.kinds.linear._fit import fitted as fitted
    from dtwin.kinds.linear._loop import before_and_after as before_and_after
    from dtwin.kinds.linear._plan import LinearPlan as LinearPlan
    from dtwin.kinds.linear._plan import read_linear_plan as read_linear_plan
    from dtwin.kinds.linear._report import compensation_text as compensation_text
    from dtwin.kinds.linear._report import wall_clock_text as wall_clock_text
    from dtwin.kinds.linear._simulate import verification_plan as verification_plan
    from dtwin.kinds.linear._wall_clock import paced as paced

_PLACES = {
    "_bundle": "is_positioning_bundle",
    "_fit": "fitted",
    "_loop": "before_and_after",
    "_plan": "LinearPlan read_linear_plan",
    "_report": "compensation_text wall_clock_text",
    "_simulate": "verification_plan",
    "_wall_clock": "paced",
}
__all__ = " ".join(_PLACES.values()).split()
__getattr__ = offered(__name__, _PLACES)
