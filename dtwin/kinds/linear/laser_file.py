"""ASCII result files of a laser interferometer that measures positioning: raw rows and averages.

Seven columns without units or directions; lengths are in the unit that the operator chose.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dtwin.acquire.xmlsafe import read_bounded
from dtwin.atomic import write_text
from dtwin.errors import InputError
from dtwin.schema import Floats

_COLUMNS = ("Position", "LasRead", "LinearError", "Status", "AirTemp", "AirPress", "MatTemp")
_AVERAGE_COLUMNS = ("Position", "LinearError")
# Three numbers of six decimals are compared.
_SIGN_TOLERANCE = 1e-6 + 1e-9
_MAX_BYTES = 64 * 1024 * 1024
_NAMES = frozenset(_COLUMNS)
_Sense = Literal["decrease", "increase"]
_SENSES: tuple[_Sense, ...] = ("decrease", "increase")


@dataclass(frozen=True)
class LaserTest:
    """Content of a laser file.

    ``raw``, (n, 7): ``_COLUMNS`` in the order of measurement; lengths in the file's unit, temperatures in degrees
    Fahrenheit, pressure in inches of mercury.
    ``averages``, (m, 2): mean error at each target, forward sweep first; empty for a single run.
    ``rejects``: lines that hold no row: ``row`` (line number from 1), ``reason``, ``values``.
    """

    raw: Floats
    averages: Floats
    rejects: list[dict[str, Any]]

    def column(self, name: str) -> Floats:
        """Return one column of the raw rows, shape (n,)."""
        return self.raw[:, _COLUMNS.index(name)]


def read_laser_file(path: Path) -> LaserTest:
    """Read a laser file.

    The header may be broken over two lines and columns parted by tabs or blanks, as exports do.

    Raises ``InputError`` when it is no laser file, or holds no usable row.
    """
    try:
        lines = read_bounded(path, _MAX_BYTES).decode("ascii").splitlines()
    except UnicodeDecodeError as error:
        raise _wrong("the laser file is no plain text", path, str(error)[:80]) from error
    raw: list[list[float]] = []
    averages: list[list[float]] = []
    rejects: list[dict[str, Any]] = []
    header: list[str] = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if words and words[0] == _COLUMNS[0]:
            header = words
        elif words and set(words) <= _NAMES and header:
            header = [*header, *words]
        elif words and header:
            rows = averages if tuple(header) == _AVERAGE_COLUMNS else raw
            width = len(_AVERAGE_COLUMNS) if rows is averages else len(_COLUMNS)
            values = _numbers(words, width)
            if values is not None:
                rows.append(values)
            else:
                reason = f"not {width} finite numbers"
                rejects.append({"row": number - 1, "reason": reason, "values": {"line": line[:120]}})
        if raw and tuple(header) not in (_COLUMNS, _AVERAGE_COLUMNS):
            raise _wrong("the laser file has other columns", path, " ".join(header)[:120])
    if not raw:
        raise _wrong("the laser file holds no row of measurements", path, f"{len(lines)} lines")
    return LaserTest(np.array(raw), np.array(averages).reshape(-1, 2), rejects)


def write_laser_file(path: Path, test: LaserTest) -> Path:
    """Write a laser file in one step."""
    lines = ["\t".join(_COLUMNS)]
    lines += [
        f"{p:z.5f}\t{reading:z.6f}\t{error:z.6f}\t{status:z.0f}\t{air:z.2f}\t{press:z.2f}\t{mat:z.2f}"
        for p, reading, error, status, air, press, mat in test.raw.tolist()
    ]
    if test.averages.size:
        lines += ["", "\t".join(_AVERAGE_COLUMNS)]
        lines += [f"{p:z.5f}\t{error:z.6f}" for p, error in test.averages.tolist()]
    return write_text(path, "\n".join([*lines, ""]), "the laser file")


def linear_error(position: Floats, reading: Floats, start: float, sense: _Sense) -> Floats:
    """Return actual minus commanded position, shape (n,), in the unit of the arguments.

    ``position``, ``reading``: commanded positions, and what the laser shows there, shape (n,) each; it was zeroed at
    the commanded position ``start``.
    ``sense``: what the distance between laser and reflector does while the position grows: with ``decrease`` the
    reading falls.
    """
    travelled = -reading if sense == "decrease" else reading
    return travelled - (position - start)


def sign_rule(test: LaserTest) -> tuple[_Sense | None, bool]:
    """Return the sense that explains the file's own errors, and whether their sign is the rule's.

    Returns ``sense``: none when neither sense explains the errors, with either sign.
    Returns ``right``: false when the errors are commanded minus actual.
    """
    position, reading = test.column("Position"), test.column("LasRead")
    stated = test.column("LinearError")
    for sense in _SENSES:
        # The first row may be missing, so the zero is what all rows agree on.
        travelled = linear_error(position, reading, 0.0, sense)
        for right in (True, False):
            zero = (stated if right else -stated) - travelled
            if np.max(np.abs(zero - np.median(zero))) <= _SIGN_TOLERANCE:
                return sense, right
    return None, True


def _numbers(words: list[str], width: int) -> list[float] | None:
    try:
        values = [float(word) for word in words]
    except ValueError:
        return None
    return values if len(values) == width and np.isfinite(values).all() else None


def _wrong(message: str, path: Path, got: str) -> InputError:
    return InputError(message, code="laser.file", where=str(path), got=got, allowed=" ".join(_COLUMNS))
