"""A slide that is told tones, followed in time from its drive to the tool.

Shares nothing with ``dtwin.physics``: joints give way by powers, play is taken up by two edges,
drives lag, so that the laws of the library hold nearly, as on machines.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from numba import njit

from dtwin.schema import Campaign, Floats, Run, RunMeta

FREQUENCIES_HZ = (4.0, 12.0, 22.0, 34.0, 48.0, 64.0, 82.0)
AMPLITUDES_UM = (10.0, 30.0, 90.0)
REPEATS = 3
CHANNELS = ("humidity_pct", "supply_v", "oil_c")
_BEGUN = datetime(2026, 3, 2, 8, tzinfo=UTC)
_STEP_S = 1.0 / 16000.0
_STEPS = 24000
_KEPT = 4
_TIMES_S = _KEPT * _STEP_S * np.arange(_STEPS // _KEPT)
_SETTLED_S = 1.0
_HARMONICS = 7
_ROUNDS = 4
_SIGNED = ("short", "mode_share", "bend_s2", "lobe_um", "bowl_um")
# What the steps in time are told, in this order.
_HEALTHY = {
    "drive_hz": 90.0,
    "drive_damping": 0.4,
    "short": 0.0,
    "friction": 0.0,
    "presliding_um": 1.0,
    "play_um": 0.0,
    "mode_hz": 90.0,
    "mode_damping": 0.05,
    "mode_share": 0.0,
    "power": 0.0,
    "bend_s2": 0.0,
    "lobe_um": 0.0,
    "lobe_orders": 4.0,
    "bowl_um": 0.0,
}
Drawn = Mapping[str, tuple[float, float]]


@njit(cache=True, error_model="numpy")
def _followed(amplitude: float, rate: float, told: Floats, h: float, steps: int) -> Floats:
    """Return where the tool is, in um, when it is told amplitude sin(rate t)."""
    (
        drive_hz,
        damping,
        short,
        friction,
        presliding,
        play,
        mode_hz,
        mode_damping,
        share,
        power,
        bend,
        lobe,
        orders,
        bowl,
    ) = told
    stiff, mode = (2.0 * np.pi * drive_hz) ** 2, (2.0 * np.pi * mode_hz) ** 2
    damp, mode_damp = 4.0 * np.pi * damping * drive_hz, 4.0 * np.pi * mode_damping * mode_hz
    # Off: what the slide lacks or has beyond the command; a healthy one has nothing.
    off, off_v, force, torque, swing, swing_v = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    bristle, softer, near, far = 0.0, 0.0, 0.0, 0.0
    tool = np.empty(steps)
    for i in range(steps):
        turn = rate * i * h
        wanted, wanted_v = amplitude * np.sin(turn), amplitude * rate * np.cos(turn)
        wanted_a = -(rate**2) * wanted
        # Feed forward gives all that is needed but a share; the amplifier lags a little.
        torque += h / 2e-4 * (short * wanted_a - torque)
        if friction > 0.0:
            v = wanted_v + off_v
            # Two kinds of bristles bend.
            full = np.sign(v)
            bristle = full + (bristle - full) * np.exp(-h * abs(v) / presliding)
            softer = full + (softer - full) * np.exp(-h * abs(v) / (4.0 * presliding))
            force = friction * stiff * (0.9 * bristle + 0.1 * softer)
        a = -stiff * off - damp * off_v - torque - force
        off_v += h * a
        off += h * off_v
        x = wanted + off
        table = x
        if play > 0.0:
            # Two edges meet one after the other.
            near = max(x - 0.45 * play, min(x + 0.45 * play, near))
            far = max(x - 0.55 * play, min(x + 0.55 * play, far))
            table = 0.5 * (near + far)
        out = table
        if share != 0.0:
            # The drive pushes off from the frame that bears the tool.
            stiffer = (abs(swing) + 1e-3) ** power if power > 0.0 else 1.0
            swing_v += h * (-mode * stiffer * swing - mode_damp * swing_v - wanted_a - a)
            swing += h * swing_v
            out += share * swing
        # Lobes of a motor, and a probe that reads a bowl.
        tool[i] = out - bend * (wanted_a + a) + lobe * np.sin(orders * turn) + bowl * (x / 90.0) ** 2
    return tool


LATE = "late_s"
_LOOP, _PRESLIDING = {"drive_hz": (60.0, 140.0), "drive_damping": (0.25, 0.5)}, (0.5, 1.5)
_MODE = {"mode_hz": (85.0, 125.0), "mode_damping": (0.03, 0.08)}
_LOBES: Drawn = {"lobe_orders": (3.5, 6.5)}
# What is drawn, and which number it is that its size sets, with its unit.
LIBRARY: dict[str, tuple[Drawn, str, float]] = {
    "servo_response": (_LOOP, "short", 0.1),
    "structural_mode": (_MODE, "mode_share", 0.1),
    "stiffening_joint": (_MODE | {"power": (0.2, 0.4)}, "mode_share", 0.1),
    "guideway_friction": (_LOOP | {"presliding_um": _PRESLIDING}, "friction", 1.0),
    "backlash": ({}, "play_um", 1.0),
    "inertial_compliance": ({}, "bend_s2", 1e-6),
    "tracking_delay": ({}, LATE, 1e-4),
}
FOREIGN: dict[str, tuple[Drawn, str, float]] = {"lobes": (_LOBES, "lobe_um", 1.0), "one_sided": ({}, "bowl_um", 1.0)}
# At most one of each: the parts are there once, and what answers in proportion to the tone adds up to
# another loop or mode, which no tone tells from its parts (far below it, a mode is inertia and delay).
ONE_PART = (
    {"structural_mode", "stiffening_joint", "inertial_compliance", "tracking_delay"},
    {"servo_response", "inertial_compliance", "tracking_delay"},
    {"servo_response", "guideway_friction"},
)
_MACHINE_WIDE = ("inertial_compliance",)


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong, of any size.

    Attributes:
        label: The name that is right.
        drawn: What goes with it.
        sized: Number that the size sets.
        unit: Its value at a size of one.
    """

    label: str
    drawn: Mapping[str, float]
    sized: str
    unit: float

    def told(self, size: float) -> dict[str, float]:
        """Return what the slide is told."""
        return {**self.drawn, self.sized: size * self.unit}


def fault(name: str, rng: np.random.Generator) -> Fault:
    """Draw a fault by name."""
    ranges, sized, unit = (LIBRARY | FOREIGN)[name]
    drawn = {key: rng.uniform(*ends) for key, ends in ranges.items()}
    if "lobe_orders" in drawn:
        drawn["lobe_orders"] = round(drawn["lobe_orders"])
    known = name in LIBRARY and name not in _MACHINE_WIDE
    return Fault(f"{name} Z" if known else name, drawn, sized, unit)


def measured(
    faults: Sequence[Fault],
    sizes_um: Sequence[float],
    noise_um: float,
    rng: np.random.Generator,
    channel: tuple[str, float] | None = None,
) -> tuple[Campaign, list[Run]]:
    """Return a campaign of tones.

    Args:
        faults: What is wrong.
        sizes_um: RMS of what each alone shows over all tones.
        noise_um: RMS of what repeats disagree by.
        rng: Order, noise, what is logged.
        channel: A channel that the scale of the probe moves with, and the RMS of that.
    """
    told: dict[str, float] = {}
    for one, size_um in zip(faults, sizes_um, strict=True):
        told |= one.told(_size_of(one, size_um) * (rng.choice((-1.0, 1.0)) if one.sized in _SIGNED else 1.0))
    quiet = {key: _tone(told, *key) for key in itertools.product(FREQUENCIES_HZ, AMPLITUDES_UM)}
    order = [key for _ in range(REPEATS) for key in rng.permutation(list(quiet))]
    logged = {name: np.cumsum(rng.standard_normal(len(order))) for name in CHANNELS}
    logged = {name: (walk - walk.mean()) / walk.std() for name, walk in logged.items()}
    loudest = float(np.sqrt(0.5 * np.mean(np.square(AMPLITUDES_UM))))
    runs, seen = [], dict.fromkeys(quiet, 0)
    for number, (frequency_hz, amplitude_um) in enumerate(order):
        key = float(frequency_hz), float(amplitude_um)
        seen[key] += 1
        command, tool = quiet[key]
        tool = tool + _noise(key[0], noise_um, rng)
        if channel is not None:
            tool = tool + logged[channel[0]][number] * channel[1] / loudest * command
        covariates = {name: float(50.0 + 5.0 * walk[number]) for name, walk in logged.items()}
        meta = RunMeta(
            f"r{number + 1:03d}",
            kind="sinusoidal",
            repeat=seen[key],
            covariates=covariates,
            condition={"axis": "Z", "frequency_hz": key[0], "amplitude_um": key[1]},
            started=(_BEGUN + timedelta(seconds=20.0 * number)).isoformat(),
        )
        samples = {"t_s": _TIMES_S, "cmd_z_mm": 1e-3 * command, "tool_z_mm": 1e-3 * tool}
        runs.append(Run(meta, samples))
    return Campaign("tones", "virtual-slide", kind="sinusoidal"), runs


def _tone(told: Mapping[str, float], frequency_hz: float, amplitude_um: float) -> tuple[Floats, Floats]:
    """Return command and tool in um, at the kept times."""
    values = np.array([told.get(name, usual) for name, usual in _HEALTHY.items()])
    rate = 2.0 * np.pi * frequency_hz
    tool = _followed(amplitude_um, rate, values, _STEP_S, _STEPS)
    times_s = _STEP_S * np.arange(_STEPS)
    tool = np.interp(times_s - told.get(LATE, 0.0), times_s, tool)
    return amplitude_um * np.sin(rate * _TIMES_S), tool[::_KEPT]


def _size_of(one: Fault, wanted_um: float) -> float:
    """Return the size at which a fault alone shows with this RMS."""
    size = 1.0
    for _ in range(_ROUNDS):
        told = one.told(size)
        size *= wanted_um / max(_shows_um(told), 1e-9)
    return size


def _shows_um(told: Mapping[str, float]) -> float:
    power = []
    for key in itertools.product(FREQUENCIES_HZ, AMPLITUDES_UM):
        command, tool = _tone(told, *key)
        power.append(np.var((tool - command)[_TIMES_S >= _SETTLED_S]))
    return float(np.sqrt(np.mean(power)))


def _noise(frequency_hz: float, rms_um: float, rng: np.random.Generator) -> Floats:
    """Return what repeats disagree by: a hum in step with the tone, and the probe."""
    weights = 1.0 / np.sqrt(1.0 + np.arange(_HARMONICS + 1))
    weights *= rms_um / np.linalg.norm(weights)
    sine, cosine = weights * rng.standard_normal((2, _HARMONICS + 1))
    turn = 2.0 * np.pi * frequency_hz * _TIMES_S
    out = cosine[0] + rms_um * rng.standard_normal(_TIMES_S.size)
    for h in range(1, _HARMONICS + 1):
        out += cosine[h] * np.cos(h * turn) + sine[h] * np.sin(h * turn)
    return out
