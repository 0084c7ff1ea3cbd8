"""The virtual cobot puts a block on the mill's table: what repeats, and what does not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.machines.cobot import VirtualCobot
from dtwin.schema import Floats
from studies.machines.joint_program import Waypoint, drive_program
from studies.machines.probed_block import Block, probe

PLACE_MM = np.array([-680.0, 0.0, 147.0])
PICK_MM = np.array([-664.0, 163.0, 89.0])
CLEAR_MM = np.array([-500.0, 80.0, 240.0])
DATUM_MM = np.array([-640.0, -40.0, 147.0])
_UP_MM = np.array([0.0, 0.0, 50.0])
_HANDOVER_S = 0.3


@dataclass(frozen=True)
class CellLooseness:
    """What differs from placement to placement; assumed, of the size that tables of the source show.

    ``robot_um``: standard deviation of the robot along each axis, from the cobot's drift.
    ``grip_um``, ``grip_mrad``: how the block lies in the jig, and how it is turned there.
    ``release_um``: jump when the magnets change over.
    ``slip_share``, ``slip_low_um``, ``slip_high_um``: how often the jig slips, and how far.
    ``lost_share``: how often a block is not where the probe searches.
    ``probe_um``: of one touch.
    ``room_c``, ``warm_c``, ``warming_placements``: temperature of the block: room, lasting work of the magnets, and its
    time constant.
    ``thermometer_c``: of the logged temperature.
    """

    robot_um: float = 7.0
    grip_um: float = 8.0
    grip_mrad: float = 0.5
    release_um: float = 6.0
    slip_share: float = 0.05
    slip_low_um: float = 100.0
    slip_high_um: float = 300.0
    lost_share: float = 0.017
    probe_um: float = 0.5
    room_c: float = 18.8
    warm_c: float = 34.5
    warming_placements: float = 25.0
    thermometer_c: float = 0.3


@dataclass(frozen=True)
class ProbedPlacement:
    """What is written down of one placement.

    ``readings_mm``, (5,): probe readings in the order of ``HITS``.
    ``temperature_c``: logged temperature of the block.
    ``jig_moved_um``: change of the jig's pin since the placement before.
    ``duration_s``: time of the program.
    """

    readings_mm: Floats
    temperature_c: float
    jig_moved_um: float
    duration_s: float


class PlacingCell:
    """Robot, jig, magnets, block and probe.

    ``cobot``: the robot.
    ``seed``: of everything that does not repeat.
    ``looseness``: how much that is.
    """

    def __init__(self, cobot: VirtualCobot, seed: int, looseness: CellLooseness | None = None) -> None:
        self.cobot, self.loose = cobot, looseness or CellLooseness()
        self._rng = np.random.default_rng([cobot.seed, 11, seed])
        self._known: dict[tuple[str, float, bytes], tuple[Floats, float]] = {}
        self._placements = 0

    def repeatable_mm(self, target_mm: Floats, motion: str, feed_mm_min: float) -> Floats:
        """Return how far from ``PLACE_MM`` the tool ends when the target is ``target_mm``."""
        return self._driven(target_mm, motion, feed_mm_min)[0]

    def place(self, target_mm: Floats, motion: str, feed_mm_min: float) -> ProbedPlacement:
        """Pick a block, place it at a target, and probe it where it should be.

        ``target_mm``, (3,): what the robot is sent, base frame.
        ``motion``: ``MoveL`` or ``MoveJ``.
        ``feed_mm_min``: programmed feed.
        """
        loose, rng = self.loose, self._rng
        reached, duration_s = self._driven(target_mm, motion, feed_mm_min)
        spread = np.array([loose.robot_um, loose.grip_um, loose.release_um]) / 1e3
        off = reached + sum(size * rng.standard_normal(3) for size in spread)
        turned = 1e-3 * loose.grip_mrad * rng.standard_normal()
        slipped = np.zeros(2)
        chance, towards, far = rng.random(2), rng.uniform(0.0, 2.0 * np.pi), rng.random()
        if chance[0] < loose.slip_share:
            size = loose.slip_low_um + far * (loose.slip_high_um - loose.slip_low_um)
            slipped = 1e-3 * size * np.array([np.cos(towards), np.sin(towards)])
        elif chance[1] < loose.lost_share:
            off = off + np.array([4.0, -4.0, 0.0])
        off[:2] += slipped
        temperature = loose.warm_c - (loose.warm_c - loose.room_c) * np.exp(
            -self._placements / loose.warming_placements
        )
        self._placements += 1
        readings = probe(Block(off, turned, temperature), loose.probe_um, rng)
        pin_um = 1e3 * float(np.hypot(*slipped)) + 2.0 * rng.standard_normal()
        shown = temperature + loose.thermometer_c * rng.standard_normal()
        return ProbedPlacement(readings, float(shown), pin_um, duration_s)

    def _driven(self, target_mm: Floats, motion: str, feed_mm_min: float) -> tuple[Floats, float]:
        key = (motion, feed_mm_min, np.asarray(target_mm, dtype=float).tobytes())
        if key not in self._known:
            # Start and mid-point move with the target: the last move stays vertical. Were the target
            # shifted alone, joint 1 would turn by some urad at the end, and might change its flank.
            shift = np.asarray(target_mm, dtype=float) - PLACE_MM
            stops = [
                Waypoint("clear", CLEAR_MM),
                Waypoint("above the jig", PICK_MM + _UP_MM),
                Waypoint("pick", PICK_MM),
                Waypoint("away", PICK_MM + _UP_MM),
                Waypoint("start of placing", PLACE_MM + 2.0 * _UP_MM + shift),
                Waypoint("mid-point", PLACE_MM + 0.3 * _UP_MM + shift),
                Waypoint("place", np.asarray(target_mm, dtype=float), _HANDOVER_S),
            ]
            ends, duration_s = drive_program(
                self.cobot, stops, motion=motion, feed_mm_min=feed_mm_min, datum_mm=DATUM_MM
            )
            self._known[key] = ends[-1] - PLACE_MM, duration_s
        return self._known[key]
