"""The one place that knows which kind of campaign has which kind of twin."""

from __future__ import annotations

from collections.abc import Mapping

from dtwin.config import Home
from dtwin.physics.effect import Effect
from dtwin.physics.volumetric.heat_twin import KIND
from dtwin.pipeline.campaign_name import in_lake
from dtwin.pipeline.heat_twins import HeatTwins
from dtwin.pipeline.twin_shelf import kind_of
from dtwin.pipeline.twins import Twins
from dtwin.store import Lake


def twins_with(home: Home, library: Mapping[str, Effect], name: str) -> Twins | HeatTwins:
    """Return the twins among which one of that name is, or would be.

    Parameters
    ----------
    home : Home
        Where twins are kept.
    library : mapping of str to Effect
        Effects of tests of a path.
    name : str
        The twin.
    """
    return HeatTwins(home) if kind_of(home, name) == KIND else Twins(home, library)


def twins_for(
    home: Home, library: Mapping[str, Effect], campaign: str
) -> tuple[Twins | HeatTwins, str]:
    """Return the twins that suit a campaign, and the name of the campaign in the lake.

    Parameters
    ----------
    home : Home
        Of the lake, and of the twins.
    library : mapping of str to Effect
        Effects of tests of a path.
    campaign : str
        Name in the lake, or a file or folder, which is ingested first.

    Raises
    ------
    InputError
        When there is no such campaign.
    """
    name = in_lake(home, campaign)
    heat = Lake(home.lake).campaign(name).kind == KIND
    return (HeatTwins(home) if heat else Twins(home, library)), name


def every_shelf(home: Home) -> tuple[Twins, HeatTwins]:
    """Return all twins of a home, kind by kind."""
    return Twins(home), HeatTwins(home)
