"""Error motions as physical effects: what each one is, what heats it, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dtwin.errors import InputError
from dtwin.kinds.volumetric._chain import COEFFICIENTS, coefficient

_BY = "@"
_AND = "+"


@dataclass(frozen=True)
class Family:
    """Error motions with one kind of cause.

    ``meaning``, ``looks_like``, ``separate_by``, ``remedy``: what it is, what balls show, which test tells its causes
    apart, what to do about it.
    ``group``: of what it is on pages.
    """

    name: str
    title: str
    meaning: str
    looks_like: str
    separate_by: str
    remedy: str
    group: str = "heat"
    per: str = "error motion"
    parameters: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class HeatTerm:
    """An error motion of a twin, and what may drive it.

    ``motion``: as in ISO 230-1, with the order: ``EXX1``.
    ``sources``: temperatures, or bodies, that it may use; any thermocouple when empty.
    """

    motion: str
    sources: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """As a user writes it: ``EXZ1@coolant_tank_c``."""
        return self.motion + (_BY + _AND.join(self.sources) if self.sources else "")

    @property
    def axis(self) -> str:
        """Axis whose motion it is; empty for the machine as a whole."""
        return coefficient(self.motion).axis.replace("0", "")


_ALONE = "heat one body alone, with the others at rest, then another"
FAMILIES = {
    family.name: family
    for family in (
        Family(
            "rigid_shift",
            "the tool shifts against the table",
            "Structure between table and spindle grows and carries the tool point away, alike everywhere.",
            "all balls move alike; distances between balls stay",
            _ALONE,
            "touch a ball on the table more often, or predict it from the bodies between table and tool",
        ),
        Family(
            "rigid_turn",
            "the axes turn against the table",
            "The structure tilts as a whole: one side of a casting is warmer than the other.",
            "balls move in proportion to their place; distances between balls stay",
            _ALONE,
            "shield the casting from draught and sun, or predict it from the difference of its two sides",
        ),
        Family(
            "axis_expansion",
            "a scale or screw grows",
            "What measures the axis grows with its temperature, so that every path is too short or too long.",
            "an error in proportion to the travel, in its own direction",
            "heat the axis' own bed alone, or measure its scale's temperature",
            "an expansion factor in the control with the scale's own temperature; a linear scale instead of the screw",
        ),
        Family(
            "uneven_expansion",
            "a scale or screw grows more at one end",
            "The temperature of what measures the axis differs along its length.",
            "an error along the travel that is not in proportion to it",
            "thermocouples at both ends and in the middle of the axis",
            "a table of positioning errors at the working temperature",
        ),
        Family(
            "squareness_drift",
            "two axes leave their right angle",
            "A guideway turns against another: a column leans when one side is warmer.",
            "an error across the travel, in proportion to it",
            _ALONE,
            "squareness compensation that follows the temperature; stop the heat on one side",
        ),
        Family(
            "guideway_bending",
            "a guideway bends",
            "One side of a bed or column is warmer than the other, so that it bends as a bimetal does.",
            "an error across the travel, a bow",
            _ALONE,
            "straightness compensation that follows the difference of temperature across the casting",
        ),
        Family(
            "carriage_turning",
            "a carriage rolls, pitches or yaws along its way",
            "The guideway is twisted or bent by heat, so that what it carries turns as it moves.",
            "errors that grow with the lever arm of the axes that are carried",
            _ALONE,
            "a volumetric compensation: offsets of one axis cannot take it away",
        ),
    )
}


def family_of(motion: str) -> Family:
    """Return the kind of cause of an error motion. Raises ``InputError`` when the name means nothing."""
    what = coefficient(motion)
    shifts = what.letter in "XYZ"
    if what.axis == "0":
        return FAMILIES["rigid_shift" if shifts else "rigid_turn"]
    if not shifts:
        return FAMILIES["carriage_turning"]
    if what.letter == what.axis:
        return FAMILIES["axis_expansion" if what.order == 1 else "uneven_expansion"]
    return FAMILIES["squareness_drift" if what.order == 1 else "guideway_bending"]


def motion_words(motion: str) -> str:
    """Return an error motion in words: ``EXZ2`` is how Z, as it moves, errs in X."""
    what = coefficient(motion)
    if what.axis == "0":
        return f"shift in {what.letter}" if what.letter in "XYZ" else f"turn {what.letter}"
    kind = f"error in {what.letter}" if what.letter in "XYZ" else f"turn {what.letter}"
    shape = {1: "linear in", 2: "quadratic in"}.get(what.order, f"order {what.order} of")
    return f"{kind} of axis {what.axis}, {shape} its travel"


def heat_terms(wanted: Sequence[str], axis: str = "") -> tuple[HeatTerm, ...]:
    """Return the terms that a user named.

    ``wanted``: error motions or families; ``EXZ1@coolant_tank_c`` takes that temperature, ``EYY1@ram`` those of a body,
    ``EZ0@ram+column_top`` those of two; ``axis_expansion:X`` is of one axis.
    ``axis``: one axis; all without.
    Raises ``InputError`` when a name means nothing, or nothing is left.
    """
    terms: dict[str, HeatTerm] = {}
    for name in wanted:
        for term in _named(name, axis):
            if terms.setdefault(term.motion, term) != term:
                raise InputError(
                    "one error motion is named twice, with other temperatures",
                    code="twin.effect_twice",
                    got=f"{terms[term.motion].label}, {term.label}",
                    hint="EXX1@bed+table takes both",
                )
    return tuple(terms.values())


def _named(name: str, axis: str) -> list[HeatTerm]:
    what, _, by = name.partition(_BY)
    plain, _, own = what.partition(":")
    where = (own or axis).upper()
    sources = tuple(sorted({part.strip() for part in by.split(_AND)} - {""}))
    known = plain in FAMILIES
    motions = [m for m in COEFFICIENTS if family_of(m).name == plain] if known else [_motion(plain)]
    terms = [HeatTerm(motion, sources) for motion in motions]
    kept = [term for term in terms if where in ("", term.axis)]
    if not kept:
        raise InputError(
            "no such error motion of that axis",
            code="twin.effect_axis",
            got=f"{plain} of {where[:20]}",
            allowed=", ".join(sorted({term.axis for term in terms} - {""})) or "no axis: it is rigid",
        )
    return kept


def _motion(name: str) -> str:
    try:
        return coefficient(name).name
    except InputError as error:
        raise InputError(
            "no such effect of heat on a volume",
            code="twin.effect",
            got=name[:40],
            allowed=f"{', '.join(FAMILIES)}; or an error motion as in ISO 230-1: EXX1, EAZ2, EX0",
            hint="dtwin effects list",
        ) from error
