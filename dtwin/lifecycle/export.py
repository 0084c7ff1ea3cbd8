"""A registered correction in the languages and tables of other controls."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named, own_kinds
from dtwin.kinds.registry import kind_of as kind_of_bundle
from dtwin.lake.store import Lake
from dtwin.lifecycle._axis_exports import ONE_AXIS, positioning_table, tables_of
from dtwin.lifecycle._axis_tables import NOT_LOADED
from dtwin.lifecycle._export_records import UNREGISTERED, Export, Request, Source, c_header, commented, said_of, whose
from dtwin.lifecycle._gcode_compensation import compensate
from dtwin.lifecycle._skew_settings import HELD, klipper_settings, reprap_settings, skews
from dtwin.lifecycle.gcode_program import marked, program_of, require_unmarked
from dtwin.physics.effect import Effect
from dtwin.physics.twin import Twin
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import MAX_BYTES, read_json
from dtwin.serve.export_plc import NOT_RUN, to_structured_text, to_urscript
from dtwin.serve.graph_code import identifier, to_c, to_latex, to_python
from dtwin.serve.pointer import NAMES, resolve
from dtwin.train.promotion import state_of
from dtwin.train.registry import RegisteredVersion, Registry
from dtwin.train.twin_terms import choose
from dtwin.twins.machine_twin import MachineTwin
from dtwin.twins.of_kind import paths_of, twins_with

__all__ = ["FORMATS", "Export", "Request", "Source", "export", "export_twin", "require_used", "source_of"]

_EQUATIONS = ("c", "st", "python", "latex", "urscript")
_TABLES = (*ONE_AXIS, "csv", "gcode", *HELD)
_OF_TWINS = tuple(dict.fromkeys(form for kind in own_kinds() for form in kind.export_forms))
FORMATS = tuple(dict.fromkeys((*_EQUATIONS, *_TABLES, *_OF_TWINS)))
_OF_TABLES = ("travel_mm", "origin_mm", "points")
_USED = {
    "gcode": ("program", "origin_mm", "tolerance_um"),
    "csv": _OF_TABLES,
    **dict.fromkeys(ONE_AXIS, ("axis", *_OF_TABLES)),
}
"""What a request may state of a form; the others are of nothing but the correction."""


def require_used(request: Request) -> None:
    """Refuse what is stated of a form that does not use it: a file without the origin that was told would correct another place."""
    used, usual = _USED.get(request.form, ()), Request(request.form)
    told = [f.name for f in fields(Request) if getattr(request, f.name) != getattr(usual, f.name)]
    if stray := [name for name in told if name not in used]:
        options = ["--" + name.removesuffix("_mm").replace("_", "-") for name in (*stray, *used)]
        raise InputError(
            f"this form does not use {', '.join(options[: len(stray)])}",
            code="export.option",
            where=request.form,
            got=", ".join(f"{name} {getattr(request, name)}" for name in stray)[:120],
            allowed=", ".join(options[len(stray) :]) or "none of the options of tables and programs",
        )


def export_twin(
    home: Home, name: str, form: str, machine: str | None = None, library: Mapping[str, Effect] | None = None
) -> Export | None:
    """Write a twin whose kind has forms of its own, of several kinds its newest part that has; None where there is no such.

    Raises ``InputError`` when its kind does not have this form, the form cannot hold the twin, or it is of another
    machine.
    """
    if not (home.root / "twins" / Path(name).name).is_dir() or name.endswith(".json"):
        return None
    twins = twins_with(home, library, name)
    twin = twins.newest(name)
    begun = twin.begun if isinstance(twin, MachineTwin) else {}
    parts = sorted(getattr(twin, "members", (twin,)), key=lambda part: begun.get(part.campaigns[-1], ""))
    lake = Lake(home.lake)
    able = [(kind, part) for part in parts if (kind := kind_named(lake.campaign(part.campaigns[-1]).kind)).export_forms]
    held = [(kind, part) for kind, part in able if form in kind.export_forms]
    if able and not held and len(able) == len(parts):
        raise InputError(
            "a twin of this kind is not written in this form",
            code="export.form",
            where=f"twin {name}",
            got=form,
            allowed=", ".join(dict.fromkeys(one for kind, _ in able for one in kind.export_forms)),
        )
    if not held:
        return None
    kind, part = held[-1]
    made = kind.export_twin(home, part, form)
    _require_machine(name, made.machine, machine)
    return made


def _require_machine(name: str, its_machine: str, machine: str | None) -> None:
    if machine not in (None, its_machine):
        raise InputError(
            "the correction is of another machine",
            code="export.machine",
            where=name,
            got=f"--machine {machine}",
            allowed=its_machine,
        )


def source_of(home: Home, name: str, machine: str | None, library: Mapping[str, Effect] | None = None) -> Source:
    """Return what a name stands for.

    ``name``: ``latest``, ``champion``, ``trial``, a bundle's ``.json`` file, a version number with its machine, or a twin whose
    correction is registered.
    ``machine``: machine; needed when there are several, and for a version number.
    Raises ``InputError`` when there is no such thing.
    """
    registry = Registry(home, reads=True)
    if name in NAMES or name.endswith(".json"):
        resolved = resolve(name, machine, home, harmless=True)
        bundle = Bundle.from_dict(read_json(resolved.path, MAX_BYTES))
        _require_machine(name, bundle.machine, machine)
        version = _registered(registry, resolved.machine, resolved.version, bundle)
        return _source(home, bundle, resolved.state, version, library)
    if name.isdigit():
        if machine is None:
            raise InputError(
                "a version number needs its machine",
                code="export.machine",
                got=name,
                hint="--machine NAME; dtwin models lists both",
            )
        version = registry.version(machine, name)
    else:
        version = _of_twin(home, registry, name)
    bundle = Bundle.from_dict(registry.bundle(version))
    _require_machine(name, bundle.machine, machine)
    return _source(home, bundle, state_of(version, home), version, library)


def export(source: Source, request: Request) -> Export:
    """Write a correction in one form. Raises ``InputError`` when the form cannot hold it."""
    require_used(request)
    if request.form in _EQUATIONS:
        return _equation(source, request.form)
    if request.form not in _TABLES:
        raise InputError(
            "this form is of a twin whose kind writes it",
            code="export.form",
            where=source.bundle.name,
            got=request.form,
            allowed=", ".join((*_EQUATIONS, *_TABLES)),
            hint="dtwin export TWIN --as " + request.form,
        )
    kind = kind_of_bundle(source.bundle)
    if kind.offers("axis_errors") and request.form in (*ONE_AXIS, "csv"):
        return positioning_table(source, kind.axis_errors(source.bundle), request)
    if source.twin is None or not any(source.twin.box.planes):
        raise InputError(
            "this form needs the error of single axes",
            code="export.axes",
            where=source.bundle.name,
            got=f"a correction of {kind.name} campaigns" if source.twin else "an equation along the path",
            allowed="the correction of a twin of circles",
            hint="dtwin twin correct NAME, then dtwin export NAME",
        )
    if request.form == "gcode":
        return _program(source, source.twin, request)
    if request.form in HELD:
        return _settings(source, source.twin, request.form)
    return tables_of(source, source.twin, request)


def _equation(source: Source, form: str) -> Export:
    bundle = source.bundle
    if bundle.window_graph is not None or bundle.feature_inputs:
        raise InputError(
            "the equation needs windows of sensor signals, which these forms do not hold",
            code="export.window",
            where=bundle.name,
            hint="serve it: dtwin serve",
        )
    graph, inputs, states = bundle.tick_graph, bundle.tick_inputs, bundle.initial_state
    outputs = tuple(o.name for o in bundle.outputs)
    name = identifier(bundle.name).strip("_").lower()
    said = said_of(source.bundle, source.version, source.state)
    if form == "latex":
        return Export("".join(f"% {line}\n" for line in said) + to_latex(graph) + "\n")
    if form == "python":
        box = "".join(f"    {i.name!r}: ({i.low!r}, {i.high!r}),\n" for i in bundle.inputs)
        head = "".join(f"# {line}\n" for line in said) + f"BOX = {{\n{box}}}\n"
        return Export(head + to_python(graph, name))
    if form == "c":
        return Export(c_header(said, bundle, to_c(graph, inputs, tuple(states), outputs, name)))
    if form == "st":
        text = to_structured_text(graph, inputs, states, f"DTWIN_{name.upper()}")
        return Export(commented(said, "(* ", " *)") + text, notes=(NOT_RUN,))
    text = to_urscript(graph, inputs, tuple(states), f"dtwin_{name}")
    return Export(commented(said, "# ", "") + text, notes=(NOT_RUN,))


def _settings(source: Source, twin: Twin, form: str) -> Export:
    said = [*whose(source.bundle, source.version, source.state), NOT_LOADED]
    if form == "klipper":
        settings = skews(twin)
        text = klipper_settings(settings, said)
    else:
        text, settings = reprap_settings(twin, said)
    held = HELD[form]
    left_out = {t.label: f"is no {' or '.join(held)}" for t in twin.terms if t.instance.effect.name not in held}
    notes = (NOT_LOADED, "the values replace those that were in force: they are right for tests without any of them")
    return Export(text, {"skew_rad" if form == "klipper" else "settings": settings}, left_out, notes)


def _program(source: Source, twin: Twin, request: Request) -> Export:
    if request.program is None:
        raise InputError("there is no program to compensate", code="export.program", hint="--program FILE")
    if not 0.001 <= request.tolerance_um <= 100.0:
        raise InputError(
            "the tolerance makes no sense",
            code="export.tolerance",
            got=f"{request.tolerance_um:g} µm",
            allowed="0.001 to 100 µm",
        )
    text = program_of(request.program)
    require_unmarked(text, request.program.name)
    made = compensate(
        text, twin, origin_mm=np.array(request.origin_mm), where=request.program.name, tolerance_um=request.tolerance_um
    )
    notes = ["the tool's own program is changed: compare both before it runs"]
    if made.outside:
        notes.append(
            f"{made.outside} of the evaluated points lie further out than "
            f"{twin.box.radius_mm[1]:g} mm, where nothing was measured"
        )
    figures = {
        "motions": made.points,
        "largest_um": made.largest_um,
        "interpolation_error_um": made.interpolation_um,
        "points_outside": made.outside,
    }
    said = f"{source.bundle.name} of {source.bundle.machine}, version {source.version}, {source.state}"
    return Export(marked(made.text, said), figures, {}, tuple(notes))


def _source(
    home: Home, bundle: Bundle, state: str, version: RegisteredVersion | None, library: Mapping[str, Effect] | None
) -> Source:
    number = UNREGISTERED if version is None else version.version
    if version is None or "twin" not in version.tags:
        return Source(bundle, state, None, number)
    told = version.tags.get("twin_version", "")
    if not told.isdecimal():
        raise InputError(
            "the registry does not say of which version of its twin a correction is",
            code="export.tags",
            where=f"version {number} of {version.machine}",
            got=f"twin_version {told[:40]}",
            allowed="a number",
            hint="somebody changed it on MLflow's page: dtwin twin correct registers the twin's correction again",
        )
    whole = paths_of(home, library, version.tags["twin"], int(told))
    twin = whole.on(version.tags.get("twin_campaign", whole.campaign))
    kept = tuple(t for t in twin.terms if choose(t).included)
    if version.tags.get("trial_only"):
        state = f"{state}, for a trial only: {version.tags['trial_only'][:120]}"
    return Source(bundle, state, replace(twin, terms=kept), number)


def _registered(registry: Registry, machine: str, number: int, bundle: Bundle) -> RegisteredVersion | None:
    """Return the version that a bundle says it is; None when it is not registered, or another equation is."""
    try:
        version = registry.version(machine, str(number))
    except InputError:
        return None
    same = Bundle.from_dict(registry.bundle(version)).model_sha256 == bundle.model_sha256
    return version if same else None


def _of_twin(home: Home, registry: Registry, name: str) -> RegisteredVersion:
    twin = twins_with(home, None, name).newest(name)
    for version in registry.versions(twin.machine):
        if version.tags.get("twin") == name:
            return version
    raise InputError(
        "the twin's correction is not registered",
        code="export.twin",
        where=f"twin {name}",
        hint=f"dtwin twin correct {name} checks and registers it",
    )
