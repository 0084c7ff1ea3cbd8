"""Units are carried by column names; this is the table of what is understood."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable
from typing import TypeGuard

from dtwin.errors import InputError

# Longest first, so that ``feed_mm_min`` is not read as minutes.
UNITS: dict[str, str] = {
    "mm_min": "mm/min",
    "mm_s2": "mm/s^2",
    "mm_s": "mm/s",
    "um_per_m": "um/m",
    "deg_s": "deg/s",
    "rad_s2": "rad/s^2",
    "rad_s": "rad/s",
    "rpm": "1/min",
    "hz": "Hz",
    "mm": "mm",
    "um": "um",
    "arcsec": "arcsec",
    "deg": "deg",
    "rad": "rad",
    "us": "us",
    "ms": "ms",
    "s": "s",
    "g2": "g^2",
    "g": "g",
    "c": "degC",
    "pct": "%",
    "v": "V",
    "a": "A",
    "n": "N",
    "nm": "N*m",
    "kg": "kg",
    "kpa": "kPa",
    "1": "1",
}

UM_PER_MM = 1000.0
_SHARES = ("tenth", "hundredth", "thousandth", "tenthousandth", "hundredthousandth", "millionth")
_SHARE = re.compile(
    r"(?<!\w)(?:0?[.,](?P<zeros>0*)1|1\s*/\s*10(?P<more>0*)|(?P<word>tenth|hundredth|thousandth|zehntel|hundertstel|tausendstel)s?(?:\s+of\s+an?)?)"
    r"\s*-?\s*(?P<unit>mm|in\b|inch(?:es)?|\"|\u2033|'')",
    re.I,
)
NEWTON_METRE = "newtonmetre"
_TORQUE = re.compile(r"(?<![^\W_])Nm(?![^\W_])")
_POWERS = {"te": 1, "ze": 1, "hu": 2, "th": 3, "ta": 3}
LENGTHS_MM = (
    {"m": 1000.0, "cm": 10.0, "mm": 1.0, "nm": 1e-6}
    | dict.fromkeys(("um", "µm", "μm", "micron", "microns", "micrometer", "micrometers", "mikrometer"), 1e-3)
    | dict.fromkeys(("µ", "μ", "mikron"), 1e-3)
    | dict.fromkeys(("millimeter", "millimeters", "millimetre", "millimetres"), 1.0)
    | dict.fromkeys(("meter", "meters", "metre", "metres"), 1000.0)
    | dict.fromkeys(("in", "inch", "inches", "zoll", "pouce", "pouces", "pollici", "pulgadas"), 25.4)
    | {"dm": 100.0}
    | dict.fromkeys(("mil", "mils", "thou"), 0.0254)
    | dict.fromkeys(("uin", "µin", "μin", "uinch", "µinch", "μinch", "microinch", "microinches"), 25.4e-6)
    | {f"{share}mm": 10.0**-n for n, share in enumerate(_SHARES, 1)}
    | {f"{share}in": 25.4 * 10.0**-n for n, share in enumerate(_SHARES, 1)}
)
"""How many millimetres a unit of length of a foreign file is, as people spell it, parts of one as :func:`with_shares` does."""
ANGLES_DEG = (
    {"mdeg": 1e-3, "m°": 1e-3, "gon": 0.9, "mgon": 0.9e-3, "rad": 180.0 / math.pi, "mrad": 0.18 / math.pi}
    | dict.fromkeys(("urad", "µrad", "μrad", "microrad"), 0.18e-3 / math.pi)
    | dict.fromkeys(("°", "deg", "degree", "degrees", "度"), 1.0)
    | dict.fromkeys(("arcmin", "arc min", "'", "\u2032", "角分", "分"), 1.0 / 60.0)
    | dict.fromkeys(
        (
            "arcsec",
            "arc sec",
            "arc-sec",
            "arcseconds",
            "bogensekunden",
            "winkelsekunden",
            '"',
            "''",
            "\u2033",
            "\u2032\u2032",
            "角秒",
            "秒",
        ),
        1.0 / 3600.0,
    )
)
"""The same of angles, in degrees; ``grad`` is none: a degree in German, 1/400 of a turn elsewhere."""
TIMES_S = (
    {"us": 1e-6, "µs": 1e-6, "μs": 1e-6, "usec": 1e-6, "µsec": 1e-6, "μsec": 1e-6}
    | dict.fromkeys(("ms", "msec", "msecs", "millisecond", "milliseconds", "millisekunden", "毫秒"), 1e-3)
    | dict.fromkeys(("min", "mins", "minute", "minutes", "minuten", "分"), 60.0)
    | dict.fromkeys(("d", "day", "days", "tage"), 86_400.0)
    | dict.fromkeys(("s", "sec", "secs", "sek", "second", "seconds", "sekunden", "秒"), 1.0)
    | dict.fromkeys(("h", "hr", "hrs", "hour", "hours", "std", "stunden"), 3600.0)
)
"""The same of times, in seconds."""
G_MM_S2 = 9806.65
_SMALL = 1e-4
"""Numbers below have more noughts than anybody counts."""
_LARGEST = sys.float_info.max


def is_number(value: object) -> TypeGuard[float]:
    """Tell whether a value that was read is a finite number; a truth value is none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST


def with_shares(text: str) -> str:
    """Return a text with units as words that small letters leave what they are: ``1/100 mm`` as ``hundredthmm``, ``0.0001 in`` as ``tenthousandthin``, ``Nm``, which is no ``nm``, as ``newtonmetre``."""
    return _SHARE.sub(_share, _TORQUE.sub(NEWTON_METRE, text))


def _share(match: re.Match[str]) -> str:
    word, zeros = match["word"], match["zeros"] or match["more"] or ""
    power = _POWERS[word[:2].lower()] if word else 1 + len(zeros)
    unit = "mm" if match["unit"].lower() == "mm" else "in"
    return f"{_SHARES[power - 1]}{unit}" if power <= len(_SHARES) else match[0]


def shown_number(value: float, digits: int = 3, sign: str = "") -> str:
    """Return a number as people read it, rounded to so many digits: 180 and 0.0012, not 1.8e+02; exponents below 0.0001 and from a million on.

    ``sign``: ``"+"`` writes that of positive numbers, too.
    """
    if 0.0 < abs(value) < _SMALL:
        return f"{value:{sign}.{digits}g}"
    # What is rounded to nothing has no sign.
    return f"{float(f'{value:.{digits}g}'):{sign}z.6g}"


def shown_unit(unit: str) -> str:
    """Return a unit as people read it: ``um/(m/s2)`` as µm/(m/s²)."""
    if unit == "arcsec":
        return "″"
    return re.sub(r"(?<=s)2\b", "²", re.sub(r"\bu(?=m\b|rad\b)", "µ", unit))


def shown_parameter(name: str) -> str:
    """Return the name of a parameter as people read it: ``cosine_at_100_mm_s`` as cosine at 100 mm/s."""
    return name.replace("_mm_s", " mm/s").replace("_", " ")


def shown_setting(name: str, value: str) -> str:
    """Return a setting as people read it: ``frequency_hz`` as frequency 5 Hz."""
    unit = unit_of(name)
    ending = next((f"_{suffix}" for suffix in UNITS if unit and name.endswith(f"_{suffix}")), "")
    return f"{name.removesuffix(ending).replace('_', ' ')} {value}{f' {shown_unit(unit)}' if unit else ''}"


def unit_of(column: str) -> str | None:
    """Return the unit that a column name ends with.

    ``column``: column name, for example ``"deviation_um"``.
    Returns the unit, for example ``"um"``; None when the name ends with no known unit.
    """
    for suffix, unit in UNITS.items():
        if column.endswith("_" + suffix):
            return unit
    return None


def require_units(columns: Iterable[str], where: str) -> dict[str, str]:
    """Return the unit of each column, or refuse those without one.

    ``columns``: names of floating-point columns.
    ``where``: what the columns belong to, for the error message.
    Raises ``InputError`` when a name ends with no known unit, or cannot be printed in one line.
    """
    units = {column: unit_of(column) for column in columns}
    # A line end in a name would make a line of its own of what is written for a control.
    strange = sorted(column for column in units if not column.isprintable())
    if strange:
        raise InputError(
            "a measured column has a name that cannot be printed",
            code="units.name",
            where=where,
            got=", ".join(map(repr, strange))[:160],
            allowed="printable characters in one line",
            hint="rename the column",
        )
    unknown = sorted(column for column, unit in units.items() if unit is None)
    if unknown:
        raise InputError(
            "a measured column must end with its unit",
            code="units.unknown",
            where=where,
            got=", ".join(unknown[:10]),
            allowed=", ".join("_" + suffix for suffix in UNITS),
            hint="rename the column, for example temperature -> temperature_c",
        )
    return {column: unit for column, unit in units.items() if unit is not None}
