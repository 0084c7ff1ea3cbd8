"""Targets that are rewritten before they start: on the virtual cobot, and by the command."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from point_program import visit
from served_robot import MACHINE, bundle, promote
from typer.testing import CliRunner

from dtwin.commands import _exporting as exporting
from dtwin.config import home
from dtwin.errors import DtwinError
from dtwin.kinematics import UR10E
from dtwin.machines.cobot import ELBOW_UP_RAD, TOOL_DOWN, VirtualCobot
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.interface import Input, Output, SafetyLimits
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.targets import Target, TargetCorrection, TargetFrame

TCP_MM = np.array([0.0, 0.0, 158.3])
FEED = 3000.0
RADIUS_MM = 100.0


@pytest.fixture(scope="module")
def cobot() -> VirtualCobot:
    return VirtualCobot(seed=3)


def frame(cobot: VirtualCobot, **changes: object) -> TargetFrame:
    centre = cobot.centre_mm(RADIUS_MM)
    joints = UR10E.inverse(centre, TOOL_DOWN, TCP_MM, ELBOW_UP_RAD)
    return TargetFrame("XY", centre, joints, **changes)  # type: ignore[arg-type]


def on_circle(cobot: VirtualCobot, angles_rad: np.ndarray) -> np.ndarray:
    circle = np.column_stack([np.cos(angles_rad), np.sin(angles_rad), np.zeros(len(angles_rad))])
    return cobot.centre_mm(RADIUS_MM) + RADIUS_MM * circle


def radial_and_tangential_um(cobot: VirtualCobot, points: np.ndarray, nominal: np.ndarray) -> np.ndarray:
    """Error of every stop in its own axes, shape (n, 2)."""
    outward = (nominal - cobot.centre_mm(RADIUS_MM)) / RADIUS_MM
    around = np.cross([0.0, 0.0, 1.0], outward)
    error_um = 1e3 * (points - nominal)
    return np.column_stack([np.sum(error_um * outward, axis=1), np.sum(error_um * around, axis=1)])


def harmonics(angle: np.ndarray) -> np.ndarray:
    return np.column_stack([np.ones_like(angle)] + [f(k * angle) for k in (1, 2, 3) for f in (np.cos, np.sin)])


def learned(cobot: VirtualCobot) -> Bundle:
    """Two outputs, along and across the radius, fitted to stops of one session."""
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    nominal = on_circle(cobot, angles)
    reached = visit(cobot, nominal, centre_mm=cobot.centre_mm(RADIUS_MM), feed_mm_min=FEED, repeat=1)
    found = np.linalg.lstsq(harmonics(angles), radial_and_tangential_um(cobot, reached, nominal), rcond=None)[0]
    g = GraphBuilder()
    angle = g.input("path_angle_rad")
    terms = [1.0] + [g.apply(f, float(k) * angle) for k in (1, 2, 3) for f in ("cos", "sin")]
    outputs = {}
    for name, weights in zip(("radial_um", "tangential_um"), found.T, strict=True):
        total = float(weights[0]) + 0.0 * angle
        for weight, term in zip(weights[1:], terms[1:], strict=True):
            total = total + float(weight) * term
        outputs[name] = total
    return bundle(
        outputs=[Output("radial_um", "path_radial"), Output("tangential_um", "path_tangential")],
        tick_graph=g.graph(outputs),
        safety=SafetyLimits(clamp_um=800.0),
    )


def test_rewritten_targets_are_nearer_in_a_session_the_model_never_saw(cobot: VirtualCobot) -> None:
    correction = TargetCorrection(CompiledBundle(learned(cobot)), TCP_MM, frame(cobot))
    angles = np.linspace(0.1, 2.0 * np.pi + 0.1, 17, endpoint=False)
    nominal = on_circle(cobot, angles)
    made = list(correction.corrected(Target(str(i), p, FEED) for i, p in enumerate(nominal)))
    assert {one.reason for one in made} == {"ok"}
    sent = np.array([one.position_mm for one in made])

    def rms_um(targets: np.ndarray, repeat: int) -> float:
        reached = visit(cobot, targets, centre_mm=cobot.centre_mm(RADIUS_MM), feed_mm_min=1500.0, repeat=repeat)
        return float(np.sqrt(np.mean(radial_and_tangential_um(cobot, reached, nominal) ** 2)))

    before, after = rms_um(nominal, 2), rms_um(sent, 3)
    assert after < 0.7 * before, (before, after)
    wrong_way = rms_um(2.0 * nominal - sent, 4)
    assert wrong_way > 1.3 * before, "the sign does not matter: nothing was tested"


def test_the_correction_is_a_vector_in_the_right_frame(cobot: VirtualCobot) -> None:
    compiled = CompiledBundle(bundle())
    angle = 0.7
    target = on_circle(cobot, np.array([angle]))[0]
    plain = TargetCorrection(compiled, TCP_MM, frame(cobot)).correct(Target("a", target, FEED))
    inward = -24.0 * np.array([np.cos(angle), np.sin(angle), 0.0])
    np.testing.assert_allclose(plain.offset_um, inward, atol=1e-9)
    np.testing.assert_allclose(1e3 * (plain.position_mm - target), inward, atol=1e-6)
    turn, origin = np.radians(30.0), cobot.centre_mm(RADIUS_MM)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    in_feature = rotation.T @ (target - origin)
    own = frame(cobot, origin_mm=origin, rotation=rotation)
    featured = TargetCorrection(compiled, TCP_MM, own).correct(Target("a", in_feature, FEED))
    np.testing.assert_allclose(featured.offset_um, inward, atol=1e-9)
    np.testing.assert_allclose(rotation @ featured.position_mm + origin, plain.position_mm)


def test_a_target_outside_the_box_is_left_alone_and_said(cobot: VirtualCobot) -> None:
    g = GraphBuilder()
    speed = g.input("programmed_feed_mm_min")
    made = bundle(
        inputs=[Input("programmed_feed_mm_min", "mm/min", "path", 500.0, "path", 1000.0, 4000.0)],
        tick_graph=g.graph({"radial_error_um": 0.1 * speed}),
    )
    correction = TargetCorrection(CompiledBundle(made), TCP_MM, frame(cobot))
    target = on_circle(cobot, np.array([0.0]))[0]
    outside = correction.correct(Target("fast", target, 6000.0))
    assert (outside.reason, outside.offset_um.any()) == ("outside_box", False)
    clamped = correction.correct(Target("slow", target, 2000.0))
    assert clamped.reason == "clamped"
    assert np.linalg.norm(clamped.offset_um) == pytest.approx(40.0)


def run(*arguments: str) -> object:
    return CliRunner().invoke(exporting.app, ["robot-targets", *arguments])


def test_the_command_writes_what_is_to_be_sent(cobot: VirtualCobot, tmp_path: Path) -> None:
    promote(home())
    target = on_circle(cobot, np.array([0.0]))[0]
    given = tmp_path / "targets.csv"
    place = ",".join(f"{value:.4f}" for value in target)
    given.write_text(f"name,x_mm,y_mm,z_mm,feed_mm_min\npick,{place},1500\n", encoding="utf-8-sig")
    joints = ",".join(f"{value:.6f}" for value in np.degrees(frame(cobot).joints_rad))
    centre = ",".join(f"{value:g}" for value in cobot.centre_mm(RADIUS_MM))
    out = tmp_path / "corrected.csv"
    options = (f"--centre={centre}", f"--joints={joints}", f"--out={out}")
    result = run(str(given), *options)
    assert result.exit_code == 0, result  # type: ignore[attr-defined]
    assert MACHINE in result.stdout  # type: ignore[attr-defined]
    (row,) = csv.DictReader(out.open())
    assert float(row["x_mm"]) == pytest.approx(target[0] - 0.024)
    assert (row["name"], row["guard"], float(row["offset_x_um"])) == ("pick", "ok", -24.0)
    before = out.read_text()
    refused = run(str(given), *options)
    assert isinstance(refused.exception, DtwinError)  # type: ignore[attr-defined]
    assert out.read_text() == before
    read = given.read_text()
    lost = run(str(given), *options[:2], f"--out={given}", "--force")
    assert isinstance(lost.exception, DtwinError)  # type: ignore[attr-defined]
    assert given.read_text() == read


@pytest.mark.parametrize(
    "text",
    [
        "",
        "x\n1\n",
        "name,x_mm,y_mm,z_mm,feed_mm_min\n",
        "name,x_mm,y_mm,z_mm,feed_mm_min\na,1,2,nan,5\n",
        'name,x_mm,y_mm,z_mm,feed_mm_min\n"a\nb,900,0,0,9",1,2,3,100\n',
        "name,x_mm,y_mm,z_mm,feed_mm_min\na,1,5,2,3,100\n",
        "name,x_mm,y_mm,z_mm,feed_mm_min\n=cmd|' /C calc'!A0,1,2,3,100\n",
    ],
)
def test_unusable_targets_are_refused_by_name(tmp_path: Path, text: str) -> None:
    given = tmp_path / "targets.csv"
    given.write_text(text)
    result = run(str(given), "--centre=0,0,0", "--joints=0,0,0,0,0,0")
    assert isinstance(result.exception, DtwinError)  # type: ignore[attr-defined]
    assert result.exception.code == "targets.file"  # type: ignore[attr-defined]
    assert not (tmp_path / "corrected.csv").exists()
