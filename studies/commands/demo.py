"""The main job in one command, demo; and papers: the figures of published systems again."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import typer

from dtwin.commands._output import Json, ProgressLine, emit
from dtwin.config import home
from dtwin.errors import InputError
from dtwin.progress import Progress

app = typer.Typer()


@app.command()
def demo(
    which: Annotated[
        str, typer.Argument(help="Which demo: cobot, mill, linuxcnc, placement, tracking, position-map.")
    ] = "cobot",
    quick: Annotated[
        bool,
        typer.Option("--quick", help="A small campaign, for a first look; tracking and position-map have one size."),
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the virtual machine.")] = 0,
    as_json: Json = False,
) -> None:
    """The main job: from a real recording and 81 tests to an equation served to a robot.

    ``tracking`` recomputes the source thesis's tracking chain on the virtual cobot instead,
    ``position-map`` asks what its equation for the mill has learned, ``mill`` tells that story to
    the end: a map of one session makes a later one worse, a twin with what was missing does not.
    ``linuxcnc`` corrects circles of the real controller, live and by its compensation files.
    ``placement`` corrects three circles at three heights and a campaign of placements, and computes
    the thesis's tables of both again.
    """
    others = {
        "mill": _mill,
        "linuxcnc": _linuxcnc,
        "placement": _placement,
        "tracking": _tracking,
        "position-map": _position_map,
    }
    if which in others:
        others[which](seed, quick=quick, as_json=as_json)
        return
    if which != "cobot":
        raise InputError("no such demo", code="demo.unknown", got=which[:40], allowed=", ".join(["cobot", *others]))
    from flows.page import shown_steps

    screen = _Terminal(quiet=as_json)
    with shown_steps(home(), screen.progress, screen.say) as steps:
        from studies.cobot_demo import full_size, quick_size, run_demo

        size = quick_size() if quick else full_size()
        result = run_demo(home(), screen, size, seed=seed, steps=steps)
    emit(result, lambda: "", as_json=as_json)


def _mill(seed: int, *, quick: bool, as_json: bool) -> None:
    from studies.mill_story import mill_story
    from studies.report.mill_story import mill_story_text

    story = mill_story(home(), seed, quick=quick, progress=partial(ProgressLine, quiet=as_json))
    emit(story, lambda: mill_story_text(story), as_json=as_json)


def _linuxcnc(seed: int, *, quick: bool, as_json: bool) -> None:
    from studies.linuxcnc_story import FULL, QUICK, linuxcnc_story
    from studies.report.linuxcnc import linuxcnc_text

    size = QUICK if quick else FULL
    story = linuxcnc_story(home(), seed, size=size, progress=partial(ProgressLine, quiet=as_json))
    emit(story, lambda: linuxcnc_text(story), as_json=as_json)


def _placement(seed: int, *, quick: bool, as_json: bool) -> None:
    from studies.placement_story import FULL, QUICK, placement_story
    from studies.report.placement import placement_text

    size = QUICK if quick else FULL
    story = placement_story(home(), seed, size=size, progress=partial(ProgressLine, quiet=as_json))
    emit(story, lambda: placement_text(story), as_json=as_json)


def _tracking(seed: int, *, quick: bool, as_json: bool) -> None:
    from studies.report.tracking import tracking_text
    from studies.tracking_chain import tracking_chain

    tracked = tracking_chain(seed, ProgressLine("circles", quiet=as_json)).as_dict()
    emit(tracked, lambda: tracking_text(tracked), as_json=as_json)


def _position_map(seed: int, *, quick: bool, as_json: bool) -> None:
    from studies.position_map import position_map
    from studies.report.position_map import position_map_text

    mapped = position_map(seed, ProgressLine("position map", quiet=as_json))
    emit(mapped, lambda: position_map_text(mapped), as_json=as_json)


class _Terminal:
    """Prints results as they come; with ``--json`` only the end is printed."""

    def __init__(self, *, quiet: bool) -> None:
        self.quiet = quiet

    def say(self, text: str) -> None:
        if not self.quiet:
            print(text, flush=True)

    def progress(self, title: str) -> Progress:
        """Return a progress line for a piece of work."""
        return ProgressLine(title, quiet=self.quiet)


_Quick = Annotated[bool, typer.Option("--quick", help="Less of everything, for a first look.")]
_Seed = Annotated[int, typer.Option(min=0, help="Of everything random.")]


@app.command()
def papers(quick: _Quick = False, seed: _Seed = 0, as_json: Json = False) -> None:
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

    def paper(quick: _Quick = False, seed: _Seed = 0, as_json: Json = False) -> None:
        """Compute the figures of the published system again: theirs, ours, whether they follow."""
        from studies.papers import computed
        from studies.report.papers import TEXTS

        figures = computed(name, quick=quick, seed=seed, progress=ProgressLine(name, quiet=as_json))
        emit(figures, lambda: TEXTS[name](figures), as_json=as_json)

    return paper
