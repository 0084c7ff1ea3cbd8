"""Command ``dtwin plan``: a campaign before anything moves."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dtwin.commands._output import Json, emit
from dtwin.errors import InputError
from dtwin.kinds.registry import own_kinds
from dtwin.report.text import table
from dtwin.units import shown_number

if TYPE_CHECKING:
    from dtwin.kinds.kind import Kind, Planned

_NOISE_UM = 1.0

app = typer.Typer()


def _controls() -> str:
    """Return which kinds know which dialects of a program, for help."""
    known = [kind for kind in own_kinds() if kind.controls]
    return "; ".join(f"{kind.name}: {', '.join(kind.controls)}" for kind in known)


@app.command()
def plan(
    file: Annotated[Path | None, typer.Argument(help="Plan file (TOML); without it the 81-test plan.")] = None,
    control: Annotated[str | None, typer.Option(help=f"With --out: dialect of the program; {_controls()}.")] = None,
    out: Annotated[Path | None, typer.Option(help="Write the motion programs of the campaign here.")] = None,
    check_only: Annotated[bool, typer.Option("--check", help="Say what the plan could tell, and what not.")] = False,
    noise_um: Annotated[
        float | None, typer.Option(help="With --check: RMS by which repeats disagree; 1 without.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Expand a campaign before anything moves: order, limits, time, programs."""
    from dtwin.kinds.registry import kind_named
    from dtwin.plan_file import planned_campaign
    from dtwin.schema import DEFAULT_KIND

    planned = kind_named(DEFAULT_KIND).usual_plan() if file is None else planned_campaign(file)
    kind = kind_named(planned.kind)
    _require_plan_options(kind, control, out, noise_um, check_only=check_only)
    findings = [finding.as_dict() for finding in planned.findings]
    payload = {**planned.summary, "total_s": planned.duration_s, "findings": findings}
    if check_only:
        from dtwin.physics.experiment import detectable
        from dtwin.physics.library import Library

        payload["noise_um"] = _NOISE_UM if noise_um is None else noise_um
        sizes = detectable(kind.foreseen(planned), Library(), noise_um=payload["noise_um"])
        payload["detectable"] = [effect.as_dict() for effect in sizes]
    elif planned.order:
        payload["order"] = list(planned.order)
    if out is not None:
        chosen = control or (kind.controls[0] if kind.controls else "")
        payload["programs"] = _write_programs(kind.programs(planned, chosen), out)
    emit(payload, lambda: _plan_text(planned, payload), as_json=as_json)


def _require_plan_options(
    kind: Kind, control: str | None, out: Path | None, noise_um: float | None, *, check_only: bool
) -> None:
    """Refuse what the kind lacks, and options that would do nothing."""
    if check_only:
        kind.require("foreseen")
    if out is not None:
        kind.require("programs")
    if noise_um is not None and not check_only:
        raise InputError(
            "the noise only acts on what a plan could detect",
            code="plan.noise",
            got=f"--noise-um {noise_um:g} without --check",
            hint="add --check, or leave it away",
        )
    if noise_um is not None and not noise_um > 0.0:
        raise InputError("the noise must be positive", code="plan.noise", got=f"{noise_um:g} µm", allowed="> 0")
    if control is None:
        return
    if out is None:
        raise InputError(
            "a control only acts on programs",
            code="plan.control",
            got=f"--control {control[:40]} without --out",
            hint="add --out FOLDER, or leave it away",
        )
    if control not in kind.controls:
        raise InputError(
            "no programs are written for this control",
            code="plan.control",
            got=control[:40],
            allowed=", ".join(kind.controls) or f"none: programs of {kind.name} tests have no dialects",
            hint="leave --control away",
        )


def _write_programs(programs: Mapping[str, str], out: Path) -> list[str]:
    from dtwin.atomic import write_text

    return [str(write_text(out / name, text, "the program")) for name, text in programs.items()]


def _plan_text(planned: Planned, payload: Mapping[str, Any]) -> str:
    lines = [*planned.lines, *(f"  {f.severity}: {f.message}" for f in planned.findings)]
    written = payload.get("programs", ())
    if len(written) == 1:
        lines.append(f"  {written[0]} written; never run on a control")
    elif written:
        lines.append(f"  {len(written)} programs written")
    if "detectable" in payload:
        lines.append(_detectable_text(payload))
    elif planned.order_text:
        lines.append(planned.order_text)
    return "\n".join(lines)


def _detectable_text(payload: Mapping[str, Any]) -> str:
    rows = [
        [
            d["label"],
            f"{shown_number(d['amplitude'])} {d['unit']}" if math.isfinite(d["amplitude"]) else "invisible",
            f"{d['typical']:g} {d['unit']}",
            "" if not math.isfinite(d["amplitude"]) else f"{d['rms_um']:z.3f}",
        ]
        for d in payload["detectable"]
    ]
    head = ("effect", "detected from (power 80 %)", "typical size", "visible RMS, µm")
    return (
        f"what this plan could detect when repeats disagree by {payload['noise_um']:g} µm RMS, "
        "alike at all harmonics:\n" + table(head, rows)
    )
