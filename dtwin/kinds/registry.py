"""The kinds that there are: those of dtwin, and those of others by entry point ``dtwin.kinds``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING

from dtwin.errors import InputError
from dtwin.kinds.kind import Kind
from dtwin.kinds.machine import VirtualMachine

if TYPE_CHECKING:
    from dtwin.serve.bundle import Bundle

_OWN = ("circular", "linear", "sinusoidal", "volumetric", "placement", "poses", "drift", "rotation", "rotary")


@cache
def _of_others() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group="dtwin.kinds")}


def kind_names() -> tuple[str, ...]:
    """Return the names of all kinds, those of dtwin first."""
    return (*_OWN, *(name for name in sorted(_of_others()) if name not in _OWN))


@cache
def kind_named(name: str) -> Kind:
    """Return a kind by its name. Raises ``InputError`` when there is none of that name."""
    if name in _OWN:
        kind = import_module(f"dtwin.kinds.{name}.record").KIND
    elif name in _of_others():
        kind = _of_others()[name].load()
    else:
        raise InputError(
            "unknown kind of campaign", code="campaign.kind", got=str(name)[:60], allowed=", ".join(kind_names())
        )
    if not isinstance(kind, Kind) or kind.name != name:
        raise InputError(
            "an entry point of dtwin.kinds gives no kind of its name",
            code="kind.entry_point",
            got=name,
            allowed="an instance of dtwin.kinds.kind.Kind with that name",
        )
    return kind


def kinds() -> Iterator[Kind]:
    """Yield every kind."""
    return map(kind_named, kind_names())


def own_kinds() -> Iterator[Kind]:
    """Yield the kinds of dtwin: cheap, and no plug-in can break it."""
    return map(kind_named, _OWN)


def unit_of_limit(symbol: str) -> str:
    """Return the unit of a tolerance: of ``rotary:A`` that of the figures of such a kind, else ``um``."""
    name, colon, _ = symbol.partition(":")
    return kind_named(name).unit if colon and name in kind_names() else "um"


def kind_of(bundle: Bundle) -> Kind:
    """Return the kind of campaign that a bundle was made of."""
    # The help lists virtual machines; it does not wait for numpy.
    from dtwin.schema import DEFAULT_KIND

    if bundle.corrects:
        return kind_named(bundle.corrects)
    # An older one does not say it.
    return next((kind for kind in own_kinds() if kind.recognises(bundle)), kind_named(DEFAULT_KIND))


def machines(of: Iterable[Kind] | None = None) -> Iterator[VirtualMachine]:
    """Yield the virtual machines of some kinds, of all without."""
    for kind in kinds() if of is None else of:
        yield from kind.machines


def machine_named(name: str) -> VirtualMachine:
    """Return a virtual machine by its name. Raises ``InputError`` when there is none of that name."""
    for machine in machines():
        if machine.name == name:
            return machine
    raise InputError(
        "no such virtual machine",
        code="simulate.machine",
        got=name[:40],
        allowed=", ".join(machine.name for machine in machines()),
    )


def machine_of_type(type_: object) -> VirtualMachine | None:
    """Return the virtual machine whose campaigns state a type in ``machine_geometry``, or None."""
    return next((machine for machine in machines() if machine.type == type_), None)
