"""The command that writes a correction for other controls: export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dtwin.commands._effects import Paths
from dtwin.commands._output import Json, emit
from dtwin.config import home
from dtwin.errors import InputError
from dtwin.units import shown_number, shown_unit

app = typer.Typer()
_Force = Annotated[bool, typer.Option("--force", help="Replace the file.")]


@app.command()
def export(
    source: Annotated[
        str, typer.Argument(help="latest or champion, trial, a bundle's .json, a version number, or a twin's name.")
    ],
    form: Annotated[
        str,
        typer.Option(
            "--as",
            help="c, st, python, latex, urscript, comp, siemens, siemens-cec, heidenhain, fanuc, fanuc30i, haas, beckhoff, csv, gcode, klipper, "
            "reprap; of a twin of an arm: urdf, dh, python, matlab; of a twin of drift: klipper.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="File to write.")],
    machine: Annotated[str | None, typer.Option(help="Machine, when there are several.")] = None,
    axis: Annotated[str, typer.Option(help="Axis of a compensation file.")] = "",
    travel: Annotated[
        str | None, typer.Option(help="LOW,HIGH in mm of the tables; the measured radius without.")
    ] = None,
    origin: Annotated[str, typer.Option(help="X,Y,Z in mm: centre of the measured circles on this machine.")] = "0,0,0",
    points: Annotated[
        int | None, typer.Option(help="Rows of a table, as many as the control holds; as needed without.")
    ] = None,
    program: Annotated[Path | None, typer.Option(help="G-code to compensate.")] = None,
    tolerance_um: Annotated[float, typer.Option(help="How far chords may leave the compensated path.")] = 0.1,
    effects_path: Paths = None,
    force: _Force = False,
    as_json: Json = False,
) -> None:
    """Write a registered correction as code, table or compensated program."""
    from dtwin.atomic import write_text
    from dtwin.lifecycle.export import FORMATS, Request, export_twin, require_used, source_of
    from dtwin.lifecycle.export import export as write
    from dtwin.physics.library import Library

    if form not in FORMATS:
        raise InputError("no such form", code="export.form", got=form[:40], allowed=", ".join(FORMATS))
    _require_new(out, program, force=force)
    low_high = numbers(travel, 2, "--travel") if travel is not None else None
    x, y, z = numbers(origin, 3, "--origin")
    request = Request(
        form=form,
        axis=axis.upper(),
        travel_mm=None if low_high is None else (low_high[0], low_high[1]),
        origin_mm=(x, y, z),
        points=points,
        program=program,
        tolerance_um=tolerance_um,
    )
    require_used(request)
    library = Library(effects_path or [])
    made = export_twin(home(), source, form, machine, library)
    if made is not None:
        name, version, state = source, str(made.twin_version), "twin"
    else:
        exported_source = source_of(home(), source, machine, library)
        name, version, state = exported_source.bundle.name, exported_source.version, exported_source.state
        made = write(exported_source, request)
    write_text(out, made.text, "the export")
    payload = {
        "file": str(out),
        "as": form,
        "name": name,
        "version": version,
        "state": state,
        "figures": dict(made.figures),
        "left_out": dict(made.left_out),
        "notes": list(made.notes),
    }

    def text() -> str:
        lines = [f"{out} written: {name} (version {version}, {state}) as {form}"]
        lines += [f"  {_shown({name: value})}" for name, value in made.figures.items()]
        lines += [f"  left out, {label}: {why}" for label, why in made.left_out.items()]
        return "\n".join([*lines, *(f"  note: {note}" for note in made.notes)])

    emit(payload, text, as_json=as_json)


def _require_new(out: Path, source: Path | None = None, *, force: bool) -> None:
    """Refuse a file that is there, and, forced or not, the one that is read."""
    if not out.exists():
        return
    if source is not None and source.exists() and out.samefile(source):
        raise InputError(
            "the file that is read would be lost",
            code="export.exists",
            where=str(out),
            allowed="a file beside it",
            hint="--out",
        )
    if not force:
        raise InputError("the file is there already", code="export.exists", where=str(out), hint="--force")


def _shown(value: object) -> str:
    """Return figures for people, with their units behind them; what rounding leaves of a zero is zero."""
    if isinstance(value, dict):
        return "; ".join(f"{_named(k)}{':' * isinstance(v, dict)} {_shown(v)}{_unit_of(k)}" for k, v in value.items())
    if isinstance(value, list):
        return " to ".join(map(_shown, value))
    return shown_number(round(value, 9) + 0.0) if isinstance(value, float) else str(value)


def _named(key: str) -> str:
    return key.removesuffix("_um").removesuffix("_mm").removesuffix("_rad").replace("_", " ")


def _unit_of(key: str) -> str:
    return next((f" {shown_unit(unit)}" for unit in ("um", "mm", "rad") if key.endswith(f"_{unit}")), "")


def numbers(text: str, count: int, option: str) -> list[float]:
    """Return so many numbers with commas between them, or refuse what an option got."""
    parts = text.split(",")
    try:
        values = [float(part) for part in parts]
    except ValueError:
        values = []
    if len(values) != count or not all(abs(v) < 1e6 for v in values):
        raise InputError(
            f"{option} needs {count} numbers",
            code="export.numbers",
            got=text[:80],
            allowed={2: "LOW,HIGH", 3: "X,Y,Z"}.get(count, f"{count} numbers and commas"),
        )
    return values


@app.command("robot-program")
def robot_program(
    out: Annotated[Path, typer.Option(help="URScript file to write.")] = Path("dtwin.script"),
    limit_um: Annotated[float, typer.Option(help="Largest offset along each axis.")] = 500.0,
    slew_um_s: Annotated[float, typer.Option(help="Fastest change of it.")] = 20_000.0,
    watchdog_s: Annotated[float, typer.Option(help="Silence after which the offset goes back to zero.")] = 0.012,
    force: _Force = False,
) -> None:
    """Write the URScript thread that lets a UR robot take corrections as a path offset."""
    from dtwin.atomic import write_text
    from dtwin.links.ur_program import correction_program

    text = correction_program(limit_um, slew_um_s, watchdog_s)
    _require_new(out, force=force)
    write_text(out, text, "the program")
    print(f"{out} written: not yet run on a controller; how to start it is in its first lines")


@app.command("robot-targets")
def robot_targets(
    targets: Annotated[Path, typer.Argument(help="CSV: name,x_mm,y_mm,z_mm,feed_mm_min.")],
    centre: Annotated[str, typer.Option(help="X,Y,Z in mm: where the path angle is counted from.")],
    joints: Annotated[str, typer.Option(help="J1,...,J6 in degrees near the targets: branch and tool's attitude.")],
    out: Annotated[Path, typer.Option(help="CSV file to write.")] = Path("corrected.csv"),
    plane: Annotated[str, typer.Option(help="XY, YZ or ZX.")] = "XY",
    model: Annotated[str, typer.Option(help="latest or champion, trial, or a bundle's .json file.")] = "latest",
    machine: Annotated[str | None, typer.Option(help="Machine, when there are several.")] = None,
    force: _Force = False,
    as_json: Json = False,
) -> None:
    """Rewrite a robot's next targets by a promoted correction, for controls that take no offset."""
    import numpy as np

    from dtwin.atomic import write_text
    from dtwin.serve.bundle_file import load_bundle
    from dtwin.serve.pointer import read_machine, resolve
    from dtwin.serve.targets import TargetCorrection, TargetFrame, corrected_csv, read_targets

    frame = TargetFrame(plane, np.array(numbers(centre, 3, "--centre")), np.radians(numbers(joints, 6, "--joints")))
    wanted = read_targets(targets)
    _require_new(out, targets, force=force)
    resolved = resolve(model, machine, home(), harmless=False)
    compiled = load_bundle(resolved.path, resolved.machine)
    correction = TargetCorrection(compiled, read_machine(resolved.machine, home()).tcp, frame)
    made = list(correction.corrected(wanted))
    write_text(out, corrected_csv(made), "the targets")
    longest_um = max(float(np.linalg.norm(m.offset_um)) for m in made)
    untouched = sum(not m.offset_um.any() for m in made)
    payload = {
        "file": str(out),
        "model": resolved.describe(),
        "evidence": compiled.bundle.provenance.evidence,
        "targets": len(made),
        "longest_um": longest_um,
        "not_corrected": untouched,
    }
    emit(
        payload,
        lambda: (
            f"{out} written: {len(made)} targets by {resolved.describe()}\n"
            f"  longest correction {longest_um:z.1f} µm, {untouched} not corrected (the last "
            f"column says why); evidence: {compiled.bundle.provenance.evidence}"
        ),
        as_json=as_json,
    )
