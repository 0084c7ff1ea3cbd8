"""Read lists of numbers that a vendor's line breaks may have torn apart."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.schema import Floats

# Squares of larger ones are no longer numbers.
_LARGEST = 1e100
_SIGNED = re.compile(r"[+-]\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")
_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?")


def parse_readings(text: str, where: str) -> Floats:
    r"""Return the numbers of a readings block, shape (n,), in the block's own unit.

    When every number carries a sign, white space carries no meaning and torn numbers
    (``"-\n0.06045"``, ``"+0.1\n2345"``) are joined again; otherwise white space separates. Where no point stands, commas are decimal signs if
    each number has one.
    ``where``: file and block, for error messages. Raises ``InputError`` when something is not a finite number.
    """
    pointed = text if "." in text else text.replace(",", ".")
    joined = "".join(pointed.split())
    signed = _SIGNED.findall(joined)
    if signed and "".join(signed) == joined:
        tokens = signed
    else:
        commas = "." not in text and all(map(_COMMA.fullmatch, text.split()))
        tokens = pointed.split() if commas else text.replace(",", " ").split()
    try:
        values = np.array([float(token) for token in tokens])
    except ValueError as error:
        raise InputError(
            "a reading is not a number", code="readings.number", where=where, got=str(error)[-80:]
        ) from error
    require_usable(values, where)
    return values


def require_usable(values: Floats, where: str) -> None:
    """Refuse numbers that cannot be computed with; ``where``: their file and block."""
    bad = np.flatnonzero(~usable(values))
    if bad.size:
        raise InputError(
            f"{bad.size} of {values.size} readings are not finite, or of no size that is measured",
            code="readings.not_finite",
            where=f"{where}, reading {bad[0] + 1}",
            allowed=f"numbers below {_LARGEST:g}",
        )


def usable(values: Floats) -> NDArray[np.bool_]:
    """Return which numbers can be computed with: finite ones, whose squares are finite, too."""
    # As float64: of single precision the bound itself is no number.
    return np.abs(values) < np.float64(_LARGEST)
