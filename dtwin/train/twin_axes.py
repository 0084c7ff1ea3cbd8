"""What a twin says of every axis, at positions and speeds that need not lie on a circle.

The regressors of an effect are its error times the direction in which the instrument looks. Looking
along one axis at a time gives the error as a vector in machine axes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.physics.problem import Term
from dtwin.physics.state import AXES_OF, State
from dtwin.physics.twin import Twin
from dtwin.schema import DEFAULT_KIND, Floats

AXES = "XYZ"
# Far from the last reversal: play is taken up, friction slides.
_FAR_MM = 1e6
_TOLERANCE_UM = 1e-9


@dataclass(frozen=True)
class AxisErrors:
    """What a correction of one axis says along it.

    ``axis``: X, Y or Z.
    ``measured_mm``: first and last position of the tests.
    ``um``: error at positions in mm (n,), actual minus commanded, going up and going down, shape (n,) each.
    """

    axis: str
    measured_mm: tuple[float, float]
    um: Callable[[Floats], tuple[Floats, Floats]]


@dataclass(frozen=True)
class Motion:
    """Positions and motion of a machine.

    ``position_mm``, shape (n, 3): from the centre of the circles that the twin was fitted to.
    ``velocity_mm_s``, ``acceleration_mm_s2``, shape (n, 3): motion along X, Y, Z.
    """

    position_mm: Floats
    velocity_mm_s: Floats
    acceleration_mm_s2: Floats

    @classmethod
    def steady(cls, position_mm: Floats, velocity_mm_s: Floats) -> Motion:
        """Return a motion without acceleration."""
        velocity = np.broadcast_to(velocity_mm_s, position_mm.shape)
        return cls(position_mm, np.asarray(velocity, dtype=float), np.zeros(position_mm.shape))


def axis_errors_um(twin: Twin, motion: Motion) -> Floats:
    """Return the predicted error of every axis, actual minus commanded.

    A reversal of an axis counts as long past: lost motion has its full size on the side that the
    axis comes from. An axis that stands still has none.

    ``twin``: its terms are all used; take out first what cannot be corrected.
    Returns, shape (n, 3): um along X, Y, Z; zero for axes that were not measured.
    """
    out = np.zeros(motion.position_mm.shape)
    for term in twin.terms:
        out += term_errors_um(term, twin, motion)
    return out


def term_errors_um(term: Term, twin: Twin, motion: Motion, values: Floats | None = None) -> Floats:
    """Return what one effect adds to every axis, shape (n, 3).

    ``values``: of its parameters; those of the twin without.
    """
    weights = twin.values(term) if values is None else values
    out = np.zeros(motion.position_mm.shape)
    for axis in range(3):
        # An effect that acts on an axis in two planes is the same one in both.
        for plane in twin.box.planes:
            if AXES[axis] not in AXES_OF[plane]:
                continue
            state = _looking_along(AXES[axis], plane, motion)
            errors_um = term.instance.effect.columns(state, term.instance.axis, term.shape) @ weights
            if np.abs(errors_um).max() > 0.0:
                out[:, axis] = errors_um
                break
    return out


def own_axis_only(
    terms: Sequence[Term],
    twin: Twin,
    axis: str,
    travel_mm: tuple[float, float],
    speed_mm_s: float,
    along: str | None = None,
) -> dict[str, str]:
    """Say which effects on an axis do not depend on its own position and direction alone.

    ``axis``: X, Y or Z.
    ``along``: the axis whose position and direction alone shall count; the same one without.
    ``travel_mm``: travel that counts.
    ``speed_mm_s``: usual speed.
    Returns reason by label, for the effects that a table of one axis cannot hold.
    """
    read, number = AXES.index(axis), AXES.index(along or axis)
    positions = np.linspace(*travel_mm, 9)
    alone = _line(number, positions, speed_mm_s)
    others = [i for i in range(3) if i != number]
    aside, moving = alone.position_mm.copy(), alone.velocity_mm_s.copy()
    aside[:, others] = 37.0
    moving[:, others] = 0.7 * speed_mm_s
    bent = np.zeros(aside.shape)
    bent[:, number] = 100.0
    tries = {
        "depends on the position of another axis": Motion.steady(aside, alone.velocity_mm_s),
        "depends on the motion of another axis": Motion.steady(alone.position_mm, moving),
        "depends on the feed": _line(number, positions, 2.0 * speed_mm_s),
        "depends on the acceleration": Motion(alone.position_mm, alone.velocity_mm_s, bent),
    }
    out = {}
    for term in terms:
        try:
            base = term_errors_um(term, twin, alone)[:, read]
            for reason, motion in tries.items():
                other = term_errors_um(term, twin, motion)[:, read]
                if np.abs(other - base).max() > _TOLERANCE_UM:
                    out[term.label] = reason
                    break
        except InputError as error:
            out[term.label] = f"{error.message}: {error.got}"
    return out


def axis_table_um(
    twin: Twin, axis: str, position_mm: Floats, speed_mm_s: float, along: str | None = None
) -> tuple[Floats, Floats]:
    """Return the error of one axis over its own position, or that of another, forwards and in reverse, shape (n,).

    ``twin``: with effects that pass ``own_axis_only``.
    ``axis``: X, Y or Z.
    ``position_mm``, shape (n,): from the centre of the circles.
    ``speed_mm_s``: usual speed; only its sign counts.
    ``along``: the axis that moves; the same one without.
    """
    read, number = AXES.index(axis), AXES.index(along or axis)
    ways = (speed_mm_s, -speed_mm_s)
    forward, reverse = (axis_errors_um(twin, _line(number, position_mm, way))[:, read] for way in ways)
    return forward, reverse


def _line(number: int, positions: Floats, speed_mm_s: float) -> Motion:
    position, velocity = np.zeros((len(positions), 3)), np.zeros((len(positions), 3))
    position[:, number], velocity[:, number] = positions, speed_mm_s
    return Motion.steady(position, velocity)


def _looking_along(axis: str, plane: str, motion: Motion) -> State:
    """Return the state of a plane's two axes for an instrument that looks along one of them."""
    first, second = AXES_OF[plane]
    n = len(motion.position_mm)
    at = {a: motion.position_mm[:, AXES.index(a)] for a in (first, second)}
    speed = {a: motion.velocity_mm_s[:, AXES.index(a)] for a in (first, second)}
    size = np.hypot(speed[first], speed[second])
    # A radius of which nothing may depend: reversals lie that far away.
    return State(
        kind=DEFAULT_KIND,
        axes=(first, second),
        plane=plane,
        position_mm=at,
        velocity_mm_s=speed,
        acceleration_mm_s2={a: motion.acceleration_mm_s2[:, AXES.index(a)] for a in (first, second)},
        sensitivity={a: np.full(n, 1.0 if a == axis else 0.0) for a in (first, second)},
        since_reversal_s={a: np.full(n, _FAR_MM) for a in (first, second)},
        last_end={a: -np.sign(speed[a]) for a in (first, second)},
        angle_rad=np.arctan2(at[second], at[first]),
        radius_mm=_FAR_MM,
        feed_mm_s=float(size.mean()),
        direction=1.0,
    )
