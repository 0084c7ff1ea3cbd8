"""A robot's corrected geometry: Denavit-Hartenberg rows, URDF, and functions for Python, MATLAB and Octave.

Each is the chain ``Rz(q + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)`` joint by joint: the nominal row, joint zeros and link
geometry of the twin. The functions also hold errors that turn with a joint. Lengths are mm, in URDF m.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.poses._data import chain_in
from dtwin.kinds.poses._twins import PoseTwin, PoseTwins
from dtwin.lake.store import Lake
from dtwin.lifecycle.export import Export
from dtwin.schema import Floats
from dtwin.serve.graph_code import identifier
from dtwin.units import shown_number

_NOT_LOADED = "Read back by dtwin's own interpreter of this form; never loaded into a robot's control."
_CYCLIC = {"joint_cyclic_1": 1, "joint_cyclic_2": 2, "joint_cyclic_3": 3}
_COLUMN = {"length": 0, "offset": 1, "twist": 2, "tilt": 4}


@dataclass(frozen=True)
class _Arm:
    """``rows``, (joints, 5): a and d in mm, alpha, theta and beta in rad. ``waves``: joint, order, cosine, sine in rad."""

    name: str
    said: tuple[str, ...]
    rows: Floats
    waves: tuple[tuple[int, int, float, float], ...]

    def link(self, n: int) -> Floats:
        """Return the constant (4, 4) from a joint's turned frame to the next."""
        a, d, alpha, _, beta = self.rows[n]
        placed = np.eye(4)
        placed[:3, :3] = Rotation.from_euler("XY", [alpha, beta]).as_matrix()
        placed[:3, 3] = a, 0.0, d
        return placed


def export_twin(home: Home, twin: PoseTwin, form: str) -> Export:
    """Write the corrected geometry of a twin of poses.

    Raises ``InputError`` when the twin has nothing that the form holds.
    """
    write, waves = _FORMS[form]
    held = {"joint_zero", "link_geometry", *(_CYCLIC if waves else ())}
    left_out = {t.label: f"{form} does not hold it" for t in twin.terms if t.effect not in held}
    if len(left_out) == len(twin.terms):
        raise InputError(
            "the twin has nothing that this form holds",
            code="export.effects",
            where=f"twin {twin.name}",
            got=", ".join(twin.labels) or "no effects",
            allowed=", ".join(sorted(held)),
            hint="dtwin twin discover NAME",
        )
    run = next(iter(Lake(home.lake).iterate(twin.campaign)))
    arm = _arm(twin, chain_in(run), held)
    unknown = sum(p["value"] is None for p in twin.document["parameters"])
    notes = [_NOT_LOADED, *([f"{unknown} parameters cannot be told and are left as they were"] if unknown else [])]
    notes += _confirmed(home, twin)
    return Export(write(arm), {"joints": len(arm.rows)}, left_out, tuple(notes), twin.version, twin.machine)


def _confirmed(home: Home, twin: PoseTwin) -> list[str]:
    """Return what poses that were held out say of a twin, by its newest diagnosis where that is of this version."""
    figures = twin.figures
    told = [
        f"poses held out: mean error {shown_number(figures['mean_before_mm'])} -> {shown_number(figures['held_out_mean_mm'])} mm"
        " (unit of replication: the block of neighbouring poses)"
    ]
    kept = PoseTwins(home).kept_diagnosis(twin.name, twin.version)
    # Of a twin of several kinds the part that is of these poses.
    said = next(
        (one for one in (kept or {}).get("members", [kept]) if one and twin.campaign in one.get("of", twin.campaigns)),
        None,
    )
    if said is None:
        return [*told, f"not confirmed: dtwin twin diagnose {twin.name} has not been asked of this version"]
    if nested := said.get("nested_mean_mm"):
        told.append(f"poses held out of the choice of effects, too: {shown_number(nested)} mm")
    doubts = [] if said["verdict"] == "nothing_missing" else [f"{said['verdict']}: {said['headline']}"]
    doubts += [f"pays nothing beside the others: {', '.join(said['idle'])}"] if said["idle"] else []
    doubts += [f"small beside what no effect explains: {', '.join(small)}"] if (small := said.get("doubtful")) else []
    return [*told, *(f"not confirmed: {doubt}" for doubt in doubts)]


def _arm(twin: PoseTwin, chain: Floats, held: set[str]) -> _Arm:
    rows = np.column_stack([chain, np.zeros(len(chain))])
    waves: dict[tuple[int, int], list[float]] = {}
    for parameter in twin.document["parameters"]:
        effect, value = parameter["effect"], parameter["value"]
        if effect not in held or value is None:
            continue
        joint = int(parameter["axis"][1:]) - 1
        size = value if parameter["unit"] == "mm" else 1e-3 * value
        if effect in _CYCLIC:
            pair = waves.setdefault((joint, _CYCLIC[effect]), [0.0, 0.0])
            pair[parameter["name"] == "sine"] += size
        else:
            rows[joint, 3 if effect == "joint_zero" else _COLUMN[parameter["name"]]] += size
    setup = twin.document["setup"]
    tool = np.array(setup["tool_mm"]) + np.array(setup["change"][6:9])
    said = (
        f"dtwin: twin {twin.name} version {twin.version} of machine {twin.machine}, campaign {twin.campaign}",
        _NOT_LOADED,
        "the measured target in the flange's frame, mm: " + ", ".join(f"{v:z.4f}" for v in tool),
    )
    name = f"dtwin_{identifier(twin.name).strip('_').lower()}"
    turning = tuple((joint, order, pair[0], pair[1]) for (joint, order), pair in waves.items())
    return _Arm(name, said, rows, turning)


def _dh(arm: _Arm) -> str:
    """Return CSV; ``beta_deg`` is a turn about y after alpha, which plain rows have not."""
    rows = np.column_stack([arm.rows[:, :2], np.degrees(arm.rows[:, 2:])])
    order = "standard (distal) rows, from the base on: Rz(q + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta), q as the control shows it"
    lines = [*(f"# {line}" for line in (*arm.said, order)), "joint,a_mm,d_mm,alpha_deg,theta_deg,beta_deg"]
    lines += [",".join([str(n), *(f"{v:z.9f}" for v in row)]) for n, row in enumerate(rows, start=1)]
    return "\n".join(lines) + "\n"


def _urdf(arm: _Arm) -> str:
    robot = ElementTree.Element("robot", name=arm.name)
    names = ["base_link", *(f"link_{n}" for n in range(1, len(arm.rows) + 1)), "flange"]
    for name in names:
        ElementTree.SubElement(robot, "link", name=name)
    before = np.eye(4)
    for n, (parent, child) in enumerate(pairwise(names)):
        last = n == len(arm.rows)
        joint = ElementTree.SubElement(
            robot,
            "joint",
            name=f"joint_{n + 1}" if not last else "flange_joint",
            type="fixed" if last else "continuous",
        )
        turn = 0.0 if last else arm.rows[n, 3]
        rotation = Rotation.from_matrix(before[:3, :3]) * Rotation.from_euler("z", turn)
        xyz, rpy = (" ".join(f"{v:z.12f}" for v in row) for row in (before[:3, 3] / 1000.0, rotation.as_euler("xyz")))
        ElementTree.SubElement(joint, "origin", xyz=xyz, rpy=rpy)
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=child)
        if not last:
            ElementTree.SubElement(joint, "axis", xyz="0 0 1")
            before = arm.link(n)
    ElementTree.indent(robot)
    head = "".join(f"<!-- {line.replace('--', '- -')} -->\n" for line in arm.said)
    return f'<?xml version="1.0"?>\n{head}{ElementTree.tostring(robot, encoding="unicode")}\n'


def _steps(arm: _Arm, joint: Callable[[int], str], matrix: Callable[[Sequence[Sequence[str]]], str]) -> list[list[str]]:
    """Return for each joint the angle, its turn and the link as expressions of a language."""
    steps = []
    for n, row in enumerate(arm.rows):
        angle = f"{joint(n)} + {row[3]:.15g}"
        for at, order, cosine, sine in arm.waves:
            if at == n:
                angle += f" + {cosine:.15g}*cos({order}*{joint(n)}) + {sine:.15g}*sin({order}*{joint(n)})"
        turn = matrix([["cos(a)", "-sin(a)", "0", "0"], ["sin(a)", "cos(a)", "0", "0"], list("0010"), list("0001")])
        steps.append([angle, turn, matrix([[f"{v + 0.0:.15g}" for v in line] for line in arm.link(n)])])
    return steps


def _python(arm: _Arm) -> str:
    def matrix(rows: Sequence[Sequence[str]]) -> str:
        return "array([" + ", ".join(f"[{', '.join(row)}]" for row in rows) + "])"

    lines = [*(f"# {line}" for line in arm.said), "from numpy import array, cos, eye, sin", "", ""]
    lines += [
        f"def {arm.name}(q):",
        '    """Return the flange in the base frame, (4, 4) in mm, of joint angles in rad."""',
    ]
    lines.append("    t = eye(4)")
    for angle, turn, link in _steps(arm, lambda n: f"q[{n}]", matrix):
        lines += [f"    a = {angle}", f"    t = t @ {turn} @ {link}"]
    return "\n".join([*lines, "    return t", ""])


def _matlab(arm: _Arm) -> str:
    def matrix(rows: Sequence[Sequence[str]]) -> str:
        return "[" + "; ".join(", ".join(row) for row in rows) + "]"

    lines = [f"function t = {arm.name}(q)", "% Flange in the base frame, 4 by 4 in mm, of joint angles in rad."]
    lines += [*(f"% {line}" for line in arm.said), "t = eye(4);"]
    for angle, turn, link in _steps(arm, lambda n: f"q({n + 1})", matrix):
        lines += [f"a = {angle};", f"t = t * {turn} * {link};"]
    return "\n".join([*lines, "end", ""])


_FORMS: Mapping[str, tuple[Callable[[_Arm], str], bool]] = {
    "urdf": (_urdf, False),
    "dh": (_dh, False),
    "python": (_python, True),
    "matlab": (_matlab, True),
}
"""Writers, and whether they hold errors that turn with a joint."""
