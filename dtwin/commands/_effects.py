"""Commands about effects."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dtwin.commands._output import Json, emit
from dtwin.config import home
from dtwin.errors import InputError
from dtwin.report.text import table

if TYPE_CHECKING:
    from dtwin.physics.effect import Effect

Paths = Annotated[
    list[Path] | None, typer.Option("--effects-path", help="Your own effect file or folder; its code is run.")
]

app = typer.Typer(
    name="effects",
    help="Physical causes of error: what they look like, and what to do about them.",
    no_args_is_help=True,
)


def library_with(paths: list[Path] | None) -> Mapping[str, Effect]:
    """Return the built-in effects and those of files."""
    from dtwin.physics.library import Library

    return Library(paths or [])


@app.command("list")
def list_effects(effects_path: Paths = None, as_json: Json = False) -> None:
    """List what dtwin knows."""
    effects = _sorted(library_with(effects_path))
    rows = [(e.name, e.title, e.per.replace("_", " "), ", ".join(e.kinds), e.group) for e in effects]
    own = [*_of_kinds()]
    rows += [(e["name"], e["title"], e["per"], ", ".join(e["kinds"]), e["group"]) for e in own]
    emit(
        {"effects": [_effect_dict(e) for e in effects], "of_kinds": own},
        lambda: table(("effect", "what", "one for each", "campaigns", "group"), rows),
        as_json=as_json,
    )


@app.command("show")
def show_effect(
    name: Annotated[str, typer.Argument(help="Name of the effect.")], effects_path: Paths = None, as_json: Json = False
) -> None:
    """Show what an effect is, what it is confused with, and what to do about it."""
    from dtwin.kinds.volumetric.twin_report import family_dict, family_named, family_text
    from dtwin.report.text import effect_text
    from dtwin.twins.verbs import Twins

    family = family_named(name)
    if family is not None:
        emit(family_dict(family), lambda: family_text(family), as_json=as_json)
        return
    library, own = Twins(home(), library_with(effects_path)).library, list(_of_kinds(name))
    if own and name not in library:
        emit(own[0], lambda: _own_text(own), as_json=as_json)
        return
    effect = library[name]
    # A robot arm may have an effect of the same name.
    emit(
        _effect_dict(effect) | ({"of_kinds": own} if own else {}),
        lambda: "\n\n".join([effect_text(effect), *([_own_text(own)] if own else [])]),
        as_json=as_json,
    )


@app.command("template")
def effect_template(
    name: Annotated[str, typer.Argument(help="Name of your effect, in lower case.")],
    out: Annotated[Path | None, typer.Option(help="File to write; NAME.py without.")] = None,
) -> None:
    """Write an effect file to start from."""
    from dtwin.atomic import write_text
    from dtwin.physics.template import template

    path = out or Path(f"{name}.py")
    if path.exists():
        raise InputError("the file is there already", code="effect.exists", where=str(path))
    write_text(path, template(name), "the effect")
    print(f"{path} written\nnext: edit it, then dtwin effects show {name} --effects-path {path}")


def _of_kinds(name: str = "") -> Iterator[dict[str, Any]]:
    """Yield the effects that single kinds of campaign have beside the library, those of one name, or all."""
    from dtwin.kinds.registry import kinds

    for kind in kinds():
        for effect in kind.effects.values():
            if name in ("", effect.name):
                told = {key: value for key, value in vars(effect).items() if not callable(value)}
                yield told | {"kinds": [kind.name], "per": effect.per, "parameters": effect.parameters}


def _own_text(own: Sequence[Mapping[str, Any]]) -> str:
    """Return what effects of single kinds are, for the terminal."""
    from dtwin.units import shown_unit

    told = []
    for effect in own:
        sizes = ", ".join(f"{name} ({shown_unit(unit)})" for name, unit in effect["parameters"])
        lines = {
            "parameters": sizes,
            "one for each": effect["per"],
            "campaigns": ", ".join(effect["kinds"]),
            "group": effect["group"],
            "needs": effect.get("needs"),
            "remedy": effect["remedy"],
        }
        told.append("\n".join([f"{effect['name']}: {effect['title']}", *(f"{k}: {v}" for k, v in lines.items() if v)]))
    return "\n\n".join(told)


def _sorted(library: Mapping[str, Effect]) -> list[Effect]:
    return [library[name] for name in sorted(library)]


def _effect_dict(effect: Effect) -> dict[str, Any]:
    out = {k: v for k, v in vars(effect).items() if k != "regressors"}
    out["parameters"] = [vars(p) for p in effect.parameters]
    out["shapes"] = [{**vars(s), "grid": list(s.grid)} for s in effect.shapes]
    out["law"] = vars(effect.law)
    return out
