"""What a table of readings along an axis cannot be: another test, angles, lengths in another unit than they seem to have."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from dtwin.acquire.repeated_heads import counts_repeats
from dtwin.acquire.title_words import REVERSED, named_unit
from dtwin.acquire.xmlsafe import number_or_none
from dtwin.errors import InputError
from dtwin.positioning._plain_table import table_of
from dtwin.positioning.position_runs import PositionTable
from dtwin.positioning.table_heads import (
    ANGLE,
    MOST_TITLES,
    NAMED,
    OTHER_TEST,
    OWN_SENSOR,
    SURELY_READ,
    Long,
    Wide,
    deviations_of,
    is_deviation,
    is_opposite,
    is_unit,
    names_target,
    plain_unit,
    told_unit,
)
from dtwin.positioning.ways import FROM_SIGN, LENGTHS, Scale
from dtwin.schema import Floats
from dtwin.units import shown_number

# An axis that stops at targets, and is read there, takes longer from one to the next.
_FASTEST_S, _FEWEST_ROWS = 0.2, 20
# Of the travel: no linear axis errs by so much.
LITTLE = 0.02
_TURNED = re.compile(r"\s*[-\u2212\u2013]\s*(error|dev|err\b|abw|fehler)(?!\w*[\s_.]*\d)", re.I)
"""Head of deviations whose sign was turned round; ``-error 1`` may be one of the way back."""
_TURNED_TITLE = re.compile(
    r"\W*(error\s+)?(correction|compensation|korrektur|kompensations?)\s*-?\s*(table|values?|tabelle|werte?)\b", re.I
)
"""Title of a table of corrections."""
_OTHER_UNIT = re.compile(
    r"(?<![^\W_])(counts?|steps?|pulses?|impulse|inkr\w*|schritte?|turns|umdr\w*|ft|feet|volts?|km|mm\s*/\s*10+)(?![^\W_])",
    re.I,
)
"""Units, in a head without one that is known, in which no axis is measured here."""
_ALIKE, _TIMES = 0.1, (1000.0, 1e-3, 25.4, 1.0 / 25.4, 10.0, 0.1, 100.0, 0.01)
"""Of deviations, by which they may differ from positions minus targets; and of how many times these they may be, in another unit."""
_DIAMETER = re.compile(r"[Ø\u2300\u2205]|\bdia\b|diam|di[aá]metro|durchm|直径|直徑", re.I)


def require_stops(t_s: Floats | None, path: Path) -> None:
    """Refuse commanded and measured positions that were recorded in motion, by the times (n,) of their rows: each would be a target of its own."""
    if t_s is None or len(t_s) < _FEWEST_ROWS:
        return
    step_s = float(np.nanmedian(np.abs(np.diff(t_s))))
    if step_s <= _FASTEST_S:
        raise InputError(
            "the rows follow each other faster than an axis stops at targets: a motion was recorded, and nothing was positioned",
            code="position_table.recorded",
            where=str(path),
            got=f"{len(t_s)} rows, one each {shown_number(step_s)} s",
            allowed="a row for each target at which the axis stood; of readings on the fly a column direction",
            hint="circles that a control recorded: docs/how-to/coming-from.md; tones of a slide, commanded and measured: docs/reference/campaign-folder.md",
        )


def require_positioning(rows: Sequence[Sequence[str]], path: Path) -> None:
    """Refuse a table whose title or heads say that it is of another test along an axis."""
    cells = ([cell.strip() for cell in row if cell.strip()] for row in rows[:MOST_TITLES])
    titles = [": ".join(told) for told in cells if 0 < len(told) <= 2]
    heads = [*(table_of(rows) or [()])[0]]
    other = next((text.strip() for text in (*titles, *heads) if OTHER_TEST.search(text)), None)
    if opposite := next((t for t in titles if REVERSED.search(t) or _TURNED_TITLE.match(t)), ""):
        raise _of_other_sign(opposite, path)
    diameter = next((head.strip() for head in heads if names_target(head) and _DIAMETER.search(head)), None)
    if diameter is not None:
        raise InputError(
            "targets are diameters: the axis moves by half of them",
            code="position_table.diameter",
            where=str(path),
            got=diameter[:60],
            allowed="targets, and readings, of the slide (radius)",
            hint="halve the targets, and readings that are of diameters, too (those of a laser on the slide are not); then leave the word out of the heads",
        )
    side = next((head.strip() for head in heads if FROM_SIGN.search(head)), None)
    if side is not None:
        raise InputError(
            "a head may name the side that a target was approached from, or the direction: that is the other way",
            code="position_table.side",
            where=str(path),
            got=side[:60],
            allowed="forward (towards larger targets), reverse; from below, from above",
            hint="write forward or reverse into the heads",
        )
    if other is not None:
        raise InputError(
            "title or heads say that this is no test of positioning",
            code="position_table.test",
            where=str(path),
            got=other[:60],
            allowed="a positioning test",
            hint="deviations across the axis, and tilts of what moves along it, are not read",
        )


def require_one_axis(axes: Sequence[str], where: str, *, in_column: bool = False) -> None:
    """Refuse readings of several axes, or machines, told by a column or otherwise: they would be taken for cycles of one."""
    if len(axes) > 1:
        raise InputError(
            "the table holds several axes, or several machines",
            code="position_table.axes",
            where=where,
            got=", ".join(axes)[:60],
            allowed="one",
            hint=f'--axis "{axes[0]}" reads the rows of that one; else a file for each'
            if in_column
            else "rows with a column Axis, tables below titles such as X axis, or sheets called so: --axis X reads those of X; else a file for each",
        )


def require_counted(heads: Sequence[str], wide: Wide, path: Path) -> None:
    """Refuse heads whose numbers count no cycles: temperatures, loads, years, numbers of machines."""
    numbers = {number for _, _, number in wide.cells if number}
    if not counts_repeats(numbers):
        raise _no_cycles([heads[i].strip() for i, _, _ in wide.cells], path)


def require_cycles(cycles: Iterable[int], head: str, path: Path) -> None:
    """Refuse numbers of rows that count no cycles; those of a log may begin anywhere."""
    numbers = sorted(set(cycles))
    if numbers and not counts_repeats(numbers, numbers[0]):
        raise _no_cycles([f"{head.strip()}: {', '.join(map(str, numbers))}"], path)


def _no_cycles(got: Sequence[str], path: Path) -> InputError:
    return InputError(
        "the numbers of the heads, or rows, count no cycles",
        code="position_table.cycles",
        where=str(path),
        got=", ".join(got)[:80],
        allowed="forward 1, reverse 1, forward 2, …, of one axis under one condition",
        hint="where they are of several temperatures, loads, years or machines: a file for each",
    )


def require_near(table: PositionTable, path: Path) -> None:
    """Refuse what was taken for positions and does not follow its targets: deviations without a unit, most likely; and targets that were read, too."""
    if table.joined_mm and OWN_SENSOR.search(table.read_with):
        raise InputError(
            "positions that differ from cycle to cycle stand beside those of the axis' own sensor, and no targets",
            code="position_table.targets",
            where=str(path),
            got=table.read_with,
            allowed="a column target [mm] beside a column of the instrument, such as laser [mm]",
            hint="call the columns so; positions that an instrument read are not those that were commanded",
        )
    scale = table.scale
    read_um = np.hstack([table.forward_um, table.reverse_um])
    there = np.isfinite(read_um).any(axis=1)
    travel_mm = float(np.ptp(table.target_mm))
    if travel_mm > scale.longest:
        raise InputError(
            "targets lie farther apart than any machine travels",
            code="position_table.unit",
            where=str(path),
            got=f"{travel_mm:z.6g} {scale.unit}",
            allowed=f"up to {scale.longest:g} {scale.unit}",
            hint=f"write the unit into the head, such as: target [{scale.fine}]",
        )
    target_mm, off_mm = table.target_mm[there], np.nanmean(read_um[there], axis=1) / scale.per
    against_mm = 2.0 * target_mm + off_mm
    if table.by_position and np.ptp(against_mm) < LITTLE * np.ptp(table.target_mm):
        raise InputError(
            "the readings run against the targets: the scale or the instrument counts the other way",
            code="position_table.mirrored",
            where=str(path),
            got=f"{target_mm[0] + off_mm[0]:z.6g} to {target_mm[-1] + off_mm[-1]:z.6g} {scale.unit} at targets of {target_mm[0]:z.6g} to {target_mm[-1]:z.6g} {scale.unit}",
            allowed="readings that grow as the targets do",
            hint="change the sign of all readings, or of all targets where those count the other way",
        )
    apart = np.abs(off_mm - np.median(off_mm))
    if table.by_position and np.median(apart) > LITTLE * np.ptp(table.target_mm):
        most = int(np.argmax(apart))
        read = target_mm[most] + off_mm[most]
        raise InputError(
            "the readings are taken for positions, and do not follow their targets",
            code="position_table.unit",
            where=str(path),
            got=f"{read % scale.turn if scale.turn else read:z.6g} {scale.unit} at a target of {target_mm[most]:z.6g} {scale.unit}",
            allowed="positions; or deviations whose heads say so and state the unit",
            hint=f"write into the heads of deviations that they are, and the unit, such as: deviation forward 1 [{scale.fine}]",
        )


def require_not_exchanged(targets: Sequence[str], read: Sequence[str], heads: tuple[str, str], path: Path) -> None:
    """Refuse positions that are the same in every cycle beside targets that differ: the heads are exchanged.

    ``heads``: of targets and of what was read.
    """
    fewest = len(set(read))
    if 1 < fewest <= len(read) / 2 and 2 * fewest <= len(set(targets)) and not is_deviation(heads[1]):
        raise InputError(
            "targets and readings are exchanged: the readings come again to the last digit, the targets do not",
            code="position_table.exchanged",
            where=str(path),
            got=f"{len(set(targets))} different targets under {heads[0].strip()}, {fewest} readings under {heads[1].strip()}",
            allowed="targets that each cycle approaches again",
            hint="exchange the heads of both columns",
        )


def require_unit_of(scale: Scale, rows: Sequence[Sequence[str]], path: Path) -> None:
    """Refuse a table of angles where lengths are read: its figures would be taken for those."""
    angles = [cell.strip() for row in rows for cell in row if ANGLE.search(cell.strip())]
    if angles and not scale.turn:
        raise of_other_unit(scale, path, angles[0][:40])


def require_deviations(
    heads: Sequence[str], units: Sequence[str], body: Sequence[Sequence[str]], long: Long, path: Path, scale: Scale
) -> None:
    """Refuse deviations of another sign or unit than positions that stand beside them say, and a column beside another one of its name.

    ``units``: of the columns, as the row below the heads tells them.
    """
    for read_in in (long.target, long.value):
        alike = [n for n, other in enumerate(heads) if other.strip() == heads[read_in].strip()]
        if any(len({row[n].strip() for n in alike if n < len(row)}) > 1 for row in body):
            raise InputError(
                "two columns have one name, and not the same in their cells",
                code="position_table.twice",
                where=str(path),
                got=heads[read_in].strip()[:60],
                hint="take one of them out, or number cycles: forward 1, reverse 1",
            )
    head = heads[long.value]
    if _TURNED.match(head):
        raise _of_other_sign(head, path)
    if not is_deviation(head):
        return
    several = [other.strip() for n, other in enumerate(heads) if n in (long.value, *deviations_of(heads, long))]
    if len(several) > 1:
        raise InputError(
            "several columns hold deviations: of which axis, or of which state, is not told",
            code="position_table.columns",
            where=str(path),
            got=", ".join(several)[:80],
            allowed="one; or error [µm] beside others",
            hint="leave the others out, or a file for each; where they are cycles: forward 1, reverse 1, forward 2, …",
        )
    for n in (n for n, other in enumerate(heads) if SURELY_READ.match(other.strip()) and not is_deviation(other)):
        used = (long.target, long.value, n)
        factor = [scale.factor(plain_unit(told_unit(heads[i], units[i] if i < len(units) else ""))) for i in used]
        cells = [[number_or_none(row[i]) if i < len(row) else None for i in used] for row in body]
        table = np.array([row for row in cells if None not in row], dtype=float).reshape(-1, 3) * factor
        told, read = table[:, 1], table[:, 2] - table[:, 0]
        size = float(np.sqrt(np.mean(told**2))) if len(told) > 1 else 0.0
        for times in (-1.0, *_TIMES) if size > 0.0 else ():
            if float(np.sqrt(np.mean((told - times * read) ** 2))) < _ALIKE * size:
                if times < 0.0:
                    raise _of_other_sign(head, path)
                raise InputError(
                    "deviations are in another unit than the positions beside them say",
                    code="position_table.unit",
                    where=str(path),
                    got=f"{head.strip()}: {times:g} times {heads[n].strip()} minus {heads[long.target].strip()}",
                    allowed="deviations that are the positions minus the targets",
                    hint="correct the unit in the heads, or take one of both columns out",
                )


def _require_sign(titles: Sequence[str], path: Path) -> None:
    """Refuse a table with a title or head which says that errors are nominal minus actual, or with corrections."""
    if opposite := next((text for text in titles if is_opposite(text) or _TURNED.match(text)), ""):
        raise _of_other_sign(opposite, path)


def factor_of(head: str, below: str, path: Path, scale: Scale) -> float:
    """Return how many of the scale's unit one of a column is; refuse a unit that is not known, and deviations without one.

    ``below``: the unit as the row below the heads tells it.
    """
    _require_sign([head], path)
    unit = plain_unit(told_unit(head, below))
    if scale.turn and unit in LENGTHS.units:
        raise of_other_unit(scale, path, f"{head.strip()} {below.strip()}".strip()[:60])
    factor, bare = scale.factor(unit), not unit and is_deviation(head)
    if not factor > 0.0 or bare or (not unit and _OTHER_UNIT.search(head)):
        raise InputError(
            "deviations do not say their unit" if bare else "a column is in a unit that is not known",
            code="position_table.unit",
            where=str(path),
            got=f"{head.strip()} {below.strip()}".strip().removeprefix(NAMED)[:60],
            allowed=scale.allowed,
            hint=f"write the unit into the head, such as: deviation forward 1 [{scale.fine}]",
        )
    return factor


def _of_other_sign(got: str, path: Path) -> InputError:
    return InputError(
        "a column holds corrections or nominal minus actual: its sign is not that of a deviation",
        code="position_table.sign",
        where=str(path),
        got=got.strip()[:60],
        allowed="actual minus target",
        hint="change the sign and call the column a deviation",
    )


def of_other_unit(scale: Scale, path: Path, got: str) -> InputError:
    """Return the refusal of a table of angles where lengths are read, or the other way round."""
    return InputError(
        f"the table is in {'lengths' if scale.turn else 'angles'}, and is to be read as one of a {scale.kind} axis",
        code="position_table.unit",
        where=str(path),
        got=got.removeprefix(NAMED),
        allowed=scale.allowed,
        hint=scale.elsewhere,
    )


def require_unit_of_heads(
    scale: Scale, rows: Sequence[Sequence[str]], table: Sequence[Sequence[str]], path: Path
) -> None:
    """Refuse a table whose heads tell no unit, and whose title tells another than that of targets: of which columns it is, nobody knows."""
    unit = named_unit(rows[:MOST_TITLES])
    heads = any(told_unit(cell, "") or is_unit(cell) for row in table[:2] for cell in row)
    if unit and not heads and (not is_unit(unit) or scale.factor(plain_unit(unit)) != 1.0):
        raise InputError(
            "a title tells a unit, and no head says that it is in it",
            code="position_table.unit",
            where=str(path),
            got=unit,
            allowed=f"a unit in the heads; without any, targets and positions are in {scale.unit}",
            hint=f"write it into the heads of the columns that are in it, such as: forward 1 [{unit}]",
        )
