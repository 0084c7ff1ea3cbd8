"""Effects in the order in which a shop thinks of a machine."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, TypeVar

_GROUPS = {
    "geometry": (
        "angular_error gravity_sag guideway_shape joint_offset lateral_play lateral_play_taper lead_error pitch_error "
        "scale_mismatch squareness straightness"
    ),
    "drive": (
        "axis_changeover backlash backlash_taper cyclic_error cyclic_error_by_direction friction guideway_friction "
        "joint_cyclic joint_reversal reversal_spike screw_error screw_error_by_direction stick_slip worn_screw"
    ),
    "dynamics": (
        "inertial_compliance joint_compliance reversal_ringing servo_lag servo_mismatch servo_response stiffening_joint "
        "structural_mode structural_resonance tracking_delay"
    ),
    "heat": (
        "axis_expansion carriage_turning guideway_bending rigid_shift rigid_turn squareness_drift thermal_drift "
        "thermal_growth thermal_shift uneven_expansion warming_growth"
    ),
    "instrument": "centre_offset datum_offset instrument_artefact measurement_delay radius_offset",
}
_GROUP_OF = {name: group for group, names in _GROUPS.items() for name in names.split()}
OWN = "your own"


class _Named(Protocol):
    @property
    def name(self) -> str: ...


_Effect = TypeVar("_Effect", bound=_Named)


def grouped(effects: Iterable[_Effect]) -> list[tuple[str, list[_Effect]]]:
    """Return effects by group, empty groups left out; those that dtwin does not ship are the user's own."""
    effects = list(effects)
    of_group = [(g, [e for e in effects if _GROUP_OF.get(e.name, OWN) == g]) for g in (*_GROUPS, OWN)]
    return [(group, some) for group, some in of_group if some]
