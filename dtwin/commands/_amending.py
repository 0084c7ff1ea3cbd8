"""Commands that state anew what was stated wrongly: amend, leave-out, restore."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from dtwin.commands._output import Json, emit
from dtwin.config import home
from dtwin.errors import InputError

_CampaignName = Annotated[str, typer.Argument(help="Campaign in the lake.")]
_Runs = Annotated[list[str], typer.Argument(help="Run ids.")]
_Because = Annotated[str, typer.Option(help="Why; it is kept and printed.")]
_Who = Annotated[str, typer.Option(help="Who says so; else the user of this computer.")]

app = typer.Typer()


@app.command()
def amend(
    campaign: _CampaignName,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="FIELD=VALUE as in campaign.toml, such as radius_mm=150.")
    ] = None,
    run: Annotated[list[str] | None, typer.Option(help="Only this run; may be repeated.")] = None,
    because: _Because = "",
    who: _Who = "",
    as_json: Json = False,
) -> None:
    """State anew what was stated wrongly of a campaign; raw values never change.

    Without --set it lists what was stated anew before.
    """
    from dtwin.acquire.amending import amend as state_anew
    from dtwin.lake.store import Lake

    lake = Lake(home().lake)
    if not settings and (run or because or who):
        raise InputError("nothing to state anew", code="amend.same", hint="--set FIELD=VALUE")
    changed = state_anew(lake, campaign, settings or [], because, runs=run or [], who=who) if settings else {}
    _said(lake, campaign, {"changed": changed}, as_json=as_json)


@app.command("leave-out")
def leave_out(campaign: _CampaignName, runs: _Runs, because: _Because, who: _Who = "", as_json: Json = False) -> None:
    """Leave runs out of every figure, twin, report and training; nothing is deleted."""
    _left_out(campaign, runs, because, who, out=True, as_json=as_json)


@app.command()
def restore(
    campaign: _CampaignName,
    runs: _Runs,
    because: _Because = "they are needed after all",
    who: _Who = "",
    as_json: Json = False,
) -> None:
    """Take runs in again that were left out."""
    _left_out(campaign, runs, because, who, out=False, as_json=as_json)


def _left_out(campaign: str, runs: list[str], because: str, who: str, *, out: bool, as_json: bool) -> None:
    from dtwin.acquire.amending import leave_out as set_out
    from dtwin.lake.store import Lake

    lake = Lake(home().lake)
    set_out(lake, campaign, runs, because, out=out, who=who)
    _said(lake, campaign, {"runs": runs, "left_out": out}, as_json=as_json)


def _said(lake: Any, campaign: str, payload: dict[str, Any], *, as_json: bool) -> None:
    from dtwin.acquire.amending import amendment_findings

    lake.campaign(campaign)
    rows = lake.runs(campaign, left_out=True)
    lines = [finding.message for finding in amendment_findings(rows)]
    version = max((row["metadata_version"] for row in rows), default=0)
    left_out = {row["run_id"]: row["left_out"] for row in rows if row["left_out"] is not None}
    emit(
        {"campaign": campaign, "metadata_version": version, "left_out_runs": left_out, "history": lines} | payload,
        lambda: "\n".join(lines or [f"{campaign}: as it was ingested"]),
        as_json=as_json,
    )
