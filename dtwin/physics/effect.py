"""What an effect is: one physical cause, as a function of the machine's state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from dtwin.errors import InputError
from dtwin.physics.state import State
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

# No machine that anyone would measure has a fault of more times its ordinary size.
_LARGEST = 200.0
_BEYOND_GRID = 10.0
# A table stands still for as long as its play is wide; wind-up beside it is taken up over some more travel.
_AS_LONG = 3.0
_AT_ONCE_UM = 1e-3
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)

Per = Literal["machine", "axis", "machine_and_axis", "plane", "plane_or_axis", "joint"]
Shape = Mapping[str, float]
Regressors = Callable[[State, str, Shape], Floats]


@dataclass(frozen=True)
class Parameter:
    """A number that the fit finds, and that the error is proportional to.

    Attributes:
        name, unit: What it is, and its unit; the regressor is in um per this unit.
        typical: Size on an ordinary machine, for planning.
        once: The parameter that stood for this one too in versions that were stored before there were two.
        positive: Whether nature lets it have one sign only, as a compliance has.
        most: Size beyond which no machine is; by default 200 times the typical one.
    """

    name: str
    unit: str
    typical: float
    once: str = ""
    positive: bool = False
    most: float | None = None

    @property
    def largest(self) -> float:
        """Size beyond which no machine is: such a value is a finding, not a result."""
        return _LARGEST * self.typical if self.most is None else self.most


@dataclass(frozen=True)
class ShapeParameter:
    """A number that the error is not proportional to.

    Attributes:
        grid: Values that diagnosis tries, refined between the outermost.
        limits: What is physically possible, which no fit leaves; without them a tenth of the smallest and ten times the
            largest value of the grid, or of the start. From zero on for what may be absent, as a rise that happens at once.
        refined: Whether values between those that are tried are possible.
        ends: Whether the effect is another one beyond the largest value tried: there it is not believed.
        vanishes: Whether the effect stays the same one far below the smallest value tried: diagnosis may go there.
        by_speed: Whether only runs at several speeds tell it: at one speed it stays at its start.
        smooth: Whether a few values of the grid's range span the effect at all others, as they do for a time constant.
        as_large: Whether the error is as large as the value: beyond the grid it is at most three times the effect's first parameter, and
            of what diagnosis tries besides, what is larger than the runs show is left out.
        step_on_circles: A circle is shorter than an axis: every so-manieth value of the grid is tried on it.
    """

    name: str
    unit: str
    start: float
    grid: tuple[float, ...]
    limits: tuple[float, float] | None = None
    refined: bool = True
    ends: bool = False
    vanishes: bool = False
    by_speed: bool = False
    smooth: bool = False
    as_large: bool = False
    step_on_circles: int = 1

    @property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest value that a fit may give."""
        tried = self.grid or (self.start,)
        return self.limits or (min(tried) / _BEYOND_GRID, max(tried) * _BEYOND_GRID)

    def largest_at(self, size: float) -> float:
        """Return the largest value that is possible where the effect's first parameter is so large."""
        high = self.bounds[1]
        return min(high, max((*self.grid, _AS_LONG * abs(size)))) if self.as_large else high


@dataclass(frozen=True)
class Law:
    """How the amplitude of an effect changes with the condition.

    Attributes:
        feed, radius: Exponents; None when the effect obeys no power law.
        direction: Whether the sign stays, changes, or neither when the motion is reversed. One of "even", "odd", "mixed".
    """

    feed: float | None
    radius: float | None
    direction: Literal["even", "odd", "mixed"]


@dataclass(frozen=True)
class Effect:
    """One physical cause.

    Attributes:
        parameters: One for each column of the regressors.
        regressors: ``regressors(state, axis, shape)`` returns columns of shape (n, parameters), in um per unit of each
            parameter, as the reference instrument sees them.
        law: Scaling that is tested before a name counts as confirmed.
        per: What there is one of: the machine, each axis, each plane, each joint. ``plane_or_axis`` is for what only
            shows as a difference: each plane when one plane was measured, else each axis.
        kinds: Kinds of campaign in which it can be seen.
        shapes: Parameters that the error is not proportional to.
        also_tried: Shapes that diagnosis tries besides the combinations of the grids; at one speed those that it tells.
        also_tried_on: Kinds of campaign for which it does; empty for all.
        needs: Logged columns without which it cannot be judged.
        stated: What the geometry of the machine must state, without which it cannot be judged.
        told_by: What must have been changed to tell it from others, as conditions call it: radius, amplitude. Else it is not tried.
        setup: Belongs to the mounting of the instrument: always fitted, never a missing effect.
        within_condition: Differs between repeats of a condition, as heat and time do.
        on_spread: Shows in the spread of repeats and not in their mean.
        group: Of what it is on pages: geometry, drive, dynamics, heat or instrument; your own when empty.
        meaning, formula, looks_like, separate_by, remedy, reference: For people: what it is, how it is computed, what the
            plot shows, which run tells it from its confusables, what to do about it, where it is described.
        confusables: Effects that it can be mistaken for.
        special_cases: Effects that it becomes at an end of its shapes: where one of them is enough, it is no other
            explanation.
        at_one_speed: Effect of the same shape that it is at one speed, together with another that has no shape.
        cause: What of the machine its size measures, where tests of other kinds can see that too: effects with the same
            cause on the same axis have the same size.
        correctable: Empty when offsets of position cannot correct it, else how they do.
    """

    name: str
    title: str
    parameters: tuple[Parameter, ...]
    regressors: Regressors
    law: Law
    meaning: str
    formula: str
    looks_like: str
    separate_by: str
    remedy: str
    reference: str
    per: Per = "axis"
    kinds: tuple[str, ...] = ("circular",)
    shapes: tuple[ShapeParameter, ...] = ()
    also_tried: tuple[Shape, ...] = ()
    also_tried_on: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    stated: tuple[str, ...] = ()
    confusables: tuple[str, ...] = ()
    special_cases: tuple[str, ...] = ()
    at_one_speed: str = ""
    cause: str = ""
    correctable: str = ""
    group: str = ""
    told_by: str = ""
    setup: bool = False
    within_condition: bool = False
    on_spread: bool = False
    source: str = field(default="dtwin", compare=False)

    def another_law(self, shape: Shape) -> bool:
        """Tell whether a shape has another than the usual value where only those that are tried are possible."""
        return any(shape[s.name] != s.start for s in self.shapes if not s.refined)

    def is_told_at_one_speed(self, shape: Shape) -> bool:
        """Tell whether a shape is the usual one where only runs at several speeds tell."""
        return all(shape[s.name] == s.start for s in self.shapes if s.by_speed)

    def refined_shapes(self, several_speeds: bool) -> tuple[ShapeParameter, ...]:
        """Return the shape parameters that are refined between the values tried."""
        return tuple(s for s in self.shapes if s.refined and (several_speeds or not s.by_speed))

    def completed(self, shape: Shape) -> dict[str, float]:
        """Return a shape of an earlier version with what it did not know: absent where it may be, else at its start."""
        absent = {s.name: 0.0 for s in self.shapes if s.bounds[0] == 0.0}
        return self.start_shape | absent | dict(shape)

    @property
    def start_shape(self) -> dict[str, float]:
        """Shape parameters where their search begins."""
        return {shape.name: shape.start for shape in self.shapes}

    def columns(self, state: State, axis: str, shape: Shape) -> Floats:
        """Return the checked regressors at every point of a run.

        Args:
            state: State of the machine at n points.
            axis: Axis, plane or joint; empty for effects of the machine.

        Returns:
            um per unit of each parameter. Shape (n, parameters).

        Raises:
            InputError: When the effect raises, or returns other than finite numbers of that shape.
        """
        wanted = (state.n, len(self.parameters))
        try:
            columns = np.asarray(self.regressors(state, axis, shape), dtype=np.float64)
        except InputError:
            raise
        except Exception as error:
            raise InputError(
                "an effect failed",
                code="effect.raised",
                where=f"{self.name} ({self.source})",
                got=f"{type(error).__name__}: {error}",
                allowed=f"an array of shape {wanted}",
            ) from error
        if columns.shape != wanted:
            raise InputError(
                "an effect returned the wrong shape",
                code="effect.shape",
                where=f"{self.name} ({self.source})",
                got=str(columns.shape),
                allowed=f"{wanted}: one row for each point, one column for each parameter",
            )
        if not np.isfinite(columns).all():
            raise InputError(
                "an effect returned numbers that are not finite",
                code="effect.not_finite",
                where=f"{self.name} ({self.source})",
                got=f"{int((~np.isfinite(columns)).sum())} of {columns.size}",
                hint="guard divisions and logarithms, for example at standstill",
            )
        return columns


@dataclass(frozen=True)
class Instance:
    """An effect on one axis, plane or joint.

    Attributes:
        axis: Where it acts; empty for effects of the machine.
    """

    effect: Effect
    axis: str = ""

    @cached_property
    def label(self) -> str:
        """Name with axis, for example ``backlash X``."""
        return f"{self.effect.name} {self.axis}".rstrip()


def stacked(*columns: Floats) -> Floats:
    """Return columns of shape (n,) side by side, shape (n, k)."""
    return np.stack(columns, axis=1)


def moves(state: State, axis: str) -> bool:
    """Tell whether an axis takes part in a run."""
    return axis in state.axes


def _other_axis(state: State, axis: str) -> str:
    """Return the second moving axis of a circle."""
    first, second = state.axes
    return second if axis == first else first


# Half the travel over which a curve of a guideway has no line and no bow: that of the largest circle, once there is a campaign.
OVER = ShapeParameter("over_mm", "mm", 0.0, (0.0,), (0.0, 1e4), refined=False)

# What slows down as heat spreads, ISO 230-3; at its largest it goes on as it began.
SETTLING = ShapeParameter("settling_h", "h", 1e4, (0.15, 0.5, 1e4), (0.05, 1e4), smooth=True)


def settled_h(state: State, shape: Shape) -> Floats:
    """Return the time since the first run, in hours, slowing down with the time constant of a shape, shape (n,)."""
    return shape["settling_h"] * -np.expm1(-state.column("time_h") / shape["settling_h"])


SECOND_AXIS = "; second_axis_ is the same towards the second of the other two axes: Z for X and Y, Y for Z"
"""What the formula of an effect says that has the columns of :func:`aside`."""


def aside(state: State, axis: str, *profiles_um: Floats) -> Floats:
    """Return what pushes the other moving axis of a circle aside, in a column for each axis that this might be.

    A guideway has a shape of its own in each of the two directions across it, and a plane shows one of them.

    ``profiles_um``: k of them, each of shape (n,).
    Returns (n, 2 k): towards the first of the other two axes by letter, then towards the second.
    """
    nothing = [np.zeros(state.n)] * len(profiles_um)
    towards = _other_axis(state, axis)
    pushed = [profile * state.sensitivity[towards] for profile in profiles_um]
    is_first = towards == min(set("XYZ") - {axis})
    return stacked(*pushed, *nothing) if is_first else stacked(*nothing, *pushed)


def guideway(state: State, axis: str, over_mm: float, *profiles_um: Callable[[Floats], Floats]) -> Floats:
    """Return what curves of a guideway push aside, as :func:`aside` does; nothing where the axis stands.

    Each is taken without its least-squares line and bow over so much to both sides of the centre, unless that is 0: these
    are squareness and straightness.

    ``profiles_um``: k functions of the place in mm.
    """
    if not moves(state, axis):
        return np.zeros((state.n, 2 * len(profiles_um)))
    made = [profile(state.position_mm[axis]) for profile in profiles_um]
    for power, plain in ((1, _line), (2, _bow)) if over_mm else ():
        parts = plain(_NODES) * _WEIGHTS * (power + 0.5)
        taken = plain(state.position_mm[axis] / over_mm)
        made = [
            m - float(parts @ profile(over_mm * _NODES)) * taken for m, profile in zip(made, profiles_um, strict=True)
        ]
    return aside(state, axis, *made)


def _line(along: Floats) -> Floats:
    return along


def _bow(along: Floats) -> Floats:
    """Return the second Legendre polynomial: a bow without a mean."""
    return 1.5 * along**2 - 0.5


def taken_up(state: State, axis: str, standstill_um: float) -> Floats:
    """Return the share of a play that an axis has taken up since it reversed, shape (n,)."""
    return np.minimum(UM_PER_MM * travelled_mm(state, axis) / max(standstill_um, _AT_ONCE_UM), 1.0)


def travelled_mm(state: State, axis: str) -> Floats:
    """Return how far an axis has moved since it last reversed, shape (n,)."""
    return np.abs(state.last_end[axis] * state.radius_mm - state.position_mm[axis])
