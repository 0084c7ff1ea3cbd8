"""Ball arrays: the record of the kind, its twins, and what ``dtwin volumetric`` calls."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dtwin.offered import offered

if TYPE_CHECKING:
    from dtwin.kinds.volumetric._heat_twin import HeatTwin as HeatTwin
    from dtwin.kinds.volumetric._judging import judged as judged
    from dtwin.kinds.volumetric._judging import models_of as models_of
    from dtwin.kinds.volumetric._motions import FAMILIES as FAMILIES
    from dtwin.kinds.volumetric._page import volumetric_page as volumetric_page
    from dtwin.kinds.volumetric._text import judged_text as judged_text
    from dtwin.kinds.volumetric._thermal_model import ThermalModel as ThermalModel
    from dtwin.kinds.volumetric._training import serving_bundle as serving_bundle
    from dtwin.kinds.volumetric._twin_report import family_dict as family_dict
    from dtwin.kinds.volumetric._twin_report import family_named as family_named
    from dtwin.kinds.volumetric._twin_report import family_text as family_text
    from dtwin.kinds.volumetric._twin_report import term_table as term_table
    from dtwin.kinds.volumetric._twins import HeatComparison as HeatComparison
    from dtwin.kinds.volumetric._twins import HeatTwins as HeatTwins

_PLACES = {
    "_heat_twin": "HeatTwin",
    "_judging": "judged models_of",
    "_motions": "FAMILIES",
    "_page": "volumetric_page",
    "_text": "judged_text",
    "_thermal_model": "ThermalModel",
    "_training": "serving_bundle",
    "_twin_report": "family_dict family_named family_text term_table",
    "_twins": "HeatComparison HeatTwins",
}
__all__ = " ".join(_PLACES.values()).split()
__getattr__ = offered(__name__, _PLACES)
