"""Pages about effects, and the user's own ones."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field
from starlette.responses import JSONResponse, Response

from dtwin.atomic import write_text
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.physics.effect import Effect
from dtwin.physics.gridding import fine_angle_rad
from dtwin.physics.library import Library, instances
from dtwin.physics.state import circular_state
from dtwin.physics.template import template
from dtwin.report.signatures import signature_caption, signature_svg
from dtwin.report.text import effect_text
from dtwin.schema import RunMeta, require_name
from dtwin.workbench._bench import Bench, Here
from dtwin.workbench._pages import download, rendered

router = APIRouter()
_MAX_SOURCE = 200_000


class _EffectSource(BaseModel):
    """A file of the user's own effect."""

    name: str
    source: str = Field(max_length=_MAX_SOURCE)


@router.get("/effects")
def effect_list(request: Request, bench: Here, edit: str = "") -> Response:
    """Show all effects, and the user's own with what is wrong with them."""
    library = [e for _, e in sorted(bench.library.items())]
    source = _source(bench, edit) if edit else ""
    return rendered(
        request,
        "effects.html",
        title="Effects",
        effects=library,
        pictures=bench.cache.get(
            ("signatures", *(e.regressors for e in library)),
            lambda: {e.name: signature_svg(e, width=48) for e in library},
        ),
        folder=bench.effects_path,
        errors=bench.effect_errors,
        own=[f.stem for f in bench.own_files()],
        edit=edit,
        source=source,
    )


@router.get("/effects/{name}")
def effect_page(request: Request, bench: Here, name: str) -> Response:
    """Show what an effect is."""
    effect = bench.library[name]
    return rendered(
        request,
        "effect.html",
        title=f"Effect {name}",
        effect=effect,
        facts=[line.partition(": ")[::2] for line in effect_text(effect).splitlines()[2:]],
        picture=signature_svg(effect),
        caption=signature_caption(effect),
    )


@router.get("/effect-template.py")
def effect_template(name: str = "my_effect") -> Response:
    """Return a file to start from."""
    return download(template(name), f"{require_name(name, 'the effect')}.py", "text/x-python")


@router.post("/api/effects")
def save(bench: Here, wanted: _EffectSource) -> JSONResponse:
    """Keep a file of an own effect, and say whether it works; a file that does not is not kept.

    Its code is run: the server must have been started with ``--effects-path``.
    """
    path = _own_path(bench, wanted.name)
    effect = _checked(bench, path, wanted.source)
    write_text(path, wanted.source, "the effect")
    return JSONResponse({"text": effect_text(effect), "name": effect.name})


def _checked(bench: Bench, path: Path, source: str) -> Effect:
    """Return the effect of a file when the library takes it and it can be computed."""
    others = [f for f in bench.own_files() if f != path and f.name not in bench.effect_errors]
    known = set(Library(others))
    with tempfile.TemporaryDirectory() as folder:
        trial = Path(folder) / path.name
        trial.write_text(source, encoding="utf-8")
        try:
            library = Library([*others, trial])
            effect = replace(library[next(iter(set(library) - known))], source=path.name)
            _compute(effect)
        except InputError as error:
            raise InputError(
                error.message, code=error.code, where=path.name, got=error.got, allowed=error.allowed, hint=error.hint
            ) from error
    return effect


def _compute(effect: Effect) -> None:
    """Compute an effect on a circle, so that a mistake shows before a fit."""
    if effect.needs or not any(kind_named(kind).goes_round for kind in effect.kinds):
        return
    meta = RunMeta("trial", plane="XY", direction="CCW", radius_mm=100.0, feed_mm_min=1200.0)
    state = circular_state(meta, fine_angle_rad(), feed_mm_s=20.0, columns={}, geometry={})
    for instance in instances(effect, ("XY",), ("X", "Y"), joints=False):
        effect.columns(state, instance.axis, effect.start_shape)


def _own_path(bench: Bench, name: str) -> Path:
    if bench.effects_path is None:
        raise InputError(
            "own effects are switched off, because their code is run",
            code="effect.off",
            hint="start the workbench with: dtwin ui --effects-path FOLDER",
        )
    plain = require_name(name, "the effect")
    if not plain.isidentifier():
        raise InputError(
            "the name of an effect is a Python name", code="effect.name", got=plain, allowed="letters, digits and _"
        )
    return bench.effects_path / f"{plain}.py"


def _source(bench: Bench, name: str) -> str:
    path = _own_path(bench, name)
    return path.read_text(encoding="utf-8") if path.is_file() else template(name)
