"""A place of an outside machine that drifts while bodies warm and cool, each with its own courses and lags.

No code and no formula is shared with dtwin.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from exam import Cause, written_table

from dtwin.schema import Floats

_STREAMS = {"null": 0, "single": 1, "full": 2, "unknown": 3, "slip": 4}
_WAYS = ("follows", "lag", "two lags", "thermistor", "lag")
_NAMES = {"follows": "follows", "lag": "lag", "two lags": "second_lag", "thermistor": "sensor_curve"}
_ALSO = {"follows": (), "lag": ("follows", "second_lag"), "two lags": ("lag", "follows"), "thermistor": ("follows",)}
_GIVES = {"bed": 2.0, "column": 1.5, "spindle": 0.5, "motor": 0.3}


def late(values: Floats, tau_s: float, t_s: Floats) -> Floats:
    """Return values through a first-order lag."""
    out = np.array(values, dtype=np.float64)
    for i, kept in enumerate(np.exp(-np.diff(t_s) / tau_s), start=1):
        out[i] = kept * out[i - 1] + (1.0 - kept) * 0.5 * (values[i - 1] + values[i])
    return out


def wandering(t_s: Floats, tau_s: float, rng: np.random.Generator) -> Floats:
    """Return what wanders about zero and forgets within ``tau_s``, of unit variance."""
    out = rng.normal(size=t_s.size)
    for i, kept in enumerate(np.exp(-np.diff(t_s) / tau_s), start=1):
        out[i] = kept * out[i - 1] + np.sqrt(1.0 - kept**2) * out[i]
    return out


def _warmth(t_s: Floats, rng: np.random.Generator) -> dict[str, Floats]:
    """Return the temperatures of bodies while the spindle works in blocks, warms up, or cools down in a hall with days."""
    share, works = t_s / t_s[-1], np.zeros(t_s.size)
    kind = int(rng.integers(4))
    if kind < 2:
        ends = np.sort(rng.uniform(0.03, 0.95, 2 * int(rng.integers(3, 7)))).reshape(-1, 2)
        for begin, end in ends:
            works[(share > begin) & (share < end)] = rng.uniform(0.4, 1.0)
    else:
        works[(share > 0.03) & (share < (2.0 if kind == 2 else rng.uniform(0.45, 0.65)))] = rng.uniform(0.6, 1.0)
    heat = works**1.6
    day = rng.uniform(0.7, 3.0) * np.sin(2.0 * np.pi * (t_s / 86400.0 + rng.random()))
    room = 20.5 + day + 0.3 * wandering(t_s, 2400.0, rng)
    begin = rng.uniform(0.2, 0.6)
    flows = (share > begin) & (share < begin + rng.uniform(0.15, 0.4))
    fast, slow = late(heat, rng.uniform(300.0, 700.0), t_s), late(heat, rng.uniform(2500.0, 5000.0), t_s)
    out = {"room": room, "spindle": room + rng.uniform(8.0, 22.0) * (0.55 * fast + 0.45 * slow)}
    out["motor"] = room + rng.uniform(10.0, 30.0) * late(late(heat, 240.0, t_s), rng.uniform(1200.0, 2400.0), t_s)
    out["column"] = late(room, rng.uniform(3e3, 9e3), t_s) + rng.uniform(0.5, 2.5) * late(
        fast, rng.uniform(5e3, 9e3), t_s
    )
    out["bed"] = late(room, rng.uniform(9e3, 2e4), t_s) + rng.uniform(0.2, 1.0) * late(slow, 15e3, t_s)
    out["coolant"] = late(19.0 + 0.2 * wandering(t_s, 1500.0, rng) + rng.uniform(2.0, 6.0) * flows, 300.0, t_s)
    out["cabinet"] = room + 6.0 + 0.5 * wandering(t_s, 5e3, rng) + rng.uniform(1.0, 4.0) * late(heat > 0.0, 1800.0, t_s)
    out["ram"] = late(0.5 * (out["spindle"] + out["column"]) + 0.3 * wandering(t_s, 3e3, rng), 900.0, t_s)
    return out


def _unknown(number: int, t_s: Floats, warm_c: Floats, rng: np.random.Generator) -> tuple[str, Floats]:
    """Return what no effect describes: a body without a sensor (``warm_c``), a joint that sticks or has play, a mount that settles."""
    whole = rng.uniform(2.0, 4.0) * (warm_c - warm_c[0])
    at, out = 0.0, np.zeros(t_s.size)
    if number % 4 == 0:
        return "body without a sensor", rng.uniform(2.0, 5.0) * (late(warm_c, 1200.0, t_s) - warm_c[0])
    if number % 4 == 3:
        return "mount settles", rng.uniform(5.0, 15.0) * np.log1p(t_s / rng.uniform(300.0, 2000.0)) / np.log(
            t_s[-1] / 1e3
        )
    for i, there in enumerate(whole):
        if number % 4 == 1:
            hold = 0.25 * np.ptp(whole) + 0.3
            at = at if abs(there - at) <= hold else there - 0.3 * hold * np.sign(there - at)
        else:
            at = min(max(at, there - 0.15 * np.ptp(whole)), there + 0.15 * np.ptp(whole))
        out[i] = at
    return "sticks" if number % 4 == 1 else "play", out


def folder(row: str, number: int, where: Path) -> tuple[str, list[Cause], float]:
    """Write the campaign of a log; return its name, what is wrong, and the noise of a reading (µm)."""
    rng = np.random.default_rng([5120, _STREAMS[row], number])
    step_s, hours = float(rng.choice([60.0, 120.0, 180.0, 300.0])), float(rng.choice([10.0, 12.0, 24.0, 36.0]))
    t_s = np.arange(0.0, 3600.0 * hours, step_s)
    t_s[1:] += rng.uniform(-0.1, 0.1, t_s.size - 1) * step_s
    warm, noise_um = _warmth(t_s, rng), float(rng.choice([0.2, 0.4, 0.8, 1.5]))
    bodies = [str(one) for one in rng.permutation(list(warm))[: int(rng.integers(4, 8))]]
    read = {body: warm[body].copy() for body in bodies}
    many = {"null": 0, "single": 1, "full": 3 + number % 3, "unknown": 1 + number % 2, "slip": 2}[row]
    causes, moved = [], np.zeros(t_s.size)
    for body in bodies[:many]:
        way = _WAYS[number % 5] if row == "single" else str(rng.choice(_WAYS, p=[0.4, 0.2, 0.1, 0.1, 0.2]))
        acts = warm[body]
        for _ in range({"lag": 1, "two lags": 2}.get(way, 0)):
            acts = late(acts, rng.uniform(600.0, 5400.0) if way == "lag" else rng.uniform(900.0, 3600.0), t_s)
        if way == "thermistor":
            bent = (warm[body] - warm[body].mean()) ** 2 / max(float(np.ptp(warm[body])), 0.1)
            read[body] += float(rng.choice([-1.0, 1.0])) * rng.uniform(0.1, 0.25) * bent
        um = float(rng.choice([-1.0, 1.0])) * rng.uniform(1.0, 8.0) * _GIVES.get(body, 1.0) * (acts - warm[body][0])
        also = frozenset(f"{one}@{body}" for one in _ALSO[way])
        causes.append(Cause(way, frozenset([f"{_NAMES[way]}@{body}"]), also, float(um.std())))
        moved += um
    if row == "slip":
        read[bodies[0]] += (
            float(rng.choice([-1.0, 1.0])) * rng.uniform(1.5, 5.0) * (t_s > rng.uniform(0.3, 0.7) * t_s[-1])
        )
    if row == "unknown":
        body = next(one for one in warm if one not in bodies) if number % 4 == 0 else bodies[-1]
        kind, um = _unknown(number, t_s, warm[body], rng)
        # What sticks or has play follows its body; time alone says that something settles, or follows a body without a sensor.
        late_names = [f"{one}@{body}" for one in ("follows", "lag", "second_lag")]
        also = frozenset(late_names if number % 4 in (1, 2) else ["time alone"])
        causes.append(Cause(kind, frozenset(), also, float(um.std())))
        moved += um
    again, name, german = int(rng.integers(1, 4)), f"drift-{row}-{number}", bool(number % 2)
    at = np.repeat(np.arange(t_s.size), again)
    digit = float(rng.choice([0.01, 0.06, 0.1]))
    um = moved[at] + noise_um * rng.normal(size=at.size)
    columns = {"t_s": t_s[at] + 3.0 * (np.arange(at.size) % again), "Z [µm]" if german else "displacement_um": um}
    for body, values in read.items():
        shown = digit * np.round((values + 0.02 * rng.normal(size=t_s.size)) / digit)
        columns[f"{body} [°C]" if german else f"temperature_{body}_c"] = shown[at]
    written_table(where / "log.csv", columns | ({"sample": at} if again > 1 else {}), german=german)
    (where / "campaign.toml").write_text(
        f'[campaign]\nname = "{name}"\nmachine = "m-{name}"\nkind = "drift"\n[[run]]\nid = "night"\nfile = "log.csv"\n'
        'condition = { axis = "Z" }\n'
    )
    return name, causes, noise_um
