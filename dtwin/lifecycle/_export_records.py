"""What is exported, how, and what came of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dtwin.physics.twin import Twin
from dtwin.serve.bundle import Bundle

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
