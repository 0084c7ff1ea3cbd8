"""Figures of a circular test, in the vocabulary of ISO 230-4 and ASME B5.54."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.schema import Floats

_LARGEST_GAP_DEG = 2.0
_UNEVEN = 1.5
"""How many times as wide as the widest beside it a gap of a coarse table may be."""
_BESIDE = 8
"""Gaps between samples on each side that tell how wide one may be."""
_STRETCHES = 720
"""Of a turn, each of which gives its extremes to the minimum zone at first."""


@dataclass(frozen=True)
class Circle:
    """Centre and radius fitted to a measured circle or arc.

    Attributes:
        centre_a_um, centre_b_um: Centre along the first and second axis of the plane.
        radius_change_um: Fitted radius minus the nominal one.
    """

    centre_a_um: float
    centre_b_um: float
    radius_change_um: float
    radius_mm: float

    @property
    def eccentricity_um(self) -> float:
        """Distance of the centre from the nominal one."""
        return float(np.hypot(self.centre_a_um, self.centre_b_um))


@dataclass(frozen=True)
class CircularFigures:
    """Figures of one run.

    Attributes:
        circular_deviation_um: ISO 230-4 G: largest minus smallest radius about the least-squares centre. Each sample counts
            with the angle that it stands for, here and in the RMS: where samples lie closer makes no difference.
        circular_deviation_mz_um: The same about the minimum-zone centre.
        radial_deviation_max_um, radial_deviation_min_um: ISO 230-4 F: extremes of radius minus nominal, centre removed,
            radius kept.
        rms_um: RMS about the fitted circle.
        mean_absolute_um: Mean absolute deviation about the fitted circle.
        arc_deg: Length of the arc that was evaluated.
    """

    circle: Circle
    circular_deviation_um: float
    circular_deviation_mz_um: float
    radial_deviation_max_um: float
    radial_deviation_min_um: float
    rms_um: float
    mean_absolute_um: float
    arc_deg: float


@dataclass(frozen=True)
class BidirectionalFigures:
    """Figures of a counter-clockwise and a clockwise run of one set-up.

    Attributes:
        circular_deviation_common_centre_um: ISO 230-4 G(b): largest minus smallest radius of both directions together,
            about one least-squares centre for both.
        circular_deviation_own_centres_um: The same with each direction about its own least-squares centre: smaller by
            what the directions' centres are apart.
        hysteresis_um, hysteresis_angle_deg: ISO 230-4 H, the largest difference of the radial deviations of the two
            directions at one angle, and where it is. Of the samples as they are, about the common centre; between two samples
            of a direction its deviation is interpolated. Nothing is averaged, so noise adds to it: of two equal paths of n
            samples with noise sigma it is about sigma * sqrt(2) * sqrt(2 ln n).
        mean_bidirectional_radius_um: ISO 230-4 D: mean radius of both directions minus nominal.
    """

    circular_deviation_common_centre_um: float
    circular_deviation_own_centres_um: float
    hysteresis_um: float
    hysteresis_angle_deg: float
    mean_bidirectional_radius_um: float


def fit_circle(angle_deg: Floats, deviation_um: Floats, radius_mm: float) -> Circle:
    """Fit the geometric least-squares circle; each sample counts with the angle that it stands for.

    Args:
        angle_deg: Angle in the plane. Shape (n,).
        deviation_um: Measured minus nominal radius. Shape (n,).

    Raises:
        InputError: With fewer than three samples, or an arc below 30 degrees.
    """
    return fit_common_circle([(angle_deg, deviation_um)], radius_mm)


def fit_common_circle(arcs: Sequence[tuple[Floats, Floats]], radius_mm: float) -> Circle:
    """Fit one geometric least-squares circle to several runs, as :func:`fit_circle` does to one; each run counts alike."""
    angle_deg, deviation_um = (np.concatenate(part) for part in zip(*arcs, strict=True))
    _require_arc(angle_deg, deviation_um)
    theta = np.radians(angle_deg)
    r_um = radius_mm * 1000.0 + deviation_um
    a_um, b_um = r_um * np.cos(theta), r_um * np.sin(theta)
    root = np.sqrt(np.concatenate([_shares(angle) for angle, _ in arcs]))
    design = np.column_stack([np.cos(theta), np.sin(theta), np.ones_like(theta)])
    start = np.linalg.lstsq(design * root[:, None], deviation_um * root, rcond=None)[0]

    def residual(p: Floats) -> Floats:
        return np.asarray(root * (np.hypot(a_um - p[0], b_um - p[1]) - (radius_mm * 1000.0 + p[2])))

    def slopes(p: Floats) -> Floats:
        from_a, from_b = p[0] - a_um, p[1] - b_um
        away = np.maximum(np.hypot(from_a, from_b), 1e-300)
        return np.stack([root * from_a / away, root * from_b / away, -root], axis=1)

    # With all that it returns it prints no warning, where a spoilt reading lies further off than any machine.
    solved = scipy.optimize.leastsq(residual, start, Dfun=slopes, xtol=1e-8, ftol=1e-8, full_output=True)[0]
    return Circle(
        centre_a_um=float(solved[0]),
        centre_b_um=float(solved[1]),
        radius_change_um=float(solved[2]),
        radius_mm=radius_mm + float(solved[2]) / 1000.0,
    )


def residual_um(angle_deg: Floats, deviation_um: Floats, radius_mm: float, circle: Circle) -> Floats:
    """Return the distance from the fitted circle, shape (n,)."""
    return _centred_um(angle_deg, deviation_um, radius_mm, circle) - circle.radius_change_um


def _minimum_zone_um(angle_deg: Floats, deviation_um: Floats) -> tuple[float, float, float]:
    """Return width and centre of the narrowest ring that holds every sample.

    Solved as a linear programme, which is exact to second order of the eccentricity.

    Args:
        angle_deg: Angles. Shape (n,).
        deviation_um: Samples; centre them first when the eccentricity is large. Shape (n,).

    Returns:
        width_um, centre_a_um, centre_b_um : float
    """
    theta = np.radians(angle_deg)
    # Of many samples few touch the ring: the programme begins with the extremes of each stretch, and takes in what lies outside.
    counted = _extremes(theta, deviation_um)
    # What the solver itself leaves.
    close_um = 1e-6 * max(float(np.ptp(deviation_um)), 1.0)
    while True:
        width, a, b, top, bottom = _ring(theta[counted], deviation_um[counted])
        rest = deviation_um - a * np.cos(theta) - b * np.sin(theta)
        outside = np.flatnonzero((rest > top + close_um) | (rest < bottom - close_um))
        more = np.union1d(counted, outside[_extremes(theta[outside], rest[outside])])
        if more.size == counted.size:
            return width, a, b
        counted = more


def _extremes(theta: Floats, deviation_um: Floats) -> NDArray[np.intp]:
    """Return which samples are the highest and the lowest of their stretch of half a degree; all of few samples."""
    if theta.size <= 4 * _STRETCHES:
        return np.arange(theta.size)
    stretch = np.floor(theta * _STRETCHES / (2.0 * np.pi)).astype(np.intp) % _STRETCHES
    order = np.lexsort((deviation_um, stretch))
    ends = np.flatnonzero(np.diff(stretch[order], append=-1))
    begins = np.concatenate([[0], ends[:-1] + 1])
    return np.unique(order[np.concatenate([begins, ends])])


def _ring(theta: Floats, deviation_um: Floats) -> tuple[float, float, float, float, float]:
    """Return width, centre, and the upper and lower deviation of the narrowest ring about all of some samples."""
    cos, sin, one = np.cos(theta), np.sin(theta), np.ones_like(theta)
    upper = np.column_stack([-cos, -sin, -one, 0 * one])
    lower = np.column_stack([cos, sin, 0 * one, one])
    solved = scipy.optimize.linprog(
        c=[0.0, 0.0, 1.0, -1.0],
        A_ub=np.vstack([upper, lower]),
        b_ub=np.concatenate([-deviation_um, deviation_um]),
        bounds=[(None, None)] * 4,
        method="highs",
    )
    if not solved.success or solved.fun is None or solved.x is None:
        raise InputError("the minimum-zone centre was not found", code="circular.minimum_zone")
    a, b, top, bottom = map(float, solved.x)
    return float(solved.fun), a, b, top, bottom


def circular_figures(angle_deg: Floats, deviation_um: Floats, radius_mm: float) -> CircularFigures:
    """Evaluate one run.

    Args:
        angle_deg: Angle of each sample, unwrapped. Shape (n,).
        deviation_um: Measured minus nominal radius. Shape (n,).
    """
    circle = fit_circle(angle_deg, deviation_um, radius_mm)
    centred = _centred_um(angle_deg, deviation_um, radius_mm, circle)
    rest = centred - circle.radius_change_um
    shares = _shares(angle_deg)
    return CircularFigures(
        circle=circle,
        circular_deviation_um=float(np.ptp(centred)),
        circular_deviation_mz_um=_minimum_zone_um(angle_deg, rest)[0],
        radial_deviation_max_um=float(centred.max()),
        radial_deviation_min_um=float(centred.min()),
        rms_um=float(np.sqrt(np.average(rest**2, weights=shares))),
        mean_absolute_um=float(np.average(np.abs(rest), weights=shares)),
        arc_deg=_arc_deg(angle_deg),
    )


def bidirectional_figures(
    ccw: tuple[Floats, Floats], cw: tuple[Floats, Floats], radius_mm: float
) -> BidirectionalFigures:
    """Evaluate both directions of one set-up together.

    Args:
        ccw: Samples of the counter-clockwise direction, arrays of shape (n,) each.
        cw: Samples of the clockwise direction.
    """
    common = fit_common_circle([ccw, cw], radius_mm)
    angle = np.concatenate([ccw[0], cw[0]])
    centred = _centred_um(angle, np.concatenate([ccw[1], cw[1]]), radius_mm, common)
    split = len(ccw[0])
    grid = np.arange(0.0, 360.0, 0.1)
    up, down = (ccw[0], centred[:split]), (cw[0], centred[split:])
    gaps = np.concatenate([up[1] - _at(up[0], *down), down[1] - _at(down[0], *up)])
    both = (_at(grid, *up) + _at(grid, *down)) / 2.0
    # Arcs that only touch have one angle in common, and no radius.
    if not np.isfinite(gaps).any() or not np.isfinite(both).any():
        raise InputError("the two directions have no angle in common", code="circular.arc")
    where = int(np.nanargmax(np.abs(gaps)))
    own = [_centred_um(*part, radius_mm, fit_circle(*part, radius_mm)) for part in (ccw, cw)]
    return BidirectionalFigures(
        circular_deviation_common_centre_um=float(np.ptp(centred)),
        circular_deviation_own_centres_um=float(np.ptp(np.concatenate(own))),
        hysteresis_um=float(abs(gaps[where])),
        hysteresis_angle_deg=float(angle[where] % 360.0),
        mean_bidirectional_radius_um=float(np.nanmean(both)),
    )


def _centred_um(angle_deg: Floats, deviation_um: Floats, radius_mm: float, circle: Circle) -> Floats:
    theta = np.radians(angle_deg)
    r_um = radius_mm * 1000.0 + deviation_um
    distance = np.hypot(r_um * np.cos(theta) - circle.centre_a_um, r_um * np.sin(theta) - circle.centre_b_um)
    return np.asarray(distance - radius_mm * 1000.0)


def _shares(angle_deg: Floats) -> Floats:
    """Return the angle in degrees that each sample of a run stands for, half of the gaps to its neighbours, shape (n,).

    A gap counts as no wider than the widest beside it: nothing stands for what was not measured.
    """
    order = np.argsort(angle_deg % 360.0, kind="stable")
    gap = np.minimum(*_gaps(angle_deg[order] % 360.0))
    shares = np.empty_like(gap)
    shares[order] = (gap + np.roll(gap, 1)) / 2.0
    return shares if shares.any() else np.ones_like(shares)


def _gaps(around_deg: Floats) -> tuple[Floats, Floats]:
    """Return the gap from each of the ordered angles of a circle to the next, and the widest of the gaps beside it."""
    gap = np.diff(around_deg, append=around_deg[0] + 360.0)
    beside = min(_BESIDE, gap.size - 1)
    widest = np.lib.stride_tricks.sliding_window_view(np.pad(gap, beside, mode="wrap"), beside).max(axis=1)
    return gap, np.maximum(widest[: gap.size], widest[beside + 1 :])


def _at(wanted_deg: Floats, angle_deg: Floats, value: Floats) -> Floats:
    """Interpolate samples at angles round the circle; NaN where the gap is wider than two degrees and than those beside it."""
    order = np.argsort(angle_deg % 360.0)
    angle, value = (angle_deg % 360.0)[order], value[order]
    gap, beside = _gaps(angle)
    within = gap <= np.maximum(_LARGEST_GAP_DEG, _UNEVEN * beside)
    values = np.interp(wanted_deg, angle, value, period=360.0)
    return np.asarray(np.where(within[np.searchsorted(angle, wanted_deg % 360.0) - 1], values, np.nan))


def _arc_deg(angle_deg: Floats) -> float:
    n = len(angle_deg)
    return float(abs(angle_deg[-1] - angle_deg[0]) * n / (n - 1))


def _require_arc(angle_deg: Floats, deviation_um: Floats) -> None:
    if len(angle_deg) != len(deviation_um) or len(angle_deg) < 3:
        raise InputError(
            "a circle needs three samples with their angles",
            code="circular.samples",
            got=f"{len(angle_deg)} angles, {len(deviation_um)} deviations",
        )
    arc = abs(float(np.max(angle_deg)) - float(np.min(angle_deg)))
    if arc < 30.0:
        raise InputError(
            "the arc is too short to fit a centre",
            code="circular.arc",
            got=f"{arc:z.1f} deg",
            allowed="30 deg and more",
        )
