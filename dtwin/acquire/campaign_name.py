"""What a user calls a campaign: its name in the lake, or where it lies."""

from __future__ import annotations

import os
from pathlib import Path

from dtwin.config import Home
from dtwin.lake.store import Lake


def in_lake(home: Home, campaign: str) -> str:
    """Return the name of a campaign in the lake; a file or folder is ingested first.

    Raises ``InputError`` where a folder beside is of that name, too, and states machine or instrument otherwise than the lake.
    """
    if campaign in Lake(home.lake).campaigns():
        if (Path(campaign) / "campaign.toml").is_file():
            from dtwin.acquire.campaign_folder import open_campaign

            folder = open_campaign(Path(campaign)).campaign
            if folder.name == campaign:
                Lake(home.lake).require_same_statements(folder)
    elif os.path.exists(campaign):  # noqa: PTH110 - False, too, where a name is too long for a path
        # Readers of every kind, and numba: not for a campaign that is there.
        from dtwin.acquire.ingest import ingest

        return ingest(Path(campaign), Lake(home.lake)).campaign
    return campaign
