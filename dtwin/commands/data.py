"""Commands about measurements: examples, check, ingest, runs, plan."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dtwin.commands.output import ProgressLine, emit
from dtwin.commands.record import run_text
from dtwin.errors import InputError
from dtwin.report.text import table

if TYPE_CHECKING:
    from dtwin.acquire.ingest import IngestReport
    from dtwin.acquire.run_recording import RecordedRun
    from dtwin.plan import Plan
    from dtwin.schema import Finding

Json = Annotated[bool, typer.Option("--json", help="Print only JSON on stdout.")]
Plane = Annotated[str | None, typer.Option(help="Of a table that lies alone: XY, YZ or ZX.")]
Radius = Annotated[float | None, typer.Option(help="Of such a table: programmed radius, mm.")]
Feed = Annotated[float | None, typer.Option(help="Of such a table: programmed feed, mm/min.")]
Direction = Annotated[
    str | None, typer.Option(help="Of such a table: CCW or CW; else as the angle runs.")
]
Axis = Annotated[str | None, typer.Option(help="Of a positioning table: the axis, such as X.")]
Setup = Annotated[str | None, typer.Option(help="Of such a table: mounting of the instrument.")]
Repeat = Annotated[int | None, typer.Option(help="Of such a table: counts repeats from 1.")]
Machine = Annotated[str | None, typer.Option(help="Of such a table: name of the machine.")]


def register(app: typer.Typer) -> None:
    """Add the commands of this module to the application."""
    app.command()(examples)
    app.command()(check)
    app.command()(ingest)
    app.command()(runs)
    app.command()(plan)
    app.command()(repair)


def examples(
    out: Annotated[Path, typer.Option(help="Folder to make.")] = Path("examples"),
    as_json: Json = False,
) -> None:
    """Copy small example campaigns here: with and without a hidden fault, and one spoilt run."""
    import shutil

    from dtwin.config import example_campaigns

    if out.exists():
        raise InputError(
            "the folder is there already", code="examples.exists", where=str(out),
            hint="dtwin examples --out ANOTHER",
        )  # fmt: skip
    try:
        shutil.copytree(example_campaigns(), out)
    except OSError as error:
        raise InputError(
            "the examples cannot be copied", code="examples.copy", where=str(out), got=str(error)
        ) from error
    found = sorted(str(p.parent) for p in out.glob("*/campaign.toml"))
    emit(
        {"campaigns": found},
        lambda: "\n".join([*found, f"next: dtwin check {found[0]}", "or:   dtwin ui"]),
        as_json=as_json,
    )


def check(
    source: Annotated[
        Path,
        typer.Argument(help="A .b5r file, a campaign folder, a table, or a campaign in the lake."),
    ],
    plane: Plane = None,
    radius: Radius = None,
    feed: Feed = None,
    direction: Direction = None,
    axis: Axis = None,
    setup: Setup = None,
    repeat: Repeat = None,
    machine: Machine = None,
    as_json: Json = False,
) -> None:
    """Say what the data are, and what is wrong with them. Changes nothing."""
    from dtwin.config import home
    from dtwin.report.checking import check_campaign, check_source, render_check
    from dtwin.store import Lake

    lake, line = Lake(home().lake), ProgressLine("check", quiet=as_json)
    told = _told(plane, radius, feed, direction, axis, setup, repeat, machine)
    alone = any(value is not None for value in told.values())
    if not alone and not source.exists() and str(source) in lake.campaigns():
        result = check_campaign(lake, str(source), line)
    else:
        result = check_source(source, line, told)
    emit(result, lambda: render_check(result), as_json=as_json)


def ingest(
    sources: Annotated[list[Path], typer.Argument(help="Campaign folders, .b5r files or a table.")],
    plane: Plane = None,
    radius: Radius = None,
    feed: Feed = None,
    direction: Direction = None,
    axis: Axis = None,
    setup: Setup = None,
    repeat: Repeat = None,
    machine: Machine = None,
    campaign: Annotated[
        str | None, typer.Option(help="Of such a table: name of the campaign; else the file's.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Bring measurements into the lake. Safe to repeat."""
    from dtwin.acquire.ingest import ingest as ingest_one
    from dtwin.config import home
    from dtwin.store import Lake

    lake = Lake(home().lake)
    told = _told(plane, radius, feed, direction, axis, setup, repeat, machine, campaign)
    reports = [
        ingest_one(path, lake, ProgressLine(f"ingest {path.name}", quiet=as_json), told)
        for path in sources
    ]
    payload = {"campaigns": [_report_dict(report) for report in reports]}
    emit(payload, lambda: "\n\n".join(map(_report_text, reports)), as_json=as_json)


def runs(
    campaign: Annotated[str | None, typer.Argument(help="Only this campaign.")] = None,
    as_json: Json = False,
) -> None:
    """List the runs in the lake."""
    from dtwin.config import home
    from dtwin.store import Lake

    rows = Lake(home().lake).runs(campaign, left_out=True)
    shown = (
        "campaign",
        "run_id",
        "machine",
        "plane",
        "radius_mm",
        "feed_mm_min",
        "direction",
        "repeat",
        "setup",
        "n_samples",
        "n_errors",
        "status",
        "metadata_version",
        "left_out",
    )
    payload = {"runs": [{name: row[name] for name in shown} for row in rows]}

    def text() -> str:
        if not rows:
            return "no runs yet; bring some in with: dtwin ingest PATH"
        return table(shown, [[row[name] for name in shown] for row in rows])

    emit(payload, text, as_json=as_json)


def plan(
    file: Annotated[
        Path | None, typer.Argument(help="Plan file (TOML); without it the 81-test plan.")
    ] = None,
    control: Annotated[
        str, typer.Option(help="Positioning tests: dialect of the program, opencnc or iso.")
    ] = "opencnc",
    out: Annotated[
        Path | None, typer.Option(help="Write G-code and URScript of every test here.")
    ] = None,
    check_only: Annotated[
        bool, typer.Option("--check", help="Say what the plan could tell, and what not.")
    ] = False,
    noise_um: Annotated[
        float, typer.Option(help="RMS by which repeats disagree, for --check.")
    ] = 1.0,
    as_json: Json = False,
) -> None:
    """Expand a campaign before anything moves: order, limits, time, programs."""
    from dtwin.plan_file import plan_kind, read_plan_file

    kind = "circular" if file is None else plan_kind(read_plan_file(file))
    if file is not None and kind != "circular":
        _plan_of(kind, file, out, control, as_json=as_json)
        return
    from dtwin.plan import advice, duration_s, read_plan, training_plan

    planned = training_plan() if file is None else read_plan(file)
    moving_s, total_s = duration_s(planned)
    findings = advice(planned)
    payload: dict[str, Any] = {
        "name": planned.name,
        "machine": planned.machine,
        "tests": len(planned.tests),
        "runs": planned.n_runs,
        "motion_s": moving_s,
        "total_s": total_s,
        "findings": [finding.as_dict() for finding in findings],
    }
    if check_only:
        payload["noise_um"] = noise_um
        payload["detectable"] = _detectable(planned, noise_um)
    else:
        payload["order"] = [vars(test) for test in planned.tests]
    if out is not None:
        payload["programs"] = _write_programs(planned, out)
    emit(payload, lambda: _plan_text(planned, payload, findings, check_only), as_json=as_json)


def repair(
    folder: Annotated[
        Path | None, typer.Argument(help="Campaign folder whose killed recordings to recover.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Drop what kills left behind, tell MLflow of twins that wait; recover a folder's killed recordings."""
    from dtwin.config import home
    from dtwin.pipeline.twin_registration import log_waiting, waiting_text
    from dtwin.store import Lake

    found = _recovered(folder) if folder is not None else []
    dropped = Lake(home().lake).repair()
    set_aside = dropped.pop("log")
    left = log_waiting(home())
    closed = 0
    # Importing MLflow takes seconds.
    if (home().root / "mlflow").is_dir():
        from dtwin.train.registry import Registry

        closed = Registry(home()).close_abandoned()
    payload = {
        "trainings_closed": closed,
        "not_in_mlflow": [item.as_dict() for item in left],
        "dropped": dropped,
        "log_entries_set_aside": set_aside,
        "recovered": [run.run_id for run in found],
    }

    def text() -> str:
        cut = [f"empty log entry set aside: {e}; ingest the newest files again" for e in set_aside]
        lines = [f"dropped orphans: {dropped}", f"killed trainings closed: {closed}", *cut]
        lines += [waiting_text(left)] if left else []
        return "\n".join([*lines, *(f"recovered {run_text(r)}" for r in found)])

    emit(payload, text, as_json=as_json)


def _told(
    plane: str | None,
    radius: float | None,
    feed: float | None,
    direction: str | None,
    axis: str | None,
    setup: str | None,
    repeat: int | None,
    machine: str | None,
    campaign: str | None = None,
) -> dict[str, Any]:
    """Return what the options tell of a table, named as in campaign.toml."""
    return {
        "plane": plane,
        "radius_mm": radius,
        "feed_mm_min": feed,
        "direction": direction,
        "axis": axis,
        "setup": setup,
        "repeat": repeat,
        "machine": machine,
        "campaign": campaign,
    }


def _recovered(folder: Path) -> list[RecordedRun]:
    from dtwin.acquire.run_recording import recover_runs

    if folder.is_dir():
        return recover_runs(folder)
    raise InputError("no such folder", code="repair.folder", where=str(folder))


def _plan_of(kind: str, file: Path, out: Path | None, control: str, *, as_json: bool) -> None:
    if kind == "linear":
        from dtwin.commands.lathe import plan_positioning

        plan_positioning(file, out, control, as_json=as_json)
        return
    if out is not None:
        raise InputError(
            "no program is written for this kind of campaign", code="plan.program", got=kind,
            allowed="circular, linear", hint="leave --out away",
        )  # fmt: skip
    if kind == "sinusoidal":
        from dtwin.commands.turning import plan_tones

        plan_tones(file, as_json=as_json)
    else:
        from dtwin.commands.volumetric import plan_balls

        plan_balls(file, as_json=as_json)


def _write_programs(planned: Plan, out: Path) -> list[str]:
    from dtwin.acquire.programs import gcode, urscript

    out.mkdir(parents=True, exist_ok=True)
    written = []
    for test in planned.tests:
        for suffix, text in (
            (".nc", gcode(test, planned.directions)),
            (".script", urscript(test, planned.directions)),
        ):
            path = out / f"{test.test_id}{suffix}"
            path.write_text(text, encoding="utf-8")
            written.append(str(path))
    return written


def _plan_text(
    planned: Plan, payload: dict[str, Any], findings: Sequence[Finding], check_only: bool
) -> str:
    head = (
        f"{planned.name} on {planned.machine}: {len(planned.tests)} tests, {planned.n_runs} runs, "
        f"{payload['motion_s'] / 60:z.0f} min of motion, about {payload['total_s'] / 60:z.0f} min in all"
    )
    lines = [head, *(f"  {f.severity}: {f.message}" for f in findings)]
    if "programs" in payload:
        lines.append(f"  {len(payload['programs'])} programs written")
    if check_only:
        lines.append(_detectable_text(payload))
    else:
        rows = [
            [t.test_id, t.setup, t.plane, t.radius_mm, t.feed_mm_min, t.repeat]
            for t in planned.tests
        ]
        lines.append(table(("test", "setup", "plane", "radius_mm", "feed_mm_min", "repeat"), rows))
    return "\n".join(lines)


def _detectable(planned: Plan, noise_um: float) -> list[dict[str, Any]]:
    from dtwin.physics.experiment import detectable, planned_observations
    from dtwin.physics.library import Library

    if noise_um <= 0.0:
        raise InputError(
            "the noise must be positive", code="plan.noise", got=f"{noise_um:g} um", allowed="> 0"
        )
    obs = planned_observations(planned)
    return [found.as_dict() for found in detectable(obs, Library(), noise_um=noise_um)]


def _detectable_text(payload: Mapping[str, Any]) -> str:
    rows = [
        [
            d["label"],
            f"{d['amplitude']:.3g} {d['unit']}" if math.isfinite(d["amplitude"]) else "invisible",
            f"{d['typical']:g} {d['unit']}",
            "" if not math.isfinite(d["amplitude"]) else f"{d['rms_um']:z.3f}",
        ]
        for d in payload["detectable"]
    ]
    head = ("effect", "detected from (power 80 %)", "typical size", "visible RMS, um")
    return (
        f"what this plan could detect when repeats disagree by {payload['noise_um']:g} um RMS, "
        "alike at all harmonics:\n" + table(head, rows)
    )


def _report_dict(report: IngestReport) -> dict[str, Any]:
    return {
        "campaign": report.campaign,
        "added": list(report.added),
        "unchanged": list(report.unchanged),
        "rejected_rows": report.rejected_rows,
        "versions": report.versions,
        "findings": [{"run": run, **finding.as_dict()} for run, finding in report.findings],
    }


def _report_text(report: IngestReport) -> str:
    lines = [
        f"{report.campaign}: {len(report.added)} runs added, {len(report.unchanged)} unchanged, "
        f"{report.rejected_rows} rows rejected"
    ]
    by_code: dict[str, list[tuple[str, Finding]]] = {}
    for run, finding in report.findings:
        by_code.setdefault(finding.code, []).append((run, finding))
    for found in by_code.values():
        run, first = found[0]
        more = f" (and {len(found) - 1} more runs)" if len(found) > 1 else ""
        lines.append(f"  {first.severity}: {run or 'campaign'}: {first.message}{more}")
    return "\n".join(lines)
