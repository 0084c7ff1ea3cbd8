"""A robot's corrected geometry: each form is read by a little interpreter and compared with the twin at 1000 poses."""

from __future__ import annotations

import csv
import re
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.poses._chain import KNOWN, frames
from dtwin.kinds.poses._effects import EFFECTS, Poses, Term
from dtwin.kinds.poses._twins import PoseTwins
from dtwin.lifecycle.export import Export, export_twin

GEOMETRY = ["joint_zero@J2+J3+J4", "link_geometry@J2+J3"]
NAMES = [f"joint_{j}_deg" for j in range(1, 7)]
TOOL = np.array([12.0, -20.0, 80.0])


def joints(n: int, seed: int) -> np.ndarray:
    low, high = [-2, -2.2, -2.0, -2.5, -2.5, -2.5], [2, -0.6, 2.0, 2.5, 2.5, 2.5]
    return np.random.default_rng(seed).uniform(low, high, (n, 6))


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Home:
    """A home with twins of an arm whose joints and links are off by tenths of a millimetre and less."""
    folder = tmp_path_factory.mktemp("arm")
    q = joints(200, 3)
    real, off = KNOWN["ur10"].copy(), np.zeros(6)
    real[1] += [0.4, -0.3, 0.5e-3, 0.0]
    off[1:4] = 0.4e-3, -0.5e-3, 0.6e-3
    turned = q + off + 0.3e-3 * np.cos(2 * q) * [1, 0, 0, 1, 0, 0]
    point = frames(turned, real).tool_mm(TOOL)
    table = np.column_stack([np.degrees(q), point @ Rotation.from_euler("z", 40, degrees=True).as_matrix().T + 500.0])
    head = ",".join(["t_s", *NAMES, *(f"measured_{a}_mm" for a in "xyz")])
    rows = [",".join([str(n), *(f"{v:.9f}" for v in row)]) for n, row in enumerate(table)]
    (folder / "p.csv").write_text("\n".join([head, *rows]), encoding="utf-8")
    (folder / "campaign.toml").write_text(
        '[campaign]\nname = "c"\nmachine = "arm"\nkind = "poses"\n[campaign.machine_geometry]\nchain = "ur10"\n'
        '[[run]]\nid = "r"\nfile = "p.csv"\n',
        encoding="utf-8",
    )
    made = Home(folder / "home")
    twins = PoseTwins(made)
    twins.fit(str(folder), GEOMETRY, "plain")
    twins.fit("c", [*GEOMETRY, "joint_cyclic_2@J1+J4", "gravity_sag@J2"], "full")
    twins.fit("c", ["gravity_sag@J2"], "sag")
    return made


def foreseen(home: Home, name: str, q: np.ndarray, left_out: tuple[str, ...] = ()) -> tuple[np.ndarray, np.ndarray]:
    """Return where the twin says that the target goes, (n, 3), and the target in the flange's frame."""
    document = PoseTwins(home).newest(name).document
    at = frames(q, KNOWN["ur10"])
    tool = np.array(document["setup"]["tool_mm"])
    point = at.tool_mm(tool)
    poses = Poses(q, point, at, None, np.arange(len(q)))
    out = point.copy()
    for told in document["parameters"]:
        if told["value"] is not None and told["effect"] not in left_out:
            effect = EFFECTS[told["effect"]]
            number = [n for n, _ in effect.parameters].index(told["name"])
            out += (
                told["value"]
                * effect.columns(poses, point, Term(told["effect"], int(told["axis"][1:])).joint)[:, :, number]
            )
    change = np.array(document["setup"]["change"][6:9])
    return out + at.rotation[-1] @ change, tool + change


def made(home: Home, name: str, form: str) -> Export:
    found = export_twin(home, name, form)
    assert found is not None
    assert "never loaded into a robot's control" in found.text
    assert f"twin {name} version 1 of machine arm" in found.text
    return found


def turn(kind: str, angle: float) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3] = Rotation.from_euler(kind, angle).as_matrix()
    return out


def move(x: float, y: float, z: float) -> np.ndarray:
    out = np.eye(4)
    out[:3, 3] = x, y, z
    return out


def by_dh(text: str) -> Callable[[Any], np.ndarray]:
    # Standard and modified rows have the same names and mean different chains.
    assert "# standard (distal) rows, from the base on: Rz(q + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)" in text
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))

    def flange(q: Any) -> np.ndarray:
        here = np.eye(4)
        for angle, row in zip(q, rows, strict=True):
            a, d = float(row["a_mm"]), float(row["d_mm"])
            alpha, theta, beta = (np.radians(float(row[f"{n}_deg"])) for n in ("alpha", "theta", "beta"))
            here = here @ turn("z", angle + theta) @ move(0, 0, d) @ move(a, 0, 0) @ turn("x", alpha) @ turn("y", beta)
        return here

    return flange


def by_urdf(text: str) -> Callable[[Any], np.ndarray]:
    joint_of = {j.find("parent").get("link"): j for j in ElementTree.fromstring(text).iter("joint")}  # type: ignore[union-attr]

    def flange(q: Any) -> np.ndarray:
        here, link, angles = np.eye(4), "base_link", iter(q)
        while link in joint_of:
            joint = joint_of[link]
            origin = joint.find("origin")
            assert origin is not None
            xyz, (r, p, y) = ([float(v) for v in origin.get(name, "").split()] for name in ("xyz", "rpy"))
            here = here @ move(*(1000.0 * v for v in xyz)) @ turn("z", y) @ turn("y", p) @ turn("x", r)
            if joint.get("type") == "continuous":
                assert joint.find("axis").get("xyz") == "0 0 1"  # type: ignore[union-attr]
                here = here @ turn("z", next(angles))
            link = joint.find("child").get("link")  # type: ignore[union-attr]
        assert link == "flange"
        return here

    return flange


def by_python(text: str, tmp_path: Path) -> Callable[[Any], np.ndarray]:
    path = tmp_path / "arm.py"
    path.write_text(text, encoding="utf-8")
    code = runpy.run_path(str(path))
    return code["dtwin_full"]  # type: ignore[no-any-return]


def by_matlab(text: str) -> Callable[[Any], np.ndarray]:
    """Run the statements of the emitted subset: ``name = expression;`` with matrices, products, cos and sin."""
    head, *lines, end = (line for line in text.splitlines() if not line.startswith("%"))
    assert (head, end) == ("function t = dtwin_full(q)", "end")
    steps = []
    for line in lines:
        name, _, code = line.rstrip(";").partition(" = ")
        assert line.endswith(";")
        assert re.fullmatch(r"[\d.eE+\-*(),; \[\]aqt]+", re.sub(r"\b(cos|sin|eye)\b", "", code)), line
        code = re.sub(r"q\((\d)\)", lambda found: f"q[{int(found[1]) - 1}]", code)
        code = re.sub(r"\[([^\[\]]*;[^\[\]]*)\]", lambda found: f"array([[{found[1].replace(';', '],[')}]])", code)
        steps.append((name, code.replace("* array", "@ array")))

    def flange(q: Any) -> np.ndarray:
        known: dict[str, Any] = {"q": q, "cos": np.cos, "sin": np.sin, "eye": np.eye, "array": np.array}
        for name, code in steps:
            known[name] = eval(code, {}, known)  # noqa: S307 - checked above
        return known["t"]  # type: ignore[no-any-return]

    return flange


def off_um(flange: Callable[[Any], np.ndarray], q: np.ndarray, wanted: tuple[np.ndarray, np.ndarray]) -> float:
    point, tool = wanted
    got = np.array([(flange(row) @ [*tool, 1.0])[:3] for row in q])
    return float(1000.0 * np.linalg.norm(got - point, axis=1).max())


def test_every_form_goes_where_the_twin_says(home: Home, tmp_path: Path) -> None:
    q = joints(1000, 8)
    plain = foreseen(home, "plain", q)
    assert np.linalg.norm(plain[0] - frames(q, KNOWN["ur10"]).tool_mm(plain[1]), axis=1).max() > 0.5
    # The twin is linear in its parameters, a chain is not: some micrometres of a millimetre.
    assert off_um(by_dh(made(home, "plain", "dh").text), q, plain) < 5.0
    assert off_um(by_urdf(made(home, "plain", "urdf").text), q, plain) < 5.0
    full = foreseen(home, "full", q, ("gravity_sag",))
    python, matlab = made(home, "full", "python"), made(home, "full", "matlab")
    assert off_um(by_python(python.text, tmp_path), q, full) < 5.0
    assert off_um(by_matlab(matlab.text), q, full) < 5.0
    assert set(python.left_out) == {"gravity_sag@J2"}
    assert set(made(home, "full", "urdf").left_out) == {"gravity_sag@J2", "joint_cyclic_2@J1", "joint_cyclic_2@J4"}


def test_what_a_form_cannot_hold_is_refused(home: Home) -> None:
    with pytest.raises(InputError, match="nothing that this form holds"):
        export_twin(home, "sag", "urdf")
    with pytest.raises(InputError, match="not written in this form"):
        export_twin(home, "plain", "comp")
    with pytest.raises(InputError, match="of another machine"):
        export_twin(home, "plain", "urdf", "other")
    assert export_twin(home, "plain", "urdf", "arm") is not None
    assert export_twin(home, "latest", "urdf") is None


def test_what_poses_held_out_say_of_the_twin_is_written_beside_the_file(home: Home) -> None:
    twins = PoseTwins(home)
    twins.fit("c", GEOMETRY, "asked")
    assert (
        "not confirmed: dtwin twin diagnose asked has not been asked of this version" in made(home, "asked", "dh").notes
    )
    twins.diagnose("asked")
    notes = made(home, "asked", "dh").notes
    assert any(note.startswith("poses held out: mean error ") for note in notes)
    (doubt,) = [note for note in notes if note.startswith("not confirmed")]
    assert "need_repeats" in doubt
