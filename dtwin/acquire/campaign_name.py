"""What a user calls a campaign: its name in the lake, or where it lies."""

from __future__ import annotations

from pathlib import Path

from dtwin.config import Home
from dtwin.lake.store import Lake


def in_lake(home: Home, campaign: str) -> str:
    """Return the name of a campaign in the lake; a file or folder is ingested first."""
    if campaign not in Lake(home.lake).campaigns() and Path(campaign).exists():
        # Readers of every kind, and numba: not for a campaign that is there.
        from dtwin.acquire.ingest import ingest

        return ingest(Path(campaign), Lake(home.lake)).campaign
    return campaign
