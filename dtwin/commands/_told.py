"""Options that tell what a table that lies alone does not: how it was measured."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Annotated, Any

import typer

from dtwin.config import home

_OPTIONS: Mapping[str, tuple[str, type, str]] = {
    "plane": ("plane", str, "Of a table that lies alone: XY, YZ or ZX."),
    "radius": ("radius_mm", float, "Of such a table: programmed radius, mm."),
    "feed": ("feed_mm_min", float, "Of such a table: programmed feed, mm/min."),
    "direction": ("direction", str, "Of such a table: CCW or CW; else as the angle runs."),
    "axis": ("axis", str, "Of a positioning table: the axis, such as X, or C of a rotary one."),
    "pitch": (
        "screw_pitch_mm",
        float,
        "Of a positioning table: travel in a turn of the screw, mm, 0 with a linear scale; else as the machine's record says.",
    ),
    "instrument": ("instrument", str, "Of a report with readings of several: which, as the report calls it."),
    "kind": ("kind", str, "Of such a table: the kind of test, where heads do not tell it, such as rotary."),
    "setup": ("setup", str, "Of such a table: mounting of the instrument."),
    "repeat": ("repeat", int, "Of such a table: counts repeats from 1."),
    "machine": ("machine", str, "Of such a table: name of the machine."),
    "started": ("started", str, "Of such a table: when it was measured, such as 2026-03-02."),
    "campaign": ("campaign", str, "Of such a table: name of the campaign; else the file's."),
}
"""What each is in campaign.toml, its type, and what it helps with."""


def tells_a_table(*without: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command these options; it takes what they tell as ``told``, named as in campaign.toml.

    ``without``: options that the command does not have.
    """
    names = [name for name in _OPTIONS if name not in without]

    def with_options(command: Callable[..., None]) -> Callable[..., None]:
        @wraps(command)
        def told_command(**given: Any) -> None:
            told = {_OPTIONS[name][0]: given.pop(name) for name in names}
            command(**given, told=told | _of_record(told))

        own = inspect.signature(command, eval_str=True)
        options = [
            inspect.Parameter(
                name,
                inspect.Parameter.KEYWORD_ONLY,
                default=None,
                annotation=Annotated[of | None, typer.Option(help=said)],
            )
            for name in names
            for _, of, said in [_OPTIONS[name]]
        ]
        kept = [p.replace(kind=p.KEYWORD_ONLY) for p in own.parameters.values() if p.name != "told"]
        # What is printed as JSON, which every command has, comes last.
        told_command.__signature__ = own.replace(parameters=[*kept[:-1], *options, kept[-1]])  # type: ignore[attr-defined]
        return told_command

    return with_options


def _of_record(told: Mapping[str, Any]) -> dict[str, Any]:
    """Return the pitch of a screw that the machine's record knows, where none is told."""
    from dtwin.machine_record import read_record

    if told.get("screw_pitch_mm") is not None or not told["machine"] or not told["axis"]:
        return {}
    record = read_record(home(), told["machine"])
    return {} if record is None else {"screw_pitch_mm": record.axes.get(told["axis"], {}).get("pitch_mm")}
