"""Commands about measurements: examples, check, ingest, runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dtwin.commands._output import Json, ProgressLine, emit
from dtwin.commands._record import run_text
from dtwin.commands._told import tells_a_table
from dtwin.config import home
from dtwin.errors import InputError
from dtwin.report.text import table

if TYPE_CHECKING:
    from dtwin.acquire.ingest import IngestReport
    from dtwin.acquire.run_recording import RecordedRun
    from dtwin.schema import Finding


app = typer.Typer()


@app.command()
def examples(
    out: Annotated[Path, typer.Option(help="Folder to make.")] = Path("examples"), as_json: Json = False
) -> None:
    """Copy small example campaigns here: with and without a hidden fault, and one spoilt run."""
    import os
    import shutil

    from dtwin.config import example_campaigns

    if out.exists():
        raise InputError(
            "the folder is there already", code="examples.exists", where=str(out), hint="dtwin examples --out ANOTHER"
        )
    beside = out.with_name(f".{out.name}.{os.getpid()}.partial")
    try:
        shutil.copytree(example_campaigns(), beside)
        beside.rename(out)
    except OSError as error:
        # Of several files that cannot be copied, each with its reason.
        reason = error.args[0][0][2] if isinstance(error, shutil.Error) else error
        raise InputError(
            "the examples cannot be copied", code="examples.copy", where=str(out), got=str(reason)
        ) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    folders = sorted(str(p.parent) for p in out.glob("*/campaign.toml"))
    emit(
        {"campaigns": folders},
        lambda: "\n".join([*folders, f"next: dtwin check {folders[0]}", "or:   dtwin ui"]),
        as_json=as_json,
    )


@app.command()
@tells_a_table("campaign")
def check(
    source: Annotated[Path, typer.Argument(help="A .b5r file, a campaign folder, a table, or a campaign in the lake.")],
    told: Mapping[str, Any],
    as_json: Json = False,
) -> None:
    """Say what the data are, and what is wrong with them. Changes nothing."""
    from dtwin.lake.store import Lake
    from dtwin.machine_record import tolerances_of
    from dtwin.pipeline.kept import variation_of
    from dtwin.report.checking import check_campaign, check_source, render_check

    lake, line = Lake(home().lake), ProgressLine("check", quiet=as_json)
    limits, surroundings = partial(tolerances_of, home()), partial(variation_of, home())
    alone = any(value is not None for value in told.values())
    campaigns = [] if alone or source.exists() else lake.campaigns()
    if str(source) in campaigns:
        result = check_campaign(lake, str(source), line, limits, surroundings)
    elif campaigns and source.name == str(source):
        raise InputError(
            "no such file or folder, and no such campaign in the lake",
            code="file.missing",
            got=str(source),
            allowed=", ".join(campaigns),
        )
    else:
        result = check_source(source, line, told, limits, surroundings)
    emit(result, lambda: render_check(result), as_json=as_json)


@app.command()
@tells_a_table()
def ingest(
    sources: Annotated[list[Path], typer.Argument(help="Campaign folders, .b5r files or a table.")],
    told: Mapping[str, Any],
    as_json: Json = False,
) -> None:
    """Bring measurements into the lake. Safe to repeat."""
    from dtwin.acquire.ingest import ingest as ingest_one
    from dtwin.lake.store import Lake

    lake = Lake(home().lake)
    reports = [ingest_one(path, lake, ProgressLine(f"ingest {path.name}", quiet=as_json), told) for path in sources]
    payload = {"campaigns": [_report_dict(report) for report in reports]}
    emit(payload, lambda: "\n\n".join(map(_report_text, reports)), as_json=as_json)


@app.command()
def runs(
    campaign: Annotated[str | None, typer.Argument(help="Only this campaign.")] = None, as_json: Json = False
) -> None:
    """List the runs in the lake."""
    from dtwin.lake.store import Lake

    lake = Lake(home().lake)
    rows = lake.runs(campaign, left_out=True)
    if campaign is not None and not rows:
        lake.campaign(campaign)  # Refused, with the names that there are.
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


@app.command()
def repair(
    folder: Annotated[Path | None, typer.Argument(help="Campaign folder whose killed recordings to recover.")] = None,
    as_json: Json = False,
) -> None:
    """Drop what kills left behind, tell MLflow of twins that wait; recover a folder's killed recordings."""
    from dtwin.lake.store import Lake
    from dtwin.shared_documents import drop_unnamed_content
    from dtwin.twins.registration import log_waiting, waiting_text

    recovered = _recovered(folder) if folder is not None else []
    dropped = Lake(home().lake).repair()
    if (bucket := home().file.bucket) is not None:
        dropped["content"] = drop_unnamed_content(bucket)
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
        "recovered": [run.run_id for run in recovered],
    }

    def text() -> str:
        cut = [f"empty log entry set aside: {e}; ingest the newest files again" for e in set_aside]
        lines = [f"dropped orphans: {dropped}", f"killed trainings closed: {closed}", *cut]
        lines += [waiting_text(left)] if left else []
        return "\n".join([*lines, *(f"recovered {run_text(r)}" for r in recovered)])

    emit(payload, text, as_json=as_json)


@app.command()
def migrate(as_json: Json = False) -> None:
    """Take over a home that an earlier version of dtwin made: lake, twins, machines.

    Runs are compared with the hashes that their ingest stored; the old lake stays beside the new one.
    """
    from dtwin.pipeline.migrating import migrate as take_over

    migrated = take_over(home(), ProgressLine("migrate", quiet=as_json))

    def text() -> str:
        if not (migrated.before or migrated.documents or migrated.machines):
            return "nothing to do: this version made all of it"
        lines = [f"{migrated.n_runs} runs of {len(migrated.campaigns)} campaigns taken over"]
        lines += [f"the lake as it was: {migrated.before}"] if migrated.before else []
        lines.append(f"{migrated.documents} documents of twins hashed as they are")
        sealed = ", ".join(migrated.machines) or "none"
        return "\n".join([*lines, f"machines sealed as they are: {sealed}"])

    emit(asdict(migrated), text, as_json=as_json)


def _recovered(folder: Path) -> list[RecordedRun]:
    from dtwin.acquire.run_recording import recover_runs

    if folder.is_dir():
        return recover_runs(folder)
    raise InputError("no such folder", code="repair.folder", where=str(folder))


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
    for findings in by_code.values():
        run, first = findings[0]
        more = f" (and {len(findings) - 1} more runs)" if len(findings) > 1 else ""
        lines.append(f"  {first.severity}: {run or 'campaign'}: {first.message}{more}")
    return "\n".join(lines)
