"""A machine: its record, its tests in the order of their days, its twins and its champion."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from hashlib import sha256
from typing import Any

from dtwin.config import Home
from dtwin.errors import GateRefusal, InputError
from dtwin.kinds.registry import kind_named
from dtwin.lake.rows import by_campaign, campaign_of, moved_in
from dtwin.lake.store import Lake
from dtwin.machine_record import MachineRecord, changed_since, drop_record, read_record, recorded
from dtwin.physics.effect import Effect
from dtwin.physics.library import Library
from dtwin.physics.twin import Twin
from dtwin.pipeline._test_points import add_figures, add_sizes, sizes
from dtwin.pipeline.home_catalogue import Overview, TwinLine, catalogue, twin_lines
from dtwin.pipeline.kept import kept, kept_already, sheet_of_campaign, stamp_of, variation_of
from dtwin.pipeline.machine_series import ALARMS, Point, Series, judged_series, next_test
from dtwin.progress import Progress, silent
from dtwin.report.faults import sized_effects, title_of
from dtwin.report.sheet import number_of
from dtwin.serve.pointer import resolve
from dtwin.twins.of_kind import paths_of
from dtwin.twins.verbs import Twins


def machine_overviews(
    home: Home, campaigns: Sequence[Overview] | None = None, twins: Sequence[TwinLine] | None = None
) -> list[dict[str, Any]]:
    """Return every machine that has a record or a campaign, JSON-ready, by name.

    ``campaigns``, ``twins``: the catalogue, where it was read before.
    """
    of_machine: dict[str, list[Overview]] = {name: [] for name in recorded(home)}
    for one in catalogue(home) if campaigns is None else campaigns:
        if one.used:
            of_machine.setdefault(one.machine, []).append(one)
    of_it = _by_machine(twin_lines(home) if twins is None else twins)
    return [
        _overview(home, name, {c.name for c in mine}, max((c.last for c in mine), default=""), of_it.get(name, []))
        for name, mine in sorted(of_machine.items())
    ]


def machine_history(
    home: Home,
    machine: str,
    progress: Progress = silent,
    library: Mapping[str, Effect] | None = None,
    twins: Sequence[TwinLine] | None = None,
    files: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, Any]:
    """Return what is known of a machine, its tests, and how its figures and the sizes of its faults went, JSON-ready.

    It is kept until a run, the record or a twin of the machine changes.

    ``home``: of the lake, the records, the twins and the bundles; what is made of a campaign is kept there.
    ``library``: of the effects of twins; the built-in ones without.
    ``twins``: the catalogue, where it was read before.
    ``files``: of its runs in the lake by campaign, where they were listed before.
    Raises ``InputError`` when there is neither a record nor a campaign of it.
    """
    effects = Library() if library is None else library
    mine = [twin for twin in (twin_lines(home) if twins is None else twins) if twin.machine == machine]
    stamp = _stamp(home, machine, mine, effects, files)
    made: dict[str, Any] = kept(
        home,
        "histories",
        machine,
        stamp,
        lambda: _history(home, machine, [twin.name for twin in mine], effects, progress),
    )
    return made | {"champion": champion_of(home, machine)}


def alarms_of(home: Home, machine: str, twins: Sequence[TwinLine]) -> str:
    """Return in words what the charts of a machine said when they were last drawn; they are not drawn here.

    ``twins``: the catalogue.
    """
    mine = [twin for twin in twins if twin.machine == machine]
    try:
        made = kept_already(home, "histories", machine, _stamp(home, machine, mine, Library()))
    except InputError as error:
        return error.message
    if made is None:
        return "not judged"
    states = Counter(series["state"] for series in made["series"])
    told = [f"{states[state]} {state}" for state in ALARMS if states[state]]
    return ", ".join(told) or ("steady" if states["steady"] else "-")


def _stamp(
    home: Home,
    machine: str,
    twins: Sequence[TwinLine],
    effects: Mapping[str, Effect],
    files: Mapping[str, Sequence[str]] | None = None,
) -> str:
    """Return a hash of what the history of a machine is made of."""
    record = read_record(home, machine)
    made_of = [
        "with what a twin knows, and until when",
        Lake(home.lake).files_by_campaign(machine) if files is None else files,
        None if record is None else record.as_dict(),
        [(twin.name, twin.changed) for twin in twins],
        sorted(effects),
    ]
    return sha256(repr(made_of).encode()).hexdigest()


def _history(
    home: Home, machine: str, names: Sequence[str], library: Mapping[str, Effect], progress: Progress
) -> dict[str, Any]:
    """Return the same without the champion, made anew; ``names``: its twins."""
    lake = Lake(home.lake)
    # Runs that are left out belong to the stamp of a campaign: taken in again, they change its figures.
    rows = lake.runs(left_out=True, machine=machine)
    record = record_of(home, machine, rows)
    of_campaign = by_campaign(rows)
    measured = ((name, mine) for name, mine in of_campaign.items() if not all(row["left_out"] for row in mine))
    ordered = sorted(measured, key=lambda item: (item[1][0]["started"] or "", item[1][0]["kind"]))
    shelf = Twins(home, library)
    twins = [twin for name in shelf.names(names) if (twin := _readable(shelf, name)) is not None]
    variation = variation_of(home, machine, rows)
    tests = []
    series: dict[tuple[str, ...], Series] = {}
    others: dict[tuple[str, ...], Series] = {}
    first: dict[str, str] = {}
    for done, (name, mine) in enumerate(ordered, start=1):
        kind, started, stamp = mine[0]["kind"], mine[0]["started"] or "", stamp_of(mine)
        offered = kind_named(kind).offers("sheet")
        try:
            sheet = sheet_of_campaign(home, name, machine, stamp, variation) if offered else None
        except InputError:
            # One test that states what cannot be used must not hide the others; its own page tells why.
            sheet = None
        copied = _copied(mine, name, first) if started else ""
        told = {"campaign": name, "kind": kind, "moved": [*moved_in(mine)], "started": started, "copy_of": copied}
        told["instrument"] = instrument_of(mine)
        tests.append({**told, **_headline(sheet)})
        if started and not copied:
            point = Point(name, started, 0.0, 0.0, instrument_of(mine))
            add_figures(series, others, sheet, kind, record, point)
            add_sizes(series, sizes(home, name, stamp, twins), point)
        progress(done, len(ordered), name)
    judged = judged_series([one for one in series.values() if len(one.points) > 1], record)
    last = max((row["started"] or "" for row in rows), default="")
    overview = _overview(home, machine, of_campaign, last, names)
    return {
        **overview,
        "facts": dict(record.facts),
        "test_every_days": record.test_every_days,
        "axes": record.as_dict()["axes"],
        "tolerances": record.as_dict()["tolerances"],
        "events": record.as_dict()["events"],
        "tests": tests,
        "series": judged,
        "others": [one.name for one in others.values() if len(one.points) > 1],
        "known": _known(home, library, names, tests),
        "next_test": next_test(judged, record, overview["last_test"]),
    }


def _known(
    home: Home, library: Mapping[str, Effect], names: Sequence[str], tests: Sequence[Mapping[str, Any]]
) -> dict[str, Any] | None:
    """Return what a twin says of the machine: that with the newest test of a path, of several the one with most tests.

    ``names``: its twins; ``tests``: in the order of their days.
    Returns ``last_test``: day of the newest test of the twin; ``later``: tests since, which it does not have.
    """
    order = [test["campaign"] for test in tests]
    twins: list[tuple[int, int, str, Twin]] = []
    for name in names:
        try:
            twin = paths_of(home, library, name)
        except InputError:
            continue
        days = [order.index(campaign) for campaign in twin.campaigns if campaign in order]
        twins += [(max(days), len(days), name, twin)] if days and twin.terms else []
    if not twins:
        return None
    last, _, name, twin = max(twins, key=lambda one: one[:2])
    day = tests[last]["started"][:10]
    titles = [title_of(term.label, library) for term in twin.terms]
    sizes = [{"title": title, **one} for title, one in zip(titles, sized_effects(twin), strict=True)]
    said = {"twin": name, "version": twin.version, "campaigns": list(twin.campaigns), "effects": sizes}
    return {**said, "last_test": day, "later": order[last + 1 :]}


def _copied(rows: Sequence[Mapping[str, Any]], name: str, first: dict[str, str]) -> str:
    """Return the earlier campaign whose readings all runs of this one have to the last digit: the same test, ingested twice.

    ``first``: campaigns by the hash of their samples; those of this one are added.
    """
    own = [str(row["samples_sha256"]) for row in rows if not row["left_out"]]
    copied = first[own[0]] if own and all(digest in first for digest in own) else ""
    for digest in own:
        first.setdefault(digest, name)
    return copied


def with_sheets(home: Home, history: Mapping[str, Any]) -> dict[str, Any]:
    """Return a history with the whole test sheet of every test, as ``sheet``; None where its kind has none."""
    rows = Lake(home.lake).runs(left_out=True, machine=history["machine"])
    variation, of_campaign = variation_of(home, history["machine"], rows), by_campaign(rows)

    def sheet(test: Mapping[str, Any]) -> dict[str, Any] | None:
        if not kind_named(test["kind"]).offers("sheet"):
            return None
        stamp = stamp_of(of_campaign[test["campaign"]])
        try:
            return sheet_of_campaign(home, test["campaign"], history["machine"], stamp, variation)
        except InputError:
            return None

    return {**history, "tests": [{**test, "sheet": sheet(test)} for test in history["tests"]]}


def record_of(home: Home, machine: str, rows: Sequence[Mapping[str, Any]]) -> MachineRecord:
    """Return the record of a machine, an empty one where only its runs are known.

    ``rows``: of the lake's table of runs.

    Raises ``InputError`` when there is neither a record nor a run of it.
    """
    record = read_record(home, machine)
    if record is None and not rows:
        require_machine(home, machine)
    return record or MachineRecord(machine)


def require_machine(home: Home, machine: str) -> None:
    """Raise ``InputError`` when a machine has neither a record nor a campaign."""
    known = [overview["machine"] for overview in machine_overviews(home)]
    if machine not in known:
        allowed, hint = ", ".join(known) or "none", f"dtwin machine add {machine}"
        raise InputError("no such machine", code="machine.unknown", got=machine, allowed=allowed, hint=hint)


def drop_machine(home: Home, machine: str) -> None:
    """Delete a machine that has only a record, as one whose name was mistyped.

    Raises ``InputError`` when it is not known, its record is not usable, or it was measured, has a twin, or is corrected.
    """
    require_machine(home, machine)
    read_record(home, machine)
    (overview,) = (one for one in machine_overviews(home) if one["machine"] == machine)
    if held := [*overview["campaigns"], *overview["twins"], *filter(None, [champion_of(home, machine)])]:
        raise InputError(
            "what was measured of a machine stays, and with it the machine",
            code="machine.measured",
            where=machine,
            got=", ".join(held[:3]),
            hint=f"where the name is wrong: dtwin amend {held[0]} --set machine=NAME --because REASON",
        )
    drop_record(home, machine)


def _readable(shelf: Twins, name: str) -> Twin | None:
    """Return the newest version of a twin, None when it has an effect that is not in the library here."""
    try:
        return shelf.newest(name)
    except InputError:
        return None


def instrument_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return what a campaign was measured with, as far as it is stated."""
    stated = campaign_of(rows).instrument
    return " ".join(str(stated[name]) for name in ("model", "serial") if stated.get(name))


def other_series(home: Home, history: Mapping[str, Any], name: str = "") -> list[dict[str, Any]]:
    """Return the figures of the tables that the history does not watch as its series, or the one of that name.

    The rate of false alarms is that of all figures together: they are many, so a change is seen later.
    """
    record = read_record(home, history["machine"]) or MachineRecord(history["machine"])
    series: dict[tuple[str, ...], Series] = {}
    for test in with_sheets(home, history)["tests"]:
        if test["started"] and not test["copy_of"]:
            point = Point(test["campaign"], test["started"], 0.0, 0.0, test["instrument"])
            add_figures({}, series, test["sheet"], test["kind"], record, point)
    wanted = [one for one in series.values() if one.name in ([name] if name else history["others"])]
    return judged_series(wanted, record, len(history["series"]) + len(history["others"]))


def _overview(
    home: Home, machine: str, campaigns: Iterable[str], last_test: str, twins: Sequence[str]
) -> dict[str, Any]:
    try:
        record = read_record(home, machine)
    except InputError:
        # Its own page tells why; it must not hide the others.
        record = None
    return {
        "machine": machine,
        "type": "" if record is None else record.facts.get("type", ""),
        "campaigns": sorted(campaigns),
        "last_test": last_test[:10],
        "twins": list(twins),
    }


def _headline(sheet: dict[str, Any] | None) -> dict[str, Any]:
    """Return the first figure of the condition where it is largest, and the decision of the whole sheet."""
    parts = [part for part in (sheet or {"parts": []})["parts"] if part["characteristics"]]
    if sheet is None or not parts:
        return {
            "figure": "",
            "condition": "",
            "unit": "um",
            "value_um": None,
            "expanded_um": None,
            "limit_um": None,
            "shown": "",
            "decision": "",
        }
    symbol = sheet["headline"]
    told = [(c, p) for p in parts for c in p["characteristics"] if c["symbol"] == symbol]
    told = told or [(p["characteristics"][0], p) for p in parts]
    largest, part = max(told, key=lambda pair: abs(float(number_of(pair[0], "value"))))
    shown = f"{largest['shown']['value']} {largest['shown']['expanded']}".removesuffix(" -")
    return {
        "figure": largest["symbol"],
        "condition": part["title"],
        "unit": sheet["unit"],
        f"value_{sheet['unit']}": number_of(largest, "value"),
        f"expanded_{sheet['unit']}": number_of(largest, "expanded"),
        f"limit_{sheet['unit']}": number_of(largest, "high"),
        "shown": shown,
        "decision": sheet["verdict"],
    }


def _by_machine(twins: Sequence[TwinLine]) -> dict[str, list[str]]:
    names: dict[str, list[str]] = {}
    for twin in twins:
        names.setdefault(twin.machine, []).append(twin.name)
    return names


def champion_of(home: Home, machine: str) -> str:
    """Return in words what corrects a machine, and whether it was changed since that was proved; empty for nothing."""
    try:
        served = resolve("latest", machine, home, harmless=True)
    except (InputError, GateRefusal) as error:
        if error.code == "serve.no_pointer":
            return ""
        # Its tests and their history are none the worse for that.
        return f"none can be served: {error.message}"
    changed = changed_since(home, machine, served.proved, doubtful=True) if served.proved else ""
    told = f", proved on {served.proved[:10]}; {changed}: dtwin recheck" if changed else ""
    return f"version {served.version} ({served.state}){told}"
