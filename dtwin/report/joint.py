"""What the tests of a machine say together, in sentences."""

from __future__ import annotations

from collections.abc import Mapping

from dtwin.physics.effect import Effect
from dtwin.physics.joint import Joint, Settled, Shared, Size
from dtwin.report.faults import with_k2


def joint_lines(found: Joint, library: Mapping[str, Effect]) -> list[str]:
    """Return contradictions first, then what was settled, then what agrees."""
    apart = [s for s in found.shared if s.apart]
    agreed = [s for s in found.shared if not s.apart]
    return [
        *(_contradiction(s) for s in apart),
        *(_settled(s, library) for s in found.settled),
        *(_agreement(s) for s in agreed),
    ]


def title_of(label: str, library: Mapping[str, Effect]) -> str:
    """Return the name of an effect in words, with its axis."""
    name, _, axis = label.partition(" ")
    title = library[name].title if name in library else name
    return f"{title} {axis}".rstrip()


def _size(size: Size, unit: str) -> str:
    return f"{size.campaign} {with_k2(size.value, size.uncertainty, unit)}"


def _cause(shared: Shared) -> str:
    return f"{shared.cause.replace('_', ' ').capitalize()} {shared.axis}".rstrip()


def _agreement(shared: Shared) -> str:
    sizes = "; ".join(_size(size, shared.unit) for size in shared.sizes)
    together = with_k2(shared.value, shared.uncertainty, shared.unit)
    return f"{_cause(shared)}: {together} from {len(shared.sizes)} tests that agree ({sizes})."


def _contradiction(shared: Shared) -> str:
    sizes = "; ".join(f"{_size(size, shared.unit)} ({size.started[:10] or 'no day'})" for size in shared.sizes)
    first, second, by, spread = max(shared.apart, key=lambda a: abs(a[2]) / a[3])
    return (
        f"{_cause(shared)} contradicts itself: {sizes}. Between {first} and {second} lie "
        f"{with_k2(by, spread, shared.unit)}: the machine changed in between, or one of the tests is mistaken."
    )


def _settled(settled: Settled, library: Mapping[str, Effect]) -> str:
    names = [_within(label, library) for label in settled.group]
    left = [_within(label, library) for label in settled.left]
    reasons = [
        f"{_within(j.label, library)} {_WORDS[j.said]}: {_size(j.there, unit)}, as the cause it would be "
        f"{with_k2(j.here.value, j.here.uncertainty, unit)}"
        for j in settled.judged
        for unit in [_unit(j.label, library)]
    ]
    end = "it is " + left[0] if len(left) == 1 else " or ".join(left) + " remain" if left else "all are ruled out"
    return f"{settled.campaign} could not tell {' from '.join(names)}: {end} ({'; '.join(reasons)})."


_WORDS = {"agrees": "agrees", "is a part": "is a part of it", "refuted": "is ruled out"}


def _within(label: str, library: Mapping[str, Effect]) -> str:
    """Return the name as it stands within a sentence."""
    title = title_of(label, library)
    return title[:1].lower() + title[1:]


def _unit(label: str, library: Mapping[str, Effect]) -> str:
    return library[label.partition(" ")[0]].parameters[0].unit
