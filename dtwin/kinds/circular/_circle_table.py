"""Tables of circles as other programs write them: no column of time, one column a direction, a radius, or two coordinates.

Four forms are known by their heads, in which, or in a row below them, units stand:

* an angle and a deviation under the house's names, without a time: ``angle_deg, deviation_um``; a radius beside it is no measurement;
* an angle and a deviation for each direction: ``angle [deg], ccw [µm], cw [µm]``, with numbers behind them where a direction was repeated;
* an angle and a measured radius: ``angle [deg], radius [mm]``;
* two coordinates, as a grid encoder or a control records them: ``X [mm], Y [mm]``; the centre is that of the least-squares circle. What was
  commanded may stand beside, ``X cmd [mm]``, and is not used.

Radii are told from the programmed one. Where no time is told, it follows from the programmed feed. Further columns with a unit
stand beside, as of any table.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.foreign_columns import (
    DEVIATION,
    TURNED,
    Column,
    below_heads,
    columns_of,
    header_row,
    joined_heads,
    require_one_table,
    require_told_apart,
)
from dtwin.acquire.one_channel import require_one_channel
from dtwin.acquire.repeated_heads import counts_repeats, require_heads_for_all
from dtwin.acquire.spreadsheet import SUFFIXES as SPREADSHEETS
from dtwin.acquire.spreadsheet import first_text, table_bytes
from dtwin.acquire.table_dialect import decoded, remarks_of, rows_of
from dtwin.acquire.title_words import require_usual_sign
from dtwin.acquire.xmlsafe import number_or_none
from dtwin.errors import InputError
from dtwin.kinds.circular._circle_ways import (
    bare,
    beside_way,
    blocks,
    coarse,
    deviates,
    direction_column,
    in_motion,
    may_be_gon,
    require_one_way,
    require_ways,
    run_column,
    stretches,
    way_of,
    way_of_title,
)
from dtwin.kinds.circular._one_circle import require_none_apart, require_one_circle
from dtwin.kinds.circular._titles import require_as_titled
from dtwin.schema import Campaign, Direction, Finding, Floats, Run, RunMeta
from dtwin.units import UM_PER_MM

_SUFFIXES = (".csv", ".txt", ".tsv", ".dat", *SPREADSHEETS)
_MAX_BYTES = 64 * 1024**2
_FEWEST = 36
"""Rows of a circle."""
_LEAST_DEG = 90.0
"""Shortest arc that is a run."""
_LONGEST_TURN_S = 3600.0
"""Of a table without a clock: beyond it the feed is one in m/min, or 1.000 was meant as a thousand."""
_MOST_OFF = 0.1
"""Of the programmed radius."""
_ANGLE = re.compile(r"^(path )?(angle|winkel|phi|theta|[φθ])$", re.I)
_TIME = re.compile(r"^(t|time|zeit)$", re.I)
_RADIUS = re.compile(r"^(actual |measured )?(radius|r|istradius)( (actual|measured|ist))?$", re.I)
_BESIDE = re.compile(
    r"angle|winkel|phi|theta|time|zeit|temp|luft|\bair|feed|vorschub|speed|mean|avg|average|mittel|fit|std|sigma|min|max|median"
    r"|tangential|command|cmd|nominal|\bsoll|predict|expect|vorhers|simulat|smooth|gegl[äa]tt|(?<![^\W_])(corr|comp|korr|komp|abs)(?![^\W_])|reference|referenz|ideal|limit|toleran|grenz|uncertaint|unsicher"
    r"|diam|durchm|[ø⌀]"
    r"|^(?!.*(dev|err|abw|fehler)).*(correction|compensation|korrektur|kompensation|radius)\b",
    re.I,
)
"""What a head says whose column is no deviation of a run, though it names a direction."""
_COMMANDED = re.compile(
    r"\b(cmd|command(ed)?|soll(position|wert)?|nominal|target|demand(ed)?|programmed)\b|^soll|(soll|cmd)$", re.I
)
"""Of a control's log: coordinates that were commanded stand beside the actual ones."""
_COORDINATE = re.compile(
    r"^((?:actual |act |ist ?|measured )?(?:pos(?:ition)? |wert )?)([xyz])1?([ _]?(actual|act|ist|istposition|istwert|pos|position))?$",
    re.I,
)


@dataclass(frozen=True)
class _Form:
    """Which column is which; ``ways``: direction of each deviation, where heads tell it; ``pair``: columns of two coordinates."""

    angle: int | None
    time: int | None
    radius: int | None
    ways: tuple[tuple[int, Direction | None], ...]
    pair: tuple[tuple[int, str], ...]


def is_circle_table(path: Path) -> bool:
    """Return whether the heads of a file are those of one of the forms; it is read no further than its beginning."""
    if path.suffix.lower() not in _SUFFIXES or not path.is_file():
        return False
    try:
        above, columns, body = _seen(first_text(path, _MAX_BYTES), path)
        return _form_of(columns, above, body) is not None
    except InputError:
        return False


def read_circle_runs(
    path: Path, campaign: Campaign, stated: Mapping[str, Any]
) -> tuple[list[Run], list[dict[str, Any]]]:
    """Read a table of one of the forms as runs, one a direction and repeat, and its rows without a number.

    ``stated``: the ``[[run]]`` entry with ``radius_mm`` and ``feed_mm_min``; repeats count on from the one that it states.

    Raises ``InputError`` when a unit or condition is missing, or the rows do not go round.
    """
    text = decoded(table_bytes(path, _MAX_BYTES))
    require_heads_for_all(text, path)
    above, columns, body = _seen(text, path)
    form = _form_of(columns, above, body)
    require_as_titled(above, stated, path)
    require_usual_sign(above, path)
    require_told_apart(columns, body, path)
    _require_one_meaning(columns, path)
    require_ways(columns, body, path)
    require_one_table([column.head for column in columns], body, path)
    radius_mm, feed_mm_min = stated.get("radius_mm"), stated.get("feed_mm_min")
    if form is None or not radius_mm or not feed_mm_min:
        raise _wrong("a table of a circle needs its programmed radius and feed", path, "radius_mm, feed_mm_min", "both")
    needed = [i for i in (form.angle, form.time, form.radius) if i is not None]
    needed += [i for i, _ in (*form.ways, *form.pair)]
    for i in needed:
        if not columns[i].unit or columns[i].why_not:
            got = f"{columns[i].head}: {columns[i].why_not}" if columns[i].unit else columns[i].head
            raise _wrong("a column tells no unit that is known", path, got, "such as ccw [µm], angle [deg], X [mm]")
    values = {i: _numbers(body, i, columns[i]) for i in needed}
    if form.angle is not None and may_be_gon(columns[form.angle], values[form.angle]):
        got = f"{columns[form.angle].head}: angles over 400, a whole turn in gon"
        raise _wrong("angles in Grad may be degrees or gon", path, got, "Winkel [gon], or Winkel [°]")
    beside = {i: c.name for i, c in enumerate(columns) if i not in needed and c.name and not _COMMANDED.search(bare(c))}
    kept = {name: _numbers(body, i, columns[i], as_it_is=True) for i, name in beside.items()}
    rejects = [
        {
            "row": n,
            "reason": "not a number",
            "values": {columns[i].head: body[n][i][:40] for i in needed if i < len(body[n])},
        }
        for n in np.flatnonzero(~np.all([np.isfinite(v) for v in values.values()], axis=0))
    ]
    if form.pair:
        angle, curves = _around(form, values, stated, float(radius_mm), path)
    else:
        angle = _unwrapped(np.radians(values[form.angle or 0]))
        if form.radius is not None and (median := _median(values[form.radius])) is not None:
            _require_near(median, float(radius_mm), "the column of radii is of another circle", path)
        curves = [(None, UM_PER_MM * (values[form.radius] - radius_mm))] if form.radius is not None else []
        curves += [(way, values[i]) for i, way in form.ways]
    if not form.pair and not stated.get("direction") and any(way is None for way, _ in curves):
        require_one_way(above, path)
    parts = blocks(columns, above, body)
    ways: list[Direction | None] = [None] * len(body)
    for told, part in parts:
        for n in np.flatnonzero(part):
            ways[n] = told
    require_one_circle(columns, body, angle, ways, needed, path)
    require_none_apart(text, angle, path)
    heads = [column.head for column in columns]
    require_one_channel(heads, body, [*needed, direction_column(columns, body), run_column(columns)], path)
    runs: list[Run] = []
    for way, deviation_um in curves:
        good = np.isfinite(angle) & np.isfinite(deviation_um)
        if form.time is not None:
            good &= np.isfinite(values[form.time])
        rows = (
            {"angle_deg": angle, "deviation_um": deviation_um}
            | ({} if form.time is None else {"t_s": values[form.time]})
            | kept
        )
        for told, part in parts:
            block = {name: column[good & part] for name, column in rows.items()}
            runs += _runs(block, way if form.pair else way or told, stated, str(path), timed=len(form.ways) == 1)
    if not runs:
        raise _wrong(
            "the rows do not go round", path, f"{len(body)} rows", f"an arc of {_LEAST_DEG:g} degrees, {_FEWEST} rows"
        )
    told = stated.get("direction")
    if told and any(run.meta.direction != told for run in runs):
        raise _wrong(
            "the table goes another way round than is told",
            path,
            f"direction {told}, runs {', '.join(str(run.meta.direction) for run in runs)}",
            "no direction told; cw [µm] or ccw [µm] as head of deviations over an angle that runs the other way",
        )
    said = coarse([values[i] for i, _ in form.pair])
    runs = [replace(run, findings=(*run.findings, *said)) for run in runs]
    return _counted(runs, int(stated.get("repeat", 1))), rejects


def _seen(text: str, path: Path) -> tuple[list[list[str]], tuple[Column, ...], list[list[str]]]:
    """Return the titles and remarks above a table, its columns and its rows."""
    lines = rows = rows_of(text)
    if rows and all(len(row) == 1 for row in rows):
        # Parted by blanks, which may stand before a unit, too.
        rows = [re.sub(r"\s+(?=[\[(])", "", row[0]).split() for row in rows]
    rows = [list(row) for row in joined_heads(rows, path)]
    begin = header_row(rows, path)
    heads = [cell.strip() for cell in rows[begin]]
    units, body = below_heads(rows, begin)
    return [*remarks_of(text), *lines[: len(lines) - len(body)]], columns_of(heads, units, {}), body


def _form_of(columns: Sequence[Column], above: Sequence[Sequence[str]], body: Sequence[Sequence[str]]) -> _Form | None:
    names = [bare(column) for column in columns]
    first = {
        pattern: next((i for i, n in enumerate(names) if pattern.match(n)), None)
        for pattern in (_ANGLE, _TIME, _RADIUS)
    }
    ways: tuple[tuple[int, Direction | None], ...] = tuple(
        (i, way_of(name)) for i, name in enumerate(names) if way_of(name)
    )
    beside = {direction_column(columns, body), run_column(columns)}
    told = beside != {None} or any(map(way_of_title, above))
    ways = ways or tuple((i, None) for i, c in enumerate(columns) if c.head == "deviation_um" or (told and deviates(c)))
    pair = tuple(
        (i, match[2].upper()) for i, match in ((i, _COORDINATE.match(n)) for i, n in enumerate(names)) if match
    )
    # Beside deviations a radius is the programmed one, or says the same again.
    form = _Form(first[_ANGLE], first[_TIME], None if ways else first[_RADIUS], ways, pair)
    known = len(ways) + len(pair) + sum(i is not None for i in first.values())
    actual = sum(not _COMMANDED.search(name) and i not in beside for i, name in enumerate(names))
    lengths = all(columns[i].name.endswith(("_mm", "_um")) or not columns[i].unit for i, _ in pair)
    if len({axis for _, axis in pair}) == len(pair) == 2 and lengths and known == 2 + (form.time is not None) == actual:
        return _Form(None, form.time, None, (), pair)
    if not told and {"t_s", "angle_deg", "deviation_um"} <= {column.head for column in columns}:
        return None
    # Deviations under another name are imported, column by column.
    foreign = not ways and any(map(DEVIATION.match, names))
    if form.angle is not None and not pair and not foreign and (ways or form.radius is not None):
        return form
    return None


def _require_one_meaning(columns: Sequence[Column], path: Path) -> None:
    """Refuse a column whose head names a direction and is no deviation in a length, and one that stands there twice."""
    for column in columns:
        name = bare(column)
        no_length = column.unit and not column.name.endswith(("_um", "_mm"))
        turned = TURNED.match(column.head) and way_of(name.strip("-\u2212\u2013|± "))
        if turned or (way_of(name) and (no_length or _BESIDE.search(name))):
            raise _wrong(
                "a column names a direction and is no deviation", path, column.head, "deviations: ccw [µm], cw [µm]"
            )
    ways = {column.head: beside_way(bare(column)) for column in columns if way_of(bare(column))}
    numbers = {number for _, told in ways.values() for number in told}
    if len({words for words, _ in ways.values()}) > 1 or not counts_repeats(numbers):
        raise _wrong(
            "columns of one direction are of several planes, feeds, radii or machines, and no repeats",
            path,
            ", ".join(ways)[:80],
            "ccw 1 [µm], cw 1 [µm], ccw 2 [µm], of one condition; a file for each",
        )
    for pattern in (_ANGLE, _TIME, _RADIUS, DEVIATION):
        alike = [column.head for column in columns if pattern.match(bare(column))]
        if len(alike) > 1:
            raise _wrong("more than one column may be meant", path, ", ".join(alike), "one angle, one time, one radius")


def _numbers(body: Sequence[Sequence[str]], i: int, column: Column, *, as_it_is: bool = False) -> Floats:
    """Return a column in degrees, seconds, µm or, of lengths that are no deviations, mm; what is no number is NaN.

    ``as_it_is``: in the unit of the column's name.
    """
    values = np.full(len(body), np.nan)
    for n, row in enumerate(body):
        if i < len(row) and (value := number_or_none(row[i])) is not None:
            values[n] = value
    values[~(np.abs(values) < 1e9)] = np.nan
    scaled = column.factor * (values - column.zero)
    if as_it_is:
        return scaled
    here = column.name.rpartition("_")[2]
    wanted = "um" if way_of(bare(column)) or deviates(column) else "mm"
    return np.asarray(scaled * {("mm", "um"): UM_PER_MM, ("um", "mm"): 1.0 / UM_PER_MM}.get((here, wanted), 1.0))


def _around(
    form: _Form, values: Mapping[int, Floats], stated: Mapping[str, Any], radius_mm: float, path: Path
) -> tuple[Floats, list[tuple[Direction | None, Floats]]]:
    """Return angle and deviation of two coordinates about the centre of their least-squares circle."""
    plane = str(stated.get("plane", ""))
    by_axis = {axis: values[i] for i, axis in form.pair}
    if set(plane) != set(by_axis):
        raise _wrong(
            "the coordinates are not those of the plane", path, " and ".join(by_axis), f"those of plane {plane}"
        )
    first, second = (by_axis[axis] for axis in plane)
    good = np.isfinite(first) & np.isfinite(second)
    if good.sum() < _FEWEST:
        raise _wrong("there are too few rows for a circle", path, f"{int(good.sum())} rows", f"{_FEWEST} rows")
    u, v = first[good] - first[good].mean(), second[good] - second[good].mean()
    design = np.stack([u, v, np.ones_like(u)], axis=1)
    (a, b, c), *_ = np.linalg.lstsq(design, u**2 + v**2, rcond=None)
    found_mm = float(np.sqrt(max(c + (a**2 + b**2) / 4.0, 0.0)))
    _require_near(found_mm, radius_mm, "the coordinates lie on another circle", path)
    u, v = first - first[good].mean() - a / 2.0, second - second[good].mean() - b / 2.0
    return _unwrapped(np.arctan2(v, u)), [(None, UM_PER_MM * (np.hypot(u, v) - radius_mm))]


def _median(values: Floats) -> float | None:
    there = values[np.isfinite(values)]
    return float(np.median(there)) if there.size else None


def _require_near(found_mm: float, radius_mm: float, message: str, path: Path) -> None:
    if not abs(found_mm - radius_mm) < _MOST_OFF * radius_mm:
        raise _wrong(message, path, f"a radius of {found_mm:z.6g} mm", f"about {radius_mm:g} mm, as it is told")


def _unwrapped(angle_rad: Floats) -> Floats:
    """Return an angle in degrees without jumps; NaN stays where it is."""
    out = np.full(angle_rad.size, np.nan)
    good = np.isfinite(angle_rad)
    out[good] = np.degrees(np.unwrap(angle_rad[good]))
    return out


def _runs(
    rows: Mapping[str, Floats], way: Direction | None, stated: Mapping[str, Any], source: str, *, timed: bool
) -> list[Run]:
    """Return the stretches in which an angle runs one way; of a column whose direction its head tells, the whole, that way round.

    ``timed``: a column of time is of these readings, not of those of the other direction.
    """
    angle = rows["angle_deg"]
    out = []
    for part in [slice(0, angle.size)] if way is not None else stretches(angle):
        moves, findings = (slice(None), []) if way is not None else in_motion(angle[part])
        samples = {name: column[part][moves] for name, column in rows.items()}
        theta = samples["angle_deg"]
        if theta.size < _FEWEST or float(np.ptp(theta)) < _LEAST_DEG:
            continue
        runs: Direction = "CCW" if theta[-1] > theta[0] else "CW"
        rising = timed and "t_s" in samples and bool(samples["t_s"][-1] > samples["t_s"][0])
        if way is not None and way != runs and not rising:
            # Both directions stand over one column of angles, which runs as one of them; a clock tells how it ran.
            samples = {name: column[::-1] for name, column in samples.items() if timed or name != "t_s"}
        if "t_s" not in samples:
            per_deg_s = float(np.radians(1.0) * stated["radius_mm"] / (stated["feed_mm_min"] / 60.0))
            if 360.0 * per_deg_s > _LONGEST_TURN_S:
                raise _wrong(
                    "a turn would take more than an hour at the programmed feed",
                    Path(source),
                    f"{stated['feed_mm_min']:g} mm/min",
                    "mm/min, such as 1000; or a column of time",
                )
            travel_deg = np.abs(samples["angle_deg"] - samples["angle_deg"][0])
            if np.any(np.diff(travel_deg) <= 0.0):
                # An encoder that shakes is read at a fixed rate.
                travel_deg = np.linspace(0.0, float(travel_deg.max()), travel_deg.size)
            samples["t_s"] = travel_deg * per_deg_s
            text = "the table has no clock; its time follows from the programmed feed"
            findings.append(Finding("clock.assumed", "info", text))
        gap_s = float(np.median(np.diff(samples["t_s"])))
        rate_hz = 1.0 / gap_s if gap_s > 0.0 else float("nan")
        meta = RunMeta("", "circular", direction=way or runs, sample_rate_hz=rate_hz)
        out.append(Run(meta, samples, source=source, findings=tuple(findings)))
    return out


def _counted(runs: Sequence[Run], first: int) -> list[Run]:
    """Give each run its name and its repeat of its direction, the first one ``first``."""
    seen: dict[Any, int] = {}
    out = []
    for run in runs:
        way = run.meta.direction
        seen[way] = seen.get(way, 0) + 1
        name = f"{str(way).lower()}{seen[way]}"
        out.append(replace(run, meta=replace(run.meta, run_id=name, repeat=first - 1 + seen[way])))
    return out


def _wrong(message: str, path: Path, got: str, allowed: str) -> InputError:
    return InputError(
        message,
        code="circle_table.form",
        where=str(path),
        got=got[:120],
        allowed=allowed,
        hint="docs/how-to/ingest-your-own.md, tables of circles; points of a plane that make no circle, commanded and measured: --kind poses",
    )
