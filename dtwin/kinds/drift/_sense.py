"""Which way a log reads: displacements of the tool, or positions of the machine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dtwin.errors import InputError
from dtwin.schema import Floats, Run


def sense(condition: Mapping[str, Any], where: str) -> float:
    """Return 1 for displacements of the tool, -1 for positions at which a probe triggers: the tool has moved the other way.

    Raises ``InputError`` when ``reads`` of the condition is neither.
    """
    reads = condition.get("reads", "displacement")
    if reads not in ("displacement", "position"):
        raise InputError(
            "what the log reads is not known",
            code="drift.reads",
            where=where,
            got=f"reads = {reads!r}"[:60],
            allowed='condition = { reads = "displacement" }: of the tool along its axis; "position": of the machine when a probe triggers',
        )
    return -1.0 if reads == "position" else 1.0


def moved_um(run: Run) -> Floats:
    """Return the tool's displacement of each reading, (n,)."""
    return sense(run.meta.condition, run.meta.run_id) * run.samples["displacement_um"]
