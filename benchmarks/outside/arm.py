"""An outside arm that a tracker measures: links of six joints that are off by what mechanism makes of them.

No code and no formula is shared with dtwin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from exam import Cause, written_table

from dtwin.schema import Floats

_STREAMS = {"null": 0, "single": 1, "full": 2, "unknown": 3}
_OFF = ("turn", "length", "offset", "twist", "tilt")
_AXES = {"x": (0, 1, 2), "y": (1, 2, 0), "z": (2, 0, 1)}
_SAME = 0.8
"""Share of the squares of an error, beside frame and tool, from which on another name says the same."""


@dataclass(frozen=True)
class _Arm:
    """Rows of Denavit and Hartenberg (mm, rad), masses of links and of the load (kg), poses (rad, n x 6) and what was logged."""

    a: Floats
    d: Floats
    alpha: Floats
    theta: Floats
    mass: Floats
    tool: Floats
    q: Floats
    t_s: Floats
    room_c: Floats
    has_room: bool

    def at(self, **off: Floats) -> tuple[Floats, Floats]:
        """Return frames (7, n, 4, 4) and the places of the tool (n, 3, mm), links being off by ``off`` (n, 6)."""
        n = len(self.q)
        turn, length, offset, twist, tilt = (off.get(name, np.zeros((n, 6))) for name in _OFF)
        frames = [np.broadcast_to(np.eye(4), (n, 4, 4))]
        for k in range(6):
            link = _moved(z=self.d[k] + offset[:, k]) @ _moved(x=self.a[k] + length[:, k])
            bent = _turned("x", self.alpha[k] + twist[:, k]) @ _turned("y", tilt[:, k])
            frames.append(frames[-1] @ _turned("z", self.q[:, k] + self.theta[k] + turn[:, k]) @ link @ bent)
        return np.array(frames), np.asarray((frames[-1] @ np.append(self.tool, 1.0))[:, :3])

    def moved(self, **off: Floats) -> Floats:
        """Return how far links that are off move the tool, (n, 3), mm."""
        return self.at(**off)[1] - self.at()[1]

    def moment(self) -> Floats:
        """Return the moment of weight about each joint, (n, 6), N m."""
        frames, tool = self.at()
        middles = [0.5 * (frames[k, :, :3, 3] + frames[k + 1, :, :3, 3]) for k in range(6)] + [tool]
        out = np.zeros_like(self.q)
        for k in range(6):
            for mass, middle in list(zip(self.mass, middles, strict=True))[k:]:
                lever = 1e-3 * (middle - frames[k, :, :3, 3])
                out[:, k] += (frames[k, :, :3, 2] * np.cross(lever, [0.0, 0.0, -9.81 * mass])).sum(axis=1)
        return out

    def side(self) -> Floats:
        """Return from which side each joint came, (n, 6)."""
        return np.sign(np.diff(self.q, axis=0, prepend=0.0))


def _turned(axis: str, angle: Floats) -> Floats:
    angle = np.asarray(angle)
    out = np.zeros((*angle.shape, 4, 4))
    i, j, k = _AXES[axis]
    out[..., i, i] = out[..., 3, 3] = 1.0
    out[..., j, j] = out[..., k, k] = np.cos(angle)
    out[..., k, j] = np.sin(angle)
    out[..., j, k] = -np.sin(angle)
    return out


def _moved(*, x: Floats | float = 0.0, z: Floats | float = 0.0) -> Floats:
    out = np.zeros((*np.shape(x + np.asarray(z)), 4, 4))
    out[..., range(4), range(4)] = 1.0
    out[..., 0, 3], out[..., 2, 3] = x, z
    return out


def _at_joint(arm: _Arm, joint: int, values: Floats | float) -> Floats:
    out = np.zeros_like(arm.q)
    out[:, joint] = values
    return out


def _drawn_arm(rng: np.random.Generator) -> _Arm:
    size, half = rng.uniform(0.6, 1.4), 0.5 * np.pi
    if rng.random() < 0.5:
        a, d = np.array([0.0, -425, -392, 0, 0, 0]), np.array([120.0, 0, 0, 115, 100, 90])
        alpha, theta = half * np.array([1.0, 0, 0, 1, -1, 0]), np.zeros(6)
        ends = np.radians([[-120, 120], [-140, -40], [-130, 130], [-170, 100], [-150, -30], [-170, 170]])
    else:
        a, d = np.array([150.0, 600, 120, 0, 0, 0]), np.array([450.0, 0, 0, 640, 0, 120])
        alpha, theta = half * np.array([-1.0, 0, -1, 1, -1, 0]), half * np.array([0.0, -1, 0, 0, 0, 2])
        ends = np.radians([[-110, 110], [-40, 70], [-60, 60], [-150, 150], [-100, 100], [-170, 170]])
    mass = np.append(np.array([20, 12, 6, 3, 2, 0.5]) * size**2 * rng.uniform(0.7, 1.4, 6), rng.uniform(0.5, 6.0))
    tool = np.round(rng.uniform([-60, -60, 40], [60, 60, 160]), 1)
    tried = rng.uniform(ends[:, 0], ends[:, 1], (4000, 6))
    arm = _Arm(
        np.round(size * a, 1), np.round(size * d, 1), alpha, theta, mass, tool, tried, tried, tried, rng.random() < 0.7
    )
    frames, place = arm.at()
    free = (place[:, 2] > 60.0) & (np.hypot(*place[:, :2].T) > 250.0 * size) & (frames[3, :, 2, 3] > 0.0)
    return _measured(arm, tried[free], rng)


def _measured(arm: _Arm, q: Floats, rng: np.random.Generator) -> _Arm:
    """Return an arm that goes to some poses twice, to some thrice, or to thirty of many twice, each time in another order."""
    times = int(rng.integers(1, 4))
    many = int(rng.integers(*((100, 220), (45, 90), (32, 60))[times - 1]))
    orders = [rng.permutation(many) for _ in range(times)]
    told = np.concatenate([*orders, *([rng.choice(many, 30, replace=False)] if times == 1 else [])])
    t_s = np.cumsum(rng.uniform(8.0, 25.0) * rng.uniform(0.8, 1.3, told.size))
    room = rng.uniform(0.5, 3.0) * np.sin(t_s / rng.uniform(1200.0, 4600.0)) + rng.uniform(-1.0, 3.0) * t_s / t_s[-1]
    q = np.radians(np.round(np.degrees(q[told]), 4))
    return _Arm(arm.a, arm.d, arm.alpha, arm.theta, arm.mass, arm.tool, q, t_s, 21.0 + room, arm.has_room)


_Made = tuple[str, set[str], set[str], Floats]
"""A mechanism, its names, what else is true of an arm because of it, and how far it moves the tool (n, 3), mm."""
_Mechanism = Callable[[_Arm, np.random.Generator], _Made]


def _sized(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))


def _zero(arm: _Arm, rng: np.random.Generator) -> _Made:
    k = int(rng.integers(1, 5))
    return "zero", {f"joint_zero@J{k + 1}"}, set(), arm.moved(turn=_at_joint(arm, k, _sized(rng, 0.15e-3, 1.2e-3)))


def _link(arm: _Arm, rng: np.random.Generator) -> _Made:
    k, what = int(rng.integers(4)), str(rng.choice(_OFF[1:]))
    size = _sized(rng, 0.1, 0.7) if what in ("length", "offset") else _sized(rng, 0.15e-3, 1e-3)
    return f"link {what}", {f"link_geometry@J{k + 1}"}, set(), arm.moved(**{what: _at_joint(arm, k, size)})


def _encoder(arm: _Arm, rng: np.random.Generator) -> _Made:
    k, size = int(rng.integers(5)), rng.uniform(0.1e-3, 0.6e-3)
    angle = arm.q[:, k] + rng.uniform(0.0, 6.0)
    turn = _at_joint(arm, k, size * (np.sin(angle) + 0.08 * np.sin(2.0 * angle)))
    return "encoder", {f"joint_cyclic_1@J{k + 1}"}, {f"joint_cyclic_2@J{k + 1}"}, arm.moved(turn=turn)


def _gear(arm: _Arm, rng: np.random.Generator) -> _Made:
    k, size = int(rng.integers(5)), rng.uniform(0.1e-3, 0.5e-3)
    wave = np.sin(2.0 * arm.q[:, k] + rng.uniform(0.0, 6.0)) + 0.1 * np.sin(4.0 * arm.q[:, k])
    return "gear", {f"joint_cyclic_2@J{k + 1}"}, set(), arm.moved(turn=_at_joint(arm, k, size * wave))


def _sag(arm: _Arm, rng: np.random.Generator) -> _Made:
    gives = np.array([0.0, rng.uniform(1.5, 4.0), rng.uniform(2.0, 6.0), 0.0, 0.0, 0.0]) * 1e-6
    gives[3] = float(rng.choice([0.0, 5e-6]))
    return "sag", {"gravity_sag@J2", "gravity_sag@J3"}, set(), arm.moved(turn=gives * arm.moment())


def _play(arm: _Arm, rng: np.random.Generator) -> _Made:
    k = int(rng.choice([0, 3, 4]))
    turn = _at_joint(arm, k, -rng.uniform(0.05e-3, 0.4e-3) * arm.side()[:, k])
    return "play", {f"joint_reversal@J{k + 1}"}, set(), arm.moved(turn=turn)


def _grown(arm: _Arm, share: Floats) -> Floats:
    return arm.moved(length=share[:, None] * arm.a, offset=share[:, None] * arm.d)


def _room(arm: _Arm, rng: np.random.Generator) -> _Made:
    names = {"ambient_growth"} if arm.has_room else set()
    # On average the room is warmer or colder than at the first pose: links are longer or shorter. Without its sensor it is a drift.
    longer = {f"link_geometry@J{k + 1}" for k in range(6) if max(abs(arm.a[k]), abs(arm.d[k])) > 200.0}
    return (
        "room",
        names,
        longer | (set() if arm.has_room else {"setup_drift"}),
        _grown(arm, rng.uniform(15e-6, 24e-6) * (arm.room_c - arm.room_c[0])),
    )


def _creep(arm: _Arm, rng: np.random.Generator) -> _Made:
    gone = (1.0 - np.exp(-2.0 * arm.t_s / arm.t_s[-1])) if rng.random() < 0.5 else arm.t_s / arm.t_s[-1]
    shift = rng.normal(size=3)
    shift *= rng.uniform(0.05, 0.3) / np.linalg.norm(shift)
    return "creep", {"setup_drift"}, set(), gone[:, None] * (shift + np.cross(3e-5 * rng.normal(size=3), arm.at()[1]))


def _tipping(arm: _Arm, rng: np.random.Generator) -> _Made:
    place = arm.at()[1]
    tip = (
        rng.uniform(1e-6, 3e-6)
        * 9.81e-3
        * 0.5
        * arm.mass.sum()
        * np.stack([-place[:, 1], place[:, 0], 0.0 * place[:, 0]], 1)
    )
    return "tipping base", set(), {"gravity_sag@J2"}, np.cross(tip * [rng.uniform(0.2, 1.0), 1.0, 1.0], place)


def _cable(arm: _Arm, rng: np.random.Generator) -> _Made:
    q = arm.q[:, 0]
    taut = np.maximum(0.0, np.abs(q) - rng.uniform(0.3, 0.6) * np.abs(q).max())
    turn = _at_joint(arm, 0, -rng.uniform(0.3e-3, 1e-3) * np.sign(q) * taut**1.5)
    return "cable", set(), {f"joint_cyclic_{n}@J1" for n in (1, 2, 3)}, arm.moved(turn=turn)


def _flank(arm: _Arm, rng: np.random.Generator) -> _Made:
    moment = arm.moment()[:, 2]
    turn = rng.uniform(0.1e-3, 0.4e-3) * np.tanh(moment / (0.1 * np.abs(moment).max()))
    return "changed flank", set(), {"gravity_sag@J3"}, arm.moved(turn=_at_joint(arm, 2, turn))


def _teeth(arm: _Arm, rng: np.random.Generator) -> _Made:
    k, often = int(rng.integers(3)), float(rng.choice([7.0, 9.0, 11.0, 80.0]))
    turn = _at_joint(arm, k, rng.uniform(0.15e-3, 0.4e-3) * np.sin(often * arm.q[:, k]))
    return "teeth", set(), set(), arm.moved(turn=turn)


_POOL: Sequence[_Mechanism] = (_zero, _link, _encoder, _gear, _sag, _play, _room, _creep, _link)
_UNKNOWN: Sequence[_Mechanism] = (_tipping, _cable, _flank, _teeth)


def _span(arm: _Arm, name: str) -> list[Floats]:
    """Return what a name may do to the tool, each (3 n,)."""
    effect, _, joint = name.partition("@")
    if effect == "ambient_growth":
        return [_grown(arm, 1e-5 * (arm.room_c - arm.room_c[0])).ravel()]
    if effect == "setup_drift":
        gone = (arm.t_s / arm.t_s[-1])[:, None]
        return [(gone * one).ravel() for one in np.eye(3)] + [
            (gone * np.cross(1e-3 * one, arm.at()[1])).ravel() for one in np.eye(3)
        ]
    k = int(joint[1:]) - 1
    q = arm.q[:, k]
    if effect == "link_geometry":
        sizes = {"length": 0.1, "offset": 0.1, "twist": 1e-4, "tilt": 1e-4}
        return [arm.moved(**{what: _at_joint(arm, k, size)}).ravel() for what, size in sizes.items()]
    turns: list[Floats | float] = {
        "joint_zero": [1.0],
        "gravity_sag": [0.01 * arm.moment()[:, k]],
        "joint_reversal": [arm.side()[:, k]],
        **{f"joint_cyclic_{n}": [np.sin(n * q), np.cos(n * q)] for n in (1, 2, 3)},
    }[effect]
    return [arm.moved(turn=_at_joint(arm, k, 1e-4 * turn)).ravel() for turn in turns]


_NAMES = (
    "ambient_growth",
    "setup_drift",
    *(f"{effect}@J{k}" for effect in ("joint_zero", "link_geometry", "gravity_sag") for k in range(1, 7)),
    *(f"{effect}@J{k}" for effect in ("joint_reversal", "joint_cyclic_1", "joint_cyclic_2") for k in range(1, 7)),
)


def _left(columns: Floats, um: Floats) -> Floats:
    scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    return np.asarray(um - scaled @ np.linalg.lstsq(scaled, um, rcond=1e-10)[0])


def folder(row: str, number: int, where: Path) -> tuple[str, list[Cause], float]:
    """Write the campaign of an arm; return its name, what is wrong, and the noise (µm, RMS beside frame and tool)."""
    rng = np.random.default_rng([3103, _STREAMS[row], number])
    arm = _drawn_arm(rng)
    frames, place = arm.at()
    turns = [np.cross(1e-3 * one, place).ravel() for one in np.eye(3)]
    shifts = [np.tile(one, len(place)) for one in np.eye(3)]
    free = np.array([*shifts, *turns, *(frames[6, :, :3, i].ravel() for i in range(3))]).T
    pool = [_POOL[number % len(_POOL)]] if row == "single" else []
    wanted = {"null": 0, "single": 1, "full": 3 + number % 3, "unknown": 1 + number % 2}[row]
    while len(pool) < wanted:
        one = _POOL[int(rng.integers(len(_POOL)))]
        if one is _link or one not in pool:
            pool.append(one)
    pool += [_UNKNOWN[number % len(_UNKNOWN)]] if row == "unknown" else []
    made = [mechanism(arm, rng) for mechanism in pool]
    spans = {name: np.column_stack([free, *_span(arm, name)]) for name in _NAMES} if made else {}
    causes = []
    for kind, names, also, moved in made:
        alone = _left(free, moved.ravel())
        same = {n for n, span in spans.items() if np.sum(_left(span, alone) ** 2) < (1.0 - _SAME) * np.sum(alone**2)}
        causes.append(
            Cause(
                kind,
                frozenset(names | same if names else ()),
                frozenset(same | also),
                1e3 * float(np.sqrt(np.mean(alone**2))),
            )
        )
    noise = _noise(arm, place, rng)
    name = f"arm-{row}-{number}"
    _written(arm, place, place + noise + sum((moved for *_, moved in made), np.zeros_like(place)), name, where, rng)
    return name, causes, 1e3 * float(np.sqrt(np.mean(_left(free, noise.ravel()) ** 2)))


def _noise(arm: _Arm, place: Floats, rng: np.random.Generator) -> Floats:
    """Return what tracker and robot scatter by, (n, 3), mm: more across the beam than along it."""
    beam = place - rng.uniform([-3000, -2500, 0], [-1500, 2500, 1500])
    far = np.linalg.norm(beam, axis=1, keepdims=True)
    white = rng.normal(size=place.shape)
    along = (white * beam).sum(axis=1, keepdims=True) * beam / far**2
    seen = along * rng.uniform(0.003, 0.008) + (white - along) * far * rng.uniform(3e-6, 8e-6)
    return np.asarray(seen + arm.moved(turn=rng.uniform(3e-6, 15e-6) * rng.normal(size=arm.q.shape)))


def _written(arm: _Arm, place: Floats, seen: Floats, name: str, where: Path, rng: np.random.Generator) -> None:
    table = {f"joint_{k + 1}_deg": np.degrees(arm.q[:, k]) for k in range(6)}
    if rng.random() < 0.5:
        turned = _turned("z", rng.uniform(-3.0, 3.0))[:3, :3] @ _turned("x", 0.01 * rng.normal())[:3, :3]
        shown = seen @ turned.T + rng.uniform(-3000.0, 3000.0, 3)
        table |= {f"measured_{axis}_mm": shown[:, i] for i, axis in enumerate("xyz")}
    else:
        table |= {f"Soll {axis} [mm]": place[:, i] for i, axis in enumerate("XYZ")}
        table |= {f"Ist {axis} [mm]": seen[:, i] for i, axis in enumerate("XYZ")}
    table |= {"t_s": arm.t_s} | ({"ambient_c": np.round(arm.room_c, 2)} if arm.has_room else {})
    rows = [
        f"{{ a_mm = {arm.a[k]}, d_mm = {arm.d[k]}, alpha_deg = {np.degrees(arm.alpha[k]):.0f}, theta_deg = {np.degrees(arm.theta[k]):.0f} }}"
        for k in range(6)
    ]
    written_table(where / "poses.csv", table, german=bool(rng.random() < 0.5))
    (where / "campaign.toml").write_text(
        f'[campaign]\nname = "{name}"\nmachine = "m-{name}"\nkind = "poses"\n[campaign.machine_geometry]\ndh = [{", ".join(rows)}]\n'
        '[[run]]\nid = "tracker"\nfile = "poses.csv"\n'
    )
