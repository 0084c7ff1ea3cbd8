"""Commands about slow tool servo turning."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from dtwin.commands._output import Json, ProgressLine, emit
from dtwin.errors import EXIT_GATE, InputError
from studies.commands.demo import paper_of

_Truth = Annotated[str, typer.Option(help="Mechanism of the virtual slide: linear, hardening, friction.")]

app = typer.Typer(
    name="turning",
    help="Slow tool servo: fit the error of tones, try it in the loop, compare with a published slide.",
    no_args_is_help=True,
)


@app.command("fit")
def fit(
    campaign: Annotated[Path, typer.Argument(help="Campaign folder of tones.")],
    model: Annotated[
        str, typer.Option(help="two-modes, power-law, printed-form (refitted), symbolic (free search).")
    ] = "two-modes",
    action: Annotated[
        str,
        typer.Option(
            help="inverse: divides the command by the gain; subtract: takes the error vector off; "
            "printed: amplitude error times a sine."
        ),
    ] = "inverse",
    out: Annotated[Path, typer.Option(help="Bundle to write.")] = Path("turning.json"),
    seed: Annotated[int, typer.Option(min=0, help="Of the free search.")] = 1,
    force: Annotated[
        bool, typer.Option("--force", help="Write it though a gate says no, or the file is there.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Fit amplitude and phase error of tones, judge the equations, write them as a bundle."""
    from studies.turning_fit import ACTIONS, MODELS, fitted_tones, folder_groups

    if model not in MODELS or action not in ACTIONS:
        raise InputError(
            "no such equation",
            code="turning.model",
            got=f"--model {model[:40]} --action {action[:40]}",
            allowed=f"--model {', '.join(MODELS)}; --action {', '.join(ACTIONS)}",
        )
    machine, groups = folder_groups(campaign, ProgressLine("read", quiet=as_json))
    made = fitted_tones(machine, groups, model, action, seed)
    written, said = made.write(out, force=force)
    payload = {
        "model": made.candidate.name,
        "action": action,
        "file": str(out) if written else None,
        "told": made.told,
        "equation": made.candidate.equation,
        "scores": {k: s.as_dict() for k, s in made.candidate.scores.items()},
        "numbers": dict(made.candidate.numbers),
        "gates": [vars(v) for v in made.verdicts],
    }
    lines = [*made.told, "", made.candidate.equation, *said]
    emit(payload, lambda: "\n".join(lines), as_json=as_json)
    if not written:
        raise typer.Exit(EXIT_GATE)


@app.command("compensate")
def compensate(
    model: Annotated[str, typer.Argument(help="A bundle's .json file, or latest, which is champion, or trial.")],
    truth: _Truth = "linear",
    frequency: Annotated[list[float] | None, typer.Option(help="Of the tool in Hz; 5, 10, 20, 30, 40 without.")] = None,
    machine: Annotated[str | None, typer.Option(help="Required when several machines have a model.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of noise.")] = 1,
    html: Annotated[Path | None, typer.Option("--html", help="Write surfaces and errors, one offline page.")] = None,
    as_json: Json = False,
) -> None:
    """Cut a bicuspid surface on the virtual slide at 8 kHz, without and with the correction."""
    from dtwin.atomic import write_text
    from dtwin.commands._models import bundle_on_virtual
    from dtwin.report.html import page
    from dtwin.serve.bundle_file import load_bundle
    from studies.bicuspid import TRIAL_HZ, trial
    from studies.report.turning import trial_section, trial_text

    chosen = tuple(frequency or TRIAL_HZ)
    if not all(0.5 <= f <= 200.0 for f in chosen):
        raise InputError(
            "the tool cannot move so", code="turning.frequency", got=f"{chosen} Hz", allowed="0.5 to 200 Hz"
        )
    path, told = bundle_on_virtual(model, machine)
    bundle = load_bundle(path).bundle
    result, surfaces = trial(
        bundle, truth=truth, seed=seed, frequencies_hz=chosen, progress=ProgressLine("cut", quiet=as_json)
    )
    payload: dict[str, Any] = {"model": told, **result}
    if html is not None:
        section = trial_section(result, surfaces)
        write_text(html, page("Slow tool servo", told, [section]), "the page")
        payload["html"] = str(html)
    lines = [told, trial_text(result), *([str(html)] if html else [])]
    emit(payload, lambda: "\n".join(lines), as_json=as_json)


app.command("paper")(paper_of("turning"))
