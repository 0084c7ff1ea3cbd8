"""What a ball bar says of three circles on a sphere, as a bundle along the bar.

The error has a part that belongs to the place on the path, whatever the feed, and one that follows
each start of a move in time and grows with the feed, as ringing does. Both are tables; centre and
length of each mounting are fitted with them and left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from dtwin import __version__
from dtwin.schema import Floats
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits
from dtwin.statistics import rms
from dtwin.train.dataset import TICK_HZ
from studies.machines.sphere_path import SphereRun

_PLACE_RAD = np.radians(0.5)
_RING_S, _RING_STEP_S = 1.5, 0.005
_RING_KNOTS = round(_RING_S / _RING_STEP_S) + 1
_REFERENCE_MM_MIN = 6000.0
# Holds what a single noisy reading could move; far below what hundreds of readings say.
_SMOOTH, _SMALL = 0.3, 0.3
_MARGIN = 0.05


@dataclass(frozen=True)
class SphereModel:
    """Fitted tables.

    ``azimuth_rad``, (places,): knots along the path, rising.
    ``place_um``, (places,): error along the bar at the knots.
    ``elevation_rad``, (places,): commanded elevation of the bar there.
    ``ring_um``, (moves, knots): error after the start of each move, at 6000 mm/min.
    ``mounting_um``, (mountings, 4): centre along x, y, z and length of every mounting, for the record.
    ``rms_um``: what the fit leaves.
    ``feeds_mm_min``: feeds that it was fitted to.
    """

    azimuth_rad: Floats
    place_um: Floats
    elevation_rad: Floats
    ring_um: Floats
    mounting_um: Floats
    rms_um: float
    feeds_mm_min: tuple[float, ...]


def mounting_terms(run: SphereRun) -> Floats:
    """Return what an offset of the centre and of the length looks like, shape (n, 4)."""
    level = np.cos(run.elevation_rad)
    return np.column_stack(
        [
            level * np.cos(run.azimuth_rad),
            level * np.sin(run.azimuth_rad),
            np.sin(run.elevation_rad),
            np.ones(len(run.deviation_um)),
        ]
    )


def fit_sphere(mountings: Sequence[Sequence[SphereRun]]) -> SphereModel:
    """Fit both tables to runs without correction.

    ``mountings``: Runs by mounting of the bar; each mounting has a centre and a length of its own.
    """
    runs = [run for group in mountings for run in group]
    azimuth = np.concatenate([r.azimuth_rad for r in runs])
    start = float(azimuth.min())
    places = int(np.ceil((float(azimuth.max()) - start) / _PLACE_RAD)) + 2
    moves = int(max(r.section.max() for r in runs))
    feed = np.concatenate([np.full(len(r.section), r.feed_mm_min) for r in runs])
    target = np.concatenate([r.deviation_um for r in runs])
    at_place = _interpolation((azimuth - start) / _PLACE_RAD, places)
    ring = np.concatenate([(r.section - 1.0) * _RING_KNOTS + _ring_place(r) for r in runs])
    at_ring = sparse.diags(feed / _REFERENCE_MM_MIN) @ _interpolation(ring, moves * _RING_KNOTS)
    mounted = sparse.block_diag([np.concatenate([mounting_terms(r) for r in group]) for group in mountings])
    design = sparse.hstack([at_place, at_ring, mounted]).tocsc()
    bend = _SMOOTH * sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(places - 2, places))
    small = sparse.diags(np.full(design.shape[1], _SMALL**2))
    small = small + sparse.block_diag([bend.T @ bend, sparse.csc_matrix((design.shape[1] - places,) * 2)])
    found = spsolve((design.T @ design + small).tocsc(), design.T @ target)
    knots = start + _PLACE_RAD * np.arange(places)
    order = np.argsort(azimuth)
    elevation = np.concatenate([r.elevation_rad for r in runs])[order]
    ends = places + moves * _RING_KNOTS
    rest = target - design @ found
    return SphereModel(
        knots,
        found[:places],
        np.interp(knots, azimuth[order], elevation),
        found[places:ends].reshape(moves, _RING_KNOTS),
        found[ends:].reshape(-1, 4),
        rms(rest),
        tuple(sorted({r.feed_mm_min for r in runs})),
    )


def sphere_bundle(model: SphereModel, machine: str, *, horizon_s: float) -> Bundle:
    """Freeze a fit: the error along the bar, as its parts in the plane and across it.

    ``model``: what was fitted.
    ``machine``: machine that it is for.
    ``horizon_s``: known delay between a correction and the motion that it causes; place and time are taken as far
    ahead.
    """
    g = GraphBuilder()
    speed, angle = g.input("commanded_speed_mm_s"), g.input("path_angle_rad")
    # The program runs clockwise; the bar turns by speed over the level radius, 150 mm within 4 %.
    ahead = angle - (horizon_s / 150.0) * speed
    start = float(model.azimuth_rad[0])
    place = g.lookup(ahead, start, float(_PLACE_RAD), model.place_um.tolist())
    move, since = g.input("segment_id"), g.input("segment_time_s")
    late = g.apply("min", since + horizon_s, _RING_S)
    u = (move - 1.0) * _RING_KNOTS + late * (1.0 / _RING_STEP_S)
    ring = g.lookup(u, 0.0, 1.0, model.ring_um.reshape(-1).tolist())
    feed = g.input("programmed_feed_mm_min")
    error = place + ring * feed * (1.0 / _REFERENCE_MM_MIN)
    tilt = g.lookup(ahead, start, float(_PLACE_RAD), model.elevation_rad.tolist())
    graph = g.graph({"in_plane_um": error * g.apply("cos", tilt), "across_um": error * g.apply("sin", tilt)})
    fast = max(model.feeds_mm_min)
    low, high = start - 0.1, float(model.azimuth_rad[-1]) + 0.1
    inputs = {
        "path_angle_rad": ("rad", "path", low, high),
        "commanded_speed_mm_s": ("mm/s", "path", -1.0, fast / 60.0 * (1.0 + _MARGIN)),
        "segment_id": ("1", "controller", -0.5, len(model.ring_um) + 1.5),
        "segment_time_s": ("s", "path", -0.01, 1e3),
        "programmed_feed_mm_min": ("mm/min", "path", 0.0, fast * (1.0 + _MARGIN)),
    }
    return create_bundle(
        name="sphere-table",
        machine=machine,
        model_version=0,
        inputs=[
            Input(n, unit, "path" if source == "path" else "none", TICK_HZ, source, lo, hi)
            for n, (unit, source, lo, hi) in inputs.items()
        ],
        outputs=[Output("in_plane_um", "path_radial"), Output("across_um", "path_normal")],
        tick_graph=graph,
        safety=_limits(model, fast / 60.0),
        provenance=Provenance(code_version=__version__),
    )


def _limits(model: SphereModel, fastest_mm_s: float) -> SafetyLimits:
    largest = float(np.abs(model.place_um).max() + np.abs(model.ring_um).max())
    by_place = float(np.abs(np.diff(model.place_um)).max()) / _PLACE_RAD * fastest_mm_s / 150.0
    by_time = float(np.abs(np.diff(model.ring_um, axis=1)).max()) / _RING_STEP_S
    return SafetyLimits(clamp_um=1.25 * largest, slew_um_s=max(2000.0, float(2.0 * (by_place + by_time))))


def _ring_place(run: SphereRun) -> Floats:
    return np.minimum(run.section_s, _RING_S) / _RING_STEP_S


def _interpolation(place: Floats, knots: int) -> sparse.csr_matrix:
    """Return the matrix that reads a table of ``knots`` values linearly at ``place``."""
    below = np.clip(np.floor(place).astype(int), 0, knots - 2)
    share = place - below
    rows = np.arange(len(place))
    return sparse.csr_matrix(
        (np.concatenate([1.0 - share, share]), (np.concatenate([rows, rows]), np.concatenate([below, below + 1]))),
        shape=(len(place), knots),
    )
