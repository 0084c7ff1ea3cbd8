"""The commands that compute the figures of published systems again, of all or of one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import typer

from dtwin.commands._output import Json, ProgressLine, emit

Quick = Annotated[bool, typer.Option("--quick", help="Less of everything, for a first look.")]
Seed = Annotated[int, typer.Option(min=0, help="Of everything random.")]

app = typer.Typer()


@app.command()
def papers(quick: Quick = False, seed: Seed = 0, as_json: Json = False) -> None:
    """Compute what four published systems report again: how many figures follow, and which do not."""
    from studies.papers import PAPERS, computed
    from studies.report.papers import summary_text

    answers: dict[str, dict[str, Any]] = {}
    for name, paper in PAPERS.items():
        progress = ProgressLine(name, quiet=as_json)
        lines = computed(name, quick=quick, seed=seed, progress=progress)["lines"]
        answers[name] = {"source": paper.source, "lines": lines}
    emit(answers, lambda: summary_text(answers), as_json=as_json)


def paper_of(name: str) -> Callable[..., None]:
    """Return the command about one published system, a key of ``studies.papers.PAPERS``."""

    def paper(quick: Quick = False, seed: Seed = 0, as_json: Json = False) -> None:
        """Compute the figures of the published system again: theirs, ours, whether they follow."""
        from studies.papers import computed
        from studies.report.papers import TEXTS

        figures = computed(name, quick=quick, seed=seed, progress=ProgressLine(name, quiet=as_json))
        emit(figures, lambda: TEXTS[name](figures), as_json=as_json)

    return paper
