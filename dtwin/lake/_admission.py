"""Which runs may enter the lake: names, doubles, and what contradicts what is there."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from dtwin.errors import InputError
from dtwin.lake.rows import OF_CAMPAIGN, differences, run_row
from dtwin.schema import Campaign, Run, require_name

_Rows = Mapping[str, dict[str, Any]]


def accepted(campaign: Campaign, runs: Sequence[Run]) -> dict[str, dict[str, Any]]:
    """Return the rows of runs by id."""
    require_name(campaign.name, "the campaign name")
    require_name(campaign.machine, "the machine name")
    rows = {}
    for run in runs:
        require_name(run.meta.run_id, "the run id")
        names = [require_name(group.name, "the name of a signal group") for group in run.signals]
        if len(set(names)) < len(names):
            raise InputError(
                "two groups of signals of a run have one name",
                code="signals.same_name",
                where=f"campaign {campaign.name}, run {run.meta.run_id}",
                got=", ".join(names),
                hint="name the devices apart: the group's name is the last dotted part of the "
                "file's name, or stands in the file's header",
            )
        rows[run.meta.run_id] = run_row(campaign, run)
    if len(rows) == len(runs):
        return rows
    raise InputError(
        "a run id occurs twice",
        code="ingest.duplicate_run",
        where=campaign.name,
        hint="give every run of the campaign its own id",
    )


def fresh(campaign: str, known: _Rows, rows: _Rows) -> dict[str, dict[str, Any]]:
    """Return the rows that are not in the lake.

    ``known``: its rows in the lake by run id, as they are stated now.
    ``rows``: as :func:`accepted` returned them.
    """
    changed, settings = {}, set()
    for name, row in rows.items():
        stored = known.get(name)
        if stored is None or stored["raw_sha256"] == row["content_sha256"]:
            continue
        told = differences(stored, row)
        if told:
            changed[name] = ", ".join(told)
            settings.add(_amended_by(stored, row) if len(told) == len(_anew(stored, row)) else "")
    if changed:
        shown = [f"{name} ({told})" for name, told in list(changed.items())[:5]]
        raise InputError(
            f"{len(changed)} run(s) are in the lake with other content",
            code="ingest.duplicate_run",
            where=f"campaign {campaign}",
            got="; ".join(shown)[:600],
            allowed="new run ids; raw values are never changed",
            hint=f"what was stated wrongly: dtwin amend {campaign} {(settings.pop() if len(settings) == 1 else '') or '--set …'}; other "
            "measurements: another campaign name or other run ids",
        )
    new = {name: row for name, row in rows.items() if name not in known}
    if known and new:
        stored, row = next(iter(known.values())), next(iter(new.values()))
        told = differences(stored, {**stored, **{name: row[name] for name in OF_CAMPAIGN}})
        if told:
            raise InputError(
                "the campaign is in the lake with another machine, kind, geometry or instrument",
                code="campaign.differs",
                where=f"campaign {campaign}",
                got="; ".join(told)[:600],
                hint=f"another machine or instrument: another campaign name; a mistake: dtwin amend {campaign} --set …",
            )
    return new


def _anew(stored: Mapping[str, Any], row: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a row states otherwise of its machine and instrument, by the settings of ``dtwin amend``."""
    anew: dict[str, Any] = {} if stored["machine"] == row["machine"] else {"machine": row["machine"]}
    for column, table in (("geometry_json", "machine_geometry"), ("instrument_json", "instrument")):
        was, now = json.loads(stored[column]), json.loads(row[column])
        anew |= {f"{table}.{key}": now.get(key) for key in sorted({*was, *now}) if was.get(key) != now.get(key)}
    return anew


def _amended_by(stored: Mapping[str, Any], row: Mapping[str, Any]) -> str:
    """Return the options of ``dtwin amend`` that state a row anew; empty where a value has no such form."""
    anew = _anew(stored, row)
    if any(value is None or isinstance(value, dict) for value in anew.values()):
        return ""
    return " ".join([*(f"--set '{name}={json.dumps(value)}'" for name, value in anew.items()), "--because WHY"])


def require_same_statements(campaign: Campaign, known: _Rows) -> None:
    """Refuse a folder that states its machine or instrument otherwise than when it was ingested; amended campaigns may differ.

    ``known``: rows of the campaign in the lake by run id.
    """
    stored = next((row for row in known.values() if not row["metadata_version"]), None)
    if stored is None:
        return
    stated = {
        **stored,
        "machine": campaign.machine,
        "geometry_json": json.dumps(dict(campaign.machine_geometry), default=str),
        "instrument_json": json.dumps(dict(campaign.instrument), default=str),
    }
    anew = _anew(stored, stated)
    if anew:
        raise InputError(
            "campaign.toml was changed since it was ingested, and the lake has what it stated then",
            code="campaign.differs",
            where=f"campaign {campaign.name}",
            got="; ".join(sorted(anew))[:600],
            hint=f"dtwin amend {campaign.name} {_amended_by(stored, stated) or '--set …'}; or change campaign.toml back",
        )
