"""Read lists of numbers that a vendor's line breaks may have torn apart."""

from __future__ import annotations

import re

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats

_SIGNED = re.compile(r"[+-]\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")


def parse_readings(text: str, where: str) -> Floats:
    r"""Return the numbers of a readings block.

    When every number carries a sign, white space carries no meaning and torn numbers
    (``"-\n0.06045"``, ``"+0.1\n2345"``) are joined again; otherwise white space separates.

    Parameters
    ----------
    text : str
        Content of the block.
    where : str
        File and block, for error messages.

    Returns
    -------
    ndarray, shape (n,)
        The readings in the block's own unit.

    Raises
    ------
    InputError
        When something is not a finite number.
    """
    joined = "".join(text.split())
    signed = _SIGNED.findall(joined)
    tokens = signed if signed and "".join(signed) == joined else text.replace(",", " ").split()
    try:
        values = np.array([float(token) for token in tokens])
    except ValueError as error:
        raise InputError(
            "a reading is not a number", code="readings.number", where=where, got=str(error)[-80:]
        ) from error
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise InputError(
            f"{bad.size} of {values.size} readings are not finite",
            code="readings.not_finite",
            where=f"{where}, reading {bad[0] + 1}",
            allowed="finite numbers",
        )
    return values
