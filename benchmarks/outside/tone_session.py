"""A session in which the outside slide is told tones: which, in which order, and what encoder and probe show."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from scipy.signal import lfilter
from tone_faults import ORDER, POOL, SEEN_BY_ENCODER, UNKNOWN, Design, Fault, drawn

from dtwin.schema import Campaign, Floats, Run, RunMeta

_BEGUN = datetime(2026, 3, 2, 8, tzinfo=UTC)
_SEED = 1311
# What a row is to the random numbers.
_STREAMS: Mapping[str, int] = {"null": 0, "single": 1, "triple": 2, "unknown": 3}
# The zero of the probe, which is not asked for, but rightly called a drift.
_DRIFTING = Fault("zero drift", "probe", frozenset(), frozenset(["thermal_drift"]), lambda x: x)
_PAUSE_S, _MAINS_HZ, _SLOW_S = 8.0, 50.0, 0.3


@dataclass(frozen=True)
class _Type:
    """What is drawn of a type of slide."""

    lowest_hz: float
    highest_hz: tuple[float, ...]
    amplitude_um: tuple[float, float]
    loop_hz: float
    seconds: tuple[float, ...]
    rate_hz: tuple[float, ...]
    noise_um: tuple[float, ...]
    warm_s: float
    digits: int = 1


_TYPES: Mapping[str, _Type] = {
    "slow tool": _Type(
        1.0, (20.0, 40.0, 60.0), (1.0, 12.0), 12e3, (2.0, 4.0, 6.0), (1e3, 2e3, 3e3), (0.002, 0.005, 0.01, 0.03), 1.5
    ),
    "stage": _Type(0.5, (5.0, 10.0, 20.0), (50.0, 2000.0), 6e3, (4.0, 6.0), (500.0, 1e3), (0.03, 0.1, 0.3), 2.5),
    "fast tool": _Type(20.0, (100.0, 200.0), (2.0, 30.0), 40e3, (0.5, 1.0), (5e3, 10e3), (0.003, 0.01, 0.03), 0.25, 0),
}
_TURNS = ("slow tool", "slow tool", "stage", "fast tool", "slow tool")


@dataclass(frozen=True)
class Slide:
    """A slide that was measured; ``makes_um``: what each fault makes alone, RMS over all tones."""

    campaign: Campaign
    runs: Sequence[Run]
    faults: Sequence[Fault]
    makes_um: Sequence[float]
    noise_um: float


def slide(row: str, number: int) -> Slide:
    """Return a machine of a row; the same for the same number."""
    rng = np.random.default_rng([_SEED, _STREAMS[row], number])
    d = _design(_TYPES[_TURNS[number % len(_TURNS)]], rng)
    odd = (UNKNOWN[number % len(UNKNOWN)],) if row == "unknown" else ()
    if row == "single":
        mechanisms = [POOL[number % len(POOL)]]
    else:
        mechanisms = drawn({"null": 0, "triple": 3, "unknown": 1 + number % 2}[row], odd, rng)
    faults = [mechanism(d, rng) for mechanism in (*mechanisms, *odd)]
    told = _command_um(d)
    kept = (d.time_s >= 0.0) & (d.time_s <= d.seconds)
    makes_um = [float(np.sqrt(np.mean((fault.stage(told) - told)[kept] ** 2))) for fault in faults]
    name = f"{row}-{number}"
    campaign = Campaign(
        name,
        f"mc-{name}",
        kind="sinusoidal",
        started=_BEGUN.isoformat(),
        machine_geometry={},
        instrument={"model": "probe", "sample_rate_hz": d.rate_hz},
    )
    drift_um = float(rng.choice([0.0, 0.0, 1.0, 4.0])) * d.noise_um * float(rng.choice([-1.0, 1.0]))
    runs = _runs(d, told, faults, drift_um, rng)
    drifting = [_DRIFTING] if drift_um else []
    return Slide(campaign, runs, [*faults, *drifting], [*makes_um, *(0.0 for _ in drifting)], d.noise_um)


def _design(of: _Type, rng: np.random.Generator) -> Design:
    low, high = of.lowest_hz * float(rng.choice([1.0, 2.0, 4.0])), float(rng.choice(of.highest_hz))
    spaced = np.linspace if rng.random() < 0.5 else np.geomspace
    frequency_hz = np.unique(np.round(spaced(low, high, int(rng.integers(3, 9))), of.digits))
    count = int(rng.integers(1, 5))
    if count == 1:
        amplitude_um = np.array([math.sqrt(math.prod(of.amplitude_um)) * rng.uniform(0.7, 1.5)])
    else:
        amplitude_um = np.geomspace(*of.amplitude_um, count) * rng.uniform(0.8, 1.3)
    seconds = max(float(rng.choice(of.seconds)), 2.0 / frequency_hz.min())
    return Design(
        frequency_hz,
        np.array([float(f"{um:.2g}") for um in amplitude_um]),
        int(rng.integers(2, 6)),
        seconds,
        float(rng.choice(of.rate_hz)),
        of.loop_hz,
        float(rng.choice(of.noise_um)),
        bool(rng.random() < 2.0 / 3.0),
        max(of.warm_s, 1.5 / frequency_hz.min()),
    )


def _command_um(d: Design) -> Floats:
    """Return what is told, shape (n, tones): tones that grow from rest before the record begins."""
    t_s = d.time_s
    grown = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.clip(t_s + d.warm_s, 0.0, 0.5 * d.warm_s) / d.warm_s)
    frequency_hz, amplitude_um = d.tones.T
    return np.asarray(grown[:, None] * amplitude_um * np.sin(2.0 * np.pi * t_s[:, None] * frequency_hz))


def _followed(d: Design, told: Floats, faults: Sequence[Fault]) -> tuple[Floats, Floats]:
    """Return where the encoder and the probe see the slide, without noise."""
    encoder = x = told
    for where in ORDER:
        for fault in (f for f in faults if f.where == where):
            x = fault.stage(x)
        encoder = x if where in SEEN_BY_ENCODER else encoder
    return encoder, x


def _wandering(count: int, kept: float, rng: np.random.Generator) -> Floats:
    """Return numbers of unit variance of which each keeps a share of the one before."""
    begun = rng.normal(size=count)
    begun[0] /= math.sqrt(1.0 - kept * kept)
    return np.asarray(lfilter([math.sqrt(1.0 - kept * kept)], [1.0, -kept], begun))


def _runs(d: Design, told: Floats, faults: Sequence[Fault], drift_um: float, rng: np.random.Generator) -> list[Run]:
    encoder, probe = _followed(d, told, faults)
    wander, step_um = float(rng.choice([0.0, 0.001, 0.005])), 0.5 * d.noise_um * float(rng.choice([0.0, 1.0, 1.0]))
    white, slow, mains = (rng.uniform(0.5, 1.0), rng.uniform(0.0, 0.6), rng.uniform(0.0, 0.4))
    whole = d.noise_um / math.sqrt(white**2 + slow**2 + mains**2)
    tones = d.tones
    order = [rng.permutation(len(tones)) if d.at_random else np.arange(len(tones)) for _ in range(d.repeats)]
    todo = [(repeat, int(tone)) for repeat, of_repeat in enumerate(order, start=1) for tone in of_repeat]
    gain = 1.0 + wander * _wandering(len(todo), 0.8, rng)
    jumps_um = 0.3 * d.noise_um * rng.normal(size=len(todo))
    runs = []
    for n, (repeat, tone) in enumerate(todo):
        frequency_hz, amplitude_um = tones[tone]
        begins_s = rng.uniform(0.0, 1.0 / d.rate_hz)
        t_s = begins_s + np.arange(int(d.seconds * d.rate_hz) - 1) / d.rate_hz
        command_um = amplitude_um * np.sin(2.0 * np.pi * frequency_hz * t_s)
        off_um = np.interp(t_s, d.time_s, probe[:, tone] - told[:, tone]) * gain[n]
        seen_um = np.interp(t_s, d.time_s, encoder[:, tone] - told[:, tone]) * gain[n]
        noise_um = whole * (
            white * rng.normal(size=t_s.size)
            + slow * _wandering(t_s.size, math.exp(-1.0 / (_SLOW_S * d.rate_hz)), rng)
            + mains * math.sqrt(2.0) * np.sin(2.0 * np.pi * _MAINS_HZ * t_s + rng.uniform(0.0, 2.0 * np.pi))
        )
        settled = 1.0 - math.exp(-2.0 * n / max(1, len(todo) - 1))
        encoder_um = command_um + seen_um + 0.3 * d.noise_um * rng.normal(size=t_s.size)
        samples = {
            "t_s": t_s - begins_s,
            "cmd_z_mm": 1e-3 * command_um,
            "act_z_mm": 1e-3 * (np.round(encoder_um / step_um) * step_um if step_um else encoder_um),
            "tool_z_mm": 1e-3 * (command_um + off_um + noise_um + jumps_um[n] + drift_um * settled),
        }
        condition = {"axis": "Z", "frequency_hz": float(frequency_hz), "amplitude_um": float(amplitude_um)}
        started = (_BEGUN + timedelta(seconds=n * (d.seconds + _PAUSE_S))).isoformat()
        meta = RunMeta(f"g{n + 1}", kind="sinusoidal", condition=condition, repeat=repeat, started=started)
        runs.append(Run(meta, samples))
    return runs
