"""Runs of poses with their chain, and as a problem to fit.

Only where the axes of the joints lie counts: what stands before the first and behind the last is a frame and a tool, which are
fitted. Two axes tell a row by their common perpendicular.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dtwin.acquire.campaign_folder import inside
from dtwin.acquire.campaign_name import in_lake
from dtwin.acquire.xmlsafe import parse_vendor_xml, read_bounded
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.poses._chain import KNOWN, Setup, chain_of
from dtwin.kinds.poses._fit import Grams
from dtwin.kinds.poses._iso9283 import joints_of, measured_of, numbers_of, times_of
from dtwin.kinds.poses._series import series_of
from dtwin.lake.store import Lake
from dtwin.schema import Campaign, Floats, Run


@dataclass(frozen=True)
class Loaded:
    """A campaign, ready to fit.

    ``data``: table versions and a hash of what was used.
    ``rows`` (n,): numbers of its rows in their table.
    """

    campaign: str
    machine: str
    grams: Grams
    data: Mapping[str, Any]
    rows: NDArray[np.int64]


def with_chain(run: Run, campaign: Campaign) -> Run:
    """Return a run that knows the chain of its robot; its condition carries it. One without joints needs none."""
    if not joints_of(run).size:
        return run
    geometry = campaign.machine_geometry
    read = _stated_chain(geometry, Path(run.source).parent)
    dh = chain_of(geometry, campaign.name) if read is None else read
    if dh.shape[0] != joints_of(run).shape[1]:
        raise InputError(
            "chain and table differ in their joints",
            code="poses.joints",
            where=run.source,
            got=f"{joints_of(run).shape[1]} columns joint_N_deg",
            allowed=f"{dh.shape[0]}, as the chain has",
        )
    name = str(geometry.get("chain", "")).lower()
    told = name if name in KNOWN and not {"dh", "urdf"} & set(geometry) else json.dumps(dh.round(9).tolist())
    return replace(run, meta=replace(run.meta, condition={**run.meta.condition, "chain": told}))


def chain_in(run: Run) -> Floats:
    """Return the chain that the condition of a run carries."""
    told = str(run.meta.condition["chain"])
    return KNOWN[told] if told in KNOWN else np.array(json.loads(told))


def load(home: Home, campaign: str, setup: Setup | None = None) -> Loaded:
    """Return a campaign of the lake or of a folder, which is ingested first.

    ``setup``: frame and tool of another campaign of the same mounting; fitted without.

    Raises ``InputError`` when it has no sound run, with what is wrong, or several: each has a frame and a tool of its own.
    """
    lake, name = Lake(home.lake), in_lake(home, campaign)
    known = lake.campaign(name).of_kind("poses")
    there = list(lake.iterate(name))
    wrong = [(run, f) for run in there for f in run.findings if f.severity == "error"]
    runs = [run for run in there if not any(run is unsound for unsound, _ in wrong)]
    if there and not runs:
        run, finding = wrong[0]
        raise InputError(
            "the run is not sound, and no twin is fitted to it",
            code=finding.code,
            where=f"{name} {run.meta.run_id}",
            got=finding.message,
            hint=f"dtwin check {name} tells all that is wrong with it",
        )
    if len(runs) != 1:
        raise InputError(
            "a twin of poses is fitted to one run",
            code="poses.runs",
            where=name,
            got=f"{len(runs)} sound runs",
            hint="a campaign for each table; dtwin twin compare NAME CAMPAIGN tries the twin on another",
        )
    run = runs[0]
    if not joints_of(run).size:
        raise InputError(
            "a twin of an arm needs joints",
            code="poses.joints",
            where=name,
            got="commanded and measured places",
            allowed="joint_1_deg … beside them, and a chain",
            hint="dtwin check tells the figures of ISO 9283 without them",
        )
    ambient = run.samples.get("ambient_c")
    series = series_of(joints_of(run), measured_of(run), chain_in(run), ambient, setup, times_of(run))
    data = lake.provenance(lake.runs(name), len(series.error_mm))
    return Loaded(name, known.machine, Grams(series), data, numbers_of(run))


_MAX_BYTES = 8_000_000
_MM_PER_M = 1000.0
_TURNS = ("revolute", "continuous")
_PARALLEL = 1e-9


def _urdf_chain(path: Path, tip: str = "") -> Floats:
    """Return rows (joints, 4): a and d in mm, alpha and theta in rad.

    ``tip``: link at the end of the chain; the farthest one without.
    Raises ``InputError`` when the file is none, or the chain has a joint that slides.
    """
    root = parse_vendor_xml(read_bounded(path, _MAX_BYTES), str(path))
    joints = [e for e in root.iter() if e.tag == "joint"]
    by_child = {_link(e, "child"): e for e in joints}
    if root.tag != "robot" or not joints:
        raise _refused(path, "no joints" if root.tag == "robot" else f"a document of {root.tag[:40]}")
    way = _way(path, by_child, tip)
    axes = _axes(path, way)
    if len(axes) < 2:
        raise _refused(path, f"{len(axes)} joints that turn")
    return _rows(axes)


def _way(path: Path, by_child: dict[str, Element], tip: str) -> list[Element]:
    """Return the joints from the base to the tip."""
    ways = {link: _up(path, by_child, link) for link in by_child}
    if tip:
        if tip not in ways:
            raise _refused(path, f"no link {tip}", f"urdf_tip = one of {', '.join(sorted(ways))[:200]}")
        return ways[tip]
    turning = {link: sum(e.get("type") in _TURNS for e in way) for link, way in ways.items()}
    most = max(turning.values())
    # Of several links behind the last joint any will do; two arms will not.
    ends = {id([e for e in ways[link] if e.get("type") in _TURNS][-1]) for link, n in turning.items() if n == most > 0}
    if len(ends) > 1:
        raise _refused(path, f"{len(ends)} arms of {most} joints", "urdf_tip = the link at the end of one")
    return ways[max(turning, key=lambda link: turning[link])]


def _up(path: Path, by_child: dict[str, Element], link: str) -> list[Element]:
    way: list[Element] = []
    while link in by_child:
        if len(way) > len(by_child):
            raise _refused(path, "a circle of links")
        way.append(by_child[link])
        link = _link(by_child[link], "parent")
    return way[::-1]


def _axes(path: Path, way: Sequence[Element]) -> list[tuple[Floats, Floats]]:
    """Return a point and the direction of every axis that turns, with all joints at zero, mm."""
    at = np.eye(4)
    axes = []
    for joint in way:
        kind, origin = joint.get("type", ""), joint.find("origin")
        step = np.eye(4)
        if origin is not None:
            step[:3, 3] = _MM_PER_M * _three(path, origin.get("xyz", "0 0 0"))
            step[:3, :3] = Rotation.from_euler("xyz", _three(path, origin.get("rpy", "0 0 0"))).as_matrix()
        at = at @ step
        if kind in _TURNS:
            axis = joint.find("axis")
            along = at[:3, :3] @ _three(path, "1 0 0" if axis is None else axis.get("xyz", "1 0 0"))
            if not np.linalg.norm(along) > 0.0:
                raise _refused(path, f"joint {joint.get('name')} without an axis")
            axes.append((at[:3, 3].copy(), along / np.linalg.norm(along)))
        elif kind != "fixed":
            raise _refused(path, f"joint {joint.get('name')}: {kind}", "joints that turn, and fixed ones")
    return axes


def _rows(axes: Sequence[tuple[Floats, Floats]]) -> Floats:
    """Return the row of every joint; the frame behind the last is that of its own axis."""
    point, z = axes[0]
    x = _aside(z)
    rows = []
    for to, after in axes[1:]:
        foot_here, foot_there, along = _perpendicular(point, z, to, after, x)
        theta = np.arctan2(np.cross(x, along) @ z, x @ along)
        d = (foot_here - point) @ z
        alpha = np.arctan2(np.cross(z, after) @ along, z @ after)
        rows.append([(foot_there - foot_here) @ along, d, alpha, theta])
        point, z, x = foot_there, after, along
    return np.array([*rows, [0.0, 0.0, 0.0, 0.0]])


def _perpendicular(point: Floats, z: Floats, to: Floats, after: Floats, x: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the feet of the common perpendicular of two axes, and its direction."""
    normal = np.cross(z, after)
    between = to - point
    if np.linalg.norm(normal) < _PARALLEL:
        # Any will do: the one through where the last frame stands.
        aside = between - (between @ z) * z
        size = float(np.linalg.norm(aside))
        return point, point + aside, aside / size if size > _PARALLEL else x
    normal = normal / np.linalg.norm(normal)
    here, there, _ = np.linalg.solve(np.stack([z, -after, normal], axis=1), between)
    foot_here, foot_there = point + here * z, to + there * after
    across = foot_there - foot_here
    return foot_here, foot_there, normal if across @ normal >= 0.0 else -normal


def _aside(z: Floats) -> Floats:
    """Return a direction at right angles to another."""
    across = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    return np.asarray(across / np.linalg.norm(across))


def _three(path: Path, text: str) -> Floats:
    try:
        values = np.array([float(part) for part in text.split()])
    except ValueError as error:
        raise _refused(path, text[:60]) from error
    if values.shape != (3,) or not np.isfinite(values).all():
        raise _refused(path, text[:60])
    return values


def _link(joint: Element, what: str) -> str:
    link = joint.find(what)
    return "" if link is None else str(link.get("link", ""))


def _refused(path: Path, got: str, allowed: str = "a URDF of a serial chain of joints that turn") -> InputError:
    return InputError(
        "the chain cannot be taken from this file", code="poses.urdf", where=str(path), got=got, allowed=allowed
    )


def _stated_chain(geometry: Mapping[str, Any], folder: Path) -> Floats | None:
    """Return the chain of ``urdf``, with ``urdf_tip``; None where a campaign names none."""
    name = geometry.get("urdf")
    if name is None:
        return None
    return _urdf_chain(inside(folder, name, "campaign.machine_geometry.urdf"), str(geometry.get("urdf_tip", "")))
