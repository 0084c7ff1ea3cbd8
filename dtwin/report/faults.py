"""The faults of a machine in the words of the shop: what, how large, how it shows, what to do, effects in their order and how they look round a circle."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np

from dtwin.physics.budget import Budget
from dtwin.physics.effect import Effect
from dtwin.physics.fit import Estimate
from dtwin.physics.gridding import CIRCLE
from dtwin.physics.library import campaign_instances
from dtwin.physics.machine_terms import key_of
from dtwin.physics.problem import Term
from dtwin.physics.several_twin import SeveralTwin
from dtwin.physics.state import State, circular_state
from dtwin.physics.twin import Twin
from dtwin.report.text import decimals, listed
from dtwin.schema import Direction, Floats, Plane, RunMeta
from dtwin.units import shown_number, shown_unit

AS_ZERO = "These runs do not tell it from zero."
"""What is said in place of the remedy of an effect that may be nothing at all."""
_PICTURE_PX = 72
_LABEL = re.compile(r"\b[a-z]+(?:_[a-z]+)*\b(?: [A-Z]{1,2}\b)?")


@dataclass(frozen=True)
class _Fault:
    """One effect of a twin.

    ``effect``, ``axis``: as the library names them.
    ``title``: in words, with the axis.
    ``size``: with k = 2 and unit; says so when the runs do not tell it.
    ``shows``, ``remedy``: how it is seen in a plot, and what to do at the machine.
    ``picture``: its signature as SVG; empty when it has none on a circle.
    ``instead``: titles of what the runs cannot tell from it.
    """

    effect: str
    axis: str
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
        told = told_of(twin, term)
        fault = _fault(term.instance.effect, term.instance.axis, told)
        sizes = sizes_of(told)
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
    return [replace(e, identifiable=e.identifiable and not alike) for e in twin.estimates_of(term)]


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
        name, _, axis = label[0].partition(" ")
        return title_of(label[0], library) if name in library and (axis or "_" in name) else label[0]

    return _LABEL.sub(told, text)


def found_faults(diagnosis: Mapping[str, Any], library: Mapping[str, Effect]) -> list[list[_Fault]]:
    """Return what a diagnosis found, most first, as faults: of each group the names that these runs do not tell apart.

    ``diagnosis``: as ``as_dict`` of a diagnosis gives it; sizes are of each name alone in the place of the group.
    """
    groups = []
    for group in diagnosis.get("found", ()):
        faults = []
        for suspect in group:
            if suspect["effect"] in library:
                sizes = [
                    Estimate(**{**e, **{n: math.nan if e[n] is None else e[n] for n in ("value", "uncertainty")}})
                    for e in suspect["sizes"]
                ]
                own = [e for e in sizes if (e.effect, e.axis) == (suspect["effect"], suspect["axis"])]
                faults.append(_fault(library[suspect["effect"]], suspect["axis"], own))
        groups.append(faults)
    return [faults for faults in groups if faults]


def _fault(effect: Effect, axis: str, estimates: Sequence[Estimate]) -> _Fault:
    picture = signature_svg(effect, axis, _PICTURE_PX)
    return _Fault(
        effect.name, axis, _title(effect, axis), size_of(estimates), effect.looks_like, effect.remedy, picture
    )


def _title(effect: Effect, axis: str) -> str:
    return f"{effect.title}, {axis}" if axis else effect.title


def size_of(estimates: Sequence[Estimate]) -> str:
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
    """Return name, value, uncertainty (k = 2) and unit of what the runs tell of an effect, waves as ``size_of`` says."""
    told = [e for e in estimates if e.identifiable]
    waves = [e for e in told if e.name.startswith(("cosine", "sine", "half_wave"))]
    sizes = [(e.name.replace("_", " "), e.value, e.uncertainty, e.unit) for e in told if e not in waves]
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
        out.append({**entry, "size": size_of(mine), "value": value, "k2": spread, "unit": unit, **made})
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


# Circle on which signatures are drawn.
_RADIUS_MM, _FEED_MM_MIN = 100.0, 3000.0
_ROBOT = {"type": "ur10e", "centre_mm": [-550.0, 0.0, 300.0], "tcp_mm": [0.0, 0.0, 158.3]}
_REACH_MM, _TURNS_RAD_S = 20.0, 2.0 * np.pi * 5.0
_SIZE, _CIRCLE, _DRAWN, _POINTS = 300, 100, 28, 720
_COLOURS = {"CCW": "#0072B2", "CW": "#D55E00"}
_LOGGED = ("temperature_c", "temperature_rise_c", "abbe_offset_mm", "time_h", "setup_first_um", "setup_second_um")


def _signature(effect: Effect, axis: str = "") -> tuple[str, dict[str, Floats]]:
    """Return label and error of the first parameter of an effect by direction, each of shape (n,) over one turn.

    ``effect``: one of a circle; other ones have no curves, and neither have those that change only the spread.
    ``axis``: on which axis; else the first on which it shows.
    """
    if CIRCLE.kind not in effect.kinds or effect.on_spread:
        return effect.name, {}
    plane: Plane = "ZX" if effect.name == "gravity_sag" or axis == "Z" else "XY"
    wanted = campaign_instances({effect.name: effect}, CIRCLE.kind, [plane], list(plane), _ROBOT)
    angle = _angle()
    columns = {name: np.ones(_POINTS) for name in _LOGGED}
    ways: tuple[Direction, Direction] = ("CCW", "CW")
    for instance in sorted(wanted, key=lambda i: i.axis != axis):
        curves: dict[str, Floats] = {}
        for way in ways:
            meta = RunMeta("r", plane=plane, direction=way, radius_mm=_RADIUS_MM, feed_mm_min=_FEED_MM_MIN)
            state = circular_state(meta, angle, feed_mm_s=_FEED_MM_MIN / 60.0, columns=columns, geometry=_ROBOT)
            curves[way] = effect.columns(state, instance.axis, effect.start_shape)[:, 0]
        if any(c.any() for c in curves.values()):
            return instance.label, curves
    return effect.name, {}


def _along(effect: Effect) -> dict[str, Floats]:
    """Return the error of the first parameter of an effect on the way forth and back along an axis, each of shape (n,).

    The axis swings by a sine, one period; both are in the order of its position. Curves that are zero are none.
    """
    if effect.on_spread:
        return {}
    phase = _angle()
    at, way = -_REACH_MM * np.cos(phase), np.sign(np.sin(phase))
    state = State(
        kind=effect.kinds[0],
        axes=("X",),
        plane="",
        position_mm={"X": at},
        velocity_mm_s={"X": _REACH_MM * _TURNS_RAD_S * np.sin(phase)},
        acceleration_mm_s2={"X": -at * _TURNS_RAD_S**2},
        sensitivity={"X": np.ones(_POINTS)},
        since_reversal_s={"X": phase % np.pi / _TURNS_RAD_S},
        last_end={"X": -way},
        angle_rad=phase,
        radius_mm=_REACH_MM,
        feed_mm_s=_REACH_MM * _TURNS_RAD_S,
        direction=1.0,
        columns={name: np.ones(_POINTS) for name in _LOGGED},
        geometry={"screw_pitch_mm": _REACH_MM / 2.0},
    )
    # Effects of sweeps take the direction from the state, those of tones from the speed of a whole period.
    forth, back = (
        effect.columns(replace(state, direction=sense), "X", effect.start_shape)[:, 0].reshape(2, -1)[half]
        for half, sense in enumerate((1.0, -1.0))
    )
    return {"forward": forth, "reverse": back[::-1]} if forth.any() or back.any() else {}


def signature_svg(effect: Effect, axis: str = "", width: int = _SIZE) -> str:
    """Return the signature as an SVG picture, empty when there is none: CCW blue, CW orange and dashed.

    An effect that no circle shows is drawn along an axis that swings, forward blue, reverse orange and dashed.
    """
    label, curves = _signature(effect, axis)
    round_circle = bool(curves)
    curves = curves or _along(effect)
    if not curves:
        return ""
    largest = max(float(np.abs(c).max()) for c in curves.values())
    middle, angle = _SIZE / 2, _angle()
    across = middle - _CIRCLE * np.cos(angle[: _POINTS // 2])
    # About one pixel as it is shown; small ones would hide their own shape.
    wide = 1.5 * _SIZE / max(width, 100)
    said = f"{label} round the circle" if round_circle else f"{effect.name} along an axis"
    nominal = (
        f'circle cx="{middle}" cy="{middle}" r="{_CIRCLE}" fill="none"'
        if round_circle
        else f'line x1="{across[0]}" x2="{across[-1]}" y1="{middle}" y2="{middle}"'
    )
    parts = [
        f'<svg viewBox="0 0 {_SIZE} {_SIZE}" width="{width}" role="img" aria-label="error of {said}">',
        f'<{nominal} stroke="#999" stroke-dasharray="3 3"/>',
    ]
    for colour, (way, curve) in zip(_COLOURS.values(), curves.items(), strict=False):
        x, y = across, middle - 0.8 * _CIRCLE * curve / largest
        if round_circle:
            radius = _CIRCLE + _DRAWN * curve / largest
            x, y = middle + radius * np.cos(angle), middle - radius * np.sin(angle)
        path = " ".join(f"{a:z.1f},{b:z.1f}" for a, b in zip(x, y, strict=True))
        dash = f' stroke-dasharray="{4 * wide:z.1f} {2 * wide:z.1f}"' if way in ("CW", "reverse") else ""
        drawn = f'points="{path}" fill="none" stroke="{colour}" stroke-width="{wide:z.1f}"{dash}'
        parts.append(f"<{'polygon' if round_circle else 'polyline'} {drawn}/>")
    return "".join([*parts, "</svg>"])


def signature_caption(effect: Effect) -> str:
    """Return what the picture of a signature shows."""
    if _signature(effect)[1]:
        return (
            f"First parameter at R = {_RADIUS_MM:g} mm, F = {_FEED_MM_MIN:g} mm/min: counter-clockwise blue, "
            "clockwise orange and dashed; dotted: the nominal circle."
        )
    return "First parameter along an axis that swings: forward blue, reverse orange and dashed; dotted: no error."


def _angle() -> Floats:
    return np.asarray((np.arange(_POINTS) + 0.5) * 2 * np.pi / _POINTS)
