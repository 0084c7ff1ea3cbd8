"""Commands about volumetric errors and how heat moves them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from dtwin.commands._output import Json, ProgressLine, emit
from dtwin.config import home
from dtwin.errors import InputError

app = typer.Typer(
    name="volumetric",
    help="Volumetric error of a mill and the heat that moves it: identify, predict, judge, serve.",
    no_args_is_help=True,
)


@app.command("fit")
def fit(
    training: Annotated[str, typer.Argument(help="Campaign in the lake, or a folder.")],
    against: Annotated[
        str | None, typer.Option(help="Another campaign of the machine: what a model is judged by.")
    ] = None,
    offer: Annotated[
        list[str] | None, typer.Option(help="A temperature that was logged beside the thermocouples.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Bundle to write; needs --against.")] = None,
    html: Annotated[Path | None, typer.Option(help="Page to write.")] = None,
    as_json: Json = False,
) -> None:
    """Identify the error motions of every cycle, predict them from temperatures, judge elsewhere."""
    from dtwin.atomic import write_text
    from dtwin.kinds.volumetric._session import session
    from studies.heat import judged, models_of, with_offered, write_bundle
    from studies.judged_bundle import require_new
    from studies.report.heat import judged_text, volumetric_page

    if out is not None and against is None:
        raise InputError(
            "a bundle needs another campaign that says what it is worth",
            code="volumetric.against",
            hint="--against CAMPAIGN",
        )
    if out is not None:
        require_new(out)
    if against == training:
        raise InputError("a campaign cannot judge what was fitted to it", code="volumetric.same", got=training)
    progress = ProgressLine("volumetric", quiet=as_json)
    offered = tuple(offer or ())
    first = session(home(), training, progress)
    models, whole = models_of(first, offered=offered)
    payload: dict[str, Any] = {"training": judged(models, whole)}
    if against is not None:
        other = with_offered(session(home(), against, progress), offered)
        payload["validation"] = judged(models, other, whole)
        if out is not None:
            payload["bundle"] = {"file": str(out), "switched_off": write_bundle(home(), out, whole, other)}

    if html is not None:
        write_text(html, volumetric_page(payload.get("validation", payload["training"])), "the page")

    def text() -> str:
        parts = [judged_text(payload[name]) for name in ("training", "validation") if name in payload]
        if "bundle" in payload:
            off = ", ".join(payload["bundle"]["switched_off"]) or "nothing"
            parts.append(
                f"{out} written: models without memory, never run on a control; switched off, "
                f"since worse than nothing: {off}"
            )
        elif against is None:
            parts.append("figures of the campaign of the fit only; --against CAMPAIGN judges elsewhere")
        return "\n\n".join(parts)

    emit(payload, text, as_json=as_json)


@app.command("paper")
def paper(
    quick: Annotated[bool, typer.Option("--quick", help="Every third cycle, for a first look.")] = False,
    truth: Annotated[str, typer.Option(help="Where the thermocouples sit: surface, or pockets.")] = "surface",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the machine.")] = 0,
    as_json: Json = False,
) -> None:
    """Compute the figures of the published mill again: theirs, ours, whether they follow."""
    from dataclasses import asdict

    from studies.report.papers import paper_table
    from studies.volumetric_paper import volumetric_paper

    progress = ProgressLine("volumetric", quiet=as_json)
    figures = volumetric_paper(seed, progress, quick=quick, truth=truth)
    lines = [asdict(line) for line in figures]
    emit({"lines": lines}, lambda: paper_table(lines), as_json=as_json)
