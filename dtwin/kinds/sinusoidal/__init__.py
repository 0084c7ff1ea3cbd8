"""Tones: the record of the kind, and what ``dtwin turning`` calls."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dtwin.offered import offered

if TYPE_CHECKING:
    from dtwin.kinds.sinusoidal._bundle import ACTIONS as ACTIONS
    from dtwin.kinds.sinusoidal._fit import MODELS as MODELS
    from dtwin.kinds.sinusoidal._fit import fitted_tones as fitted_tones
    from dtwin.kinds.sinusoidal._fit import folder_groups as folder_groups
    from dtwin.kinds.sinusoidal._report import trial_section as trial_section
    from dtwin.kinds.sinusoidal._report import trial_text as trial_text

_PLACES = {"_bundle": "ACTIONS", "_fit": "MODELS fitted_tones folder_groups", "_report": "trial_section trial_text"}
__all__ = " ".join(_PLACES.values()).split()
__getattr__ = offered(__name__, _PLACES)
