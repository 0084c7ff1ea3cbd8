"""Renishaw Ballbar 20 result files (``.b5r``): one test, one or two runs, and the limits that it states."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from dtwin.acquire._readings import parse_readings
from dtwin.acquire.xmlsafe import child_text, number_or_none, parse_vendor_xml, read_bounded
from dtwin.atomic import write_text
from dtwin.errors import InputError
from dtwin.local_time import was_set
from dtwin.schema import Direction, Finding, Floats, Run, RunMeta, standard_plane

_MAX_READINGS = 5_000_000
_VENDOR_FIGURES = {
    "AF_CENTRE_OFFSET_A": ("centre_a_um", 1000.0),
    "AF_CENTRE_OFFSET_B": ("centre_b_um", 1000.0),
    "AF_BEST_RADIUS": ("best_radius_mm", 1.0),
    "AF_CIRCULARITY": ("circularity_um", 1000.0),
    "AF_CALCULATED_FEEDRATE": ("feed_mm_min", 1.0),
}
_HOTTEST = 1000.0
_OF_MACHINES = re.compile(r"[XYZ]{2}")
_USUAL_VIEW = "+A+B"
_WHOLE_DEG = 359.0
_SCALES_ALIKE = 0.005


@dataclass(frozen=True)
class BallbarTest:
    """Content of a ``.b5r`` file.

    Attributes:
        name, machine, operator, started: As stated by the file; ``started`` is ISO 8601.
        runs: One per direction; ids are ``ccw`` and ``cw`` (with a counter when there are several).
        instrument: model, serial, certificate, calibrated_on, operator, nominal_mm, calibrated_mm, sample_rate_hz;
            expansion_um_per_m_k of the machine and calibrator_temperature_c; ``tolerances`` by the symbol of a test sheet, in
            µm.
        diagnostics: The vendor's own diagnosis of the test, feature names as in the file.
    """

    name: str
    machine: str
    operator: str
    started: str
    runs: tuple[Run, ...]
    instrument: dict[str, Any] = field(default_factory=dict)
    diagnostics: dict[str, float] = field(default_factory=dict)


def read_b5r(path: Path) -> BallbarTest:
    """Read a ball-bar result file.

    Angles are assigned as the file's indices say: START to END is the marked arc, or CW from END to START, evenly
    divided. Whether that is true is for the quality gates to judge, not for the reader.

    Raises:
        InputError: When the file is hostile, truncated, or lacks what a test must have.
    """
    root = parse_vendor_xml(read_bounded(path), str(path))
    if root.tag != "TEST_DOCUMENT":
        raise InputError(
            "not a ball-bar result",
            code="b5r.root",
            where=str(path),
            got=f"<{root.tag[:40]}>",
            allowed="<TEST_DOCUMENT>",
        )
    bar = root.find("TEST_SPEC/INSTRUMENT/DYNAMIC_BALLBAR")
    elements = root.findall("RUN_RESULTS/BALLBAR_RUN")
    if bar is None or not elements:
        raise InputError(
            "the file holds no ball-bar run",
            code="b5r.no_runs",
            where=str(path),
            hint="save the test after it was measured",
        )
    started = _started(child_text(root, "DATE_STARTED"))
    scaled = _scale_findings(root)
    runs = [_read_run(element, bar, started, path, scaled) for element in elements]
    spec, tested = root.find("TEST_SPEC"), root.find("MACHINE_TESTED")
    machine = tested.get("NAME", "") if tested is not None else ""
    return BallbarTest(
        name=spec.get("NAME", "") if spec is not None else "",
        machine=machine,
        operator=child_text(root, "OPERATOR"),
        started=started,
        runs=_named_by_direction([replace(run, machine=machine) for run in runs]),
        instrument=_instrument(root, bar, str(path)),
        diagnostics=_features(root.find("ANALYSIS")),
    )


def _scale_findings(root: Element) -> tuple[Finding, ...]:
    """Return that the ball bar has a scale factor: whether readings hold it already, a file does not say."""
    stated = number_or_none(child_text(root, "EQUIPMENT/BALLBAR/SCALE_FACTOR"))
    if stated is None or abs(stated - 1.0) <= _SCALES_ALIKE:
        return ()
    said = f"the file states a scale factor of {stated:g} for the ball bar; readings are taken as they stand: where they lack it, every figure does"
    return (Finding("b5r.scale", "warning", said, {"factor_1": stated}),)


def _read_run(element: Element, bar: Element, started: str, path: Path, scaled: tuple[Finding, ...]) -> Run:
    stated = child_text(element, "RUN_DIRECTION").upper()
    where = f"{path} BALLBAR_RUN {stated or '?'}"
    if stated not in ("CCW", "CW"):
        raise InputError(
            "the run does not say its direction",
            code="b5r.direction",
            where=where,
            got=stated[:40] or "nothing",
            allowed="CCW or CW",
        )
    readings_mm = parse_readings(child_text(element, "READINGS"), where)
    if not 3 <= readings_mm.size <= _MAX_READINGS:
        raise InputError(
            "unusable number of readings",
            code="b5r.readings",
            where=where,
            got=str(readings_mm.size),
            allowed=f"3 to {_MAX_READINGS}",
        )
    start = _whole(element, "START_INDEX", where) - 1
    end = _whole(element, "END_INDEX", where)
    if not 0 <= start < end <= readings_mm.size:
        raise InputError(
            "the marked arc lies outside the readings",
            code="b5r.window",
            where=where,
            got=f"START {start + 1}, END {end} of {readings_mm.size} readings",
            allowed="1 <= START < END <= number of readings",
            hint="the file may be cut short",
        )
    plane_element = bar.find("PLANE")
    own_way: Direction = "CCW" if stated == "CCW" else "CW"
    own_plane = plane_element.get("TEST_PLANE", "XY") if plane_element is not None else "XY"
    plane, direction = standard_plane(own_plane, own_way)
    rate_hz = _number(element, "SAMPLE_RATE", where, low=0.1, high=1e6)
    arc_start_deg = _number(bar, "START_ANGLE", where, low=-3600.0, high=3600.0)
    arc_deg = _number(bar, "END_ANGLE", where, low=-3600.0, high=3600.0) - arc_start_deg
    meta = RunMeta(
        run_id=direction.lower(),
        plane=plane,
        direction=direction,
        radius_mm=_number(bar, "TEST_RADIUS", where, low=1e-3, high=1e5),
        feed_mm_min=_number(bar, "PROGRAMMED_FEEDRATE", where, low=1e-3, high=1e6),
        started=started,
        sample_rate_hz=rate_hz,
        covariates=_temperature(element),
        vendor=_vendor_figures(element),
    )
    angle_deg = marked_angle_deg(readings_mm.size, (start, end), own_way, arc_start_deg, abs(arc_deg) or 360.0)
    if direction != own_way:
        # Told from the other axis.
        angle_deg = 90.0 - angle_deg
    samples = {
        "t_s": np.arange(readings_mm.size) / rate_hz,
        "angle_deg": angle_deg,
        "deviation_um": readings_mm * 1000.0,
    }
    findings = () if plane_element is None else _plane_findings(plane_element, own_plane)
    return Run(meta=meta, samples=samples, window=(start, end), source=str(path), findings=(*scaled, *findings))


def _plane_findings(element: Element, plane: str) -> tuple[Finding, ...]:
    """Return that axes or view of a test are not those of its plane: then angles may be counted the other way."""
    axes = "".join(child_text(element, tag).strip().upper() for tag in ("A_AXIS_NAME", "B_AXIS_NAME"))
    view = element.get("VIEW", "").replace(" ", "")
    other_axes = bool(_OF_MACHINES.fullmatch(axes)) and axes != plane.upper()
    if not other_axes and view in ("", _USUAL_VIEW):
        return ()
    told = f"axes {', '.join(axes)}" if other_axes else f"the view {view[:20]}"
    said = f"the file states plane {plane} and {told}: angles and directions are taken as seen in plane {plane}; where that is wrong, the run is mirrored"
    return (Finding("b5r.plane", "warning", said),)


def marked_angle_deg(
    n_samples: int, window: tuple[int, int], direction: Direction, arc_start_deg: float = 0.0, arc_deg: float = 360.0
) -> Floats:
    """Return the angle of every sample when the marked window is taken as the arc.

    Args:
        n_samples: Number of samples of the whole recording.
        window: First and one-past-last sample of the marked arc.
        direction: CCW angles rise, CW angles fall. One of "CCW", "CW".
        arc_start_deg: Start of the arc that the window stands for.
        arc_deg: Its length.

    Returns:
        Unwrapped angle, outside the window continued at the same speed. Shape (n_samples,).
    """
    start, end = window
    turned = (np.arange(n_samples) - start) * (arc_deg / (end - start))
    # Part of a circle is run to its end, and back from there; a whole one begins at the same place both ways.
    back_deg = arc_start_deg + (arc_deg if arc_deg < _WHOLE_DEG else 0.0)
    return np.asarray(arc_start_deg + turned if direction == "CCW" else back_deg - turned, dtype=float)


def write_b5r(path: Path, runs: Sequence[Run], *, name: str, machine: str) -> None:
    """Write runs of one test as a ball-bar result file.

    Readings have 10 nm resolution, as the vendor's have. The run's window becomes the marked
    arc; its length is taken from the angles at its ends.

    Args:
        path: File to write; replaced in one step.
        runs: Runs that share plane, radius and feed.
        name: Title to state in the file.
        machine: Machine to state in the file.

    Raises:
        InputError: When a run has no window or the runs do not belong to one test.
    """
    first = runs[0].meta
    if len({(r.meta.plane, r.meta.radius_mm, r.meta.feed_mm_min) for r in runs}) != 1:
        raise InputError("runs of one .b5r must share plane, radius and feed", code="b5r.mixed")
    lines = [
        '<?xml version="1.0" encoding="utf-8" standalone="yes"?>',
        "<TEST_DOCUMENT>",
        f'<TEST_SPEC NAME="{html.escape(name)}" version="2.0">',
        '<INSTRUMENT MANUFACTURER="dtwin" MODEL="virtual ballbar">',
        '<DYNAMIC_BALLBAR CALIBRATION_REQUIRED="false">',
        f"<NOMINAL_LENGTH>{first.radius_mm}</NOMINAL_LENGTH>",
        f"<PROGRAMMED_FEEDRATE>{first.feed_mm_min}</PROGRAMMED_FEEDRATE>",
        "<START_ANGLE>0</START_ANGLE>",
        f"<END_ANGLE>{_arc_length_deg(runs[0]):z.6f}</END_ANGLE>",
        f"<TEST_RADIUS>{first.radius_mm}</TEST_RADIUS>",
        f'<PLANE VIEW="+A+B" TEST_PLANE="{first.plane}"></PLANE>',
        f"<SAMPLE_RATE>{first.sample_rate_hz}</SAMPLE_RATE>",
        "</DYNAMIC_BALLBAR>",
        "</INSTRUMENT>",
        "</TEST_SPEC>",
        "<OPERATOR>dtwin</OPERATOR>",
        f"<DATE_STARTED>{_vendor_date(first.started)}</DATE_STARTED>",
        f'<MACHINE_TESTED NAME="{html.escape(machine)}" />',
        "<RUN_RESULTS>",
    ]
    for run in runs:
        lines += _run_lines(run)
    lines += ["</RUN_RESULTS>", "</TEST_DOCUMENT>", ""]
    write_text(path, "\n".join(lines), "the ball-bar file")


def _run_lines(run: Run) -> list[str]:
    first, end = _marked(run)
    readings = run.samples["deviation_um"] / 1000.0
    return [
        "<BALLBAR_RUN>",
        f"<RUN_DIRECTION>{run.meta.direction}</RUN_DIRECTION>",
        f"<RUN_TEMPERATURE>{run.meta.covariates.get('temperature_c', 20.0)}</RUN_TEMPERATURE>",
        f"<START_INDEX>{first + 1}</START_INDEX>",
        f"<END_INDEX>{end}</END_INDEX>",
        f"<SAMPLE_RATE>{run.meta.sample_rate_hz}</SAMPLE_RATE>",
        "<READINGS>" + " ".join(f"{value:+z.5f}" for value in readings) + "</READINGS>",
        "</BALLBAR_RUN>",
    ]


def _marked(run: Run) -> tuple[int, int]:
    if run.window is None:
        raise InputError("a run without a marked arc cannot be written", code="b5r.no_window")
    return run.window


def _arc_length_deg(run: Run) -> float:
    start, end = _marked(run)
    angle = run.samples["angle_deg"]
    step = abs(float(angle[end - 1] - angle[start])) / (end - 1 - start)
    return step * (end - start)


def _named_by_direction(runs: list[Run]) -> tuple[Run, ...]:
    seen: dict[str, int] = {}
    named = []
    for run in runs:
        base = run.meta.run_id
        seen[base] = seen.get(base, 0) + 1
        unique = base if seen[base] == 1 else f"{base}-{seen[base]}"
        named.append(replace(run, meta=replace(run.meta, run_id=unique)))
    return tuple(named)


def _instrument(root: Element, bar: Element, where: str) -> dict[str, Any]:
    ballbar = root.find("EQUIPMENT/BALLBAR")
    calibrator = root.find("EQUIPMENT/CALIBRATOR")
    instrument: dict[str, Any] = {}
    if ballbar is not None:
        instrument["model"] = child_text(ballbar, "MODEL")
        instrument["serial"] = child_text(ballbar, "SERIAL_NUMBER")
        instrument["certificate"] = child_text(ballbar, "CERTIFICATE_NUMBER")
        instrument["calibrated_on"] = _day(child_text(ballbar, "LAST_CALIBRATED"))
    instrument["operator"] = child_text(root, "OPERATOR")
    instrument = {name: value for name, value in instrument.items() if value}
    for key, element, tag in (
        ("nominal_mm", bar, "NOMINAL_LENGTH"),
        ("calibrated_mm", calibrator, "CALIBRATED_LENGTH"),
        ("sample_rate_hz", bar, "SAMPLE_RATE"),
    ):
        if element is not None and child_text(element, tag):
            instrument[key] = _number(element, tag, where, low=0.1, high=1e6)
    # What a test can do without is left away when it is no number.
    for key, parent, tag in (
        ("expansion_um_per_m_k", bar, "TEMP_MATERIAL_COEFFICIENT"),
        ("calibrator_temperature_c", calibrator, "TEMPERATURE"),
    ):
        stated = None if parent is None else number_or_none(child_text(parent, tag))
        if stated is not None and 0.0 <= stated < _HOTTEST:
            instrument[key] = stated
    limits = _tolerances(bar)
    return {**instrument, "tolerances": limits} if limits else instrument


def _features(parent: Element | None) -> dict[str, float]:
    if parent is None:
        return {}
    pairs = ((f.get("NAME", ""), number_or_none(f.text or "")) for f in parent.findall("FEATURE"))
    return {name: value for name, value in pairs if name and value is not None}


def _vendor_figures(element: Element) -> dict[str, float]:
    stated = _features(element)
    return {name: stated[feature] * factor for feature, (name, factor) in _VENDOR_FIGURES.items() if feature in stated}


def _temperature(element: Element) -> dict[str, float]:
    value = number_or_none(child_text(element, "RUN_TEMPERATURE"))
    return {} if value is None else {"temperature_c": value}


def _day(text: str) -> str:
    """Return a day as ISO 8601; what is none stays as it is."""
    return f"{text[:4]}-{text[4:6]}-{text[6:]}" if len(text) == 8 and text.isdigit() else text


def _number(element: Element, tag: str, where: str, *, low: float, high: float) -> float:
    value = number_or_none(child_text(element, tag))
    if value is None or not low <= value <= high:
        raise InputError(
            f"{tag} is missing or impossible",
            code="b5r.field",
            where=where,
            got=child_text(element, tag)[:40] or "nothing",
            allowed=f"{low:g} to {high:g}",
        )
    return value


def _whole(element: Element, tag: str, where: str) -> int:
    value = _number(element, tag, where, low=1, high=_MAX_READINGS)
    if value != int(value):
        raise InputError(f"{tag} is not a whole number", code="b5r.field", where=where, got=str(value))
    return int(value)


def _started(text: str) -> str:
    try:
        stamp = datetime.strptime(text, "%Y%m%d-%H%M%S")  # local, the file names no zone
    except ValueError:
        return ""
    return stamp.isoformat() if was_set(stamp) else ""


def _vendor_date(started: str) -> str:
    try:
        return datetime.fromisoformat(started).strftime("%Y%m%d-%H%M%S")
    except ValueError:
        return ""


_LIMITED = {"AF_BEST_RADIUS": (("D",), True), "AF_CIRCULARITY": (("G(CCW)", "G(CW)"), False)}
"""Features that a test sheet has, too: their symbols, and whether the limits are of the radius, not of its deviation."""


def _tolerances(bar: Element) -> dict[str, dict[str, float]]:
    """Return limits of figures by symbol, in µm; of several levels the widest: beyond it the test has failed."""
    radius_mm = number_or_none(child_text(bar, "TEST_RADIUS"))
    limits_by_symbol: dict[str, dict[str, float]] = {}
    for feature in bar.iter("FEATURE_SPEC"):
        symbols, from_radius = _LIMITED.get(feature.get("NAME", ""), ((), False))
        pairs = [
            (number_or_none(child_text(level, "LOWER_LIMIT")), number_or_none(child_text(level, "UPPER_LIMIT")))
            for level in feature.findall("TOLERANCE")
        ]
        known = [(low, high) for low, high in pairs if low is not None and high is not None and low < high]
        if not known or (from_radius and radius_mm is None) or feature.get("DT") != "UT_LENGTH_MM":
            continue
        zero = radius_mm if from_radius and radius_mm is not None else 0.0
        low, high = min(low for low, _ in known), max(high for _, high in known)
        limits = {"low": round(1000.0 * (low - zero), 4), "high": round(1000.0 * (high - zero), 4)}
        limits_by_symbol |= {symbol: limits if from_radius else {"high": limits["high"]} for symbol in symbols}
    return limits_by_symbol
