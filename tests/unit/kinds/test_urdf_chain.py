"""Chains from a URDF: driven joint by joint by turns and shifts, beside the rows that were taken from it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dtwin.acquire.ingest import open_source
from dtwin.errors import InputError
from dtwin.kinds.poses._chain import fitted, frames
from dtwin.kinds.poses._data import _urdf_chain, chain_in

# Origins (m), turns (rad) and axes of six joints: crossing, skew, parallel, and one that lies on the one before.
ARMS = {
    "skew": [
        ((0, 0, 0.3), (0.1, 0.2, 0.3), (0, 0, 1)),
        ((0.2, 0.1, 0), (0.7, -0.4, 0.2), (0, 1, 0)),
        ((0.4, 0, 0.1), (-0.3, 0.5, 0.9), (1, 0, 0.2)),
        ((0.1, 0.3, 0), (1.1, 0.1, -0.6), (0, 0, -1)),
        ((0, 0.1, 0.2), (0.4, 0.8, 0.1), (0, 1, 1)),
        ((0.05, 0, 0.1), (0, 0.2, 0), (1, 0, 0)),
    ],
    "cobot": [
        ((0, 0, 0.089159), (0, 0, 0), (0, 0, 1)),
        ((0, 0.13585, 0), (0, 1.5707963, 0), (0, 1, 0)),
        ((0, -0.1197, 0.425), (0, 0, 0), (0, 1, 0)),
        ((0, 0, 0.39225), (0, 1.5707963, 0), (0, 1, 0)),
        ((0, 0.093, 0), (0, 0, 0), (0, 0, 1)),
        ((0, 0, 0.09465), (0, 0, 0), (0, 1, 0)),
    ],
    "wrist": [
        ((0, 0, 0.4), (0, 0, 0), (0, 0, 1)),
        ((0.1, 0, 0), (0, 0, 0), (0, 1, 0)),
        ((0, 0, 0.6), (0, 0, 0), (0, 1, 0)),
        ((0.5, 0, 0), (0, 0, 0), (1, 0, 0)),
        ((0, 0, 0), (0, 0, 0), (0, 1, 0)),
        ((0.1, 0, 0), (0, 0, 0), (1, 0, 0)),
    ],
}


def urdf(arm: list[tuple[tuple[float, ...], ...]], more: str = "") -> str:
    parts = ['<robot name="r"><link name="world"/><link name="l0"/>']
    parts.append('<joint name="f" type="fixed"><parent link="world"/><child link="l0"/><origin xyz="1 2 3"/></joint>')
    for n, (xyz, rpy, axis) in enumerate(arm):
        words = [" ".join(map(str, v)) for v in (xyz, rpy, axis)]
        parts.append(
            f'<joint name="j{n}" type="revolute"><origin xyz="{words[0]}" rpy="{words[1]}"/><parent link="l{n}"/>'
            f'<child link="l{n + 1}"/><axis xyz="{words[2]}"/><limit lower="-3" upper="3"/></joint><link name="l{n + 1}"/>'
        )
    return "".join([*parts, more, "</robot>"])


def driven_mm(arm: list[tuple[tuple[float, ...], ...]], q: np.ndarray, tool_mm: np.ndarray) -> np.ndarray:
    """Return where a point on the last link goes, (n, 3): each origin, then a turn about its axis."""
    out = []
    for row in q:
        at, turn = np.zeros(3), Rotation.identity()
        for angle, (xyz, rpy, axis) in zip(row, arm, strict=True):
            at = at + turn.apply(1000.0 * np.array(xyz))
            along = np.array(axis) / np.linalg.norm(axis)
            turn = turn * Rotation.from_euler("xyz", rpy) * Rotation.from_rotvec(angle * along)
        out.append(at + turn.apply(tool_mm))
    return np.array(out)


@pytest.mark.parametrize("name", ARMS)
def test_rows_from_a_urdf_move_the_tool_as_the_joints_do(name: str, tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    path.write_text(urdf(ARMS[name]), encoding="utf-8")
    rows = _urdf_chain(path)
    assert rows.shape == (6, 4)
    q = np.random.default_rng(1).uniform(-2.5, 2.5, (60, 6))
    point = driven_mm(ARMS[name], q, np.array([30.0, -20.0, 50.0]))
    at = frames(q, rows)
    setup = fitted(at, point)
    assert np.abs(setup.in_base(point) - at.tool_mm(setup.tool_mm)).max() < 1e-6


def test_a_campaign_names_its_urdf_and_needs_no_known_robot(tmp_path: Path) -> None:
    arm = ARMS["skew"]
    (tmp_path / "r.urdf").write_text(urdf(arm), encoding="utf-8")
    q = np.random.default_rng(2).uniform(-1.0, 1.0, (40, 6))
    table = np.column_stack([np.degrees(q), driven_mm(arm, q, np.zeros(3))])
    head = ",".join([*(f"joint_{n}_deg" for n in range(1, 7)), *(f"measured_{a}_mm" for a in "xyz")])
    (tmp_path / "p.csv").write_text("\n".join([head, *(",".join(map(repr, row.tolist())) for row in table)]), "utf-8")
    told = '[campaign]\nname = "c"\nmachine = "m"\nkind = "poses"\n[campaign.machine_geometry]\nurdf = "{}"\n'
    rest = '[[run]]\nid = "r"\nfile = "p.csv"\n'
    (tmp_path / "campaign.toml").write_text(told.format("r.urdf") + rest, encoding="utf-8")
    ((run,), _) = next(iter(open_source(tmp_path)[1]))
    np.testing.assert_allclose(chain_in(run), _urdf_chain(tmp_path / "r.urdf"), atol=1e-8)
    assert not [f for f in run.findings if f.severity == "error"]
    for name, code in (("../r.urdf", "campaign.escape"), ("none.urdf", "file.missing")):
        (tmp_path / "campaign.toml").write_text(told.format(name) + rest, encoding="utf-8")
        with pytest.raises(InputError) as caught:
            next(iter(open_source(tmp_path)[1]))
        assert caught.value.code == code


TWO = '<joint name="b" type="revolute"><parent link="world"/><child link="other"/><axis xyz="0 0 1"/></joint>'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<robot/>", "no joints"),
        ("<sdf/>", "a document of sdf"),
        (urdf(ARMS["skew"][:1]), "1 joints that turn"),
        (urdf(ARMS["skew"]).replace('"revolute"', '"prismatic"', 1), "prismatic"),
        (urdf(ARMS["skew"]).replace('axis xyz="0 1 1"', 'axis xyz="0 0 0"'), "without an axis"),
        (urdf(ARMS["skew"]).replace('xyz="0.4 0 0.1"', 'xyz="0.4 0"'), "0.4 0"),
        (urdf(ARMS["skew"]).replace('<parent link="world"/>', '<parent link="l6"/>'), "a circle of links"),
    ],
)
def test_what_is_no_chain_is_refused(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        _urdf_chain(path)
    assert said in str(caught.value.got)


def test_of_two_arms_one_is_named(tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    arm = ARMS["skew"][:2]
    second = urdf(arm).replace('name="r"', 'name="s"').replace('"l', '"k').replace('"j', '"i')
    inner = second.split("<link", 2)[2].split(">", 1)[1].removesuffix("</robot>").replace('"world"', '"l0"')
    path.write_text(urdf(arm, inner + TWO), encoding="utf-8")
    with pytest.raises(InputError, match="cannot be taken") as caught:
        _urdf_chain(path)
    assert "2 arms of 2 joints" in str(caught.value.got)
    assert _urdf_chain(path, "l2").shape == (2, 4)
    with pytest.raises(InputError) as unknown:
        _urdf_chain(path, "tool9")
    assert "k2" in str(unknown.value.allowed)
