"""Effects in the order in which a shop thinks of a machine."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, TypeVar

_ORDER = ("geometry", "drive", "dynamics", "heat", "instrument")
_OWN = "your own"


class _Grouped(Protocol):
    @property
    def group(self) -> str: ...


_Effect = TypeVar("_Effect", bound=_Grouped)


def grouped(effects: Iterable[_Effect]) -> list[tuple[str, list[_Effect]]]:
    """Return effects by group, empty groups left out; those of the user's own groups, or of none, come last."""
    of_group: dict[str, list[_Effect]] = {group: [] for group in _ORDER}
    for effect in effects:
        of_group.setdefault(effect.group or _OWN, []).append(effect)
    return [(group, some) for group, some in of_group.items() if some]
