"""The slower way that any robot accepts: the next targets are rewritten before they start.

Nothing is sent while the robot moves. The equation is evaluated for the state that the robot
will have at each target, and the target is shifted by the correction, a vector in the base frame.
"""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from dtwin.errors import InputError
from dtwin.kinematics import UR10E, plane_axes
from dtwin.links import layout
from dtwin.schema import Floats
from dtwin.serve.decision import Decision
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.safety import REASONS

_HEAD = ("name", "x_mm", "y_mm", "z_mm", "feed_mm_min")
_STEP_S = 0.02
_MOST_TARGETS = 100_000
_FORMULA = ("=", "+", "-", "@")


@dataclasses.dataclass(frozen=True)
class Target:
    """Where the tool is to go.

    Attributes:
        position_mm: In the frame of the path. Shape (3,).
        feed_mm_min: Programmed on the way to it.
    """

    name: str
    position_mm: Floats
    feed_mm_min: float


@dataclasses.dataclass(frozen=True)
class CorrectedTarget:
    """A target as it is to be sent.

    Attributes:
        position_mm: What is to be sent, in the frame of the path. Shape (3,).
        offset_um: The correction along base x, y, z. Shape (3,).
        reason: What the guard did: ``ok``, ``clamped``, ``outside_box`` and so on.
    """

    target: Target
    position_mm: Floats
    offset_um: Floats
    reason: str


@dataclasses.dataclass(frozen=True)
class TargetFrame:
    """What the targets belong to.

    Attributes:
        plane: Plane of the base frame whose path angle the model counts. One of "XY", "YZ", "ZX".
        centre_mm: Centre from which the angle is counted, in the base frame. Shape (3,).
        joints_rad: Joint angles near the targets: they say branch and orientation of the tool. Shape (6,).
        direction_sign: +1 counter-clockwise, -1 clockwise.
        origin_mm, rotation: Pose of the targets' own frame (feature) in the base frame. Shapes (3,) and (3, 3).
    """

    plane: str
    centre_mm: Floats
    joints_rad: Floats
    direction_sign: float = 1.0
    origin_mm: Floats = dataclasses.field(default_factory=lambda: np.zeros(3))
    rotation: Floats = dataclasses.field(default_factory=lambda: np.eye(3))


class TargetCorrection:
    """Corrects targets one by one, each before it is sent.

    Box and clamp of the bundle hold; its slew limit does not, because between targets the robot's
    own motion is the ramp.

    Args:
        tcp_mm: Tool centre point in the flange frame. Shape (3,).

    Raises:
        InputError: When the model wants sensor windows, which no target has, or the plane is none.
    """

    def __init__(
        self,
        compiled: CompiledBundle,
        tcp_mm: Floats,
        frame: TargetFrame,
        covariates: Mapping[str, float] | None = None,
    ) -> None:
        bundle = compiled.bundle
        # From one clamp to the opposite one within a step.
        safety = dataclasses.replace(bundle.safety, slew_um_s=2.0 * bundle.safety.clamp_um / _STEP_S)
        self._decision = Decision(compiled.limited(safety), tcp_mm, covariates)
        plane_axes(frame.plane)
        self._frame, self._tcp_mm = frame, np.asarray(tcp_mm, dtype=float)
        self._joints_rad = np.asarray(frame.joints_rad, dtype=float)
        _, self._tool = UR10E.forward(self._joints_rad, self._tcp_mm)
        self._stages = np.zeros(6, dtype=np.int64)

    def corrected(self, targets: Iterable[Target]) -> Iterator[CorrectedTarget]:
        """Yield every target corrected, when it is asked for: send it, then ask for the next.

        Args:
            targets: In the order of the program.

        Raises:
            InputError: When a target is out of reach.
        """
        for target in targets:
            yield self.correct(target)

    def correct(self, target: Target) -> CorrectedTarget:
        """Return one target corrected; see ``corrected``."""
        frame = self._frame
        base_mm = frame.rotation @ target.position_mm + frame.origin_mm
        state = self._state_at(base_mm, target.feed_mm_min)
        # Targets are far from each other: nothing is carried over but the joints' branch.
        self._decision.reset()
        offset_um = self._decision.decide(state, age_s=0.0, elapsed_s=_STEP_S, enabled=True, stages=self._stages).copy()
        sent_mm = frame.rotation.T @ (base_mm + 1e-3 * offset_um - frame.origin_mm)
        return CorrectedTarget(target, sent_mm, offset_um, REASONS[self._decision.guard.reason])

    def _state_at(self, base_mm: Floats, feed_mm_min: float) -> layout.RobotState:
        """Return the state of a robot that has come to rest at a target."""
        frame = self._frame
        self._joints_rad = UR10E.inverse(base_mm, self._tool, self._tcp_mm, self._joints_rad)
        state = layout.empty_state()
        for place in (layout.TARGET_Q, layout.ACTUAL_Q):
            state[place : place + 6] = self._joints_rad
        for place in (layout.TARGET_TCP, layout.ACTUAL_TCP):
            state[place : place + 3] = base_mm
        state[layout.SPEED_SCALING] = 1.0
        state[layout.RUNTIME_RUNNING], state[layout.SAFETY_OK] = layout.RUNNING, layout.SAFE
        state[layout.PLANE_ID] = layout.PLANE_OF_ID.index(frame.plane)
        state[layout.CENTRE : layout.CENTRE + 3] = frame.centre_mm
        state[layout.RADIUS] = float(np.linalg.norm(base_mm - frame.centre_mm))
        state[layout.DIRECTION_SIGN] = frame.direction_sign
        state[layout.FEED] = feed_mm_min
        return state


def read_targets(path: Path) -> list[Target]:
    """Return the targets of a CSV file with the columns ``name,x_mm,y_mm,z_mm,feed_mm_min``.

    Raises ``InputError`` when the file cannot be read, lacks a column, or holds what is no number.
    """
    targets = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            if tuple(reader.fieldnames or ()) != _HEAD:
                raise _unusable(path, "columns", ",".join(reader.fieldnames or ()), ",".join(_HEAD))
            for number, row in enumerate(reader, start=2):
                # Of 1,5 commas make two cells: the target would be elsewhere.
                if None in row:
                    raise _unusable(
                        path, f"line {number}", "more cells than columns", "decimal points, a cell for each"
                    )
                values = [float(row[name] or "nan") for name in _HEAD[1:]]
                if not all(math.isfinite(v) for v in values) or values[3] <= 0.0:
                    raise _unusable(path, f"line {number}", str(values), "finite, feed above 0")
                # A name with a line end, which a spreadsheet hides, would be a target of its own in what is written.
                if not (name := str(row["name"])).isprintable():
                    raise _unusable(path, f"line {number}", repr(name), "a name of printable characters")
                if name.lstrip().startswith(_FORMULA):
                    raise _unusable(
                        path, f"line {number}", name, "a name that a spreadsheet does not take for a formula"
                    )
                targets.append(Target(name, np.array(values[:3]), values[3]))
                if len(targets) > _MOST_TARGETS:
                    raise _unusable(path, "rows", "more", f"{_MOST_TARGETS} targets")
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise _unusable(path, "file", str(error)[:120], "a CSV file of numbers") from error
    if not targets:
        raise _unusable(path, "rows", "none", "one target or more")
    return targets


def corrected_csv(made: Iterable[CorrectedTarget]) -> str:
    """Return corrected targets as CSV: the columns of the input, the offset, what the guard did."""
    lines = [",".join((*_HEAD, "offset_x_um", "offset_y_um", "offset_z_um", "guard"))]
    for one in made:
        place = ",".join(f"{value:z.5f}" for value in one.position_mm)
        offset = ",".join(f"{value:z.3f}" for value in one.offset_um)
        name = one.target.name.replace(",", " ").replace('"', " ")
        lines.append(f"{name},{place},{one.target.feed_mm_min:g},{offset},{one.reason}")
    return "\n".join(lines) + "\n"


def _unusable(path: Path, what: str, got: str, allowed: str) -> InputError:
    return InputError(
        "the targets cannot be used", code="targets.file", where=f"{path}, {what}", got=got[:160], allowed=allowed
    )
