"""What changes a twin: fit, diagnose, add, remove, learn, roll back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Literal

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field
from starlette.responses import JSONResponse

from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.physics.twin import Twin
from dtwin.pipeline.machine_joint import newest_tests
from dtwin.progress import Tell
from dtwin.schema import require_name
from dtwin.twins.learn import learn_law, learn_map
from dtwin.twins.of_kind import AnyTwin, AnyTwins, fit_twin, twins_for
from dtwin.twins.seen import chosen
from dtwin.twins.shelf import require_same_machine
from dtwin.workbench import _reading as reading
from dtwin.workbench._bench import Bench, Here, bench_of
from dtwin.workbench._pages import accepted, begun

router = APIRouter()
# With a limit, what is no text (half a character) is refused, too.
_Word = Annotated[str, Field(max_length=120)]


class _FitRequest(BaseModel):
    """What to fit: one campaign, or several of one machine."""

    campaign: _Word = ""
    campaigns: list[_Word] = Field(default_factory=list, max_length=20)
    name: _Word
    effects: list[_Word] = Field(default_factory=list, max_length=60)
    robust: bool = False


class _NameRequest(BaseModel):
    """Name of a twin that is to be made."""

    name: str = Field(max_length=100)


class _TogetherRequest(_NameRequest):
    """The same of several campaigns."""

    campaigns: list[_Word] = Field(default_factory=list, max_length=20)


class _EffectRequest(BaseModel):
    """An effect, perhaps on one axis."""

    effect: str = Field(max_length=120)
    axis: str = Field("", max_length=20)


class _CorrectionRequest(BaseModel):
    """On the path of which campaign, and whether a correction may be registered although the twin is not confirmed."""

    on: _Word = ""
    trial: bool = False


class _VersionRequest(BaseModel):
    """A version."""

    version: int


@router.post("/api/twins")
def fit(bench: Here, wanted: _FitRequest) -> JSONResponse:
    """Fit effects to a campaign of the lake."""
    require_name(wanted.name, "the twin")
    campaigns = wanted.campaigns or [wanted.campaign]
    for campaign in campaigns:
        bench.lake.campaign(campaign)
    twins_for(bench.home, bench.library, campaigns)
    return _start(
        bench,
        f"Fit {wanted.name}",
        wanted.name,
        lambda: fit_twin(bench.home, bench.library, campaigns, wanted.effects, wanted.name, robust=wanted.robust)[1],
        "/twins/{name}",
    )


@router.post("/api/twins/{name}/add")
def add(request: Request, name: str, wanted: _EffectRequest) -> JSONResponse:
    """Add an effect and refit."""
    return _changed(request, name, wanted, "add")


@router.post("/api/twins/{name}/remove")
def remove(request: Request, name: str, wanted: _EffectRequest) -> JSONResponse:
    """Take an effect out and refit."""
    return _changed(request, name, wanted, "remove")


def _changed(request: Request, name: str, wanted: _EffectRequest, verb: str) -> JSONResponse:
    bench = bench_of(request)
    twins = bench.twins_with(name)
    twins.newest(name)
    title = f"{verb.capitalize()} {wanted.effect} {wanted.axis}".strip()
    change = partial(getattr(twins, verb), name, wanted.effect, wanted.axis)
    return _start(bench, title, name, change, "/twins/{name}/versions")


@router.post("/api/twins/{name}/learn/{what}")
def learn(bench: Here, name: str, what: Literal["law", "map"]) -> JSONResponse:
    """Add a law, or a map, for structure that no effect explains."""
    twins = bench.twins_with(name)
    twins.newest(name)
    learned = partial(learn_law if what == "law" else learn_map, twins, name)
    return _start(bench, f"Learn a {what} for {name}", name, lambda: learned().twin, "/twins/{name}/versions")


@router.post("/api/twins/{name}/rollback")
def roll_back(bench: Here, name: str, wanted: _VersionRequest) -> JSONResponse:
    """Make a new version with the effects of an older one; nothing is deleted."""
    twins = bench.twins_with(name)
    twins.newest(name, wanted.version)
    title = f"Roll {name} back to version {wanted.version}"
    return _start(bench, title, name, lambda: twins.restore(name, wanted.version), "/twins/{name}/versions")


@router.post("/api/twins/{name}/diagnose")
def diagnose(bench: Here, name: str) -> JSONResponse:
    """Find out what the newest version lacks."""
    twins = bench.twins_with(name)
    twins.newest(name)
    said = "test every effect of the library, and what repeats say"

    def work() -> None:
        twins.diagnose(name)
        twins.require_kept()

    return begun(bench, f"Diagnose {name}", f"/twins/{name}/diagnose", work, said)


@router.post("/api/campaigns/{campaign}/find")
def find(bench: Here, campaign: str, wanted: _NameRequest) -> JSONResponse:
    """Fit a twin of nothing but the set-ups, or of what its kind begins with, and add every effect that the runs can tell."""
    return _find(bench, [campaign], wanted.name, kind_named(bench.lake.campaign(campaign).kind).search_from)


@router.post("/api/machines/{machine}/find")
def find_together(bench: Here, machine: str, wanted: _TogetherRequest) -> JSONResponse:
    """The same of several tests of a machine, all in one twin; of its newest tests of a path where none is named."""
    for campaign in wanted.campaigns:
        require_same_machine(wanted.name, machine, campaign, bench.lake.campaign(campaign).machine)
    newest = newest_tests(bench.lake.runs(left_out=True, machine=machine), machine) if not wanted.campaigns else ()
    campaigns = wanted.campaigns or list(newest)
    if not campaigns:
        raise InputError("no test of the machine can have a twin of paths", code="machine.tests", where=machine)
    return _find(bench, campaigns, wanted.name)


def _find(bench: Bench, campaigns: Sequence[str], name: str, known: Sequence[str] = ()) -> JSONResponse:
    require_name(name, "the twin")
    for campaign in campaigns:
        bench.lake.campaign(campaign)
    twins_for(bench.home, bench.library, campaigns)
    title = f"Find what {', '.join(campaigns)} can tell"
    # Asked again in another tab, it would be a second twin of the same.
    if (
        same := next((job for job in bench.jobs.unfinished() if job.title == title and not job.ended), None)
    ) is not None:
        return accepted(same)

    def work(tell: Tell) -> str:
        tell("fit the set-ups")
        twins, _ = fit_twin(bench.home, bench.library, campaigns, known, name)
        _discover(twins, name, tell)
        return f"/twins/{name}/diagnose"

    return accepted(bench.jobs.start(title, work))


@router.post("/api/twins/{name}/discover")
def discover(bench: Here, name: str) -> JSONResponse:
    """Find all effects that the runs can tell, and add them one by one."""
    twins = bench.twins_with(name)
    twins.newest(name)

    def work(tell: Tell) -> str:
        _discover(twins, name, tell)
        return f"/twins/{name}/versions"

    return accepted(bench.jobs.start(f"Find all that {name} lacks", work))


@router.post("/api/twins/{name}/correct")
def correct(bench: Here, name: str, wanted: _CorrectionRequest) -> JSONResponse:
    """Register the correction that a confirmed twin stands for, or say why not."""
    twins = bench.twins_with(name)
    on = chosen(bench.home, twins.newest(name), "twin_correction", wanted.on or None)

    def work(tell: Tell) -> str:
        from dtwin.twins.correct import correct as register

        tell("diagnose, grade every effect, freeze and register")
        correction = register(twins, name, campaign=on, trial=wanted.trial).as_dict()
        return f"/models/{correction['machine']}/{correction['version']}"

    return accepted(bench.jobs.start(f"Correct with {name}", work))


def _discover(twins: AnyTwins, name: str, tell: Tell) -> None:
    tell("search for the effects, add each, and diagnose what is left")
    made = twins.discover(name)[0]
    twins.require_kept()
    tell(f"{len(made)} effects were added")


def _start(bench: Bench, title: str, name: str, change: Callable[[], AnyTwin], address: str) -> JSONResponse:
    def work(tell: Tell) -> str:
        tell("read the runs, fit, and register the version")
        made = change()
        tell(f"compare version {made.version} with its runs")
        if isinstance(made, Twin):
            reading.view(bench, name, made.version)
        return address.format(name=name)

    return accepted(bench.jobs.start(title, work))
