"""From a positioning campaign to a judged bundle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.kinds.linear._bundle import deployed_bundle, printed_pair
from dtwin.kinds.linear._gates import positioning_gates
from dtwin.kinds.linear._loop import campaign_test
from dtwin.kinds.linear._models import MM_PER_IN, Averages, PositionModel, averages_of
from dtwin.kinds.linear._training import fit_pair, flanks_from, screw_of, serving_bundle
from dtwin.machines.printed_network import MAPPED_MM, PITCH_IN, read_network
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import require_new, save_bundle
from dtwin.statistics import rms
from dtwin.train.gates import Verdict


@dataclass(frozen=True)
class _Fitted:
    """A fitted equation. ``pitch_mm``: travel in one turn of the screw."""

    bundle: Bundle
    pitch_mm: float
    reach_mm: tuple[float, float]
    figures: Mapping[str, Any]


def fitted(campaign: Path | None, model: str, seed: int) -> _Fitted:
    """Fit an equation to a positioning campaign.

    ``campaign``: campaign folder; None for the printed networks.
    ``model``: ``flanks``, ``pair`` or ``printed``.
    Raises ``InputError`` when the campaign has too few targets in a turn of the screw, or none at whole turns.
    """
    if campaign is None or model == "printed":
        network = read_network()
        bundle = deployed_bundle(printed_pair(network), "lathe-printed", "published-lathe")
        return _Fitted(bundle, PITCH_IN * MM_PER_IN, MAPPED_MM, {"from": network.source})
    machine, test = campaign_test(campaign)
    averages = averages_of(test)
    screw = screw_of(test, str(campaign))
    pair = fit_pair(averages, screw, seed)
    chosen = pair if model == "pair" else flanks_from(pair, averages, screw)
    equation = serving_bundle(chosen, machine, screw, test.axis)
    assert equation is not None
    figures = _figures(chosen, averages, screw.phases)
    return _Fitted(equation, screw.pitch_mm, screw.reach_mm, figures)


def judged(made: _Fitted) -> list[Verdict]:
    """Return what the gates say of a fitted equation."""
    return positioning_gates(made.bundle, made.pitch_mm, made.reach_mm)


def write_judged(made: _Fitted, verdicts: Sequence[Verdict], out: Path, *, force: bool = False) -> bool:
    """Write a bundle with what the gates said in its provenance; return True.

    Raises ``InputError`` when the file is there.
    """
    require_new(out, force=force)
    provenance = replace(made.bundle.provenance, gates={v.gate: v.passed for v in verdicts})
    save_bundle(replace(made.bundle, provenance=provenance), out)
    return True


def _figures(model: PositionModel, averages: Averages, phases: int) -> dict[str, Any]:
    direction, position, error = averages.stacked()
    rest: Floats = error - model.error_um(direction, position)
    return {
        "targets": len(averages.position_mm),
        "screw_phases": phases,
        "rms_left_um": round(rms(rest), 3),
        "largest_left_um": round(float(np.max(np.abs(rest))), 3),
    }
