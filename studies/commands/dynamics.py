"""Commands about the dynamic part of ball-bar recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dtwin.commands._output import Json, emit
from dtwin.config import home
from studies.commands.demo import paper_of

app = typer.Typer(
    name="dynamics",
    help="Dynamic part of ball-bar tests: vibration and what changes with the feed.",
    no_args_is_help=True,
)


@app.command("split")
def split(
    campaign: Annotated[str, typer.Argument(help="Circular campaign in the lake, or a folder.")],
    how: Annotated[
        str, typer.Option("--filter", help="twin, reference, low-pass, rts, kalman, ukf, ukf-circle.")
    ] = "twin",
    reference_feed: Annotated[
        float | None, typer.Option(help="Feed of the slow reference, mm/min; the slowest without.")
    ] = None,
    effects: Annotated[
        str | None, typer.Option(help="Effects of the twin, comma between; the usual ones without.")
    ] = None,
    q: Annotated[float | None, typer.Option(help="Process variance per reading, um2; published: 0.001.")] = None,
    r: Annotated[float | None, typer.Option(help="Variance of a reading, um2; published: 1.")] = None,
    alpha: Annotated[float, typer.Option(help="Scaling of the sigma points.")] = 0.1,
    cutoff: Annotated[float, typer.Option(help="Of the low-pass, undulations per revolution.")] = 15.0,
    readings: Annotated[int, typer.Option(help="Readings per revolution, up to 1000.")] = 1000,
    tune: Annotated[str, typer.Option(help="Let a swarm find: ratio (Q over R), or alpha as published.")] = "",
    fitness: Annotated[str, typer.Option(help="weighted_sum, or eq15 as printed.")] = "weighted_sum",
    particles: Annotated[int, typer.Option(help="Of the swarm.")] = 50,
    iterations: Annotated[int, typer.Option(help="Of the swarm.")] = 150,
    seed: Annotated[int, typer.Option(min=0, help="Of the swarm.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Page to write (HTML).")] = None,
    as_json: Json = False,
) -> None:
    """Part static from dynamic error in every run, against the slow reference."""
    from dtwin.atomic import write_text
    from studies.dynamics.split import split_campaign
    from studies.dynamics.swarm import SwarmSettings
    from studies.dynamics.ways import TWIN_EFFECTS, DynamicsRequest
    from studies.report.dynamics import dynamics_page, dynamics_text

    chosen = TWIN_EFFECTS if effects is None else tuple(e.strip() for e in effects.split(","))
    split = split_campaign(
        home(),
        campaign,
        DynamicsRequest(
            how=how,
            reference_feed_mm_min=reference_feed,
            readings=readings,
            q_um2=q,
            r_um2=r,
            cutoff_upr=cutoff,
            alpha=alpha,
            tuned=tune,
            fitness=fitness,
            swarm=SwarmSettings(particles, iterations, seed),
            effects=chosen,
        ),
    )
    if out is not None:
        radius = split.result["radius_mm"]
        write_text(out, dynamics_page(split.result, split.curves, radius), "the page")

    def text() -> str:
        end = [] if out is None else [f"{out} written"]
        return "\n".join([dynamics_text(split.result), *end])

    emit(split.result, text, as_json=as_json)


app.command("paper")(paper_of("dynamics"))
