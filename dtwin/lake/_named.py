"""What the names of files of the lake say: campaign and machine."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from dtwin.lake.delta import stem_of


def names_of(told: str | Collection[str] | None) -> set[str] | None:
    """Return names that were asked for, None for all."""
    return {told} if isinstance(told, str) else None if told is None else set(told)


def campaign_named(file: str) -> str:
    """Return the campaign whose rows a file holds."""
    return stem_of(file).split("/")[0]


def of_machines(files: Sequence[str], machines: Collection[str], anew: Collection[str]) -> list[str]:
    """Return the files of runs of machines; what was stated ``anew`` of a campaign may be its machine."""
    return [f for f in files if _machine_of(f) in {*machines, None} or campaign_named(f) in anew]


def _machine_of(file: str) -> str | None:
    """Return the machine of which a campaign was ingested; None where the name of its file does not say."""
    return stem_of(file).partition("/")[2] or None
