"""Commands about models: features, train, models, promote, rollback, report."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dtwin.commands._output import Json, ProgressLine, emit
from dtwin.config import home
from dtwin.errors import EXIT_GATE, InputError
from dtwin.progress import Progress
from dtwin.report.text import table

if TYPE_CHECKING:
    from dtwin.train.registry import Registry
    from dtwin.train.symbolic import Engine

Machine = Annotated[str | None, typer.Option(help="Required when there are several.")]


def _short(comment: str) -> str:
    if comment:
        from dtwin.train.promotion_books import require_comment

        require_comment(comment)
    return comment


_Comment = Annotated[str, typer.Option(help="Why; kept in the history.", callback=_short)]

app = typer.Typer()


@app.command()
def features(campaign: Annotated[str, typer.Argument(help="Campaign in the lake.")], as_json: Json = False) -> None:
    """Compute the signal features of a campaign into the lake."""
    from dtwin.pipeline.measuring import compute_features

    features = compute_features(home(), campaign, ProgressLine("features", quiet=as_json))
    payload = dict(vars(features)) | {"contract": features.contract.to_dict() if features.contract else None}
    emit(
        payload,
        lambda: (
            f"{campaign}: {features.windows} windows of {features.runs} runs, "
            f"{features.not_finite} not finite, {features.constant} constant; table version {features.version}"
            if features.runs
            else f"{campaign}: no run of it has signals that features are computed of"
        ),
        as_json=as_json,
    )


@app.command()
def train(
    campaign: Annotated[str, typer.Argument(help="Campaign in the lake.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything random.")] = 1,
    engine: Annotated[str, typer.Option(help="Free symbolic search: operon, or pysr (needs Julia).")] = "operon",
    as_json: Json = False,
) -> None:
    """Train every candidate, compare on conditions left out, register the best equation."""
    from dtwin.lifecycle.train import train as train_and_register
    from dtwin.report.campaign import comparison_table
    from dtwin.train.promotion import verdict_lines

    search = _engine(engine)
    lines: dict[str, Progress] = {}

    def tell(stage: str, done: int, total: int, what: str) -> None:
        lines.setdefault(stage, ProgressLine(stage, quiet=as_json))(done, total, what)

    registered = train_and_register(home(), campaign, seed=seed, engine=search, progress=tell)
    result = registered.training.report
    payload = {
        "campaign": campaign,
        "machine": result.machine,
        "version": registered.version.version,
        "proposed": result.proposed,
        "noise_floor_um": None if math.isnan(result.noise_floor_um) else result.noise_floor_um,
        "told": list(result.told),
        "rms_before_um": result.rms_before_um,
        "table_versions": dict(result.table_versions),
        "candidates": [
            {
                "name": c.name,
                "promotable": c.promotable,
                "complexity": c.complexity,
                "scores": {k: s.as_dict() for k, s in c.scores.items()},
                "latency": vars(c.latency) if c.latency else None,
                "findings": list(c.findings),
            }
            for c in result.candidates
        ],
        "gates": [vars(v) for v in registered.verdicts],
    }

    def text() -> str:
        head = f"{campaign}: {result.rms_before_um:z.1f} µm RMS without a model, noise floor {result.noise_floor_text}"
        gates = "\n".join(verdict_lines(registered.verdicts))
        failed = [v.gate for v in registered.verdicts if not v.passed]
        advice = f"next: dtwin promote {registered.version.version} --machine {result.machine}"
        return "\n".join(
            [
                head,
                *result.told,
                table(*comparison_table(result.candidates)),
                f"registered {result.proposed} as version {registered.version.version}",
                gates,
                f"dtwin promote will refuse it: {', '.join(failed)}" if failed else advice,
            ]
        )

    emit(payload, text, as_json=as_json)


@app.command()
def models(machine: Machine = None, as_json: Json = False) -> None:
    """List registered versions, what they are, and the history of promotions."""
    from dtwin.train.promotion import listed
    from dtwin.train.promotion_books import history
    from dtwin.train.registry import MODEL, Registry
    from dtwin.twins.registration import log_waiting, waiting_text

    left = log_waiting(home())
    listing = listed(Registry(home(), reads=True), home(), machine)
    past = {m: history(home(), m) for m in sorted({v.machine for v, _ in listing})}
    payload = {
        "versions": [dict(vars(v)) | {"state": state} for v, state in listing],
        "history": past,
        "not_in_mlflow": [item.as_dict() for item in left],
    }

    def text() -> str:
        last = [waiting_text(left)] if left else []
        if not listing:
            of = f" of machine {machine}" if machine else ""
            none = f"no model{of} is registered yet; make one with: dtwin train CAMPAIGN"
            return "\n".join([none, *last])
        rows = [
            [
                v.machine,
                v.version,
                ", ".join(v.aliases) or "-",
                state,
                v.tags.get("gates", "-"),
                v.tags.get("evidence", "none"),
                v.tags.get("proved", "-")[:10],
                v.created,
                v.tags.get(MODEL, "-")[:12],
            ]
            for v, state in listing
        ]
        head = ("machine", "version", "alias", "state", "gates", "evidence", "last proved", "created", "model")
        lines = [table(head, rows)]
        made = [
            [
                name,
                e["time"][:16].replace("T", " "),
                e["version"],
                e["action"],
                e["comment"] or "-",
                ", ".join(e["failed"]) or "-",
            ]
            for name, entries in past.items()
            for e in entries
        ]
        if made:
            lines += ["", table(("machine", "when, UTC", "version", "what", "why", "failed gates"), made)]
        return "\n".join([*lines, *last])

    emit(payload, text, as_json=as_json)


@app.command()
def promote(
    version: Annotated[str, typer.Argument(help="Version number, or candidate.")] = "candidate",
    machine: Machine = None,
    trial: Annotated[bool, typer.Option("--trial", help="Only put it on trial.")] = False,
    despite: Annotated[
        list[str] | None, typer.Option(help="Evidence on record that speaks against it, by name; kept in the history.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the virtual machine.")] = 0,
    comment: _Comment = "",
    valid_days: Annotated[
        float, typer.Option(min=0.0, max=36_500.0, help="How long the evidence holds; 0: for ever.")
    ] = 0.0,
    as_json: Json = False,
) -> None:
    """Check a version and make it champion, or say why not (exit 3).

    Its evidence (dtwin evidence) is computed again from the runs in the lake. Without any, the
    virtual machine that the campaign came from is measured first.
    """
    from dtwin.lifecycle.evidence import make_champion, proven_or_measured
    from dtwin.lifecycle.train import put_on_trial
    from dtwin.report.campaign import evidence_table
    from dtwin.serve._lease import is_leased
    from dtwin.train.registry import Registry

    registry = Registry(home())
    registered = registry.version(machine_named(registry, machine), version)
    served = is_leased(registered.machine, home())
    keeps = "\nthe machine is served now: that session keeps its version until it is begun again" if served else ""
    if trial:
        path = put_on_trial(home(), registered, comment)
        emit(
            {"version": registered.version, "state": "trial", "bundle": str(path), "served_now": served},
            lambda: f"version {registered.version} is on trial: dtwin serve --model trial --trial{keeps}",
            as_json=as_json,
        )
        return
    progress = ProgressLine("measure", quiet=as_json)
    given = proven_or_measured(home(), registered, seed=seed, progress=progress).as_dict()
    bundle, reason = make_champion(home(), registered, comment, despite or [], valid_days)
    payload = {
        "version": registered.version,
        "champion": bundle is not None,
        "bundle": str(bundle) if bundle else None,
        "reason": reason,
        "served_now": served,
        "evidence": given,
    }

    def text() -> str:
        state = f"champion: version {registered.version}, {bundle}{keeps}" if bundle else reason
        return "\n".join([table(*evidence_table(given)), state])

    emit(payload, text, as_json=as_json)
    if bundle is None:
        raise typer.Exit(EXIT_GATE)


@app.command()
def rollback(machine: Machine = None, comment: _Comment = "", as_json: Json = False) -> None:
    """Bar the champion and go back to the one before it; without one nothing is served."""
    from dtwin.train.promotion import rollback as go_back
    from dtwin.train.registry import Registry

    registry = Registry(home())
    restored = go_back(registry, home(), machine_named(registry, machine), comment)
    version = None if restored is None else restored.version
    told = f"champion again: version {version}" if version else "withdrawn; none is served"
    emit({"champion": version}, lambda: told, as_json=as_json)


@app.command()
def report(
    source: Annotated[Path, typer.Argument(help="A .b5r file.")],
    out: Annotated[
        Path | None, typer.Option(help="File to write: .html, or .pdf where a browser is installed.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Write one self-contained HTML page about a recording."""
    from dtwin.report.campaign import recording_section, sheet_section
    from dtwin.report.checking import check_source
    from dtwin.report.html import page
    from dtwin.report.pdf import write_document

    if source.suffix.lower() != ".b5r":
        raise InputError(
            "only a ball-bar file can be reported on by itself",
            code="report.source",
            got=str(source)[:80],
            allowed=".b5r",
            hint="dtwin certificate CAMPAIGN makes a page of a campaign, dtwin twin compare NAME --html FILE of a twin",
        )
    result = check_source(source)
    sections = [sheet_section(result["sheet"]), recording_section(source, result)]
    target = out or home().reports / f"{source.stem}.html"
    content = page(source.name, f"machine {result['machine']}", sections)
    write_document(target, content, "the report")
    emit({"report": str(target)}, lambda: str(target), as_json=as_json)


def machine_named(registry: Registry, named: str | None) -> str:
    """Return the machine that was named, or the only one that has a model.

    Raises ``InputError`` for one without a model.
    """
    from dtwin.serve.pointer import machine_folder

    known = registry.machines()
    # What is served is taken back also where the registry has lost it.
    if named is not None and (named in known or machine_folder(named, home()).is_dir()):
        return named
    if named is not None and known:
        raise InputError(
            "no model of this machine is registered yet",
            code="models.machine",
            got=named,
            allowed=", ".join(known),
            hint="dtwin train CAMPAIGN",
        )
    if len(known) == 1:
        return known[0]
    raise InputError(
        "no model is registered yet" if not known else "several machines have models",
        code="models.machine",
        got=", ".join(known) or None,
        hint="dtwin train CAMPAIGN" if not known else "name one with --machine",
    )


def bundle_on_virtual(model: str, machine: str | None) -> tuple[Path, str]:
    """Return a bundle's file and what to call it, from a file's name, ``latest`` or ``trial``.

    The machine is virtual: nothing can be harmed by a version that did not pass.
    """
    from dtwin.serve.pointer import resolve

    if model.endswith(".json"):
        return Path(model), model
    resolved = resolve(model, machine, home(), harmless=True)
    return resolved.path, resolved.describe()


def _engine(name: str) -> Engine | None:
    """Return the engine that was asked for; None for each kind of campaign's own Operon."""
    from dtwin.train.symbolic import PySREngine

    if name == "operon":
        return None
    if name == "pysr":
        PySREngine.require()
        return PySREngine()
    raise InputError("no such engine", code="train.engine", got=name[:40], allowed="operon, pysr")
