"""From a positioning campaign to a judged bundle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
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
from dtwin.statistics import rms
from dtwin.train.gates import JudgedBundle


@dataclass(frozen=True)
class _Fitted(JudgedBundle):
    """A fitted equation, judged."""

    figures: Mapping[str, Any]


def fitted(campaign: Path | None, model: str, seed: int) -> _Fitted:
    """Fit an equation to a positioning campaign, and judge it.

    ``campaign``: campaign folder; None for the printed networks.
    ``model``: ``flanks``, ``pair`` or ``printed``.
    Raises ``InputError`` when the campaign has too few targets in a turn of the screw, or none at whole turns.
    """
    if campaign is None or model == "printed":
        network = read_network()
        bundle = deployed_bundle(printed_pair(network), "lathe-printed", "published-lathe")
        verdicts = positioning_gates(bundle, PITCH_IN * MM_PER_IN, MAPPED_MM)
        return _Fitted(bundle, verdicts, {"from": network.source})
    machine, test = campaign_test(campaign)
    screw = screw_of(test, str(campaign))
    averages = averages_of(test)
    pair = fit_pair(averages, screw, seed)
    chosen = pair if model == "pair" else flanks_from(pair, averages, screw)
    equation = serving_bundle(chosen, machine, screw, test.axis)
    assert equation is not None
    figures = _figures(chosen, averages, screw.phases)
    return _Fitted(equation, positioning_gates(equation, screw.pitch_mm, screw.reach_mm), figures)


def _figures(model: PositionModel, averages: Averages, phases: int) -> dict[str, Any]:
    direction, position, error = averages.stacked()
    rest: Floats = error - model.error_um(direction, position)
    return {
        "targets": len(averages.position_mm),
        "screw_phases": phases,
        "rms_left_um": round(rms(rest), 3),
        "largest_left_um": round(float(np.max(np.abs(rest))), 3),
    }
