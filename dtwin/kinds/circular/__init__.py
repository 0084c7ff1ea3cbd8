"""Circles by ball bar: the record of the kind and its dynamics."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dtwin.offered import offered

if TYPE_CHECKING:
    from dtwin.kinds.circular._dynamics import split_campaign as split_campaign
    from dtwin.kinds.circular._dynamics_report import dynamics_page as dynamics_page
    from dtwin.kinds.circular._dynamics_report import dynamics_text as dynamics_text
    from dtwin.kinds.circular._dynamics_ways import TWIN_EFFECTS as TWIN_EFFECTS
    from dtwin.kinds.circular._dynamics_ways import DynamicsRequest as DynamicsRequest
    from dtwin.kinds.circular._particle_swarm import SwarmSettings as SwarmSettings
    from dtwin.kinds.circular._physics_fit import PhysicsFit as PhysicsFit

_PLACES = {
    "_dynamics": "split_campaign",
    "_dynamics_report": "dynamics_page dynamics_text",
    "_dynamics_ways": "DynamicsRequest TWIN_EFFECTS",
    "_particle_swarm": "SwarmSettings",
    "_physics_fit": "PhysicsFit",
}
__all__ = " ".join(_PLACES.values()).split()
__getattr__ = offered(__name__, _PLACES)
