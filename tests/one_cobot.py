"""Tests of one cobot by three instruments: screws one after the other, which share no formula with what fits them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.linalg import expm

from dtwin.kinematics import UR10E
from dtwin.schema import Floats

CENTRE_MM, TOOL_MM = (550.0, -250.0, 300.0), (0.0, 0.0, 100.0)
_DOWN = np.diag([-1.0, 1.0, -1.0])
_ELBOW_UP = np.radians([-18.5, -86.3, 137.0, -140.7, -90.0, -108.5])
# Axes of a UR10e at rest and a point on each, mm: off the maker's drawing.
_AXES = np.array([[0, 0, 1], [0, -1, 0], [0, -1, 0], [0, -1, 0], [0, 0, -1], [0, -1, 0]], dtype=float)
_X = (0.0, 0.0, -612.7, -612.7 - 571.55)
_Y, _Z = (-174.15, -174.15 - 116.55), (180.7, 180.7 - 119.85)
_POINTS = np.array(
    [[0, 0, 0], [0, 0, _Z[0]], [_X[2], 0, _Z[0]], [_X[3], 0, _Z[0]], [_X[3], _Y[0], _Z[0]], [_X[3], _Y[0], _Z[1]]],
    dtype=float,
)


def tool_mm(joints_rad: Floats, tool: Floats | tuple[float, ...] = TOOL_MM, grown: float = 0.0) -> Floats:
    """Return tool points (n, 3) of a cobot whose links have all grown by a share."""
    size = 1.0 + grown
    # The flange of a UR at rest: its z is -y of the base, its y is z.
    end = np.array([_X[3], _Y[1], _Z[1]]) * size + np.array([tool[0], -tool[2], tool[1]])
    out = []
    for angles in joints_rad:
        here = np.eye(4)
        for axis, point, angle in zip(_AXES, _POINTS * size, angles, strict=True):
            x, y, z = axis
            screw = np.zeros((4, 4))
            screw[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
            screw[:3, 3] = -np.cross(axis, point)
            here = here @ expm(screw * angle)
        out.append((here @ [*end, 1.0])[:3])
    return np.array(out)


def write_circles(
    folder: Path,
    offsets_mrad: Floats,
    *,
    day: str,
    seed: int = 1,
    growth_um_m_k: float = 0.0,
    n: int = 90,
    centre_mm: tuple[float, float, float] = CENTRE_MM,
) -> Path:
    """Write circles of two planes, both ways, three of each, of a cobot whose joints stand off by so much."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    head = [
        "[campaign]",
        f'name = "{folder.name}"',
        'machine = "cobot-1"',
        'kind = "circular"',
        "[campaign.machine_geometry]",
        'type = "ur10e"',
        f"centre_mm = {list(centre_mm)}",
        f"tcp_mm = {list(TOOL_MM)}",
    ]
    angle = np.arange(n) * 2.0 * np.pi / n
    radius, number = 150.0, 0
    step_s = 2.0 * np.pi * radius / n / 25.0
    for plane in ("XY", "YZ"):
        a, b = ("XYZ".index(letter) for letter in plane)
        path = np.tile(centre_mm, (n, 1))
        path[:, a] += radius * np.cos(angle)
        path[:, b] += radius * np.sin(angle)
        joints = UR10E.inverse_many(path, _DOWN, np.array(TOOL_MM), _ELBOW_UP)
        there = tool_mm(joints + 1e-3 * offsets_mrad) - np.array(centre_mm)
        for repeat in (1, 2, 3):
            warm_c = 20.0 + 3.0 * np.sin(1.9 * number)
            # Where growth carries the centre, the ball is carried, too.
            grown = 1.0 + 1e-6 * growth_um_m_k * (warm_c - 20.0)
            length = 1e3 * (np.linalg.norm(there, axis=1) * grown - radius)
            for way in ("CCW", "CW"):
                number += 1
                turn = angle if way == "CCW" else angle[::-1]
                read = (length if way == "CCW" else length[::-1]) + rng.normal(0.0, 1.0, n)
                read += rng.normal(0.0, 0.5)
                rows = [
                    f"{step_s * i:.4f},{np.degrees(t):.4f},{um:.3f},{warm_c:.2f}"
                    for i, (t, um) in enumerate(zip(turn, read, strict=True))
                ]
                name = f"{plane}-{way}-{repeat}"
                text = "\n".join(["t_s,angle_deg,deviation_um,temperature_c", *rows])
                (folder / f"{name}.csv").write_text(text + "\n", encoding="utf-8")
                head += [
                    "[[run]]",
                    f'id = "{name}"',
                    f'file = "{name}.csv"',
                    f'plane = "{plane}"',
                    f'setup = "{plane}"',
                ]
                head += [f"radius_mm = {radius}", "feed_mm_min = 1500.0", f"repeat = {repeat}", f'direction = "{way}"']
                head += [f"started = {day}T10:{number:02d}:00"]
    (folder / "campaign.toml").write_text("\n".join(head) + "\n", encoding="utf-8")
    return folder


def write_poses(
    folder: Path, offsets_mrad: Floats, *, day: str, seed: int = 2, growth_um_m_k: float = 0.0, n: int = 150
) -> Path:
    """Write poses of the same cobot that a tracker measures, a fifth of them twice, while the room warms."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    one = rng.uniform([-2, -2.2, 0.4, -2.5, -2.5, -2.5], [2, -0.6, 2.2, 2.5, 2.5, 2.5], (n, 6))
    joints = np.concatenate([one, one[: n // 5]])
    warm_c = 19.0 + 4.0 * np.arange(len(joints)) / len(joints)
    grown = 1e-6 * growth_um_m_k * (warm_c - warm_c.mean())
    points = np.concatenate(
        [tool_mm(q[None] + 1e-3 * offsets_mrad, (20.0, 5.0, 80.0), g) for q, g in zip(joints, grown, strict=True)]
    )
    read = points + np.array([2000.0, -1500.0, 300.0]) + rng.normal(0.0, 0.02, points.shape)
    head = ["t_s", *(f"joint_{j}_deg" for j in range(1, 7)), *(f"measured_{a}_mm" for a in "xyz"), "ambient_c"]
    rows = [
        ",".join([f"{20 * i}", *(f"{v:.5f}" for v in np.degrees(q)), *(f"{v:.4f}" for v in p), f"{c:.2f}"])
        for i, (q, p, c) in enumerate(zip(joints, read, warm_c, strict=True))
    ]
    (folder / "poses.csv").write_text("\n".join([",".join(head), *rows]) + "\n", encoding="utf-8")
    toml = [
        "[campaign]",
        f'name = "{folder.name}"',
        'machine = "cobot-1"',
        'kind = "poses"',
        "[campaign.machine_geometry]",
        'chain = "ur10e"',
        "[[run]]",
        'id = "poses"',
        'file = "poses.csv"',
        f"started = {day}T09:00:00",
    ]
    (folder / "campaign.toml").write_text("\n".join(toml) + "\n", encoding="utf-8")
    return folder


def write_drift(folder: Path, *, day: str, frame_um_k: float = 4.0, motor_um_k: float = 1.5, seed: int = 3) -> Path:
    """Write a log of how far the flange stands off a fixed probe along Z, beside two temperatures that come and go."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    minutes = np.arange(0.0, 480.0, 2.0)
    frame_c, motor_c = (20.0 + np.cumsum(rng.normal(0.0, size, minutes.size)) for size in (0.2, 0.5))
    moved = frame_um_k * (frame_c - frame_c[0]) + motor_um_k * (motor_c - motor_c[0])
    lines = ["t_s,sample,displacement_um,temperature_frame_c,temperature_motor_c"]
    for i, (t, um, a, b) in enumerate(zip(minutes, moved, frame_c, motor_c, strict=True)):
        lines += [f"{60 * t + k:.0f},{i},{um + rng.normal(0.0, 0.3):.3f},{a:.3f},{b:.3f}" for k in (0, 1)]
    (folder / "log.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    toml = ["[campaign]", f'name = "{folder.name}"', 'machine = "cobot-1"', 'kind = "drift"', "[[run]]", 'id = "log"']
    toml += ['file = "log.csv"', f"started = {day}T07:00:00", 'condition = { axis = "Z" }']
    (folder / "campaign.toml").write_text("\n".join(toml) + "\n", encoding="utf-8")
    return folder
