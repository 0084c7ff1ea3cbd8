"""The twins that suit a campaign, whatever its kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from dtwin.acquire.campaign_name import in_lake
from dtwin.config import Home
from dtwin.kinds.registry import kind_named, kinds
from dtwin.lake.store import Lake
from dtwin.physics.effect import Effect
from dtwin.twins.shelf import kind_of

if TYPE_CHECKING:
    from dtwin.kinds.volumetric.twins import HeatTwins
    from dtwin.twins.verbs import Twins


def twins_with(home: Home, library: Mapping[str, Effect], name: str) -> Twins | HeatTwins:
    """Return the twins among which one of that name is, or would be."""
    return kind_named(kind_of(home, name)).twins(home, library)


def twins_for(home: Home, library: Mapping[str, Effect], campaign: str) -> tuple[Twins | HeatTwins, str]:
    """Return the twins that suit a campaign, and the name of the campaign in the lake.

    Parameters
    ----------
    campaign : str
        Name in the lake, or a file or folder, which is ingested first.

    Raises
    ------
    InputError
        When there is no such campaign.
    """
    name = in_lake(home, campaign)
    return kind_named(Lake(home.lake).campaign(name).kind).twins(home, library), name


def every_shelf(home: Home) -> list[Twins | HeatTwins]:
    """Return all twins of a home: those of tests of a path, and kind by kind those of others."""
    shelves = [kind.twins(home, None) for kind in kinds() if kind.offers("twins")]
    return list({shelf.kind: shelf for shelf in shelves}.values())
