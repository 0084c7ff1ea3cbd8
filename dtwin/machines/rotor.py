"""A spindle's rotor on springs, driven in time: unbalance, balls that differ, heat; and a target that three probes read.

The rotor is a mass on two springs that differ; its bearing's centre is moved by balls of different size as their cage takes them
round. The target is a curve: off the axis, with lobes and a groove; a probe reads where the curve crosses its line of sight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from dtwin.schema import Floats

_WARM_UP_TURNS = 40
_SUBSTEPS = 2
_BALLS = 9


@dataclass(frozen=True)
class RotorParameters:
    """What the spindle is like.

    ``critical_rpm``: of the softer spring; the stiffer one has a twelfth more.
    ``unbalance_um``: distance of the centre of mass from the axis.
    ``balls_um``: deviation of the balls' diameters; ``cage``: turns of the cage in a turn.
    ``target_um``, ``target_deg``: where the target's centre lies; ``lobes_um``: its form by number of lobes.
    ``groove_um``, ``groove_deg``, ``groove_wide_deg``: depth, place and width of a groove.
    ``growth_um``: how far the nose goes along the axis when it is warm at the highest speed; ``warm_s``: time constant.
    ``centrifugal_um``: growth of the target's radius at 10 000 rpm.
    """

    mass_kg: float = 6.0
    critical_rpm: float = 40_000.0
    damping: float = 0.04
    unbalance_um: float = 0.0
    balls_um: float = 0.05
    cage: float = 0.417
    target_um: float = 6.0
    target_deg: float = 35.0
    lobes_um: tuple[tuple[int, float], ...] = ((2, 0.8), (3, 0.5), (5, 0.2))
    groove_um: float = 4.0
    groove_deg: float = 140.0
    groove_wide_deg: float = 4.0
    face_um: float = 1.5
    growth_um: float = 0.0
    warm_s: float = 1500.0
    centrifugal_um: float = 0.0
    radius_mm: float = 20.0
    noise_um: float = 0.05


@dataclass(frozen=True)
class RotorLog:
    """What is read at one speed, one value for each reading; angles are those of an encoder of 0.1 degrees."""

    t_s: Floats
    angle_deg: Floats
    x_um: Floats
    y_um: Floats
    axial_um: Floats


class Rotor:
    """The machine; a seed is of its balls, its noise and where the balls begin."""

    def __init__(self, parameters: RotorParameters | None = None, seed: int = 0) -> None:
        self.parameters = parameters or RotorParameters()
        self.seed = seed
        self._warm = 0.0
        self._balls = np.random.default_rng([seed, 7]).normal(0.0, self.parameters.balls_um, _BALLS)

    def rest(self, seconds: float, speed_rpm: float) -> None:
        """Let the spindle turn, or stand at speed 0, for a time: it warms, or cools."""
        aim = speed_rpm / 10_000.0
        self._warm += (aim - self._warm) * -np.expm1(-seconds / self.parameters.warm_s)

    def run(self, speed_rpm: float, turns: int, readings: int, seed: int) -> RotorLog:
        """Return what probes read in so many turns, with so many readings in each."""
        p = self.parameters
        rng = np.random.default_rng([self.seed, seed])
        omega = 2.0 * np.pi * speed_rpm / 60.0
        step = 2.0 * np.pi / omega / readings / _SUBSTEPS
        count = (turns + _WARM_UP_TURNS) * readings * _SUBSTEPS + readings
        begin = rng.uniform(0.0, 2.0 * np.pi)
        theta: Floats = np.asarray(begin + omega * step * np.arange(count), dtype=np.float64)
        # The cage slips a little, more or less from moment to moment.
        slip = np.cumsum(rng.normal(0.0, 2e-4, count)) * np.sqrt(omega * step)
        cage = p.cage * (theta - begin) + rng.uniform(0.0, 2.0 * np.pi) + slip
        place = cage[:, None] + 2.0 * np.pi * np.arange(_BALLS) / _BALLS
        pushed = np.column_stack([np.cos(place) @ self._balls, np.sin(place) @ self._balls])
        at = self._moved(theta, pushed, omega, step)
        keep = slice(_WARM_UP_TURNS * readings * _SUBSTEPS, None, _SUBSTEPS)
        theta, at = theta[keep], at[keep]
        t_s: Floats = np.asarray(step * _SUBSTEPS * np.arange(len(theta)), dtype=np.float64)
        grown = p.centrifugal_um * (speed_rpm / 10_000.0) ** 2
        x, y = (
            self._seen(theta, at, sight) + grown + rng.normal(0.0, p.noise_um, len(theta)) for sight in (0.0, np.pi / 2)
        )
        warm = self._warm + (speed_rpm / 10_000.0 - self._warm) * -np.expm1(-t_s / p.warm_s)
        face = p.face_um * np.cos(theta - 1.0) + p.growth_um * warm
        axial = face + 0.2 * pushed[keep, 0] + rng.normal(0.0, p.noise_um, len(theta))
        self.rest(float(t_s[-1]), speed_rpm)
        read = np.round(np.degrees(theta) % 360.0 * 10.0) / 10.0 % 360.0
        return RotorLog(t_s, read, x, y, axial)

    def _moved(self, theta: Floats, pushed: Floats, omega: float, step: float) -> Floats:
        """Return where the axis is at each step, in µm: two masses on springs whose feet the balls move, exactly between steps."""
        p = self.parameters
        out = np.empty_like(pushed)
        for axis, stiffer in enumerate((1.0, 1.0 + 1.0 / 12.0)):
            natural = 2.0 * np.pi * p.critical_rpm * stiffer / 60.0
            rate = 2.0 * p.damping * natural
            a = np.array([[0.0, 1.0], [-(natural**2), -rate]])
            whole = np.zeros((3, 3))
            whole[:2, :2], whole[1, 2] = a, 1.0
            matrix = expm(whole * step)
            turning = np.cos(theta) if axis == 0 else np.sin(theta)
            force = natural**2 * pushed[:, axis] + p.unbalance_um * omega**2 * turning
            # The force in the middle of a step stands for all of it.
            middle = 0.5 * (force[:-1] + force[1:])
            (kept, of_speed, of_push), (back, slowed, driven) = matrix[:2].tolist()
            place, speed = float(pushed[0, axis]), 0.0
            places = [place]
            # Plain numbers: arrays of two take ten times as long.
            for push in middle.tolist():
                place, speed = (
                    kept * place + of_speed * speed + of_push * push,
                    back * place + slowed * speed + driven * push,
                )
                places.append(place)
            out[:, axis] = places
        return out

    def _seen(self, theta: Floats, at_um: Floats, sight: float) -> Floats:
        """Return how far the target's edge lies on a line of sight from the middle outwards, in µm beyond its radius."""
        p = self.parameters
        centre = at_um + p.target_um * np.column_stack(
            [np.cos(theta + np.radians(p.target_deg)), np.sin(theta + np.radians(p.target_deg))]
        )
        along = centre @ np.array([np.cos(sight), np.sin(sight)])
        across = centre @ np.array([-np.sin(sight), np.cos(sight)])
        radius = 1000.0 * p.radius_mm
        # The edge that is seen lies a little off where it would be without the shift across.
        body = sight - theta - np.arcsin(across / radius)
        form = sum((um * np.cos(k * body) for k, um in p.lobes_um), np.zeros(len(theta)))
        off = np.degrees(np.angle(np.exp(1j * (body + np.radians(p.groove_deg)))))
        form = form - p.groove_um * np.clip(1.5 - np.abs(off) / (p.groove_wide_deg / 2.0), 0.0, 1.0)
        edge = radius + form
        return np.asarray(along + np.sqrt(edge**2 - across**2) - radius)
