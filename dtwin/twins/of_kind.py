"""The twins that suit a campaign, whatever its kind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from dtwin.acquire.campaign_name import in_lake
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named, kinds
from dtwin.lake.store import Lake
from dtwin.physics.effect import Effect
from dtwin.twins._machine_twins import MachineTwins
from dtwin.twins.machine_twin import MACHINE, MachineTwin
from dtwin.twins.several_campaigns import require_together
from dtwin.twins.shelf import kind_of

if TYPE_CHECKING:
    from dtwin.physics.twin import Twin
    from dtwin.twins.term_twins import TermTwin, TermTwins
    from dtwin.twins.verbs import Twins

AnyTwins: TypeAlias = "Twins | TermTwins[Any, Any, Any, Any] | MachineTwins"
"""Twins of a home, of one kind of campaign or of several."""
AnyTwin: TypeAlias = "Twin | TermTwin[Any] | MachineTwin"


def twins_with(home: Home, library: Mapping[str, Effect] | None, name: str) -> AnyTwins:
    """Return the twins among which one of that name is, or would be."""
    kind = kind_of(home, name)
    return MachineTwins(home, library) if kind == MACHINE else kind_named(kind).twins(home, library)


def twins_for(home: Home, library: Mapping[str, Effect], campaigns: Sequence[str]) -> tuple[AnyTwins, list[str]]:
    """Return the twins that suit campaigns, and the names of the campaigns in the lake.

    ``campaigns``: names in the lake, or files or folders, which are ingested first.
    Raises ``InputError`` when there is no such campaign, or several cannot have one twin.
    """
    if not campaigns:
        raise InputError(
            "a twin needs a campaign", code="twin.campaigns", got="none", allowed="one, or several of one machine"
        )
    names = [in_lake(home, campaign) for campaign in campaigns]
    known = [Lake(home.lake).campaign(name) for name in names]
    if len(known) > 1:
        require_together([(c.name, c.machine, c.kind) for c in known])
        # Tests of a path have one fit; others agree with them.
        if not all(kind_named(c.kind).offers("rows") for c in known):
            return MachineTwins(home, library), names
    return kind_named(known[0].kind).twins(home, library), names


def fit_twin(
    home: Home,
    library: Mapping[str, Effect],
    campaigns: Sequence[str],
    effects: Sequence[str],
    name: str,
    *,
    robust: bool = False,
) -> tuple[AnyTwins, AnyTwin]:
    """Fit a twin to campaigns of a machine, one or several, as :func:`twins_for` takes them; return it with its twins."""
    twins, names = twins_for(home, library, campaigns)
    if len(names) == 1:
        return twins, twins.fit(names[0], effects, name, robust=robust)
    # Only twins of one campaign are not of several.
    several = cast("Twins | MachineTwins", twins)
    return several, several.fit(names, effects, name, robust=robust)


def paths_of(home: Home, library: Mapping[str, Effect] | None, name: str, version: int | None = None) -> Twin:
    """Return a version of a twin of tests of a path; of one of several kinds the part that is of such tests.

    Raises ``InputError`` when there is no such twin, or it has no such test.
    """
    from dtwin.physics.twin import Twin
    from dtwin.twins.verbs import Twins

    twins = twins_with(home, library, name)
    if isinstance(twins, MachineTwins):
        for part in twins.newest(name, version).members:
            if isinstance(part, Twin):
                return part
    return Twins(home, library).newest(name, version)


def every_shelf(home: Home) -> list[AnyTwins]:
    """Return all twins of a home: those of tests of a path, and kind by kind those of others."""
    shelves = [*(kind.twins(home, None) for kind in kinds() if kind.offers("twins")), MachineTwins(home)]
    return list({shelf.kind: shelf for shelf in shelves}.values())
