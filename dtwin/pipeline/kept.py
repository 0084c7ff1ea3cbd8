"""What was made of the runs of a campaign, kept in a file until they change."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from dtwin import __version__
from dtwin.config import Home
from dtwin.documents import read_document, write_document
from dtwin.errors import StoreError
from dtwin.lake.store import Lake
from dtwin.machine_record import tolerances_of
from dtwin.report.checking import campaign_sheet
from dtwin.schema import require_name


def stamp_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a hash of rows of the lake's table of runs: what they hold, and what was stated anew."""
    said = "".join(f"{row['content_sha256']} {row['metadata_version']}" for row in rows)
    return hashlib.sha256(said.encode()).hexdigest()


def kept(home: Home, what: str, campaign: str, stamp: str, make: Callable[[], Any]) -> Any:
    """Return what was made of the runs of a campaign: from its file when nothing changed since, else made now.

    Parameters
    ----------
    what : str
        Name of the folder that holds files of this sort.
    stamp : str
        Of what it is made from.
    make : callable
        Returns something JSON-ready.
    """
    found = kept_already(home, what, campaign, stamp)
    if found is None:
        found = make()
        with suppress(StoreError):  # A home that cannot be written is read all the same.
            keep(home, what, campaign, stamp, found)
    return found


def kept_already(home: Home, what: str, campaign: str, stamp: str | None = None) -> Any:
    """Return what :func:`kept` keeps; None when there is nothing, or the runs changed since.

    ``stamp``: None takes what was made of other runs too.
    """
    path = _file_of(home, what, campaign)
    try:
        found = read_document(path) if path.exists() else {}
    except StoreError:
        return None
    return found.get("made") if stamp is None or found.get("stamp") == f"{__version__} {stamp}" else None


def keep(home: Home, what: str, campaign: str, stamp: str, made: Any) -> None:
    """Keep what was made of the runs of a campaign.

    Raises
    ------
    StoreError
        When the home cannot be written.
    """
    write_document(_file_of(home, what, campaign), {"stamp": f"{__version__} {stamp}", "made": made}, what)


def _file_of(home: Home, what: str, campaign: str) -> Path:
    return home.root / "kept" / what / f"{require_name(campaign, 'the campaign')}.json"


def sheet_of_campaign(home: Home, campaign: str, machine: str, stamp: str) -> dict[str, Any]:
    """Return the test sheet of a campaign of this machine, JSON-ready.

    ``stamp``: of its runs, as ``stamp_of`` gives it.
    """
    limits = tolerances_of(home, machine)
    made: dict[str, Any] = kept(
        home, "sheets", campaign, f"{stamp} {limits}", lambda: campaign_sheet(Lake(home.lake), campaign, limits)
    )
    return made
