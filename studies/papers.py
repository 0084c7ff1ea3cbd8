"""The published systems whose figures are computed again. Bodies import late: naming them needs none of their models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from dtwin.progress import Progress


@dataclass(frozen=True)
class Paper:
    """A source.

    ``source``: who published it.
    ``compute``: called with (quick, seed, progress); returns ``lines``, JSON-ready fields of ``Line``.
    """

    source: str
    compute: Callable[[bool, int, Progress], dict[str, Any]]


def _lathe(quick: bool, seed: int, progress: Progress) -> dict[str, Any]:
    from studies import lathe_paper

    size = lathe_paper.QUICK if quick else lathe_paper.FULL
    return lathe_paper.lathe_paper(size, seed, progress)


def _turning(quick: bool, seed: int, progress: Progress) -> dict[str, Any]:
    from studies import turning_paper

    return turning_paper.turning_paper(quick=quick, seed=seed, progress=progress)


def _volumetric(quick: bool, seed: int, progress: Progress) -> dict[str, Any]:
    from studies import volumetric_paper

    lines = volumetric_paper.volumetric_paper(seed, progress, quick=quick)
    return {"lines": [asdict(line) for line in lines]}


def _dynamics(quick: bool, seed: int, progress: Progress) -> dict[str, Any]:
    from studies import dynamics_paper

    size = dynamics_paper.QUICK if quick else dynamics_paper.FULL
    return dynamics_paper.dynamics_paper(size, seed, progress)


PAPERS = {
    "lathe": Paper("J. M. Fines, MSc thesis, lathe and networks", _lathe),
    "turning": Paper("slow tool servo on a diamond turning machine", _turning),
    "volumetric": Paper("geometric and thermal errors of a mill", _volumetric),
    "dynamics": Paper("Xing, Bonev, Champliaud, Liu (2024), ball bar and filter", _dynamics),
}


def computed(name: str, *, quick: bool, seed: int, progress: Progress) -> dict[str, Any]:
    """Compute the figures of a source again.

    ``name``: a key of ``PAPERS``.
    ``quick``: less of everything.
    ``seed``: of everything random.
    ``progress``: called with (done, total, what).
    """
    return PAPERS[name].compute(quick, seed, progress)
