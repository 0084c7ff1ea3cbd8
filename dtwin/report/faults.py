"""The faults of a machine in the words of the shop: what, how large, how it shows, what to do, and effects in their order."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any, TypeVar

from dtwin.physics.budget import Budget
from dtwin.physics.effect import Effect
from dtwin.physics.fit import Estimate
from dtwin.physics.machine_terms import key_of
from dtwin.physics.problem import Term
from dtwin.physics.several_twin import SeveralTwin
from dtwin.physics.twin import Twin
from dtwin.report.signatures import signature_svg
from dtwin.report.text import decimals, listed
from dtwin.units import shown_number, shown_parameter, shown_unit

AS_ZERO = "These runs do not tell it from zero."
"""What is said in place of the remedy of an effect that may be nothing at all."""
_PICTURE_PX = 72
_LABEL = re.compile(r"\b[a-z]+(?:_[a-z]+)*\b(?:[ :][A-Z]{1,2}\b)?")


@dataclass(frozen=True)
class _Fault:
    """One effect of a twin.

    ``effect``, ``axis``, ``group``: as the library names them.
    ``title``: in words, with the axis.
    ``size``: with k = 2 and unit; says so when the runs do not tell it.
    ``shows``, ``remedy``: how it is seen in a plot, and what to do at the machine.
    ``picture``: its signature as SVG.
    ``instead``: titles of what the runs cannot tell from it.
    """

    effect: str
    axis: str
    group: str
    title: str
    size: str
    shows: str
    remedy: str
    picture: str
    instead: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """All of it in a line."""
        return " ".join([f"{self.title}: {self.size}. {self.shows} {self.remedy}", *self.doubt])

    @property
    def doubt(self) -> tuple[str, ...]:
        """A sentence where the runs cannot tell it from others."""
        if not self.instead:
            return ()
        return (f"These runs do not tell it from: {listed(self.instead)}. The size is that of it alone.",)


def faults(
    twin: Twin, diagnosis: Mapping[str, Any] | None = None, library: Mapping[str, Effect] | None = None
) -> list[_Fault]:
    """Return the effects of a twin as faults, in the order of the twin.

    ``diagnosis``: of the twin, as ``as_dict`` gives it, for what its runs cannot tell apart; ``library``: to name that.
    """
    instead = {own: others for own, *others in undecided_of(diagnosis)}
    faults = []
    titles = {t.label: _title(t.instance.effect, t.instance.axis) for t in twin.terms}
    for term in twin.terms:
        own = (label for label in _labels(twin, term) if label in instead)
        others = tuple(title_of(label, library or {}) for label in instead.get(next(own, ""), ()))
        fault = replace(_fault(term.instance.effect, term.instance.axis, ()), size=_size_in(twin, term))
        sizes = sizes_of(told_of(twin, term))
        if sizes and all(abs(value) <= spread for _, value, spread, _ in sizes):
            fault = replace(fault, remedy=AS_ZERO)
        if alike := _alike(twin, term):
            beside = listed([titles.get(label, label) for label, _ in alike])
            # What cannot be told is not mended: another test comes first.
            fault = replace(fault, size=f"these runs do not tell it from {beside}", remedy=alike[0][1])
        faults.append(replace(fault, instead=others))
    return faults


def told_of(twin: Twin, term: Term) -> list[Estimate]:
    """Return the parameters of an effect of a twin; none is told where its runs show the effect and another one of the twin alike."""
    alike = bool(_alike(twin, term))
    where = term.instance.effect.name, term.instance.axis
    # Of a wave campaigns share the amplitude and nothing else.
    shared = [e for e in twin.estimates if (e.effect, e.axis, e.name) == (*where, "amplitude")]
    return [replace(e, identifiable=e.identifiable and not alike) for e in shared or twin.estimates_of(term)]


def _size_in(twin: Twin, term: Term) -> str:
    """Return the size of an effect of a twin; of what campaigns do not share, such as the drift of a day, that of each."""
    told = told_of(twin, term)
    if sizes_of(told) or not isinstance(twin, SeveralTwin):
        return _size_of(told)
    own = [(part, t) for part in twin.parts for t in part.terms if key_of(t) == key_of(term)]
    sizes = [f"{_size_of(mine)} in {part.campaign}" for part, t in own if sizes_of(mine := told_of(part, t))]
    return "; ".join(sizes) or _size_of(told)


def _alike(twin: Twin, term: Term) -> list[tuple[str, str]]:
    """Return the effects of a twin that its runs show as they show this one, each with the run that would separate them."""
    own = _labels(twin, term)
    pairs = [(alias["first"], alias["second"], alias["separate_by"]) for alias in twin.aliases]
    return [(b if a in own else a, how) for a, b, how in pairs if a in own or b in own]


def not_told(diagnosis: Mapping[str, Any], library: Mapping[str, Effect] | None = None) -> list[str]:
    """Return the effects that a diagnosis could not judge, by the reason; their labels, with a library their titles."""
    of_reason: dict[str, list[str]] = {}
    for label, why in diagnosis.get("untestable", {}).items():
        of_reason.setdefault(why, []).append(label if library is None else title_of(label, library))
    return [f"{', '.join(labels)}: {why}" for why, labels in of_reason.items()]


def undecided_of(diagnosis: Mapping[str, Any] | None) -> list[list[str]]:
    """Return the effects of a twin, each with those that its runs cannot tell from it; of several kinds those of each fit."""
    told = diagnosis or {}
    return [list(group) for one in (told, *told.get("members", ())) for group in one.get("undecided", ())]


def undecided_lines(diagnosis: Mapping[str, Any] | None, library: Mapping[str, Effect] | None = None) -> list[str]:
    """Return the same in words: by labels, with a library by titles."""
    groups = undecided_of(diagnosis)
    if library is not None:
        groups = [[title_of(label, library) for label in group] for group in groups]
    return [
        f"these runs do not tell {own} from {listed(others)}: its size is that of it alone" for own, *others in groups
    ]


def _labels(twin: Twin, term: Term) -> list[str]:
    """Return what an effect of a twin is called in it and in its campaigns."""
    parts = twin.parts if isinstance(twin, SeveralTwin) else ()
    return [term.label, *(t.label for part in parts for t in part.terms if key_of(t) == key_of(term))]


def title_of(label: str, library: Mapping[str, Effect]) -> str:
    """Return the name of an effect in words, with its axis."""
    name, _, axis = label.partition(" ")
    title = library[name].title if name in library else name
    return f"{title} {axis}".rstrip()


def in_titles(text: str, library: Mapping[str, Effect]) -> str:
    """Return a text in which effects that stand by the names that commands take, with an axis or an underline, have their titles."""

    def told(label: re.Match[str]) -> str:
        own = label[0].replace(":", " ")
        name, _, axis = own.partition(" ")
        return title_of(own, library) if name in library and (axis or "_" in name) else label[0]

    return _LABEL.sub(told, text)


def found_faults(diagnosis: Mapping[str, Any], library: Mapping[str, Effect]) -> list[list[_Fault]]:
    """Return what a diagnosis found, most first, as faults: of each group the names that these runs do not tell apart.

    Effects on which the spread of repeats depends come last.

    ``diagnosis``: as ``as_dict`` of a diagnosis gives it; sizes are of each name alone in the place of the group.
    """
    groups = []
    for group in diagnosis.get("found", ()):
        faults = []
        for suspect in group:
            if suspect["effect"] in library:
                sizes = [Estimate.of(e) for e in suspect["sizes"]]
                own = [e for e in sizes if (e.effect, e.axis) == (suspect["effect"], suspect["axis"])]
                faults.append(_fault(library[suspect["effect"]], suspect["axis"], own))
        groups.append(faults)
    for name, _, axis in (label.partition(" ") for label in diagnosis.get("variance", {}).get("depends_on", ())):
        groups.append([_fault(library[name], axis, ())] if name in library else [])
    return [faults for faults in groups if faults]


def _fault(effect: Effect, axis: str, estimates: Sequence[Estimate]) -> _Fault:
    picture = signature_svg(effect, axis, _PICTURE_PX)
    return _Fault(
        effect.name,
        axis,
        effect.group,
        _title(effect, axis),
        _size_of(estimates),
        effect.looks_like,
        effect.remedy,
        picture,
    )


def _title(effect: Effect, axis: str) -> str:
    return f"{effect.title}, {axis}" if axis else effect.title


def _size_of(estimates: Sequence[Estimate]) -> str:
    """Return the size of an effect with k = 2.

    Cosines and sines of waves are told as one amplitude: the root of the sum of their squares, its uncertainty
    with both taken as uncorrelated.
    """
    sizes = sizes_of(estimates)
    if not sizes:
        return "its size is not told by these runs"
    if len(sizes) == 1:
        return with_k2(*sizes[0][1:])
    return "; ".join(f"{name} {with_k2(value, spread, unit)}" for name, value, spread, unit in sizes)


def sizes_of(estimates: Sequence[Estimate]) -> list[tuple[str, float, float, str]]:
    """Return name, value, uncertainty (k = 2) and unit of what the runs tell of an effect, waves as ``_size_of`` says."""
    told = [e for e in estimates if e.identifiable]
    waves = [e for e in told if e.name.startswith(("cosine", "sine", "half_wave"))]
    sizes = [(shown_parameter(e.name), e.value, e.uncertainty, e.unit) for e in told if e not in waves]
    if waves:
        amplitude = math.hypot(*(e.value for e in waves))
        spread = math.hypot(*(e.value * e.uncertainty for e in waves)) / amplitude if amplitude else math.nan
        sizes.append(("amplitude", amplitude, spread, waves[0].unit))
    return sizes


def sized_effects(twin: Twin, shares: Budget | None = None) -> list[dict[str, Any]]:
    """Return every effect of a twin with its size: in words, and value, k2 and unit.

    Of several sizes the first is in numbers; None where the runs do not tell it. With a budget also the RMS that it makes
    of the error, um.
    """
    makes_um = {share.label: share.rms_um[""] for share in shares.shares} if shares else {}
    out: list[dict[str, Any]] = []
    for entry, term in zip(twin.as_dict()["effects"], twin.terms, strict=True):
        mine = told_of(twin, term)
        sizes = sizes_of(mine)
        _, value, spread, unit = sizes[0] if sizes else ("", None, None, term.instance.effect.parameters[0].unit)
        made = {"makes_um": makes_um[term.label]} if term.label in makes_um else {}
        out.append({**entry, "size": _size_in(twin, term), "value": value, "k2": spread, "unit": unit, **made})
    return out


def with_k2(value: float, uncertainty: float, unit: str) -> str:
    """Return a value rounded to two digits of its uncertainty."""
    words = "" if unit == "1" else f" {shown_unit(unit)}"
    if not math.isfinite(uncertainty) or uncertainty <= 0:
        return f"{shown_number(value)}{words}"
    digits = decimals(uncertainty)
    return f"{value:z.{digits}f} ± {uncertainty:z.{digits}f}{words}"


_ORDER = ("geometry", "drive", "dynamics", "heat", "instrument")
_OWN = "your own"


_Told = TypeVar("_Told")


def grouped(
    some: Iterable[_Told], group: Callable[[_Told], str] = attrgetter("group")
) -> list[tuple[str, list[_Told]]]:
    """Return effects, or what is told of them, by group, empty groups left out; the user's own groups, or none, come last."""
    of_group: dict[str, list[_Told]] = {known: [] for known in _ORDER}
    for one in some:
        of_group.setdefault(group(one) or _OWN, []).append(one)
    return [(name, told) for name, told in of_group.items() if told]
