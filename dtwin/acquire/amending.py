"""What was stated wrongly is stated anew, and runs are left out: as records, never in place."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from dtwin.acquire import _stated as stated
from dtwin.acquire.axis_titles import AXIS_CHOSEN
from dtwin.acquire.quality import judge_run
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.lake.rows import findings_fields, meta_of
from dtwin.lake.store import Lake
from dtwin.people import acting
from dtwin.schema import Campaign, Finding, Run, require_name, standard_plane

# Tables of a row, by the name that a setting begins with; the first two are of the campaign.
_TABLES = {
    "instrument": "instrument_json",
    "machine_geometry": "geometry_json",
    "condition": "condition_json",
    "covariates": "covariates_json",
}
_OF_CAMPAIGN = ("machine", "instrument", "machine_geometry")
_OF_RUN = ("plane", "direction", "radius_mm", "feed_mm_min", "repeat", "setup", "started")
_OF_CIRCLES = ("plane", "direction", "radius_mm")
_ALLOWED = ", ".join(["machine", *_OF_RUN, *(f"{name}.KEY" for name in _TABLES)])
_LONGEST = 500
AMENDED, _LEFT_OUT = "campaign.amended", "campaign.left_out"


def amend(
    lake: Lake, campaign: str, settings: Sequence[str], because: str, *, runs: Sequence[str] = (), who: str = ""
) -> dict[str, dict[str, Any]]:
    """State anew what was stated wrongly of runs; their quality is judged again.

    ``settings``: ``FIELD=VALUE``, named as in ``campaign.toml``; ``condition.KEY=`` takes a key away.
    ``runs``: only these; what belongs to the campaign is stated of all.
    ``who``: who says so; the user of this computer by default.

    Returns changed fields of the row by run.

    Raises ``InputError`` when a field is not one of a run, a value is not usable, or nothing would change.
    """
    told = [_setting(text) for text in settings]
    campaign_wide = [name for name, _ in told if name.split(".")[0] in _OF_CAMPAIGN]
    if runs and campaign_wide:
        raise InputError(
            "this belongs to the campaign, not to single runs",
            code="amend.runs",
            where=f"campaign {campaign}",
            got=", ".join(campaign_wide),
            hint="leave --run away",
        )
    changes: dict[str, dict[str, Any]] = {}
    rows, of = _rows(lake, campaign, runs), lake.campaign(campaign)
    for row in rows:
        where = f"campaign {campaign}, run {row['run_id']}"
        now = dict(row)
        for name, value in told:
            _require_not_read_with(name, row, where)
            now |= _changed(now, name, value, where)
        if now["geometry_json"] != row["geometry_json"]:
            now["condition_json"] = _taken_over(lake, of, row, now)
        different = {name: value for name, value in now.items() if not _alike(row[name], value)}
        if different:
            changes[row["run_id"]] = different | _judged_again(lake, of, row, now)
    if not changes:
        raise InputError(
            "nothing would change",
            code="amend.same",
            where=f"campaign {campaign}",
            got=", ".join(settings) or "no setting",
            hint=f"dtwin amend {campaign} says what was stated anew",
        )
    _record(lake, campaign, changes, because, who)
    return changes


def leave_out(lake: Lake, campaign: str, runs: Sequence[str], because: str, *, out: bool = True, who: str = "") -> None:
    """Leave runs out of every figure, twin, report and training, or bring them back.

    ``lake``, ``campaign``, ``because``, ``who``: as in :func:`amend`.
    ``out``: False brings them back.

    Raises ``InputError`` when a run is not there, or is left out, or in, already.
    """
    wrong = [r["run_id"] for r in _rows(lake, campaign, runs) if (r["left_out"] is not None) is out]
    if wrong:
        raise InputError(
            "the run is left out already" if out else "the run is not left out",
            code="amend.same",
            where=f"campaign {campaign}",
            got=", ".join(wrong),
        )
    _record(lake, campaign, {run: {"left_out": out} for run in runs}, because, who)


def amendment_findings(rows: Sequence[Mapping[str, Any]]) -> Iterator[Finding]:
    """Yield in words what was stated anew of a campaign by its rows, all of them, and which are left out, and why."""
    by_version: dict[int, list[Mapping[str, Any]]] = {}
    for row in rows:
        for record in row["amendments"]:
            by_version.setdefault(record["version"], []).append(record)
    for version, records in sorted(by_version.items()):
        first = records[0]
        names = [record["run_id"] for record in records]
        changed = json.loads(first["changes_json"])
        code = _LEFT_OUT if "left_out" in changed else AMENDED
        if code == _LEFT_OUT:
            what = "left out" if changed["left_out"] else "taken in again"
        else:
            fields = sorted({n for r in records for n in json.loads(r["changes_json"])})
            what = ", ".join(n.removesuffix("_json") for n in fields if n not in _JUDGED)
            what = f"{what} stated anew"
        shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
        yield Finding(
            code,
            "info",
            f"metadata version {version} ({first['when'][:16]}, {first['who']}): {shown} {what}, "
            f"because {first['because']}",
            {"version_1": float(version), "runs_1": float(len(names))},
        )


_JUDGED = ("findings_json", "n_errors")


def _setting(text: str) -> tuple[str, Any]:
    name, equals, written = text.partition("=")
    if not equals:
        raise InputError("this is no setting", code="amend.setting", got=text[:80], allowed="FIELD=VALUE")
    try:
        value = tomllib.loads(f"value = {written}")["value"]
    except (ValueError, RecursionError):
        value = written
    return name.strip(), value


def _taken_over(lake: Lake, of: Campaign, row: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Return the conditions of a run with what its kind takes over from the machine's geometry, as that is stated now."""
    was, geometry = (json.loads(told["geometry_json"]) for told in (row, now))
    run = lake.load(now, signals=False)
    own = {name: value for name, value in run.meta.condition.items() if name not in was or was[name] != value}
    campaign = replace(of, machine_geometry=geometry)
    done = kind_named(row["kind"]).completed(replace(run, meta=replace(run.meta, condition=own)), campaign)
    return json.dumps(dict(done.meta.condition))


def _alike(one: Any, other: Any) -> bool:
    """Return whether values of a row are the same; NaN, a rate that is not known, is the same as NaN."""
    return bool(one == other or (one != one and other != other))


def _changed(row: Mapping[str, Any], name: str, value: Any, where: str) -> dict[str, Any]:
    """Return the fields of a row that one setting states."""
    table, dot, key = name.partition(".")
    if dot and key and table in _TABLES:
        field, kind = _TABLES[table], kind_named(row["kind"])
        there = json.loads(row[field])
        if value == "":
            there.pop(key, None)
        else:
            one = {key: value}
            if table == "covariates":
                there |= stated.covariates(one, where)
            elif table == "condition":
                there |= stated.condition(one, kind, where)
            else:
                there |= stated.table(one, table, kind, where)
        if table == "condition":
            kind.require_condition(there, where)
        return {field: json.dumps(there, default=str)}
    if name in _OF_CIRCLES and not kind_named(row["kind"]).goes_round:
        raise InputError(
            f"a {row['kind']} test goes round no circle: it has no {name}",
            code="amend.kind",
            where=where,
            got=f"{name}={value}"[:120],
            allowed=", ".join(word for word in _ALLOWED.split(", ") if word not in _OF_CIRCLES),
        )
    if name == "machine":
        return {name: require_name(value, "the machine name")}
    if name == "setup":
        return {name: require_name(value, "the set-up")}
    if name == "repeat":
        return {name: stated.count(value, name, where)}
    if name == "started":
        return {name: stated.iso_time(value, name, where)}
    if name in ("radius_mm", "feed_mm_min"):
        return {name: stated.positive(value, name, where)}
    if name == "direction" and value in ("CCW", "CW"):
        return {name: value}
    if name == "plane" and row["direction"] is not None:
        plane, direction = standard_plane(str(value), row["direction"])
        return {"plane": plane, "direction": direction}
    raise InputError(
        "this cannot be stated of a run",
        code="amend.setting",
        where=where,
        got=f"{name}={value}"[:120],
        allowed=_ALLOWED + "; direction CCW or CW",
    )


def _judged_again(lake: Lake, of: Campaign, row: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """Return the findings of a run under what is stated now; those of its reader stay."""
    was = lake.load(row)
    run = replace(was, meta=meta_of(now))
    before = [*judge_run(replace(was, findings=())), *_completing(of, row, was)]
    kept = [finding for finding in was.findings if finding not in before]
    fields = findings_fields([*kept, *_completing(of, now, run), *judge_run(replace(run, findings=()))])
    return {name: value for name, value in fields.items() if row[name] != value}


def _completing(of: Campaign, row: Mapping[str, Any], run: Run) -> tuple[Finding, ...]:
    """Return what its kind finds in a run beside the geometry that a row states; nothing where that is none."""
    campaign = replace(of, machine_geometry=json.loads(row["geometry_json"]))
    try:
        return tuple(kind_named(row["kind"]).completed(replace(run, findings=()), campaign).findings)
    except InputError:
        return ()


def _require_not_read_with(name: str, row: Mapping[str, Any], where: str) -> None:
    chosen = name == "condition.axis" and any(f["code"] == AXIS_CHOSEN for f in json.loads(row["findings_json"]))
    if chosen or name in kind_named(row["kind"]).read_with:
        raise InputError(
            "the file was read with this: stated anew, it changes nothing of what was read",
            code="amend.read_with",
            where=where,
            got=name,
            hint="state it in campaign.toml under another name of the campaign, and ingest that",
        )


def _rows(lake: Lake, campaign: str, runs: Sequence[str]) -> list[dict[str, Any]]:
    lake.campaign(campaign)
    rows = lake.runs(campaign, left_out=True)
    there = {row["run_id"] for row in rows}
    unknown = sorted(set(runs) - there)
    if unknown:
        raise InputError(
            "no such run in the campaign",
            code="run.unknown",
            where=f"campaign {campaign}",
            got=", ".join(unknown)[:200],
            allowed=", ".join(sorted(there))[:400],
        )
    return [row for row in rows if not runs or row["run_id"] in runs]


def _record(lake: Lake, campaign: str, changes: Mapping[str, Mapping[str, Any]], because: str, who: str) -> None:
    reason = " ".join(because.split())
    if not reason or len(reason) > _LONGEST or not reason.isprintable():
        raise InputError(
            "say why",
            code="amend.because",
            got=repr(because[:60]),
            allowed=f"1 to {_LONGEST} printable characters",
            hint='--because "wrong master entered"',
        )
    said = {"who": who or acting(), "when": datetime.now(UTC).isoformat(timespec="seconds")}
    lake.amend(campaign, [{"run_id": r, "because": reason, "changes": c, **said} for r, c in changes.items()])
