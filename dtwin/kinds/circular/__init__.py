"""Circles by ball bar: the record of the kind, its dynamics and the study of one recording."""

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
    from dtwin.kinds.circular._recording import Study as Study
    from dtwin.kinds.circular._recording import study_recording as study_recording
    from dtwin.kinds.circular._recording import ur10e_geometry as ur10e_geometry
    from dtwin.kinds.circular._recording_report import recording_sections as recording_sections
    from dtwin.kinds.circular._recording_report import recording_text as recording_text

_PLACES = {
    "_dynamics": "split_campaign",
    "_dynamics_report": "dynamics_page dynamics_text",
    "_dynamics_ways": "DynamicsRequest TWIN_EFFECTS",
    "_particle_swarm": "SwarmSettings",
    "_physics_fit": "PhysicsFit",
    "_recording": "Study study_recording ur10e_geometry",
    "_recording_report": "recording_sections recording_text",
}
__all__ = " ".join(_PLACES.values()).split()
__getattr__ = offered(__name__, _PLACES)
