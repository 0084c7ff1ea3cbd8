"""Commands about positioning tests and their compensation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dtwin.commands._output import Json, emit
from dtwin.errors import EXIT_GATE, InputError
from studies.commands.demo import paper_of

MODELS = ("flanks", "pair", "printed")

app = typer.Typer(
    name="lathe",
    help="Positioning error of an axis: fit, try in the loop, and compare with a published lathe.",
    no_args_is_help=True,
)


@app.command("fit")
def fit(
    campaign: Annotated[Path | None, typer.Argument(help="Campaign folder; none for --model printed.")] = None,
    model: Annotated[
        str, typer.Option(help="flanks: remembers the play; pair: two networks; printed: theirs.")
    ] = "flanks",
    out: Annotated[Path, typer.Option(help="Bundle to write.")] = Path("lathe.json"),
    seed: Annotated[int, typer.Option(min=0, help="Of the first weights.")] = 0,
    force: Annotated[
        bool, typer.Option("--force", help="Write it though a gate says no, or the file is there.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Fit the positioning error of an axis, judge the equation, write it as a bundle."""
    from studies.lathe_fit import fitted

    if model not in MODELS or (campaign is None) != (model == "printed"):
        raise InputError(
            "say what is to be fitted",
            code="lathe.model",
            got=f"{model[:40]} of {campaign}",
            allowed="--model flanks or pair with a campaign folder, --model printed without",
        )
    made = fitted(campaign, model, seed)
    written, said = made.write(out, force=force)
    payload = {
        "model": model,
        "file": str(out) if written else None,
        "figures": dict(made.figures),
        "gates": [vars(v) for v in made.verdicts],
    }
    lines = [f"{model}: " + ", ".join(f"{name} {value}" for name, value in made.figures.items()), *said]
    emit(payload, lambda: "\n".join(lines), as_json=as_json)
    if not written:
        raise typer.Exit(EXIT_GATE)


@app.command("compensate")
def compensate(
    model: Annotated[str, typer.Argument(help="A bundle's .json file, or latest, which is champion, or trial.")],
    truth: Annotated[str, typer.Option(help="Error of the virtual lathe: published, or mechanism.")] = "published",
    seed: Annotated[int, typer.Option(min=0, help="Of the day: drift and noise.")] = 1,
    plan: Annotated[Path | None, typer.Option(help="Positioning plan; every 0.52 in without.")] = None,
    machine: Annotated[str | None, typer.Option(help="Required when several machines have a model.")] = None,
    wall_clock: Annotated[
        float, typer.Option(help="Only run the loop in real time for so many seconds.", min=0.0)
    ] = 0.0,
    as_json: Json = False,
) -> None:
    """Correct the virtual lathe every 10 ms and let the laser measure before and after."""
    from dtwin.commands._models import bundle_on_virtual

    path, told = bundle_on_virtual(model, machine)
    if wall_clock > 0.0:
        from studies.lathe_clock import paced_by
        from studies.report.lathe import wall_clock_text

        timed = {"model": told} | paced_by(path, plan, wall_clock)
        emit(timed, lambda: f"{told}\n{wall_clock_text(timed)}", as_json=as_json)
        return
    from studies.lathe_fit import before_and_after
    from studies.report.lathe import compensation_text

    compared = {"model": told} | before_and_after(path, truth, seed, plan)
    emit(compared, lambda: f"{told}\n{compensation_text(compared)}", as_json=as_json)


app.command("paper")(paper_of("lathe"))
