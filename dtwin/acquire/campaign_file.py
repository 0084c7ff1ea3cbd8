"""Write ``campaign.toml``, which says what a folder's files are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dtwin.atomic import write_toml


def write_campaign_file(folder: Path, campaign: Mapping[str, Any], runs: Sequence[Mapping[str, Any]]) -> Path:
    """Write the campaign file of a folder in one step and return its path.

    Args:
        folder: Campaign folder, whose other files are there.
        campaign: The table ``[campaign]``, with its own tables.
        runs: A table ``[[run]]`` each.
    """
    content = {"campaign": campaign, "run": list(runs)}
    return write_toml(folder / "campaign.toml", content, "the campaign file")
