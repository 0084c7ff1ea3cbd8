"""Motion programs of positioning tests, for controls that know nothing of the laser."""

from __future__ import annotations

from dtwin.acquire.programs import NO_DIAMETERS
from dtwin.errors import InputError
from dtwin.kinds.linear._plan import LinearPlan

CONTROLS = ("opencnc", "iso")


def laser_program(plan: LinearPlan, control: str = "opencnc") -> str:
    """Return the program of a bidirectional test.

    Each run overshoots below the start, sweeps up with a halt at every target, overshoots above the
    end and sweeps down. Before the first run the program stops so that the laser can be zeroed at
    the start; after each run there is an optional stop.

    ``control``: ``opencnc``: machine coordinates in every block and ``G04F``, as the published test used; ``iso``:
    ``G20``/``G21``, ``G04 P`` in milliseconds, ``M30``, axis in machine coordinates by ``G53``. Neither was run on a
    control.
    """
    if control not in CONTROLS:
        raise InputError(
            "no programs are written for this control",
            code="plan.control",
            got=control[:40],
            allowed=", ".join(CONTROLS),
        )
    words = _Words(plan, control)
    lines = words.head()
    for run in range(1, plan.runs + 1):
        lines += _one_run(plan, words, run)
    return "\n".join([*lines, *words.tail(), ""])


class _Words:
    """The words of one control."""

    def __init__(self, plan: LinearPlan, control: str) -> None:
        self.plan = plan
        self.iso = control == "iso"

    def head(self) -> list[str]:
        inch = self.plan.unit == "in"
        remark = [NO_DIAMETERS] if self.plan.axis == "X" else []
        if self.iso:
            return ["%", *remark, "G20" if inch else "G21", "G90 G94"]
        return [*remark, "G70" if inch else "G71", "G01G59G90G94 (modes)"]

    def tail(self) -> list[str]:
        return ["M30", "%"] if self.iso else []

    def move(self, target: float, *, with_feed: bool = False) -> str:
        feed = f"F{_number(self.plan.feed_min, whole_point=True)}"
        if self.iso:
            return f"G53 G01 {self.plan.axis}{_number(target)} {feed}"
        return f"G53{self.plan.axis}{_number(target)}{feed if with_feed else ''}"

    def dwell(self) -> str:
        seconds = self.plan.dwell_s
        return f"G04 P{seconds * 1000:z.0f}" if self.iso else f"G04F{seconds:g}"


def _one_run(plan: LinearPlan, words: _Words, run: int) -> list[str]:
    low, high = plan.start - plan.overshoot, plan.end + plan.overshoot
    lines = [words.move(plan.start, with_feed=True)] if run == 1 else []
    lines += [words.move(low, with_feed=True), words.dwell()]
    lines += [words.move(plan.start, with_feed=True)]
    lines.append("M00 (zero the laser)" if run == 1 else words.dwell())
    lines.append(f"(run {run} of {plan.runs})")
    for target in plan.targets[1:]:
        lines += [words.move(target), words.dwell()]
    lines += [words.move(high), words.dwell()]
    for target in reversed(plan.targets):
        lines += [words.move(target), words.dwell()]
    return [*lines, f"M01 (end of run {run})"]


def _number(value: float, *, whole_point: bool = False) -> str:
    """Return a number as controls read it: always with its point, no needless zeros."""
    text = f"{value:z.6f}".rstrip("0")
    if text.endswith(".") and not whole_point:
        text += "0"
    return text
