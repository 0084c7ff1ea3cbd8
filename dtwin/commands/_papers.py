"""The command that computes the figures of all published systems again."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from dtwin.commands._output import Json, ProgressLine, emit

app = typer.Typer()


@app.command()
def papers(
    quick: Annotated[bool, typer.Option("--quick", help="Less of everything, for a first look.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of everything random.")] = 0,
    as_json: Json = False,
) -> None:
    """Compute what four published systems report again: how many figures follow, and which do not."""
    from studies.papers import PAPERS, computed
    from studies.report.papers import summary_text

    answers: dict[str, dict[str, Any]] = {}
    for name, paper in PAPERS.items():
        progress = ProgressLine(name, quiet=as_json)
        lines = computed(name, quick=quick, seed=seed, progress=progress)["lines"]
        answers[name] = {"source": paper.source, "lines": lines}
    emit(answers, lambda: summary_text(answers), as_json=as_json)
