"""All effects that are known: built in, from entry points, and from the user's own files."""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType

from dtwin.errors import InputError
from dtwin.physics import effects
from dtwin.physics.effect import Effect, Instance
from dtwin.physics.learned import PREFIX, learned_effect
from dtwin.physics.state import has_joints
from dtwin.schema import require_name

_ENTRY_POINTS = "dtwin.effects"
_N_JOINTS = 6


@cache
def _of_others() -> tuple[EntryPoint, ...]:
    """Return effects of other packages; to look through all of them takes four times as long as all else that a library does."""
    return tuple(entry_points(group=_ENTRY_POINTS))


class Library(Mapping[str, Effect]):
    """Effects by name.

    Args:
        paths: The user's own effect files, or folders of them. Their code is run.

    Raises:
        InputError: When a file has no usable ``EFFECT``, or its name is taken.
    """

    def __init__(self, paths: Sequence[Path] = ()) -> None:
        self._effects: dict[str, Effect] = {}
        for module in pkgutil.iter_modules(effects.__path__):
            self._add(_effect_of(importlib.import_module(f"{effects.__name__}.{module.name}")))
        for entry in _of_others():
            self._add(_as_effect(entry.load(), entry.value))
        for path in paths:
            for file in sorted(path.glob("*.py")) if path.is_dir() else [path]:
                self._add(_from_file(file))

    def __getitem__(self, name: str) -> Effect:
        """Return an effect."""
        if name in self._effects:
            return self._effects[name]
        if name.startswith(PREFIX):
            return learned_effect(name)
        raise InputError(
            "no such effect",
            code="effect.unknown",
            got=name[:60],
            allowed=", ".join(sorted(self._effects)),
            hint="dtwin effects list; --effects-path FILE adds your own",
        )

    def __contains__(self, name: object) -> bool:
        """Tell whether there is an effect of that name."""
        return name in self._effects or str(name).startswith(PREFIX)

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(self._effects)

    def __len__(self) -> int:
        """Return how many effects there are."""
        return len(self._effects)

    def _add(self, effect: Effect) -> None:
        taken = self._effects.get(effect.name)
        if taken is not None:
            raise InputError(
                "two effects have the same name",
                code="effect.twice",
                got=f"{effect.name} in {effect.source} and {taken.source}",
                hint="rename yours",
            )
        self._effects[effect.name] = effect


def instances(effect: Effect, planes: Sequence[str], axes: Sequence[str], *, joints: bool) -> list[Instance]:
    """Return an effect on every axis, plane or joint of a campaign.

    Args:
        joints: Whether the joints of the machine are known.
    """
    if effect.per == "machine":
        return [Instance(effect)]
    if effect.per == "axis":
        return [Instance(effect, axis) for axis in axes]
    if effect.per == "machine_and_axis":
        return [Instance(effect), *(Instance(effect, axis) for axis in axes)]
    if effect.per == "joint":
        return [Instance(effect, str(n + 1)) for n in range(_N_JOINTS)] if joints else []
    if effect.per == "plane" or len(planes) == 1:
        return [Instance(effect, plane) for plane in planes]
    return [Instance(effect, axis) for axis in axes]


def campaign_instances(
    library: Mapping[str, Effect], kind: str, planes: Sequence[str], axes: Sequence[str], geometry: Mapping[str, object]
) -> list[Instance]:
    """Return everything in the library that could act in a campaign, set-up terms first.

    Args:
        geometry: ``machine_geometry`` of the campaign.
    """
    fitting = sorted(
        (effect for effect in library.values() if kind in effect.kinds),
        key=lambda effect: (not effect.setup, effect.name),
    )
    joints = has_joints(geometry)
    return [instance for effect in fitting for instance in instances(effect, planes, axes, joints=joints)]


def _effect_of(module: ModuleType) -> Effect:
    return _as_effect(getattr(module, "EFFECT", None), module.__name__.rpartition(".")[2])


def _as_effect(effect: object, where: str) -> Effect:
    if not isinstance(effect, Effect):
        raise InputError(
            "an effect file needs EFFECT = Effect(...)",
            code="effect.file",
            where=where,
            got=type(effect).__name__,
            hint="dtwin effects template NAME writes one to start from",
        )
    require_name(effect.name, "the effect")
    return effect


def _from_file(path: Path) -> Effect:
    if not path.is_file():
        raise InputError("no such effect file", code="effect.file", where=str(path))
    spec = importlib.util.spec_from_file_location(f"dtwin_user_effect_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise InputError("an effect file is Python", code="effect.file", where=str(path), allowed="*.py")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError(
            "an effect file failed to load", code="effect.file", where=str(path), got=f"{type(error).__name__}: {error}"
        ) from error
    return replace(_as_effect(getattr(module, "EFFECT", None), str(path)), source=str(path))
