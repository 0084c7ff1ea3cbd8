"""Commands about machines: what is known of one, its tests, twins and models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dtwin.commands._effects import Paths
from dtwin.commands._output import Json, Report, ReportLanguage, emit, require_report
from dtwin.config import home
from dtwin.errors import InputError
from dtwin.report.text import series_cells, table
from dtwin.units import shown_number

if TYPE_CHECKING:
    from dtwin.machine_record import MachineRecord

Name = Annotated[str, typer.Argument(help="The machine, as campaigns name it.")]

_FORMS = "SYMBOL=10, SYMBOL=-5:5, X:travel_mm=500,pitch_mm=10 or X:low_mm=-250,high_mm=250"
app = typer.Typer(name="machine", no_args_is_help=True, help="What is known of a machine, and what happened to it.")


@app.command()
def add(
    name: Name,
    type: Annotated[str | None, typer.Option(help="What it is, such as a 3-axis mill.")] = None,
    serial: Annotated[str | None, typer.Option(help="Serial number.")] = None,
    chain: Annotated[str | None, typer.Option(help="Axes from the workpiece to the tool, such as w-Y-X-b-Z-t.")] = None,
    controller: Annotated[str | None, typer.Option(help="Control and its version.")] = None,
    instruments: Annotated[
        str | None, typer.Option(help="What measures it, such as ball-bar QC20-W, laser XL-80.")
    ] = None,
    notes: Annotated[str | None, typer.Option(help="Anything else.")] = None,
    axis: Annotated[
        list[str] | None,
        typer.Option(
            help="AXIS:travel_mm=500,pitch_mm=10, or with its limits, low_mm=-250,high_mm=250; may be repeated."
        ),
    ] = None,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(
            help="SYMBOL=LARGEST or SYMBOL=LOW:HIGH in µm, such as 'G(b)=10', of rotary axes in seconds of arc, 'rotary:A=8'; one number limits the size of D. SYMBOL= takes it back."
        ),
    ] = None,
    test_every: Annotated[float | None, typer.Option(help="Days between two tests; 0 takes it back.")] = None,
    as_json: Json = False,
) -> None:
    """State what is known of a machine, or state it anew; what is not given stays."""
    from dtwin.machine_record import keep_record, record_file

    stated = {
        "type": type,
        "serial": serial,
        "chain": chain,
        "controller": controller,
        "instruments": instruments,
        "notes": notes,
        "axes": dict(map(_axis, axis or [])),
        "tolerances": dict(map(_tolerance, tolerance or [])),
        "test_every_days": test_every,
    }
    record = keep_record(home(), name, {key: value for key, value in stated.items() if value is not None})
    where = record_file(home(), name)
    emit({"machine": name, **record.as_dict()}, lambda: f"{_record_text(record)}\nkept in {where}", as_json=as_json)


@app.command()
def event(
    name: Name,
    what: Annotated[str, typer.Argument(help="repair, crash, moved, compensated or other.")],
    on: Annotated[str, typer.Option(help="Day, such as 2026-11-02; else today.")] = "",
    note: Annotated[str, typer.Option(help="What was done or seen.")] = "",
    take_back: Annotated[bool, typer.Option("--take-back", help="It did not happen: remove the note of it.")] = False,
    as_json: Json = False,
) -> None:
    """Note what happened to a machine, so that its history can be read; or take such a note back."""
    from dtwin.machine_record import with_event, without_event
    from dtwin.pipeline.machine_history import champion_of, require_machine

    require_machine(home(), name)
    record = (without_event if take_back else with_event)(home(), name, what, on, note)
    champion = champion_of(home(), name)
    told = f"\nchampion: {champion}" if champion else ""
    emit({"machine": name, **record.as_dict()}, lambda: _record_text(record) + told, as_json=as_json)


@app.command()
def remove(name: Name, as_json: Json = False) -> None:
    """Delete a machine that was not measured, as one whose name was mistyped."""
    from dtwin.pipeline.machine_history import drop_machine

    drop_machine(home(), name)
    emit({"removed": name}, lambda: f"machine {name} is removed", as_json=as_json)


@app.command("list")
def list_machines(as_json: Json = False) -> None:
    """List machines that have a record or a campaign."""
    from dtwin.pipeline.home_catalogue import twin_lines
    from dtwin.pipeline.machine_history import alarms_of, machine_overviews

    twins = twin_lines(home())
    told = [m | {"alarms": alarms_of(home(), m["machine"], twins)} for m in machine_overviews(home(), None, twins)]
    rows = [
        [m["machine"], m["type"] or "-", len(m["campaigns"]), m["last_test"] or "-", len(m["twins"]), m["alarms"]]
        for m in told
    ]
    head = ("machine", "type", "campaigns", "last test", "twins", "alarms")
    fresh = ["not judged: dtwin machine show NAME, or dtwin fleet nightly"]
    more = fresh if any(m["alarms"] == "not judged" for m in told) else []
    emit(
        {"machines": told}, lambda: "\n".join([table(head, rows), *more]) if rows else "no machine yet", as_json=as_json
    )


@app.command()
def show(
    name: Name,
    ics: Annotated[Path | None, typer.Option(help="Write the next test to this calendar file.")] = None,
    html: Report = None,
    language: ReportLanguage = "en",
    as_json: Json = False,
) -> None:
    """Show a machine: what is known of it, its tests, what changed from test to test, and when the next one is due."""
    from datetime import UTC, datetime

    from dtwin.atomic import write_text
    from dtwin.commands._output import ProgressLine
    from dtwin.pipeline.machine_history import machine_history, other_series, with_sheets
    from dtwin.pipeline.machine_report import machine_report
    from dtwin.pipeline.machine_series import calendar_of
    from dtwin.report.pdf import write_document

    require_report(html, language)
    history = machine_history(home(), name, ProgressLine("figures", quiet=as_json))
    if html is not None:
        write_document(html, machine_report(history, language), "the report")
    if ics is not None:
        if not history["next_test"]:
            raise InputError(
                "no next test is known",
                code="machine.next_test",
                where=name,
                hint="dtwin ingest a test of it, from which the days count"
                if history["test_every_days"]
                else f"dtwin machine add {name} --test-every 30",
            )
        write_text(ics, calendar_of(name, history["next_test"], datetime.now(UTC)), "the calendar file")
    shown = with_sheets(home(), history) | {"others": other_series(home(), history)} if as_json else history
    emit(shown, lambda: _history_text(history), as_json=as_json)


@app.command()
def diagnose(
    name: Name,
    campaign: Annotated[
        list[str] | None, typer.Option(help="A test of it; may be repeated. The newest of each sort without.")
    ] = None,
    effects_path: Paths = None,
    as_json: Json = False,
) -> None:
    """Compare tests of a machine by several instruments: what they agree on, and which of two names is right."""
    from dtwin.commands._effects import library_with
    from dtwin.commands._output import ProgressLine
    from dtwin.pipeline.machine_joint import machine_joint

    progress = ProgressLine("tests", quiet=as_json)
    diagnosis = machine_joint(home(), name, campaign or (), progress, library_with(effects_path))
    emit(diagnosis, lambda: _joint_text(diagnosis), as_json=as_json)


@app.command("next")
def next_test(
    name: Name,
    kind: Annotated[list[str] | None, typer.Option(help="Kind of test that can be made; may be repeated.")] = None,
    minutes: Annotated[float | None, typer.Option(min=1.0, help="Longest time, mounting included.")] = None,
    out: Annotated[Path | None, typer.Option(help="Write the plan file of the first one here.")] = None,
    effects_path: Paths = None,
    as_json: Json = False,
) -> None:
    """Say which test tells most about a machine for its time, after what was measured."""
    from dtwin.atomic import write_toml
    from dtwin.commands._effects import library_with
    from dtwin.commands._output import ProgressLine
    from dtwin.pipeline.machine_next import machine_next

    progress = ProgressLine("tests", quiet=as_json)
    advice = machine_next(home(), name, kind or (), minutes, progress, library_with(effects_path))
    if out is not None:
        advice["plan_file"] = str(write_toml(out, advice["tests"][0]["document"], "the plan file"))
    emit(advice, lambda: _next_text(advice), as_json=as_json)


def _next_text(advice: Mapping[str, Any]) -> str:

    head = ("test", "kind", "minutes", "bits", "bits per hour", "tells (k = 2)")
    rows = [
        [
            t["name"],
            t["kind"],
            round(t["minutes"]),
            shown_number(t["bits"], 2),
            shown_number(60 * t["bits_per_minute"], 2),
            _told_text(t["told"]),
        ]
        for t in advice["tests"]
    ]
    lines = [f"measured: {', '.join(advice['measured']) or 'nothing yet'}", *_passed_over(advice)]
    if advice["measured"]:
        lines.append(f"found, and not told apart: {_listed([' or '.join(group) for group in advice['unclear']])}")
        lines.append(f"not told by that, alone or beside others that look alike: {_listed(advice['untold'])}")
    lines += ["", table(head, rows)]
    if "plan_file" in advice:
        lines.append(f"\nplan of the first: {advice['plan_file']} (dtwin plan {advice['plan_file']})")
    return "\n".join(lines)


def _told_text(told: Sequence[Mapping[str, Any]]) -> str:
    from dtwin.units import shown_unit

    most = [
        f"{g['cause']} ± {shown_number(g['before'], 2)} → {shown_number(g['after'], 2)} {shown_unit(g['unit'])}"
        for g in told[:2]
    ]
    return ", ".join(most) + (f" and {len(told) - 2} more" if len(told) > 2 else "")


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "") or "nothing"


def _joint_text(diagnosis: Mapping[str, Any]) -> str:

    rows = [
        [
            t["started"][:10] or "-",
            t["campaign"],
            t["kind"],
            "; ".join(" or ".join(group) for group in t["found"]) or "-",
        ]
        for t in diagnosis["tests"]
    ]
    lines = diagnosis["lines"] or ["no test sees what another one found"]
    return "\n".join([table(("day", "test", "kind", "found by itself"), rows), *_passed_over(diagnosis), "", *lines])


def _passed_over(history: Mapping[str, Any]) -> list[str]:
    return [f"passed over: {name}: {why}" for name, why in history["passed_over"].items()]


def _axis(text: str) -> tuple[str, dict[str, float]]:
    axis, _, rest = text.partition(":")
    if not axis.isalnum():
        raise InputError("an axis has no such name", code="machine.axis", got=text[:80], allowed=_FORMS)
    pairs = [part.partition("=") for part in rest.split(",") if part]
    return axis, {key.strip(): _number(value, text) for key, _, value in pairs}


def _tolerance(text: str) -> tuple[str, Any]:
    symbol, _, bounds = text.rpartition("=")
    low, colon, high = bounds.partition(":")
    if not colon:
        return symbol, _number(low, text) if low.strip() or not symbol else None
    pairs = (("low", low), ("high", high))
    return symbol, {name: _number(value, text) for name, value in pairs if value.strip()}


def _number(text: str, where: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError("not a number", code="machine.number", where=where, got=text[:40], allowed=_FORMS) from None


def _record_text(record: MachineRecord) -> str:
    from dtwin.kinds.registry import unit_of_limit
    from dtwin.units import shown_unit

    lines = [record.name, *(f"  {name}: {value}" for name, value in record.facts.items())]
    for axis, known in record.axes.items():
        lines.append(_axis_line(axis, known))
    if record.test_every_days:
        lines.append(f"  tested every {record.test_every_days:g} days")
    lines += [
        f"  {symbol} {limits} {shown_unit(unit_of_limit(symbol))}" for symbol, limits in record.tolerances.items()
    ]
    lines += [f"  {e.on.isoformat()} {e.what}" + (f": {e.note}" if e.note else "") for e in record.events]
    return "\n".join(lines)


def _axis_line(axis: str, known: Mapping[str, float]) -> str:
    return f"  axis {axis}: " + ", ".join(f"{name.removesuffix('_mm')} {value:g} mm" for name, value in known.items())


def _history_text(history: Mapping[str, Any]) -> str:
    from dtwin.pipeline.machine_report import tolerance_words, until
    from dtwin.units import shown_unit

    lines = [history["machine"], *(f"  {key}: {value}" for key, value in history["facts"].items())]
    lines += [_axis_line(axis, known) for axis, known in history["axes"].items()]
    lines += [f"  {symbol} {tolerance_words(symbol, limit)}" for symbol, limit in history["tolerances"].items()]
    rows = [[e["on"], e["note"] or "-", e["what"], "-", "-", "-"] for e in history["events"]]
    rows += [
        [
            t["started"][:10],
            t["campaign"],
            t["kind"],
            ", ".join(filter(None, (t["figure"], t["condition"]))) or "-",
            f"{t['shown']} {shown_unit(t['unit'])}" if t["shown"] else "-",
            f"a copy of {t['copy_of']}" if t.get("copy_of") else t["decision"] or "-",
        ]
        for t in history["tests"]
    ]
    if rows:
        # Of one day tests stand in the order of their times.
        rows.sort(key=lambda row: row[0])
        lines += ["", table(("day", "test or note", "kind", "figure", "value", "decision"), rows)]
    if history["series"]:
        lines += ["", *_series_lines(history["series"])]
    if history["next_test"]:
        lines += ["", f"next test: {history['next_test']['on']}, {history['next_test']['why']}"]
    if known := history["known"]:
        sizes = [f"  {one['title']}: {one['size']}" for one in known["effects"]]
        of = f"what twin {known['twin']} knows (k = 2), of {', '.join(known['campaigns'])}: {until(known)}"
        lines += ["", of, *sizes]
    lines += ["", f"twins: {', '.join(history['twins']) or 'none'}", f"champion: {history['champion'] or 'none'}"]
    return "\n".join(lines)


def _series_lines(series: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what changed, and the levels of the figures that did; of steady ones the number."""
    from dtwin.pipeline.machine_series import SORTED_BY, by_size

    lines = [str(change["text"]) for change in by_size(series)]
    lines += [SORTED_BY] if len(lines) > 1 else []
    shown = [one for one in series if one["state"] in ("changed", "trend") or one["crossing"]] or series[:4]
    rows = [series_cells(one) for one in shown]
    lines += table(("figure", "state", "level", "noise floor", "since", "limit"), rows).splitlines()
    more = len(series) - len(shown)
    if more:
        lines.append(f"and {more} more figure{'s' if more > 1 else ''} without a change (--json has all)")
    return lines
