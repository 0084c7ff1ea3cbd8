"""What is exported, how, and what came of it; the heads of exported equations."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dtwin.physics.twin import Twin
from dtwin.serve.bundle import Bundle
from dtwin.serve.export_plc import NOT_RUN
from dtwin.serve.graph_code import identifier

UNREGISTERED = "not registered"


@dataclass(frozen=True)
class Source:
    """What is exported.

    ``state``: ``champion``, ``trial``, ``candidate`` ... and whether it is for a trial only.
    ``twin``: the twin behind it, reduced to what it corrects.
    ``version``: in the model registry, or that it is not there; a bundle learns it by promotion only.
    """

    bundle: Bundle
    state: str
    twin: Twin | None
    version: str = UNREGISTERED


@dataclass(frozen=True)
class Request:
    """How it is written.

    ``form``: one of ``FORMATS`` in ``dtwin.lifecycle.export``.
    ``travel_mm``: of the tables; the largest measured radius to both sides without.
    ``origin_mm``: centre of the measured circles in the coordinates of the machine or program.
    ``tolerance_um``: of the chords of a compensated program.
    """

    form: str
    axis: str = ""
    travel_mm: tuple[float, float] | None = None
    origin_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    points: int | None = None
    program: Path | None = None
    tolerance_um: float = 0.1


@dataclass(frozen=True)
class Export:
    """A written form.

    ``figures``: rows, interpolation error and the like.
    ``left_out``: effects that this form cannot hold, and why.
    ``twin_version``, ``machine``: of the twin that was written without a registered correction.
    """

    text: str
    figures: Mapping[str, Any] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    twin_version: int | None = None
    machine: str = ""


# Controls read ASCII, or one of many other alphabets.
_UNSAFE = re.compile(r"[^\w .,:+\-/^]", re.ASCII)
_SMALL = 0.1


def commented(said: Sequence[str], first: str, last: str) -> str:
    """Return lines as comments, with the remark that the form never ran on a controller.

    ``first``, ``last``: what begins and ends a comment.
    """
    return "".join(f"{first}{line}{last}\n" for line in [*said, NOT_RUN])


def whose(bundle: Bundle, version: str, state: str) -> list[str]:
    """Return which correction a file holds, without characters that end a comment."""
    lines = [
        f"dtwin: {bundle.name} for machine {bundle.machine}, version {version}, state {state}",
        f"model {bundle.model_sha256}",
    ]
    return _safe(lines)


def _safe(lines: Sequence[str]) -> list[str]:
    return [_UNSAFE.sub("?", line.replace("µm", "um")) for line in lines]


def said_of(bundle: Bundle, version: str, state: str) -> list[str]:
    """Return what stands at the head of an equation, without characters that end a comment."""
    lines = whose(bundle, version, state)
    for o in bundle.outputs:
        meaning = "predicted error, apply with its sign changed" if o.role == "error" else "correction"
        lines.append(f"output {o.name}, {o.unit}, along {o.frame}: {meaning}")
    lines.append("inputs in this order, valid in these ranges, outside of which nothing may be corrected:")
    lines += [f"  {i.name}, {i.unit}: {_range(i.low, i.high)}" for i in bundle.inputs]
    lines += [f"state {s.name}, {s.unit}, begins at {s.initial!r}" for s in bundle.states]
    return _safe(lines)


def _range(low: float, high: float) -> str:
    """Return a range in five digits of its larger end: the margin that a box has for rounding is none of the measurement."""
    digits = 4 - math.floor(math.log10(max(abs(low), abs(high), _SMALL)))
    return " to ".join(f"{round(end, digits):z.10g}" for end in (low, high))


def c_header(said: Sequence[str], bundle: Bundle, code: str) -> str:
    """Return C code as a header that can be included twice, with a test of the valid ranges.

    ``code``: from ``to_c``.
    """
    guard = f"DTWIN_{identifier(bundle.name).upper()}_H"
    symbol = f"dtwin_{identifier(bundle.name).strip('_').lower()}"
    boxes = {i.name: (i.low, i.high) for i in bundle.inputs}
    tests = [
        f"in[{n}] >= {boxes[name][0]!r} && in[{n}] <= {boxes[name][1]!r}" for n, name in enumerate(bundle.tick_inputs)
    ]
    inside = " &&\n         ".join(tests) or "1"
    return "\n".join(
        [
            "/*",
            *(f" * {line}" for line in said),
            " */",
            f"#ifndef {guard}",
            f"#define {guard}",
            code.replace(f"\nvoid {symbol}(", f"\nstatic inline void {symbol}(").rstrip(),
            "",
            f"static inline int {symbol}_inside(const double *in) {{",
            f"  return {inside};",
            "}",
            "",
            "#endif",
            "",
        ]
    )
