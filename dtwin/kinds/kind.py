"""What a kind of campaign is: a name, its columns, and one method for each verb."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from dtwin.errors import InputError
from dtwin.progress import Progress, silent

# The command line reads the records for its help: they import nothing heavy, numpy included.
if TYPE_CHECKING:
    from pathlib import Path

    import plotly.graph_objects as go

    from dtwin.acquire.foreign_columns import Column
    from dtwin.config import Home
    from dtwin.kinds.machine import VirtualMachine
    from dtwin.lake.store import Lake
    from dtwin.lifecycle.export import Export
    from dtwin.physics.effect import Effect
    from dtwin.physics.grid import Grid, Row
    from dtwin.physics.observations import Observations
    from dtwin.report.sheet import Sheet
    from dtwin.report.twin_of_kind import TwinReport
    from dtwin.report.uncertainty import Circumstances, Variation
    from dtwin.schema import Campaign, Finding, Run
    from dtwin.serve.bundle import Bundle
    from dtwin.tolerances import Limits
    from dtwin.train.champion_error import ChampionError, HeldOut, RunError
    from dtwin.train.gates import Verdict
    from dtwin.train.results import Training
    from dtwin.train.twin_axes import AxisErrors
    from dtwin.twins.correct import CorrectionWay
    from dtwin.twins.of_kind import AnyTwins


class NotOffered(InputError):
    """A verb that a kind of campaign does not have; ``hint``: what it needs, or what serves instead."""

    def __init__(self, kind: str, verb: str, hint: str) -> None:
        super().__init__(f"{verb} is not offered for {kind} campaigns", code="kind.not_offered", got=kind, hint=hint)


VERBS: Mapping[str, tuple[str, str]] = {
    "plan": ("a plan", "settings that a plan file states, and rules for them"),
    "usual_plan": ("a plan without a file", "a usual campaign"),
    "draft": ("a form for a plan", "usual settings of a plan of a machine"),
    "programs": ("writing motion programs", "motion that a control runs by itself"),
    "foreseen": ("telling what a plan could detect", "a grid on which runs are compared"),
    "proposals": ("proposing a test", "plans for the axes of a machine"),
    "judge_run": ("a check of runs", "a judgement of one run"),
    "sheet": ("a test sheet", "figures of a standard"),
    "variation": ("the variation of the surroundings", "readings of a machine that stands still"),
    "drawings": ("a picture of a run", "a figure of one run"),
    "twins": ("a twin", "effects, and a fit of them"),
    "export_twin": ("an export of the twin itself", "a geometry that controls and simulators take"),
    "axis_errors": ("tables of one axis from its equation", "an equation of position and direction alone"),
    "rows": ("a twin of paths", "a grid on which runs are compared"),
    "laws": ("a law or a formula for what a twin leaves", "runs of one circle"),
    "twin_correction": ("the correction of a twin", "a bundle of the effects of a twin"),
    "training": ("training", "a table of inputs and targets"),
    "gates": ("promotion", "gates of its bundles"),
    "champion_error": ("drift of the champion", "an error that a bundle leaves of recorded runs"),
    "run_errors": ("evidence run by run", "an error of each run"),
}
"""Verbs that a kind may lack: what each is called, and what it needs."""
TWINS_OF_PATHS: Mapping[str, str] = {"twins": "dtwin.twins.verbs:Twins", "twin_report": "dtwin.report.twins"}
"""Places of the twins of kinds that have ``rows``: one fit and one report serve all of them."""


class FileReader(Protocol):
    """Reads a vendor's file of one kind of campaign."""

    def __call__(
        self, path: Path, campaign: Campaign, stated: Mapping[str, Any]
    ) -> tuple[list[Run], list[dict[str, Any]]]:
        """Return the runs of a file, and the rows that were rejected."""


@dataclass(frozen=True)
class Planned:
    """A campaign before anything moves, as its plan file states it.

    Attributes:
        summary: JSON-ready: names and counts.
        findings: What may go wrong, and what the campaign cannot tell.
        lines: The same as text, without the findings.
        order: Conditions in the order of measurement, JSON-ready; empty when the kind has one order only.
        order_text: The order as text, when it is long.
        mounting_s: Usual time to mount and align the instrument, which ``duration_s`` does not hold.
        noise_um: RMS by which repeats of a usual instrument disagree.
    """

    kind: str
    plan: Any
    summary: Mapping[str, Any]
    duration_s: float
    findings: Sequence[Finding]
    lines: tuple[str, ...]
    order: tuple[Mapping[str, Any], ...] = ()
    order_text: str = ""
    mounting_s: float = 600.0
    noise_um: float = 0.5


@dataclass(frozen=True)
class Drawing:
    """A figure of one run; ``title``: what it shows, for those who do not see it.

    ``draw(run, floor_um)``: the plotly figure; ``floor_um`` gives the noise floor, NaN when it is not known. ``half``: whether two
    stand side by side; ``in_sheet``: whether the picture of the test sheet shows it already; ``fits(run)``: whether a run has it.
    """

    name: str
    title: str
    height: int
    draw: Callable[[Run, Callable[[], float]], go.Figure]
    half: bool = False
    note: str = ""
    in_sheet: bool = False
    fits: Callable[[Run], bool] | None = None


class Kind:
    """A kind of campaign; a verb that it lacks raises :class:`NotOffered`.

    Attributes:
        name: As in ``campaign.toml`` and in the lake.
        columns: What a table of samples must have.
        stated: What must be told of a table that lies alone; None when it takes a ``campaign.toml``.
        examples: Of these, what a hint proposes where it is not what it is for other kinds.
        goes_round: Whether a run has a plane and a direction, CCW or CW, that must be told.
        in_one_table: Whether a check tells the figures of all runs in one table, not run by run.
        laws: Whether a law is searched for what a twin leaves.
        told_as: What a check calls the figures of a campaign; empty: as the kind.
        campaign_columns: Columns of samples that a judgement of the whole campaign needs; ``temperature_*`` stands for
            all such names.
        sheet_columns: Columns of samples that a test sheet needs.
        measured_by: What the names of instruments that make its tests hold, in small letters without hyphens.
        figures: Symbols of every figure that its test sheet may have.
        unit: Of those figures and their tolerances, ``um`` or ``arcsec``.
        prefixed: Those that another kind has, too: a tolerance of a machine is of these where it is stated as
            ``NAME:SYMBOL``.
        read_with: What a file is read with, as ``dtwin amend`` names it: stated anew, it would change nothing.
        settings: What it reads of ``instrument``, ``machine_geometry`` and ``condition`` beside every kind; others are
            notes.
        always_fitted: What every twin has beside its effects, as a sentence; empty when there is no twin.
        search_from: Effects with which a search for all that its runs can tell begins.
        controls: Dialects of its programs, the usual first; empty when they are alike for all controls.
        export_forms: Forms of ``dtwin export`` that a twin is written in without a registered correction.
        instead: What serves in place of a verb that the kind lacks.
        places: What does a verb, ``module:name``, imported when it is asked for; a module of the kind's own folder begins
            with an underscore. It takes what the method of that name takes; what is no method is an object.
    """

    name: ClassVar[str]
    columns: ClassVar[tuple[str, ...]]
    stated: ClassVar[tuple[str, ...] | None] = None
    examples: ClassVar[Mapping[str, str]] = {}
    goes_round: ClassVar[bool] = False
    in_one_table: ClassVar[bool] = False
    laws: ClassVar[bool] = False
    told_as: ClassVar[str] = ""
    campaign_columns: ClassVar[tuple[str, ...]] = ()
    sheet_columns: ClassVar[tuple[str, ...]] = ()
    measured_by: ClassVar[tuple[str, ...]] = ()
    figures: ClassVar[tuple[str, ...]] = ()
    unit: ClassVar[str] = "um"
    prefixed: ClassVar[tuple[str, ...]] = ()
    read_with: ClassVar[tuple[str, ...]] = ("instrument.sample_rate_hz",)
    settings: ClassVar[tuple[str, ...]] = ()
    always_fitted: ClassVar[str] = ""
    search_from: ClassVar[tuple[str, ...]] = ()
    controls: ClassVar[tuple[str, ...]] = ()
    export_forms: ClassVar[tuple[str, ...]] = ()
    instead: ClassVar[Mapping[str, str]] = {}
    places: ClassVar[Mapping[str, str]] = {}

    @property
    def machines(self) -> Sequence[VirtualMachine]:
        """Virtual machines that are measured by such campaigns."""
        return self._done("machines") if "machines" in self.places else ()

    @property
    def readers(self) -> Mapping[str, FileReader]:
        """Readers of vendors' files, by ending; other tables are read as CSV or Parquet."""
        return self._done("readers") if "readers" in self.places else {}

    def reader_of(self, path: Path) -> FileReader | None:
        """Return the reader of a file, None when it is a table with the columns of the kind."""
        return self.readers.get(path.suffix.lower())

    def takes_alone(self, path: Path) -> bool:
        """Return whether a file that lies alone is of this kind, though it has not its columns."""
        return self._done("takes_alone")(path) if "takes_alone" in self.places else False

    def told_above(self, path: Path) -> Mapping[str, Any]:
        """Return the conditions that titles above the table of a file tell, by their names."""
        return self._done("told_above")(path) if "told_above" in self.places else {}

    def titled(
        self,
        titles: Sequence[Sequence[str]],
        columns: Sequence[Column],
        body: Sequence[Sequence[str]],
        stated: Mapping[str, Any],
        path: Path,
    ) -> Mapping[str, Any]:
        """Return what a table, and the titles above it, tell of its run; refuse another condition than one that is stated.

        ``titles``: cells of each line.
        """
        return self._done("titled")(titles, columns, body, stated, path) if "titled" in self.places else {}

    def plan(self, document: Mapping[str, Any], where: str) -> Planned:
        """Return the plan that a plan file states; ``where`` is its name, for error messages."""
        return self._done("plan")(document, where)

    def usual_plan(self) -> Planned:
        """Return the plan of the usual campaign."""
        return self._done("usual_plan")()

    def draft(self, machine: str, axes: Mapping[str, Mapping[str, float]], last: Sequence[Run]) -> Mapping[str, Any]:
        """Return a plan file, as TOML is read, with the settings of ``last``, runs of the last test, else usual ones; only the first has samples."""
        return self._done("draft")(machine, axes, last)

    def programs(self, planned: Planned, control: str) -> Mapping[str, str]:
        """Return the motion programs of a plan by file name; ``control`` is one of ``controls``."""
        return self._done("programs")(planned, control)

    def foreseen(self, planned: Planned) -> Observations:
        """Return the runs of a plan as if they had been measured, with no error in them."""
        return self._done("foreseen")(planned)

    def proposals(self, machine: str, axes: Mapping[str, Mapping[str, float]]) -> Sequence[Mapping[str, Any]]:
        """Return plan files, as TOML is read, of tests of a machine that could be worth their time.

        ``axes``: its axes, with ``travel_mm`` and ``pitch_mm`` where they are known.
        """
        return self._done("proposals")(machine, axes)

    def require_condition(self, condition: Mapping[str, Any], where: str) -> None:
        """Refuse what is set for a run and cannot be in a test of this kind."""
        return

    def completed(self, run: Run, campaign: Campaign) -> Run:
        """Return a run with what the campaign states of its instrument."""
        return self._done("completed")(run, campaign) if "completed" in self.places else run

    def judge_run(self, run: Run) -> list[Finding]:
        """Return what is wrong with one run, with its samples."""
        return list(self._done("judge_run")(run))

    def judge_campaign(self, runs: Sequence[Run]) -> list[Finding]:
        """Return what the runs lack as a whole; of their samples, ``campaign_columns`` are there."""
        return list(self._done("judge_campaign")(runs)) if "judge_campaign" in self.places else []

    def sheet(self, runs: Sequence[Run], under: Circumstances) -> Sheet:
        """Return the figures of the standard by condition, with what makes each uncertain beside its repeatability.

        ``runs``: of their samples, ``sheet_columns`` are there.
        ``under``: what is known of instrument, temperature and surroundings.
        """
        return self._done("sheet")(runs, under)

    def variation(self, runs: Sequence[Run], campaign: str) -> Variation | None:
        """Return how far a reading moves while the machine stands still, None when the runs do not tell."""
        return self._done("variation")(runs, campaign)

    def sheet_figure(self, runs: Sequence[Run]) -> go.Figure:
        """Return the picture beside the figures of one condition."""
        return self._done("sheet_figure", "sheet")(runs)

    def run_figures(self, run: Run) -> Mapping[str, Any]:
        """Return the figures of one sound run, JSON-ready."""
        return self._done("run_figures")(run) if "run_figures" in self.places else {}

    def campaign_figures(self, runs: Sequence[Run], progress: Progress = silent) -> Mapping[str, Any]:
        """Return the figures of a campaign, JSON-ready; what does it gives those of ``told_as``. ``progress``: of what takes long."""
        told_as = self.told_as or self.name
        return {told_as: self._done("campaign_figures")(runs, progress)} if "campaign_figures" in self.places else {}

    def figure_lines(self, result: Mapping[str, Any]) -> list[str]:
        """Return the text of what a check found, besides that of each run; what does it takes the figures of ``told_as``."""
        told_as = self.told_as or self.name
        return list(self._done("figure_lines")(result[told_as])) if "figure_lines" in self.places else []

    @property
    def drawings(self) -> Sequence[Drawing]:
        """Figures of one run, in the order of its page."""
        return self._done("drawings")

    def twins(self, home: Home, library: Mapping[str, Effect] | None) -> AnyTwins:
        """Return the twins of a home that are of such campaigns, with a library of effects."""
        return self._done("twins")(home, library)

    @property
    def effects(self) -> Mapping[str, Any]:
        """What its twins may have, with name, title, group, per, parameters and remedy, where that is not of the library."""
        return self._done("effects") if "effects" in self.places else {}

    @property
    def twin_report(self) -> TwinReport:
        """How twins of such campaigns are told."""
        return self._done("twin_report", "twins")

    def export_twin(self, home: Home, twin: Any, form: str) -> Export:
        """Write a twin of such a campaign in one of ``export_forms``."""
        return self._done("export_twin")(home, twin, form)

    def limits(self, of_machine: Mapping[str, Limits]) -> dict[str, Limits]:
        """Return the limits of a machine's record that are of the figures of such tests.

        ``rotation:A`` is of tests of that kind only, and goes before ``A``.
        """
        plain = {s: one for s, one in of_machine.items() if ":" not in s and s not in self.prefixed}
        own = {s.partition(":")[2]: one for s, one in of_machine.items() if s.startswith(f"{self.name}:")}
        return {**plain, **own}

    def axis_errors(self, bundle: Bundle) -> AxisErrors:
        """Return what a bundle of such campaigns says along its axis."""
        return self._done("axis_errors")(bundle)

    def rows(self, runs: Sequence[Run], times_h: Sequence[float]) -> tuple[Grid, list[Row]]:
        """Return the grid on which runs are compared, and the runs on it."""
        return self._done("rows")(runs, times_h)

    def run_errors(self, runs: Sequence[Run]) -> list[RunError]:
        """Return the error of every run, as evidence compares them."""
        return self._done("run_errors")(runs)

    def training(self) -> Callable[..., Training]:
        """Return what trains an equation of such a campaign."""
        return self._done("training")

    def gates(self, bundle: Bundle, metrics: Mapping[str, float]) -> list[Verdict]:
        """Return the verdicts of what needs no motion on a bundle and its metrics."""
        return self._done("gates")(bundle, metrics)

    def recognises(self, bundle: Bundle) -> bool:
        """Tell by its inputs whether a bundle that does not say so was made of such a campaign."""
        return self._done("recognises")(bundle) if "recognises" in self.places else False

    def twin_correction(self) -> CorrectionWay:
        """Return how a twin of such a campaign becomes a correction."""
        return self._done("twin_correction")

    def training_obstacle(self, rows: Sequence[Mapping[str, Any]]) -> str:
        """Return why rows of the lake cannot train an equation, or nothing."""
        return self._done("training_obstacle")(rows) if "training_obstacle" in self.places else ""

    def drift_obstacle(self, rows: Sequence[Mapping[str, Any]]) -> str:
        """Return why rows of the lake cannot judge a champion of such campaigns, or nothing."""
        return ""

    def champion_error(
        self,
        lake: Lake,
        rows: Sequence[dict[str, Any]],
        bundle: Bundle,
        metrics: Mapping[str, float],
        progress: Progress = silent,
    ) -> ChampionError:
        """Return what a bundle leaves of the runs of rows of the lake; ``metrics`` were logged with it."""
        return self._done("champion_error")(lake, rows, bundle, metrics, progress)

    def held_out(self, known: Sequence[Mapping[str, Any]], fresh: Sequence[Mapping[str, Any]]) -> HeldOut:
        """Return which logged error to expect on fresh rows of the lake, by those that a bundle was trained on.

        Raises ``InputError`` when the known ones say nothing of the fresh ones.
        """
        return self._done("held_out", "champion_error")(known, fresh)

    def offers(self, verb: str) -> bool:
        """Tell whether the kind has one of ``VERBS``."""
        own = getattr(type(self), verb)
        return own if isinstance(own, bool) else verb in self.places or own is not getattr(Kind, verb)

    def require(self, verb: str) -> None:
        """Refuse a verb that the kind lacks."""
        if not self.offers(verb):
            raise self.lacks(verb)

    def lacks(self, verb: str) -> NotOffered:
        """Return the refusal of a verb."""
        title, needed = VERBS[verb]
        hint = self.instead.get(verb, f"it needs {needed}")
        return NotOffered(self.name, title, hint)

    def _done(self, verb: str, needed: str = "") -> Any:
        """Return what does a verb, or refuse it as what it is part of."""
        place = self.places.get(verb)
        if place is None:
            raise self.lacks(needed or verb)
        return resolve_name(f"{type(self).__module__.rpartition('.')[0]}.{place}" if place[0] == "_" else place)
