"""How effects look: the error that each makes round a circle, or along an axis, as a small picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dtwin.physics.effect import Effect
from dtwin.physics.gridding import CIRCLE
from dtwin.physics.library import campaign_instances
from dtwin.physics.state import State, circular_state
from dtwin.schema import Direction, Floats, Plane, RunMeta

# Circle on which signatures are drawn.
_RADIUS_MM, _FEED_MM_MIN = 100.0, 3000.0
_ROBOT = {"type": "ur10e", "centre_mm": [-550.0, 0.0, 300.0], "tcp_mm": [0.0, 0.0, 158.3]}
_REACH_MM, _TURNS_RAD_S = 20.0, 2.0 * np.pi * 5.0
# What shows in the spread of repeats is drawn in so many of them, at a feed that makes an axis creep.
_REPEATS, _CREEPING_MM_MIN = 3, 300.0
_TOOTH = (8.0, 24.0)
_SIZE, _CIRCLE, _DRAWN, _POINTS = 300, 100, 28, 720
_COLOURS = ("#0072B2", "#D55E00", "#009E73")
_LOGGED = ("temperature_c", "temperature_rise_c", "abbe_offset_mm", "time_h", "setup_first_um", "setup_second_um")


def _signature(effect: Effect, axis: str = "") -> tuple[str, dict[str, Floats]]:
    """Return label and error of the first parameter of an effect by direction, each of shape (n,) over one turn.

    One that changes only the spread has the errors of repeats of one direction.

    ``effect``: one of a circle; other ones have no curves.
    ``axis``: on which axis; else the first on which it shows.
    """
    if CIRCLE.kind not in effect.kinds:
        return effect.name, {}
    plane: Plane = "ZX" if effect.name == "gravity_sag" or axis == "Z" else "XY"
    wanted = campaign_instances({effect.name: effect}, CIRCLE.kind, [plane], list(plane), _ROBOT)
    angle = _angle()
    columns = {name: np.ones(_POINTS) for name in _LOGGED}
    ways: tuple[Direction, ...] = ("CCW",) if effect.on_spread else ("CCW", "CW")
    feed_mm_min = _feed_mm_min(effect)
    for instance in sorted(wanted, key=lambda i: i.axis != axis):
        curves: dict[str, Floats] = {}
        for way in ways:
            meta = RunMeta("r", plane=plane, direction=way, radius_mm=_RADIUS_MM, feed_mm_min=feed_mm_min)
            state = circular_state(meta, angle, feed_mm_s=feed_mm_min / 60.0, columns=columns, geometry=_ROBOT)
            curves[way] = effect.columns(state, instance.axis, effect.start_shape)[:, 0]
        if effect.on_spread:
            deviation = np.sqrt(curves["CCW"])
            curves = {f"repeat {number}": deviation * _jerks(number) for number in range(_REPEATS)}
        if any(c.any() for c in curves.values()):
            return instance.label, curves
    return effect.name, {}


def _feed_mm_min(effect: Effect) -> float:
    return _CREEPING_MM_MIN if effect.on_spread else _FEED_MM_MIN


def _jerks(repeat: int) -> Floats:
    """Return how an axis sticks and jumps in one repeat, shape (n,): saw teeth of random length and height about one."""
    rng = np.random.default_rng(repeat)
    length = rng.uniform(*_TOOTH, _POINTS)
    height, end = rng.normal(0.0, 1.0, _POINTS), np.cumsum(length)
    tooth = np.searchsorted(end, np.arange(_POINTS))
    return np.asarray(height[tooth] * (0.5 - (end[tooth] - np.arange(_POINTS)) / length[tooth]))


def _along(effect: Effect) -> dict[str, Floats]:
    """Return the error of the first parameter of an effect on the way forth and back along an axis, each of shape (n,).

    The axis swings by a sine, one period; both are in the order of its position. Curves that are zero are none.
    """
    phase = _angle()
    at, way = -_REACH_MM * np.cos(phase), np.sign(np.sin(phase))
    state = State(
        kind=effect.kinds[0],
        axes=("X",),
        plane="",
        position_mm={"X": at},
        velocity_mm_s={"X": _REACH_MM * _TURNS_RAD_S * np.sin(phase)},
        acceleration_mm_s2={"X": -at * _TURNS_RAD_S**2},
        sensitivity={"X": np.ones(_POINTS)},
        since_reversal_s={"X": phase % np.pi / _TURNS_RAD_S},
        last_end={"X": -way},
        angle_rad=phase,
        radius_mm=_REACH_MM,
        feed_mm_s=_REACH_MM * _TURNS_RAD_S,
        direction=1.0,
        columns={name: np.ones(_POINTS) for name in _LOGGED},
        geometry={"screw_pitch_mm": _REACH_MM / 2.0},
    )
    # Effects of sweeps take the direction from the state, those of tones from the speed of a whole period.
    forth, back = (
        effect.columns(replace(state, direction=sense), "X", effect.start_shape)[:, 0].reshape(2, -1)[half]
        for half, sense in enumerate((1.0, -1.0))
    )
    return {"forward": forth, "reverse": back[::-1]} if forth.any() or back.any() else {}


def signature_svg(effect: Effect, axis: str = "", width: int = _SIZE) -> str:
    """Return the signature as an SVG picture, empty when there is none: CCW blue, CW orange and dashed.

    An effect that no circle shows is drawn along an axis that swings, forward blue, reverse orange and dashed; one
    that changes only the spread in several repeats.
    """
    label, curves = _signature(effect, axis)
    round_circle = bool(curves)
    curves = curves or _along(effect)
    if not curves:
        return ""
    largest = max(float(np.abs(c).max()) for c in curves.values())
    middle, angle = _SIZE / 2, _angle()
    across = middle - _CIRCLE * np.cos(angle[: _POINTS // 2])
    # About one pixel as it is shown; small ones would hide their own shape, and need points and digits as fine as pixels.
    wide = 1.5 * _SIZE / max(width, 100)
    step, digits = max(1, round(0.65 * _SIZE / width)), int(width >= _SIZE)
    said = f"{label} round the circle" if round_circle else f"{effect.name} along an axis"
    nominal = (
        f'circle cx="{middle}" cy="{middle}" r="{_CIRCLE}" fill="none"'
        if round_circle
        else f'line x1="{across[0]}" x2="{across[-1]}" y1="{middle}" y2="{middle}"'
    )
    parts = [
        f'<svg viewBox="0 0 {_SIZE} {_SIZE}" width="{width}" role="img" aria-label="error of {said}">',
        f'<{nominal} stroke="#999" stroke-dasharray="3 3"/>',
    ]
    for colour, (way, curve) in zip(_COLOURS, curves.items(), strict=False):
        x, y = across, middle - 0.8 * _CIRCLE * curve / largest
        if round_circle:
            radius = _CIRCLE + _DRAWN * curve / largest
            x, y = middle + radius * np.cos(angle), middle - radius * np.sin(angle)
        path = " ".join(f"{a:z.{digits}f},{b:z.{digits}f}" for a, b in zip(x[::step], y[::step], strict=True))
        dash = f' stroke-dasharray="{4 * wide:z.1f} {2 * wide:z.1f}"' if way in ("CW", "reverse") else ""
        drawn = f'points="{path}" fill="none" stroke="{colour}" stroke-width="{wide:z.1f}"{dash}'
        parts.append(f"<{'polygon' if round_circle else 'polyline'} {drawn}/>")
    return "".join([*parts, "</svg>"])


def signature_caption(effect: Effect) -> str:
    """Return what the picture of a signature shows."""
    if effect.on_spread:
        return (
            f"{_REPEATS} repeats of one circle counter-clockwise, R = {_RADIUS_MM:g} mm, F = {_feed_mm_min(effect):g} mm/min: "
            "each has other jerks in the same stretches; dotted: the nominal circle."
        )
    if _signature(effect)[1]:
        return (
            f"First parameter at R = {_RADIUS_MM:g} mm, F = {_FEED_MM_MIN:g} mm/min: counter-clockwise blue, "
            "clockwise orange and dashed; dotted: the nominal circle."
        )
    return "First parameter along an axis that swings: forward blue, reverse orange and dashed; dotted: no error."


def _angle() -> Floats:
    return np.asarray((np.arange(_POINTS) + 0.5) * 2 * np.pi / _POINTS)
