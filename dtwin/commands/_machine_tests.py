"""Commands about the tests of a machine: plan one, measure it or wait for it, and compare it with the last one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from dtwin.commands._effects import Paths
from dtwin.commands._machine import Name
from dtwin.commands._machine import app as machine_app
from dtwin.commands._output import Json, emit
from dtwin.config import home
from dtwin.errors import InputError
from dtwin.report.text import table
from dtwin.units import shown_number


@machine_app.command()
def plan(
    name: Name,
    kind: Annotated[str | None, typer.Option(help="Kind of test; that of the last test without.")] = None,
    told: Annotated[
        list[str] | None,
        typer.Option("--set", help="SETTING=VALUE of the plan, such as radius_mm=50,100; may be repeated."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Write the plan file here.")] = None,
    effects_path: Paths = None,
    as_json: Json = False,
) -> None:
    """Plan a test of a machine: how long it takes, what it would show, and what it could not tell apart."""
    from dtwin.atomic import write_toml
    from dtwin.commands._effects import library_with
    from dtwin.pipeline.planned_tests import draft_of, foretold, with_settings

    document = with_settings(draft_of(home(), name, kind or ""), dict(map(_setting, told or [])))
    forecast = foretold(home(), document, library_with(effects_path))
    if out is not None:
        forecast["plan_file"] = str(write_toml(out, document, "the plan file"))
    emit(forecast, lambda: _foretold_text(forecast), as_json=as_json)


@machine_app.command()
def measure(
    name: Name,
    file: Annotated[
        Path | None, typer.Argument(help="Plan file (TOML); without it the plans that wait are listed.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Of a virtual machine; a fresh one where that is of noise alone.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Have a planned test measured: at once, as a flow, on a virtual machine; else the plan waits for its campaign.

    A campaign that comes in later, of the name or with all conditions of the plan, answers it, and is compared with the last
    such test of the machine.
    """
    from dtwin.pipeline.machine_history import require_machine
    from dtwin.pipeline.planned_tests import free_name, keep_plan, kept_plans, measured_by, write_plan
    from dtwin.plan_file import planned_document, read_plan_file

    if file is None:
        require_machine(home(), name)
        waiting = kept_plans(home(), name)
        emit({"machine": name, "plans": waiting}, lambda: _plans_text(name, waiting), as_json=as_json)
        return
    document = read_plan_file(file)
    planned = planned_document(document, str(file))
    if planned.summary["machine"] != name:
        raise InputError(
            "the plan is of another machine",
            code="plan.machine",
            where=str(file),
            got=str(planned.summary["machine"]),
            allowed=name,
        )
    how = measured_by(home(), document)
    if how is None:
        kept = keep_plan(home(), document)
        emit({"plan": kept, "waits": True}, lambda: _waits_text(kept, planned.kind), as_json=as_json)
        return
    from flows._runtime import delivered
    from flows._runtime import run as run_flow
    from flows.simulate import simulate_flow

    kept = free_name(home(), planned)
    machine, options, fresh = how
    with delivered():
        done = run_flow(
            simulate_flow, plan_file=file, machine=machine, options=options, seed=fresh if seed is None else seed
        )
    # Not before it was measured: a plan that is kept waits for somebody.
    write_plan(home(), document)
    emit({"plan": kept, "waits": False, **done}, lambda: _changes_text(home(), kept), as_json=as_json)


@machine_app.command()
def changes(
    name: Name,
    campaign: Annotated[
        str | None, typer.Option(help="A test of it; the newest one that has an earlier one without.")
    ] = None,
    earlier: Annotated[
        str | None, typer.Option("--with", help="The test to compare with; the last one of its kind without.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare the figures of two tests of a machine: changed, not changed, or cannot be said."""
    from dtwin.pipeline.sheet_changes import last_changes, sheet_changes

    if campaign is None and earlier is not None:
        raise InputError("with which test?", code="changes.campaign", got=f"--with {earlier}", hint="--campaign NAME")
    compared = last_changes(home(), name) if campaign is None else sheet_changes(home(), campaign, earlier or "", name)
    emit(compared, lambda: _table_text(compared), as_json=as_json)


def _setting(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals:
        raise InputError(
            "not a setting", code="plan.setting", got=text[:60], allowed="SETTING=VALUE, such as repeats=3"
        )
    return key.strip(), value


def _foretold_text(forecast: Mapping[str, Any]) -> str:
    from dtwin.units import shown_unit

    lines = [*forecast["lines"], f"and {forecast['mounting_minutes']:z.0f} min to mount the instrument"]
    lines += [f"{one['severity']}: {one['message']}" for one in forecast["findings"]]
    if forecast["detectable"] is not None:
        shown = [one for one in forecast["detectable"] if one["amplitude"] is not None]
        rows = [
            [one["label"], f"{shown_number(one['amplitude'], 2)} {shown_unit(one['unit'])}", f"{one['typical']:g}"]
            for one in shown
        ]
        head = ("effect", f"seen from (80 %, noise {forecast['noise_um']:g} µm)", "ordinary size")
        hidden = [one["label"] for one in forecast["detectable"] if one["amplitude"] is None]
        lines += ["", table(head, rows), f"not visible: {', '.join(hidden) or 'none of the others'}"]
        alike = "; ".join(", ".join(group) for group in forecast["alike"])
        lines.append(f"not told apart: {alike or 'nothing'}")
    lines.append(f"measured at once on the virtual {forecast['virtual']}" if forecast["virtual"] else "")
    if "plan_file" in forecast:
        lines.append(f"next: dtwin machine measure {forecast['machine']} {forecast['plan_file']}")
    return "\n".join(lines).rstrip()


def _waits_text(name: str, kind: str) -> str:
    file = home().plans / f"{name}.toml"
    return (
        f"{name} waits for its {kind} campaign; dtwin plan {file} --out FOLDER writes its programs where its kind has them\n"
        f"next: dtwin ingest FOLDER, of that name or with all its conditions; dtwin machine changes compares it"
    )


def _plans_text(machine: str, waiting: list[dict[str, Any]]) -> str:
    rows = [[one["made"][:16].replace("T", " "), one["name"], one["kind"], one["answer"] or "waits"] for one in waiting]
    return table(("made", "plan", "kind", "measured"), rows) if rows else f"no test of {machine} is planned"


def _changes_text(where: Any, campaign: str) -> str:
    from dtwin.pipeline.sheet_changes import sheet_changes

    try:
        return _table_text(sheet_changes(where, campaign))
    except InputError as error:
        return f"{campaign} was measured and ingested; not compared: {error.message}"


def _table_text(forecast: Mapping[str, Any]) -> str:
    from dtwin.report.changes import change_table, changes_text

    return "\n".join([*changes_text(forecast), "", table(*change_table(forecast))])
