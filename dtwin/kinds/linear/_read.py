"""Runs of a positioning test from a laser file or a table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.kinds.linear.laser_file import LaserTest, read_laser_file, sign_rule
from dtwin.positioning.matrix import sweeps
from dtwin.positioning.ways import with_ways
from dtwin.schema import Campaign, Finding, Run, RunMeta
from dtwin.units import UM_PER_MM, is_number

_FORWARD, _REVERSE = "forward", "reverse"
MM_PER: Mapping[str, float] = {"mm": 1.0, "in": 25.4}
_KPA_PER_INHG = 3.386389
_ASSUMED_PERIOD_S = 1.0


def read_laser_runs(
    path: Path, campaign: Campaign, stated: Mapping[str, Any]
) -> tuple[list[Run], list[dict[str, Any]]]:
    """Read a laser file as runs, each one sweep forward and one back.

    ``campaign``: ``instrument.length_unit`` says whether lengths are ``mm`` or ``in``; ``instrument.reading_period_s``
    how long after one another readings were taken.
    ``stated``: the ``[[run]]`` entry.
    Returns ``runs``: ids are ``1``, ``2`` ...; repeats count on from the stated one.
    Returns ``rejects``: lines without a row.
    """
    unit = campaign.instrument.get("length_unit")
    if not isinstance(unit, str) or unit not in MM_PER:
        raise InputError(
            "a laser file does not say its unit of length",
            code="laser.unit",
            where=str(path),
            got=str(unit)[:40],
            allowed=", ".join(MM_PER),
            hint='set length_unit = "in" under [campaign.instrument]',
        )
    test = read_laser_file(path)
    findings = _findings(test, campaign)
    parts = sweeps(test.column("Position"))
    first = int(stated.get("repeat", 1))
    runs = []
    for number in range(0, len(parts), 2):
        pair = parts[number : number + 2]
        columns = _columns(test, pair, MM_PER[unit], _period_s(campaign))
        count = number // 2
        meta = RunMeta(
            run_id=str(count + 1), kind="linear", repeat=first + count, sample_rate_hz=1.0 / _period_s(campaign)
        )
        runs.append(Run(meta, columns, source=str(path), findings=findings))
    return runs, test.rejects


def with_pitch(run: Run, campaign: Campaign) -> Run:
    """Return a positioning run with the screw's pitch among its conditions, directions checked.

    ``run``: a run of kind ``linear``.
    ``campaign``: ``machine_geometry.screw_pitch_mm`` is the pitch.
    """
    run = with_ways(run)
    pitch = campaign.machine_geometry.get("screw_pitch_mm")
    if pitch is None:
        return run
    require_pitch(pitch, campaign.name)
    condition = {"screw_pitch_mm": float(pitch)} | dict(run.meta.condition)
    return replace(run, meta=replace(run.meta, condition=condition))


def require_pitch(pitch: object, where: str) -> None:
    """Refuse a pitch that is no length; None is not stated, and 0 says that a linear scale measures the axis, not the turn of a screw."""
    if pitch is not None and not (is_number(pitch) and 0.0 <= pitch < 1000.0):
        raise InputError(
            "the screw's pitch is no length",
            code="linear.pitch",
            where=where,
            got=str(pitch)[:40],
            allowed="mm per turn; 0 for an axis with a linear scale",
        )


def _period_s(campaign: Campaign) -> float:
    period = campaign.instrument.get("reading_period_s", _ASSUMED_PERIOD_S)
    if not isinstance(period, int | float) or not 0.0 < period < 1e6:
        raise InputError(
            "the time between readings is no time",
            code="laser.period",
            got=str(period)[:40],
            allowed="seconds, above 0",
            where="campaign.instrument.reading_period_s",
        )
    return float(period)


def _columns(test: LaserTest, pair: list[tuple[slice, int]], mm: float, period_s: float) -> dict[str, Any]:
    rows = slice(pair[0][0].start, pair[-1][0].stop)
    direction = np.concatenate(
        [np.full(part.stop - part.start, _FORWARD if sign > 0 else _REVERSE) for part, sign in pair]
    ).astype(object)
    celsius = {
        name: (test.column(column)[rows] - 32.0) / 1.8
        for name, column in (("air_c", "AirTemp"), ("material_c", "MatTemp"))
    }
    return {
        "t_s": np.arange(rows.start, rows.stop) * period_s,
        "position_mm": test.column("Position")[rows] * mm,
        "direction": direction,
        "error_um": test.column("LinearError")[rows] * mm * UM_PER_MM,
        "laser_mm": test.column("LasRead")[rows] * mm,
        "status_1": test.column("Status")[rows],
        **celsius,
        "air_kpa": test.column("AirPress")[rows] * _KPA_PER_INHG,
    }


def _findings(test: LaserTest, campaign: Campaign) -> tuple[Finding, ...]:
    findings = []
    sense, right = sign_rule(test)
    if sense is None:
        findings.append(
            Finding(
                "laser.inconsistent",
                "error",
                "the errors in the file are not those of its laser readings: columns mixed up, "
                "or the laser was zeroed in between",
            )
        )
    elif not right:
        findings.append(
            Finding(
                "laser.sign",
                "error",
                "the errors in the file are commanded minus actual; everywhere else an error is "
                "actual minus commanded: turn the sign of LinearError",
            )
        )
    odd = int(np.count_nonzero(test.column("Status")))
    if odd:
        findings.append(
            Finding(
                "laser.status",
                "warning",
                f"{odd} of {len(test.raw)} readings carry a status other than 0",
                {"readings_1": float(odd)},
            )
        )
    if "reading_period_s" not in campaign.instrument:
        findings.append(
            Finding(
                "clock.assumed",
                "info",
                f"the file has no clock; a reading every {_ASSUMED_PERIOD_S:g} s is assumed, so "
                "nothing per hour can be said: set reading_period_s under [campaign.instrument]",
            )
        )
    return tuple(findings)
