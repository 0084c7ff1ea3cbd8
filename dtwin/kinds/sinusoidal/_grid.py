"""Tests that command a tone, as what the tool does over the phase of the command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.physics.grid import Grid, OneAxis, PathCondition, Row
from dtwin.physics.state import State
from dtwin.schema import Floats, Run, RunMeta
from dtwin.units import UM_PER_MM, shown_number

# Harmonics 0 to 7 of the tone: as many points as numbers, so that none is made up.
_HARMONICS = 7
_POINTS = 2 * _HARMONICS + 1
_FINE = 64
# What has not settled is left out: a second, of short runs half, but never so much that no period is left.
_SETTLING_S, _SETTLING = 1.0, 0.5
# The last sample of a period is not its end.
_WHOLE = 0.9
_NOT_LOGGED = ("cmd_", "act_", "tool_", "t_s")


@dataclass(frozen=True)
class ToneCondition(OneAxis):
    """A tone on an axis."""

    amplitude_um: float
    frequency_hz: float

    @property
    def radius_mm(self) -> float:
        """Amplitude."""
        return self.amplitude_um / UM_PER_MM

    @property
    def feed_mm_min(self) -> float:
        """Highest speed."""
        return 120.0 * np.pi * self.frequency_hz * self.radius_mm

    @property
    def direction(self) -> str:
        """Both: a tone goes there and back."""
        return "both"

    @property
    def sense(self) -> float:
        """The phase rises in every run."""
        return 1.0

    @property
    def turned(self) -> None:
        """There is no other sense."""
        return

    @property
    def swept(self) -> Mapping[str, float]:
        """What campaigns change."""
        return {"frequency": self.frequency_hz, "amplitude": self.amplitude_um}

    @property
    def seconds(self) -> float:
        """Time of a run."""
        return 6.0

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return dict(vars(self))

    def __str__(self) -> str:
        """Return it as people write it."""
        return f"{self.axis} {self.frequency_hz:g} Hz {self.amplitude_um:g} µm"


def tone_rows(runs: Sequence[Run], times_h: Sequence[float]) -> tuple[Grid, list[Row]]:
    """Return the grid of tones, and runs on it."""
    return TONE, [tone_row(run, time_h) for run, time_h in zip(runs, times_h, strict=True)]


def tone_row(run: Run, time_h: float) -> Row:
    """Reduce a run of a tone to what the tool does beyond the command, over its phase.

    ``run``: with ``t_s``, and command and tool of the axis, ``cmd_z_mm`` and ``tool_z_mm`` for Z.
    Raises ``InputError`` when columns or the tone are missing, there are too few samples in a period, or no whole one.
    """
    condition = _condition(run)
    names = [f"{part}_{condition.axis.lower()}_mm" for part in ("cmd", "tool")]
    if not {"t_s", *names} <= set(run.samples):
        raise InputError(
            "a twin of tones needs the time, the command and what the tool did",
            code="twin.columns",
            where=f"run {run.meta.run_id}",
            got=", ".join(run.samples),
            allowed=f"t_s, {', '.join(names)}",
        )
    read = np.stack([np.asarray(run.samples[n], dtype=float) for n in ("t_s", *names)])
    # A sample that was lost tells nothing, and the others tell the tone without it.
    t_s, command, tool = read[:, np.isfinite(read).all(axis=0)]
    used = t_s >= _settled_s(t_s, condition.frequency_hz)
    if used.sum() < 2 * _POINTS or _rate_hz(t_s) < _POINTS * condition.frequency_hz:
        raise InputError(
            "a tone has too few samples for its harmonics",
            code="twin.short",
            where=f"run {run.meta.run_id}",
            got=f"{int(used.sum())} samples once it has settled, "
            f"{_rate_hz(t_s) / condition.frequency_hz:z.1f} in a period",
            allowed=f"at least {_POINTS} in a period",
        )
    t_s, command, tool = t_s[used], command[used] * UM_PER_MM, tool[used] * UM_PER_MM
    if np.ptp(t_s) < _WHOLE / condition.frequency_hz:
        raise InputError(
            "a tone is shorter than its period",
            code="twin.short",
            where=f"run {run.meta.run_id}",
            got=f"{shown_number(np.ptp(t_s))} s of {condition.frequency_hz:g} Hz",
            allowed=f"at least {shown_number(1.0 / condition.frequency_hz)} s",
        )
    turn = 2.0 * np.pi * condition.frequency_hz * t_s
    sine, cosine = np.linalg.lstsq(
        np.stack([np.sin(turn), np.cos(turn), np.ones_like(turn)], axis=1), command, rcond=None
    )[0][:2]
    phase = turn + np.arctan2(cosine, sine)
    fitted = np.linalg.lstsq(_waves(phase), tool - command, rcond=None)[0]
    logged = {n: np.asarray(v, dtype=float) for n, v in run.samples.items() if not n.startswith(_NOT_LOGGED)}
    means = {n: float(np.mean(v[np.isfinite(v)])) for n, v in logged.items() if np.isfinite(v).any()}
    columns = {"time_h": time_h, **run.meta.covariates, **means}
    y_um = _waves(_phases(_POINTS)) @ fitted
    mask = np.ones(_POINTS, dtype=bool)
    return Row(run, condition, y_um, mask, columns, condition.feed_mm_min / 60.0)


def _rate_hz(t_s: Floats) -> float:
    """Return the samples in a second, of times of shape (n,)."""
    return (len(t_s) - 1) / max(float(np.ptp(t_s)), 1e-300) if len(t_s) else 0.0


def _settled_s(t_s: Floats, frequency_hz: float) -> float:
    """Return the time from which a tone counts as settled, of times of shape (n,)."""
    if not len(t_s):
        return 0.0
    length_s = float(t_s[-1] - t_s[0])
    return float(t_s[0]) + max(0.0, min(_SETTLING_S, _SETTLING * length_s, length_s - 1.0 / frequency_hz))


def _condition(run: Run) -> ToneCondition:
    stated = run.meta.condition
    axis = str(stated.get("axis", ""))
    numbers = [stated.get(name) for name in ("amplitude_um", "frequency_hz")]
    good = [float(v) for v in numbers if isinstance(v, int | float) and 0.0 < v < np.inf]
    if axis not in ("X", "Y", "Z") or len(good) < 2:
        raise InputError(
            "a twin of tones needs axis, amplitude and frequency of every run",
            code="twin.condition",
            where=f"run {run.meta.run_id}",
            got=f"axis {axis or 'not stated'}, amplitude_um, frequency_hz = {numbers}",
            allowed="X, Y or Z, and positive numbers under [run.condition]",
        )
    return ToneCondition(axis, *good)


def _phases(n: int) -> Floats:
    return np.asarray((np.arange(n) + 0.5) * (2.0 * np.pi / n), dtype=np.float64)


def _waves(phase: Floats) -> Floats:
    parts = [f(h * phase) for h in range(1, _HARMONICS + 1) for f in (np.cos, np.sin)]
    return np.stack([np.ones_like(phase), *parts], axis=1)


def _state(meta: RunMeta, condition: PathCondition, feed_mm_s: float, geometry: Mapping[str, Any]) -> State:
    phase = _phases(_POINTS * _FINE)
    (axis,) = condition.axes
    size = condition.radius_mm
    rate_rad_s = feed_mm_s / size
    sine, cosine = np.sin(phase), np.cos(phase)
    # The axis is furthest out a quarter and three quarters of the way.
    turned = (phase - 0.5 * np.pi) % (2.0 * np.pi)
    return State(
        kind="sinusoidal",
        axes=(axis,),
        plane="",
        position_mm={axis: size * sine},
        velocity_mm_s={axis: feed_mm_s * cosine},
        acceleration_mm_s2={axis: -rate_rad_s * feed_mm_s * sine},
        sensitivity={axis: np.ones_like(phase)},
        since_reversal_s={axis: (turned % np.pi) / rate_rad_s},
        last_end={axis: np.where(turned < np.pi, 1.0, -1.0)},
        angle_rad=phase,
        radius_mm=size,
        feed_mm_s=feed_mm_s,
        direction=1.0,
        geometry=geometry,
    )


# What a run is reduced to is also what an effect is reduced to.
_REDUCED = _waves(_phases(_POINTS)) @ np.linalg.pinv(_waves(_phases(_POINTS * _FINE)))


def _reduced(fine: Floats) -> Floats:
    return np.asarray(_REDUCED @ fine)


def _wave(harmonic: int) -> str:
    return f"harmonic {harmonic} of the tone" if harmonic else "a constant"


TONE = Grid(
    kind="sinusoidal",
    coordinate="phase_deg",
    points=np.degrees(_phases(_POINTS)),
    setup=np.ones((_POINTS, 1)),
    setup_names=("zero_um",),
    fine=_FINE,
    averaged=_reduced,
    state=_state,
    described=_HARMONICS,
    wave=_wave,
)
