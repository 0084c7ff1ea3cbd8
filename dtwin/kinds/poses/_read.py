"""Tables of robot poses in the dialect and under the headers that they come with.

``[campaign.instrument.columns]`` names the house's column for a foreign header, with the unit that the file
has: ``"Goal x" = "target_x_m"``. Metres and radians become millimetres and degrees. Without joints, commanded positions must be there.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.campaign_folder import inside
from dtwin.acquire.foreign_columns import below_heads, in_english, joined_heads, require_one_of, require_one_table
from dtwin.acquire.repeated_heads import require_heads, require_one_block
from dtwin.acquire.spreadsheet import SUFFIXES as SPREADSHEETS
from dtwin.acquire.spreadsheet import first_rows, table_bytes
from dtwin.acquire.table_dialect import SUMMARY, decoded, remarks_of, rows_of, typed
from dtwin.acquire.time_stamps import clock_of, numbers_of, of_stamps
from dtwin.acquire.title_words import named_unit, require_usual_sign, unit_of_titles
from dtwin.errors import InputError
from dtwin.kinds.poses._axis_rows import (
    FEWEST_OF_ARM,
    NO_UNIT,
    axes_beside,
    is_by_axes,
    joined,
    joints_of,
    lines_for,
    of_ros,
    of_tracker,
    of_words,
    places_of,
)
from dtwin.kinds.poses._orientation import house_name, with_orientation
from dtwin.kinds.poses._repeats import no_commanded, repeated_places, with_joints, with_tracker_heads
from dtwin.positioning.table_heads import told_unit
from dtwin.schema import Campaign, Finding, Floats, Run, RunMeta
from dtwin.units import LENGTHS_MM

_MOST_BYTES = 256 * 1024**2
_SCALES = {f"_{unit}": ("_mm", mm) for unit, mm in LENGTHS_MM.items()} | {"_rad": ("_deg", 180.0 / np.pi)}
_STAMP_DIGITS, _MOST_TITLES, _LARGEST = 14, 20, 1e9
_UNDER = re.compile(
    r"(.*[\s_])?(velocity|speed|geschwindigkeit|override|payload|load|last|nutzlast|traglast|arm|config(uration)?|konfiguration)([\s_]*[\[(].*|_(mm_s|m_s|pct|kg))?",
    re.I,
)
"""Head of a column that says under what poses were measured: those of ISO 9283 are told for each velocity and load."""
_NEEDED = ("joint_", "measured_", "error_")


def _read_poses(path: Path, campaign: Campaign, stated: Mapping[str, Any]) -> tuple[list[Run], list[dict[str, Any]]]:
    """Return one table as a run, and the rows that hold no usable number.

    Raises ``InputError`` when a column is missing, with those that the file has.
    """
    log = stated.get("condition", {}).get("joints_log")
    columns, heads, unit = _columns(path, campaign, with_log=log is not None)
    in_motion: list[dict[str, Any]] = []
    if log is not None:
        logged = inside(path.parent, log, "condition.joints_log")
        columns, moving = with_joints(columns, _columns(logged, campaign)[0], logged)
        in_motion = [{"row": int(r), "reason": "the robot moved", "values": {}} for r in np.flatnonzero(moving)]
    columns, of_plane = _with_height(columns)
    _require(columns, path, heads, unit)
    total = len(next(iter(columns.values())))
    columns["row_1"] = np.arange(1.0, total + 1.0)
    out = _left_out(stated.get("condition", {}), total, path)
    copy_of = _copies(columns)
    columns, findings = with_orientation(columns, path)
    findings += [*of_plane, *_timed(columns, heads, total)]
    needed = _NEEDED if any(n.startswith("joint_") for n in columns) else (*_NEEDED, "target_")
    need = np.stack([v for n, v in columns.items() if n.startswith(needed)], axis=1)
    good = np.isfinite(need).all(axis=1)
    read = [columns[n] for n in ("measured_x_mm", "measured_y_mm", "measured_z_mm") if n in columns]
    # Where its beam is lost an instrument writes zeros.
    good &= np.any([values != 0.0 for values in read], axis=0) if read else True
    left_out = np.isin(columns["row_1"], out)
    # The same reading at the same time was written twice; without times it may be two that agree.
    copied = np.isin(columns["row_1"], [] if any(f.code == "poses.times" for f in findings) else list(copy_of))
    if len(copy_of) > copied.sum():
        said = (
            f"rows that hold the numbers of an earlier one: {len(copy_of)}, the first is {min(copy_of)}; "
            "copies are no repeats, and make repeatability, floor and U too small; "
            "with the times of the rows copies are told from readings that agree"
        )
        findings.append(Finding("poses.copies", "warning", said, {"rows_1": float(len(copy_of))}))
    if not (good & ~left_out).any():
        raise InputError("no row holds finite numbers", code="table.no_rows", where=str(path))
    rejects = [
        {
            "row": int(columns["row_1"][r]) - 1,
            "reason": _why_not(int(columns["row_1"][r]), left_out[r], copied[r], copy_of),
            "values": {n: repr(c[r].item()) for n, c in columns.items() if n != "row_1"},
        }
        for r in np.flatnonzero(~good | left_out | copied)
    ]
    good &= ~left_out & ~copied
    if (columns["row_1"][good] == np.arange(1, good.sum() + 1)).all():
        # The place of a row is its number.
        del columns["row_1"]
    gone = {n for n, c in columns.items() if not np.isfinite(c[good]).all()}
    samples = {n: c[good] for n, c in columns.items() if n not in gone}
    if gone:
        said = f"columns with gaps are left out: {', '.join(sorted(gone))}"
        findings.append(Finding("poses.gaps", "warning", said))
    meta = RunMeta(run_id="poses", kind="poses", sample_rate_hz=float("nan"))
    return [Run(meta, samples, source=str(path), findings=tuple(findings))], [*in_motion, *rejects]


def _with_height(columns: dict[str, Floats]) -> tuple[dict[str, Floats], list[Finding]]:
    """Return commanded and measured points of a plane with a height of 0, and what is said of it; others as they are."""
    read = "measured" if "measured_x_mm" in columns else "error"
    flat = {f"{what}_{axis}_mm" for what in ("target", read) for axis in "xy"}
    if not flat <= set(columns) or any(name.startswith("joint_") or name.endswith("_z_mm") for name in columns):
        return columns, []
    height = np.zeros(len(columns["target_x_mm"]))
    said = "the table has X and Y alone: points of a plane, whose height is taken to be as commanded"
    return {**columns, "target_z_mm": height, f"{read}_z_mm": height}, [Finding("poses.plane", "info", said)]


def _left_out(condition: Mapping[str, Any], n: int, path: Path) -> list[int]:
    """Return the numbers of rows that ``leave_out`` of a run's condition names."""
    told = str(condition.get("leave_out", ""))
    named = [part.strip() for part in told.split(",") if part.strip()]
    if not all(part.isdecimal() and 1 <= int(part) <= n for part in named):
        raise InputError(
            "rows to leave out are told by their numbers",
            code="poses.leave_out",
            where=f"{path} condition.leave_out",
            got=told[:80],
            allowed=f'numbers from 1, the first row below the heads, to {n}: leave_out = "3, 17"',
        )
    return [int(part) for part in named]


def _copies(columns: Mapping[str, Floats]) -> dict[int, int]:
    """Return the number of each row that holds the same finite numbers as an earlier one, and the number of that one."""
    first: dict[bytes, int] = {}
    table = np.stack([values for name, values in columns.items() if name != "row_1"], axis=1)
    numbers = ((int(number), row) for number, row in zip(columns["row_1"], table, strict=True))
    seen = ((number, first.setdefault(row.tobytes(), number)) for number, row in numbers if np.isfinite(row).all())
    return {number: earlier for number, earlier in seen if earlier != number}


def _why_not(number: int, left_out: bool, copied: bool, copy_of: Mapping[int, int]) -> str:
    if left_out:
        return "left out in campaign.toml"
    return f"a copy of row {copy_of[number]}" if copied else "not finite, or nothing was read"


def is_pose_table(path: Path) -> bool:
    """Return whether a table has joints or commanded places, and measured places or errors, under the house's names, or is one of cameras or
    of ROS; its conditions are told elsewhere.
    """
    if path.suffix.lower() not in (".csv", ".txt", *SPREADSHEETS) or not path.is_file():
        return False
    told = first_rows(path, _MOST_BYTES)
    rows = with_tracker_heads(told)
    if rows is not told or is_by_axes(rows):
        return True
    if path.suffix.lower() == ".txt":
        return bool(repeated_places(rows))
    heads = _headed(rows, {}, path)[0]
    if joined(rows) is not None or of_ros(heads) or of_tracker(heads) or repeated_places(rows):
        return True
    if sum(head.startswith("joint_") for head in heads) >= FEWEST_OF_ARM:
        return True
    commanded = any(h.startswith("joint_1_") for h in heads) or _are_places("target", heads)
    return commanded and (_are_places("measured", heads) or _are_places("error", heads))


def _are_places(what: str, heads: Sequence[str]) -> bool:
    """Return whether columns are of places in space, or of a part of them that is no circle's plane."""
    told = {axis for axis in "xyz" if any(head.startswith(f"{what}_{axis}_") for head in heads)}
    return "x" in told and told != {"x", "y"}


def _columns(path: Path, campaign: Campaign, *, with_log: bool = False) -> tuple[dict[str, Floats], list[str], str]:
    """Return the columns of a table by the house's names, in mm and degrees, its heads, and the unit of lengths that it states, else metres.

    ``with_log``: the joints are in a file of their own.
    """
    recipe = campaign.instrument.get("columns", {})
    text = decoded(table_bytes(path, _MOST_BYTES))
    require_one_block(text, path)
    rows = axes_beside(with_tracker_heads(rows_of(text)), path)
    if not recipe and (places := repeated_places(rows)):
        raise no_commanded(path, places)
    named, heads, units, below, unit = _headed(rows, recipe, path, with_log)
    first = heads if len(heads) > 1 else " ".join(heads).split()
    require_heads(
        first,
        path,
        "joint_1_deg, joint_2_deg …, or measured_x_mm, measured_y_mm, measured_z_mm, in the order of the columns",
    )
    if not any(name.startswith("measured_") for name in named):
        require_usual_sign([*remarks_of(text), *rows[:_MOST_TITLES]], path)
    bare = any(
        name.startswith(("measured_", "target_"))
        and name.endswith("_mm")
        and head not in recipe
        and not told_unit(head, "")
        for head, name in zip(heads, named, strict=True)
        if not units
    )
    titled = named_unit([*remarks_of(text), *rows[:_MOST_TITLES]]) if bare else ""
    if titled and LENGTHS_MM.get(titled.lower()) != 1.0:
        raise InputError(
            "a title tells a unit, and no head says that it is in it",
            code="poses.unit",
            where=str(path),
            got=titled[:40],
            allowed="a unit in the heads; without any, places are in mm",
            hint=f"write it into the heads, such as: target X [{titled[:20]}]",
        )
    without = [h for h, name in zip(heads, named, strict=True) if name.startswith("error_") and name.endswith(NO_UNIT)]
    if without:
        raise InputError(
            "errors do not say their unit",
            code="poses.unit",
            where=str(path),
            got=", ".join(without)[:80],
            allowed=", ".join(LENGTHS_MM)[:40],
            hint=f"write it into the heads, such as: {without[0]} [mm]",
        )
    require_one_table(heads, below, path)
    if not recipe:
        require_one_of(_UNDER, heads, below, path, repeated=True)
    sound = (len(row) == len(named) and not any(SUMMARY.fullmatch(cell.strip()) for cell in row) for row in below)
    body = [row if whole else [""] * len(named) for row, whole in zip(below, sound, strict=True)]
    wanted = {
        n: i for i, n in enumerate(named) if n in ("t_s", "t_ns") or n.startswith((*_NEEDED, "target_", "ambient_"))
    }
    twice = sorted(name for name in wanted if named.count(name) > 1)
    if twice:
        raise InputError(
            "two columns are the same quantity", code="poses.twice", where=str(path), got=", ".join(twice)[:80]
        )
    columns: dict[str, Floats] = {}
    for name, place in wanted.items():
        # Decimal commas and points may be mixed within a column.
        column = numbers_of([typed(row[place].strip()).replace(",", ".") for row in body])
        if not name.startswith("t_"):
            # Their squares would be infinite, and a decomposition of them never ends.
            column[~(np.abs(column) < _LARGEST)] = np.nan
        ending = next((e for e in _SCALES if name.endswith(e)), "")
        new, scale = _SCALES.get(ending, (ending, 1.0))
        columns[name.removesuffix(ending) + new] = column * scale
    columns = _with_degrees(columns, path)
    if not {"t_s", "t_ns"} & set(columns):
        # Stamps of which day and month may be exchanged are no times.
        with suppress(InputError):
            times = clock_of([head if head not in recipe else "" for head in heads], units, body, str(path))
            columns |= {} if times is None else {"t_s": times}
    if "t_ns" in columns:
        # ROS tells whole seconds and the rest apart.
        columns["t_s"] = columns.get("t_s", 0.0) + 1e-9 * columns.pop("t_ns")
    return columns, heads, unit


def _with_degrees(columns: dict[str, Floats], path: Path) -> dict[str, Floats]:
    """Return columns with joints of no unit in degrees: what turns by more than one turn in radians is not in them."""
    without = [name for name in columns if name.startswith("joint_") and name.endswith(NO_UNIT)]
    if without and not max(np.nanmax(np.abs(columns[name]), initial=0.0) for name in without) > 2.0 * np.pi:
        raise InputError(
            "joints do not say their unit",
            code="poses.unit",
            where=str(path),
            got=", ".join(name.removesuffix(f"_{NO_UNIT}") for name in without),
            allowed="deg, rad",
            hint='write it into the heads, such as J1 [rad], or "J1" = "joint_1_rad" under [campaign.instrument.columns]',
        )
    return {name.replace(NO_UNIT, "deg"): values for name, values in columns.items()}


def _headed(
    rows: Sequence[Sequence[str]], recipe: Mapping[str, Any], path: Path, with_log: bool = False
) -> tuple[list[str], list[str], list[str], list[Sequence[str]], str]:
    """Return the house's names of the columns, the heads, which may stand below titles, units below them, rows and the unit of lengths.

    Beside joints, in the table or, ``with_log``, in a file of their own, plain X, Y and Z are measured.
    """
    exported = joined(rows)
    if exported is not None:
        heads, body, unit = exported
        return [house_name(str(recipe.get(head.strip(), head.strip()))) for head in heads], heads, [], body, unit
    rows = joined_heads(rows, path)
    known = (*_NEEDED, "target_")
    named_in = (
        n
        for n, row in enumerate(rows[:_MOST_TITLES])
        if any(cell.strip() in recipe or of_words(cell.strip()).startswith(known) for cell in row)
    )
    begin = next(named_in, 0)
    heads = [cell.strip() for cell in rows[begin]] if rows else []
    units, body = below_heads(rows, begin)
    told = units or [unit_of_titles(rows[:begin])] * len(heads)
    named = [
        house_name(str(recipe.get(head, of_words(head, below))))
        for head, below in zip_longest(heads, told[: len(heads)], fillvalue="")
    ]
    known_already = {name.partition("_")[0] for name in named}
    # A plain joint_1 tells no unit.
    if "joint" not in known_already or "joint_1" in named:
        for n, name in joints_of(heads, told).items():
            named[n] = name
    with_log = with_log or any(name.startswith("joint_") for name in named)
    if with_log and not {"measured", "target", "error"} & known_already:
        for n, name in places_of(heads, told).items():
            named[n] = name
    return named, heads, list(units or []), body, "m"


def _require(columns: Mapping[str, Floats], path: Path, heads: list[str], unit: str) -> None:
    target, measured, error = ({f"{what}_{a}_mm" for a in "xyz"} for what in ("target", "measured", "error"))
    there = set(columns)
    joints = {name for name in columns if name.startswith("joint_")}
    counted = joints == {f"joint_{j}_deg" for j in range(1, len(joints) + 1)}
    if counted and (measured <= there or target | error <= there) and (joints or target <= there):
        return
    known = lines_for(heads, unit)
    commanded = "joints, joint_1_deg …, or commanded places, target_x_mm …"
    if (measured <= there or places_of(heads, ())) and not joints:
        hint = f"only measured places are told: add {commanded}; joints may be in a file of their own, condition = {{ joints_log = … }} of the run in campaign.toml"
    elif joints and {head[:1].lower() for head in heads} >= {"x", "y", "z"}:
        hint = "heads of measured places tell their unit: X [mm], Y [mm], Z [mm]"
    elif known:
        missing = "measured places, measured_x_mm …" if "joint_1" in known[0] else commanded
        hint = f"[campaign.instrument.columns] with the lines {', '.join(known[:7])}; and {missing}, in the same way"
    else:
        read = "HEAD" if joints else "Goal x"
        hint = f'other headers: [campaign.instrument.columns] of campaign.toml with lines such as "{read}" = "{"measured" if joints else "target"}_x_m": docs/how-to/robot-poses.md'
    raise InputError(
        "a table of poses lacks columns",
        code="columns.missing",
        where=str(path),
        got=", ".join(heads)[:200],
        allowed="joint_1_deg, joint_2_deg …, without a gap, or target_x_mm …; and measured_x_mm … or target_x_mm … with error_x_mm …",
        hint=hint,
    )


def _timed(columns: dict[str, Floats], heads: Sequence[str], n: int) -> list[Finding]:
    """Give the rows their times; the number of the row stands for a time that is not known."""
    stamps = columns.get("t_s")
    if stamps is not None and np.isfinite(stamps).all():
        if stamps.min() > 10.0 ** (_STAMP_DIGITS - 1):
            stamps = _seconds(stamps)
        if np.ptp(stamps) > 0.0:
            order = np.argsort(stamps, kind="stable")
            for name in columns:
                columns[name] = columns[name][order]
            columns["t_s"] = stamps[order] - stamps[order[0]]
            if (np.diff(order) > 0).all():
                return []
            return [Finding("poses.order", "info", "rows were not in the order of their times: they are sorted")]
    columns["t_s"] = np.arange(n, dtype=np.float64)
    said = "the times of the rows are not known: t_s is the number of the row, and drift over time is not judged"
    if clock := next((head for head in heads if of_stamps(in_english(head))), ""):
        said += f"; {clock.strip()} tells no unit, and holds no dates of a known form: write {clock.strip()} [s]"
    return [Finding("poses.times", "warning", said)]


def _seconds(stamps: Floats) -> Floats:
    """Return stamps such as 20200714163904 in seconds; of a stamp that is none, all are the same."""
    texts = [f"{s:z.0f}" for s in stamps]
    iso = [f"{s[:4]}-{s[4:6]}-{s[6:8]}T{s[8:10]}:{s[10:12]}:{s[12:14]}" for s in texts]
    try:
        return np.array(iso, dtype="datetime64[s]").astype(np.float64)
    except ValueError:
        return np.zeros(len(stamps))


READERS = dict.fromkeys((".csv", ".txt", ".tsv", ".dat", *SPREADSHEETS), _read_poses)
