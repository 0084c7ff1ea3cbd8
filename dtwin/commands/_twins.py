"""Commands about twins."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dtwin.commands._effects import Paths, library_with
from dtwin.commands._output import Json, Report, ReportLanguage, emit, require_report, stages
from dtwin.commands.tasks import TwinCommands
from dtwin.config import home
from dtwin.errors import InputError, StoreError

if TYPE_CHECKING:
    from dtwin.twins.of_kind import AnyTwins

Name = Annotated[str, typer.Argument(help="Name of the twin.")]
_Axis = Annotated[str, typer.Option(help="One axis, plane or joint; all of them without.")]
_Seed = Annotated[int, typer.Option(min=0, help="Seed of permutations.")]

app = typer.Typer(
    name="twin",
    cls=TwinCommands,
    help="A machine's twin: compare with measurements, find what is missing, add it.",
    no_args_is_help=True,
)


@app.command("fit")
def fit_twin(
    campaigns: Annotated[
        list[str],
        typer.Argument(metavar="CAMPAIGN...", help="Campaigns of one machine, in the lake or as file or folder."),
    ],
    name: Annotated[str, typer.Option(help="Name of the twin.")],
    wanted: Annotated[
        str, typer.Option("--effects", help="Names with commas; backlash:X takes one axis. Without: the set-up alone.")
    ] = "",
    robust: Annotated[bool, typer.Option("--robust", help="Less weight for odd runs.")] = False,
    effects_path: Paths = None,
    as_json: Json = False,
) -> None:
    """Fit effects to a campaign, or to several of one machine: each has its set-ups and noise, effects are the same."""
    from dtwin.report.twin_of_kind import report_of
    from dtwin.twins.of_kind import fit_twin

    names = [part.strip() for part in wanted.split(",") if part.strip()]
    twins, twin = fit_twin(home(), library_with(effects_path), campaigns, names, name, robust=robust)
    emit(
        twin.as_dict(),
        lambda: report_of(twin.as_dict()).twin_text(twin) + _before(name, twins.history(name)),
        as_json=as_json,
    )
    _tell_failed(name)


def _before(name: str, rungs: Sequence[Mapping[str, Any]]) -> str:
    """Return what a fit did to the versions that the twin had, empty when it had none."""
    if len(rungs) < 2:
        return ""
    old = rungs[-2]
    return (
        f"\n\nThe twin had {len(rungs) - 1} version{'s' if len(rungs) > 2 else ''}; they stay. Version {old['version']} "
        f"({old['action']}, campaign {old['campaign']}) comes back by: dtwin twin restore {name} --version {old['version']}"
    )


@app.command("compare")
def compare_twin(
    name: Name,
    campaign: Annotated[str | None, typer.Option("--on", help="Other measurements.")] = None,
    split_cycles: Annotated[
        float | None, typer.Option(help="Cycles per revolution above which error is dynamic; 15 without.")
    ] = None,
    split_hz: Annotated[float | None, typer.Option(help="The same in Hz, instead of cycles per revolution.")] = None,
    html: Report = None,
    effects_path: Paths = None,
    as_json: Json = False,
) -> None:
    """Compare a twin with measurements, condition by condition.

    Runs with the controller's positions (cmd_x_mm, act_x_mm ...) are split into what the
    controller saw, quasi-static and dynamic error.
    """
    from dtwin.report.twin_of_kind import report_of
    from dtwin.twins.encoder_comparison import cutoff_of, no_controller_columns

    asked = split_cycles is not None or split_hz is not None
    cutoff = cutoff_of(split_cycles, split_hz)
    comparison = twins_named(name, effects_path).compare(name, campaign)
    result = comparison.as_dict(cutoff)
    if asked and result["encoder_split"] is None:
        raise no_controller_columns(f"campaign {result['campaign']}")
    emit(result, lambda: report_of(result).comparison_text(result), as_json=as_json)
    if html is not None:
        _write_page(html, comparison.twin.name, report_of(result).comparison_sections(comparison, result))


@app.command("diagnose")
def diagnose_twin(
    name: Name, seed: _Seed = 0, html: Report = None, effects_path: Paths = None, as_json: Json = False
) -> None:
    """Name the effect that is missing, or say why it cannot be named."""
    from dtwin.pipeline.kept import moving_findings
    from dtwin.report.twin_of_kind import report_of, said_by_runs

    twins = twins_named(name, effects_path)
    with stages(quiet=as_json):
        twin, diagnosis = twins.diagnose(name, seed=seed)
    moving = [said for campaign in twin.campaigns for said in moving_findings(home(), campaign)]
    result = {
        "twin": name,
        "version": twin.version,
        "campaign": twin.campaign,
        **diagnosis.as_dict(),
        "runs_say": moving,
    }
    emit(result, lambda: report_of(result).diagnosis_text(name, result) + said_by_runs(moving), as_json=as_json)
    if html is not None:
        _write_page(html, name, [report_of(result).diagnosis_section(name, result)])
    _require_kept(twins)


@app.command("add")
def add_effect(
    name: Name,
    effect: Annotated[str, typer.Argument(help="Name of the effect.")],
    axis: _Axis = "",
    effects_path: Paths = None,
    as_json: Json = False,
) -> None:
    """Add an effect and refit: a new version."""
    twins = twins_named(name, effects_path)
    _show_rung(twins.newest(name), twins.add(name, effect, axis), as_json=as_json)


@app.command("remove")
def remove_effect(
    name: Name,
    effect: Annotated[str, typer.Argument(help="Name of the effect.")],
    axis: _Axis = "",
    effects_path: Paths = None,
    as_json: Json = False,
) -> None:
    """Take an effect out and refit: a new version."""
    twins = twins_named(name, effects_path)
    _show_rung(twins.newest(name), twins.remove(name, effect, axis), as_json=as_json)


@app.command("restore")
def restore_version(
    name: Name,
    version: Annotated[int, typer.Option(help="Version to go back to.")],
    effects_path: Paths = None,
    as_json: Json = False,
) -> None:
    """Refit with the effects of an older version: a new version, nothing is deleted."""
    twins = twins_named(name, effects_path)
    _show_rung(twins.newest(name), twins.restore(name, version), as_json=as_json)


@app.command("discover")
def discover_effects(name: Name, seed: _Seed = 0, effects_path: Paths = None, as_json: Json = False) -> None:
    """Find all effects that these runs can tell, and add them one by one."""
    from dtwin.physics.diagnosis import LEAST_GAIN
    from dtwin.physics.twin import Twin
    from dtwin.pipeline.kept import moving_findings
    from dtwin.report.faults import sized_effects
    from dtwin.report.twin_of_kind import discovery_text, report_of, said_by_runs
    from dtwin.twins.verbs import Twins

    twins = twins_named(name, effects_path)
    try:
        with stages(quiet=as_json):
            made, groups, said = twins.discover(name, seed=seed)
    except StoreError:
        # What to add was found out, and cannot be added.
        if twins.unkept:
            result = dict(twins.unkept)
            emit(result, lambda: report_of(result).diagnosis_text(name, result), as_json=as_json)
        raise
    twin = twins.newest(name)
    effects: list[dict[str, Any]] = []
    if isinstance(twins, Twins) and isinstance(twin, Twin):
        effects = sized_effects(twin, twins.budget(twin)[0] if len(twin.campaigns) == 1 else None)
    moving = [one for campaign in twin.campaigns for one in moving_findings(home(), campaign)]
    payload = {
        "twin": name,
        "added": [twin.action.removeprefix("add ") for twin in made],
        "groups": [list(group) for group in groups],
        "effects": effects,
        "history": twins.history(name),
        "final": said.as_dict(),
        "runs_say": moving,
    }
    emit(payload, lambda: discovery_text(payload, LEAST_GAIN) + said_by_runs(moving), as_json=as_json)
    _require_kept(twins)


@app.command("learn")
def learn_effect(
    name: Name,
    seed: _Seed = 0,
    symbolic: Annotated[bool, typer.Option("--symbolic", help="A formula by symbolic regression instead.")] = False,
    as_map: Annotated[bool, typer.Option("--map", help="A map of what is the same at every feed instead.")] = False,
    effects_path: Paths = None,
    as_json: Json = False,
) -> None:
    """Add a law for structure that no effect explains: a description, provisional."""
    if symbolic and as_map:
        raise InputError(
            "a law is a formula or a map", code="twin.learn", got="--symbolic --map", allowed="one of them"
        )
    from dtwin.train.symbolic import OperonEngine
    from dtwin.twins.learn import learn_formula, learn_law, learn_map

    twins = twins_named(name, effects_path)
    before = twins.newest(name)
    if symbolic:
        learned = learn_formula(twins, name, OperonEngine(), seed=seed)
    else:
        learned = (learn_map if as_map else learn_law)(twins, name, seed=seed)
    if not as_json:
        print(f"gain where it was left out ({learned.left_out}): {100 * learned.gain:z.1f} %{learned.said}")
    _show_rung(before, learned.twin, as_json=as_json, gain=learned.gain, left_out=learned.left_out)


@app.command("correct")
def correct_machine(
    name: Name,
    campaign: Annotated[
        str | None, typer.Option("--on", help="Whose path is corrected, of a twin of several campaigns.")
    ] = None,
    trial: Annotated[bool, typer.Option("--trial", help="Although it is not confirmed: for a trial only.")] = False,
    seed: _Seed = 0,
    effects_path: Paths = None,
    as_json: Json = False,
) -> None:
    """Register the correction that a confirmed twin stands for, or say why not (exit 3)."""
    from dtwin.report.correction import correction_text
    from dtwin.twins.correct import correct

    correction = correct(twins_named(name, effects_path), name, campaign=campaign, trial=trial, seed=seed).as_dict()
    emit(correction, lambda: correction_text(correction), as_json=as_json)


@app.command("confirm")
def confirm_effect(
    name: Name,
    effect: Annotated[str, typer.Argument(help="An effect of the twin, like backlash:X.")],
    after: Annotated[
        list[str], typer.Option(help="Campaign measured after the cause was mended; several, each by its own --after.")
    ],
    what: Annotated[str, typer.Option(help="What was done.")] = "",
    effects_path: Paths = None,
    as_json: Json = False,
) -> None:
    """Compare an effect before and after its cause was mended: intervention-confirmed or not."""
    from dtwin.twins.confirm import confirm

    confirmation = confirm(twins_named(name, effects_path), name, effect, after, what)
    emit(
        {"twin": name, **confirmation.as_dict()},
        lambda: "\n".join(
            [
                f"{confirmation.effect} {confirmation.said}",
                *(f"  {c}" for c in confirmation.changes),
                *(f"  besides, {c}" for c in confirmation.others),
            ]
        ),
        as_json=as_json,
    )


@app.command("history")
def show_history(name: Name, as_json: Json = False, effects_path: Paths = None) -> None:
    """Every rung of a twin, with error before and after."""
    from dtwin.report.twins import history_text
    from dtwin.twins.registration import waiting, waiting_text

    twins = twins_named(name, effects_path)
    rungs = twins.history(name)
    left = waiting(home(), name)
    unread = None
    try:
        twins.newest(name)
    except StoreError as error:
        unread = error
    told = [waiting_text(left)] if left else []
    emit(
        {
            "twin": name,
            "rungs": rungs,
            "not_in_mlflow": [item.as_dict() for item in left],
            "unread": unread.as_dict() if unread else None,
        },
        lambda: "\n".join([history_text(rungs), *told, *([unread.render()] if unread else [])]),
        as_json=as_json,
    )


@app.command("show")
def show_twin(
    name: Name,
    version: Annotated[int | None, typer.Option(help="The newest one without.")] = None,
    html: Report = None,
    language: ReportLanguage = "en",
    effects_path: Paths = None,
    as_json: Json = False,
) -> None:
    """Show a twin with its parameters; --html writes the whole story as one page."""
    from dtwin.physics.twin import Twin
    from dtwin.pipeline.reported_twin import diagnosed, write_report
    from dtwin.report.faults import sized_effects, undecided_lines, undecided_of
    from dtwin.report.twin_of_kind import report_of
    from dtwin.twins.confirm import interventions

    require_report(html, language)
    twins = twins_named(name, effects_path)
    twin = twins.newest(name, version)
    if html is not None:
        write_report(html, home(), twins, library_with(effects_path), twin, language)
    mended = interventions(twins, name)
    lines = [
        f"{m['effect']} was mended ({m['what'] or 'not said how'}), {m['after_campaign']}: "
        f"{m['grade'] or 'did not certainly go away'}"
        for m in mended
    ]
    diagnosis = diagnosed(twins, twin)[1]
    lines += undecided_lines(diagnosis)
    document = {**twin.as_dict(), "interventions": mended, "undecided": undecided_of(diagnosis)}
    if isinstance(twin, Twin):
        document["effects"] = sized_effects(twin)
    emit(document, lambda: "\n".join([report_of(twin.as_dict()).twin_text(twin), *lines]), as_json=as_json)
    _require_kept(twins)


def _show_rung(before: Any, twin: Any, *, as_json: bool, **more: Any) -> None:
    from dtwin.report.text import micrometres
    from dtwin.report.twin_of_kind import report_of

    after_um = twin.figures["rms_after_um"]
    payload = {**twin.as_dict(), "before": dict(before.figures), **more}
    emit(
        payload,
        lambda: (
            f"{report_of(twin.as_dict()).twin_text(twin)}\nthis step: {micrometres(before.figures['rms_after_um'])} -> "
            f"{micrometres(after_um)} µm RMS\nnext: dtwin twin diagnose {twin.name}"
        ),
        as_json=as_json,
    )
    _tell_failed(twin.name)


def _tell_failed(name: str) -> None:
    """Say on stderr when MLflow did not take an earlier version."""
    from dtwin.twins.registration import waiting, waiting_text

    waiting_items = waiting(home(), name)
    if any(item.failed for item in waiting_items):
        print(waiting_text(waiting_items), file=sys.stderr)


def _require_kept(twins: AnyTwins) -> None:
    """Say, after a diagnosis was printed, that it could not be kept; refuse it where it should have been."""
    if twins.unkept:
        twins.require_kept()
        print("note: nothing is kept of this diagnosis, for the home can only be read", file=sys.stderr)


def twins_named(name: str, paths: list[Path] | None) -> AnyTwins:
    from dtwin.twins.of_kind import twins_with

    return twins_with(home(), library_with(paths), name)


def _write_page(path: Path, name: str, sections: list[Any]) -> None:
    from dtwin.report.html import page
    from dtwin.report.pdf import write_document

    write_document(path, page(f"Twin {name}", "dtwin", sections), "the report")
