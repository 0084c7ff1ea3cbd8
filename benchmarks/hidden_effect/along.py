"""The making of a case along one axis: positioning tests, and tones."""

from __future__ import annotations

from dataclasses import dataclass

import axis_machine
import numpy as np
import tone_machine
from causes import Cause
from rows import FAINTEST, LOUDEST, Row

from dtwin.schema import Campaign, Run

# By number of the case; tones are read by a finer probe than positions.
_NOISES_UM = {"linear": (0.1, 0.25), "sinusoidal": (0.03, 0.1)}


@dataclass(frozen=True)
class Line:
    """Runs, and what is hidden in them, with its RMS in um."""

    campaign: Campaign
    runs: list[Run]
    hidden: tuple[Cause, ...]
    sizes: tuple[float, ...]


def line_case(row: Row, number: int, rng: np.random.Generator) -> Line:
    """Return a case of positioning tests or of tones."""
    noise_um = _NOISES_UM[row.kind][number % 2]
    names = _names(row, number, rng)
    sizes = tuple(float(noise_um * rng.uniform(FAINTEST, LOUDEST)) for _ in names)
    make = _axis if row.kind == "linear" else _tones
    campaign, runs, hidden = make(row, names, sizes, noise_um, rng)
    return Line(campaign, runs, hidden, sizes)


def _names(row: Row, number: int, rng: np.random.Generator) -> list[str]:
    if not row.hidden:
        return []
    if row.how_many == 1:
        return [row.hidden[number % len(row.hidden)]]
    names: list[str] = []
    for name in rng.permutation(row.hidden):
        alone = all(not {str(name), other} <= part for part in tone_machine.ONE_PART for other in names)
        if len(names) < row.how_many and alone:
            names.append(str(name))
    return names


def _axis(
    row: Row, names: list[str], sizes: tuple[float, ...], noise_um: float, rng: np.random.Generator
) -> tuple[Campaign, list[Run], tuple[Cause, ...]]:
    found = [axis_machine.mechanism(name) for name in names]
    campaign, runs = axis_machine.measured([act for _, act in found], sizes, noise_um, rng)
    return campaign, runs, tuple(Cause(label, 1.0) for label, _ in found)


def _tones(
    row: Row, names: list[str], sizes: tuple[float, ...], noise_um: float, rng: np.random.Generator
) -> tuple[Campaign, list[Run], tuple[Cause, ...]]:
    if row.right == "channel":
        campaign, runs = tone_machine.measured([], [], noise_um, rng, (names[0], sizes[0]))
        return campaign, runs, (Cause(names[0], 1.0),)
    faults = [tone_machine.fault(name, rng) for name in names]
    campaign, runs = tone_machine.measured(faults, sizes, noise_um, rng)
    return campaign, runs, tuple(Cause(fault.label, 1.0) for fault in faults)
