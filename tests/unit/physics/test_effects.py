"""Every effect of the library: complete, finite, and true to the law that it declares."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.kinematics import UR10E
from dtwin.physics.effect import Effect, Instance
from dtwin.physics.library import Library, campaign_instances
from dtwin.physics.observations import observe
from dtwin.physics.state import AXES_OF, State, circular_state
from dtwin.physics.template import template
from dtwin.schema import Campaign, Direction, Floats, Plane, Run, RunMeta

LIBRARY = Library()
ROBOT = {"type": "ur10e", "centre_mm": [-550.0, 0.0, 300.0], "tcp_mm": [0.0, 0.0, 158.3]}
CANONICAL = [
    "centre_offset",
    "radius_offset",
    "scale_mismatch",
    "squareness",
    "straightness",
    "backlash",
    "lateral_play",
    "reversal_spike",
    "servo_mismatch",
    "servo_lag",
    "cyclic_error",
    "thermal_growth",
    "thermal_drift",
    "structural_resonance",
    "gravity_sag",
    "joint_reversal",
    "pitch_error",
    "lead_error",
    "inertial_compliance",
    "friction",
    "measurement_delay",
    "angular_error",
    "reversal_ringing",
    "axis_changeover",
    "stick_slip",
    "instrument_artefact",
]


def state(
    plane: Plane = "XY", direction: Direction = "CCW", radius_mm: float = 100.0, feed_mm_s: float = 50.0, n: int = 720
) -> State:
    meta = RunMeta("r", plane=plane, direction=direction, radius_mm=radius_mm, feed_mm_min=3000.0)
    angle = (np.arange(n) + 0.5) * 2 * np.pi / n
    columns = {
        "temperature_c": np.full(n, 23.0),
        "temperature_rise_c": np.full(n, 2.0),
        "abbe_offset_mm": np.full(n, 150.0),
        "time_h": np.full(n, 0.5),
        "setup_first_um": np.full(n, 40.0),
        "setup_second_um": np.full(n, -30.0),
    }
    return circular_state(meta, angle, feed_mm_s=feed_mm_s, columns=columns, geometry=ROBOT)


def everywhere(effect: Effect, planes: list[str]) -> list[Instance]:
    axes = sorted({a for p in planes for a in AXES_OF[p]})
    return campaign_instances({effect.name: effect}, effect.kinds[0], planes, axes, ROBOT)


def test_the_canonical_names_are_there() -> None:
    assert set(CANONICAL) <= set(LIBRARY)


@pytest.mark.parametrize("name", sorted(LIBRARY))
def test_an_effect_is_documented_and_finite_everywhere(name: str) -> None:
    effect = LIBRARY[name]
    for text in (
        effect.title,
        effect.meaning,
        effect.formula,
        effect.looks_like,
        effect.separate_by,
        effect.remedy,
        effect.reference,
    ):
        assert len(text) > 2
    assert all(other in LIBRARY for other in effect.confusables)
    assert name not in effect.confusables
    if "circular" not in effect.kinds:
        assert acts_along_an_axis(effect), "it never acts"
        return
    planes: list[Plane] = ["XY", "YZ", "ZX"]
    acting = 0
    for instance in everywhere(effect, list(planes)):
        for plane in planes:
            for direction in ("CCW", "CW"):
                way: Direction = "CCW" if direction == "CCW" else "CW"
                columns = effect.columns(state(plane, way), instance.axis, effect.start_shape)
                acting += int(np.abs(columns).max() > 0)
    assert acting > 0, "it never acts"


def acts_along_an_axis(effect: Effect) -> bool:
    """Tell whether an effect is finite and not zero on a travel or a tone, and zero elsewhere."""
    if effect.kinds[0] == "linear":
        t_s, position = np.arange(80.0), np.linspace(0.0, 50.0, 40)
        samples = {
            "t_s": t_s,
            "position_mm": np.concatenate([position, position[::-1]]),
            "direction": np.repeat(["forward", "reverse"], 40).astype(object),
            "error_um": t_s,
            "temperature_c": 20.0 + 0.01 * t_s,
        }
    else:
        t_s = np.arange(3000.0) / 1000.0
        command = 0.005 * np.sin(2.0 * np.pi * 10.0 * t_s)
        samples = {"t_s": t_s, "cmd_z_mm": command, "tool_z_mm": 1.1 * command}
    condition: dict[str, float | str] = {"axis": "Z", "frequency_hz": 10.0, "amplitude_um": 5.0}
    kind = effect.kinds[0]
    campaign = Campaign("c", "m", kind=kind, machine_geometry={"screw_pitch_mm": 6.35})
    obs = observe(campaign, [Run(RunMeta("r", kind=kind, condition=condition), samples)])
    whole = effect.setup or effect.per == "machine"
    found = obs.regressors(Instance(effect, "" if whole else "Z"), effect.start_shape)
    still = np.array([[1.0]]) if whole else obs.regressors(Instance(effect, "X"), effect.start_shape)
    return bool(np.isfinite(found).all() and found.any() and (whole or not still.any()))


@pytest.mark.parametrize("name", sorted(LIBRARY))
def test_the_declared_law_is_the_law_of_the_columns(name: str) -> None:
    effect = LIBRARY[name]
    law = effect.law
    if "circular" not in effect.kinds or effect.per == "joint":
        return
    # While the play is taken up, over some um of travel, no power law holds.
    shape = {name: 1e-9 if name == "standstill_um" else value for name, value in effect.start_shape.items()}
    for instance in everywhere(effect, ["XY"]) + everywhere(effect, ["ZX"]):
        plane: Plane = "ZX" if "Z" in instance.axis else "XY"

        def columns(plane: Plane = plane, axis: str = instance.axis, **condition: float) -> Floats:
            direction: Direction = "CW" if condition.pop("cw", 0.0) else "CCW"
            return effect.columns(state(plane, direction, **condition), axis, shape)

        plain = columns()
        if not plain.any():
            continue
        if law.feed is not None:
            np.testing.assert_allclose(columns(feed_mm_s=100.0), plain * 2**law.feed, atol=1e-9)
        if law.radius is not None:
            grown = columns(radius_mm=200.0)
            np.testing.assert_allclose(grown, plain * 2**law.radius, atol=1e-9)
        if law.feed is not None and law.direction != "mixed":
            sign = 1.0 if law.direction == "even" else -1.0
            np.testing.assert_allclose(columns(cw=1.0), sign * plain, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "known", "before"),
    [
        ("backlash_taper", {}, lambda s: -0.5 * np.sign(s.velocity_mm_s["X"]) * s.position_mm["X"] / 100.0),
        (
            "cyclic_error_by_direction",
            {"pitch_mm": 8.0},
            lambda s: np.sign(s.velocity_mm_s["X"]) * np.cos(2.0 * np.pi * s.position_mm["X"] / 8.0),
        ),
    ],
)
def test_a_version_that_did_not_know_a_shape_says_what_it_said(name: str, known: dict[str, float], before) -> None:  # type: ignore[no-untyped-def]
    effect, where = LIBRARY[name], state()
    told = effect.columns(where, "X", effect.completed(known))[:, 0]
    np.testing.assert_allclose(told, before(where) * where.sensitivity["X"], atol=1e-9)


def displaced_um(theta: Floats, radius_mm: float, push) -> Floats:  # type: ignore[no-untyped-def]
    """Exact change of the distance from the centre when each point is pushed by (ex, ey) um."""
    out = []
    for t in theta:
        x, y = radius_mm * math.cos(t), radius_mm * math.sin(t)
        ex, ey = push(x, y, t)
        out.append((math.hypot(x + ex / 1000, y + ey / 1000) - radius_mm) * 1000)
    return np.array(out)


@pytest.mark.parametrize(
    ("name", "axis", "push"),
    [
        ("squareness", "XY", lambda x, y, t: (-y * 5 / 1000, 0.0)),
        ("straightness", "X", lambda x, y, t: (0.0, 5 * (x / 100) ** 2)),
        ("backlash", "X", lambda x, y, t: (2.5 if math.sin(t) > 0 else -2.5, 0.0)),
        ("backlash", "Y", lambda x, y, t: (0.0, -2.5 if math.cos(t) > 0 else 2.5)),
        ("lateral_play", "X", lambda x, y, t: (0.0, -2.5 if math.sin(t) > 0 else 2.5)),
        ("thermal_growth", "", lambda x, y, t: (x * 2 * 5 / 1000, y * 2 * 5 / 1000)),
        ("thermal_growth", "Y", lambda x, y, t: (0.0, y * 2 * 5 / 1000)),
        ("gravity_sag", "X", None),
    ],
)
def test_columns_are_the_length_that_geometry_gives(name: str, axis: str, push) -> None:  # type: ignore[no-untyped-def]
    effect = LIBRARY[name]
    if push is None:
        flat = effect.columns(state("XY"), axis, {})
        assert not flat.any(), "nothing sags in a level plane"
        return
    here = state("XY", radius_mm=120.0)
    expected = displaced_um(here.angle_rad, 120.0, push)
    shape = dict(effect.start_shape) | ({"standstill_um": 1e-9} if name == "backlash" else {})
    found = 5.0 * effect.columns(here, axis, shape)[:, 0]
    # First order against exact: 5 um at 120 mm leaves less than a nanometre.
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_a_table_with_play_stands_still_until_the_play_is_taken_up() -> None:
    """A mass on a plane that a claw of 30 um play pushes to and fro."""
    here = state("XY", n=36000)
    command = 100.0 * np.cos(np.concatenate([here.angle_rad, here.angle_rad]))
    table, seen = 0.0, []
    for pushed in command:
        table = min(max(table, pushed - 0.015), pushed + 0.015)
        seen.append(table)
    lost_um = (np.array(seen[36000:]) - command[36000:]) * 1000
    expected = lost_um * np.cos(here.angle_rad)
    found = 30.0 * LIBRARY["backlash"].columns(here, "X", {"standstill_um": 30.0})[:, 0]
    np.testing.assert_allclose(found, expected, atol=0.05)


def test_servo_mismatch_is_a_delay_of_one_axis() -> None:
    """An axis that is 0.1 ms late stands where it was 0.1 ms ago."""
    here = state("XY", feed_mm_s=50.0)
    late_s = 1e-4
    omega = 50.0 / 100.0
    x = 100.0 * np.cos(here.angle_rad - omega * late_s)
    y = 100.0 * np.sin(here.angle_rad)
    length = (np.hypot(x, y) - 100.0) * 1000
    found = 0.1 * LIBRARY["servo_mismatch"].columns(here, "XY", {})[:, 0]
    np.testing.assert_allclose(found, length - length.mean(), atol=2e-3)


def test_a_late_reading_is_that_of_the_place_passed_before() -> None:
    here = state("XY", feed_mm_s=50.0)
    earlier = here.angle_rad - 50.0 / 100.0 * 1e-3
    late = 40.0 * np.cos(earlier) - 30.0 * np.sin(earlier)
    now = 40.0 * np.cos(here.angle_rad) - 30.0 * np.sin(here.angle_rad)
    found = LIBRARY["measurement_delay"].columns(here, "", {})[:, 0]
    np.testing.assert_allclose(found, late - now, atol=1e-4)


def test_joint_effects_move_the_tool_as_the_robot_s_kinematics_do() -> None:
    here = state("XY")
    motion = here.joints
    i, joint = 100, 1
    tcp = np.array(ROBOT["tcp_mm"])
    turned = motion.q_rad[i].copy()
    before, _ = UR10E.forward(turned, tcp)
    turned[joint] += 1e-6
    after, _ = UR10E.forward(turned, tcp)
    centre = np.array(ROBOT["centre_mm"])
    expected = (np.linalg.norm(after - centre) - np.linalg.norm(before - centre)) * 1000
    found = LIBRARY["joint_offset"].columns(here, str(joint + 1), {})[i, 0]
    assert found == pytest.approx(expected, rel=1e-3)
    np.testing.assert_allclose(np.linalg.norm(before - centre), 100.0, atol=1e-6)


def test_a_column_that_was_not_logged_is_named() -> None:
    bare = circular_state(
        RunMeta("r", plane="XY", direction="CCW", radius_mm=100.0, feed_mm_min=3000.0),
        np.linspace(0.1, 6.2, 50),
        feed_mm_s=50.0,
        columns={},
        geometry={},
    )
    for name, axis, missing in (
        ("thermal_growth", "", "temperature_rise_c"),
        ("joint_reversal", "1", "machine_geometry"),
    ):
        with pytest.raises(InputError) as caught:
            LIBRARY[name].columns(bare, axis, {})
        assert missing in caught.value.render()


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ("raise ValueError('boom')", "effect.raised"),
        ("return np.full((state.n, 1), np.nan)", "effect.not_finite"),
        ("return np.zeros((3, 1))", "effect.shape"),
        ("return 'red'", "effect.raised"),
    ],
)
def test_a_user_s_effect_that_misbehaves_is_named(tmp_path, body: str, code: str) -> None:  # type: ignore[no-untyped-def]
    source = template("my_effect").replace("return np.cos(4.0 * state.angle_rad)[:, None]", body)
    path = tmp_path / "my_effect.py"
    path.write_text(source, encoding="utf-8")
    effect = Library([path])["my_effect"]
    with pytest.raises(InputError) as caught:
        effect.columns(state(), "", {})
    assert caught.value.code == code
    assert "my_effect" in caught.value.render()


def test_a_user_s_effect_from_the_template_takes_part(tmp_path) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "table_tilt.py"
    path.write_text(template("table_tilt"), encoding="utf-8")
    library = Library([tmp_path])
    assert library["table_tilt"].source == str(path)
    assert library["table_tilt"].columns(state(), "", {}).shape == (720, 1)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("x = 1", "needs EFFECT"),
        ("1 / 0", "ZeroDivisionError"),
        ("def broken(:", "SyntaxError"),
        ("from dtwin.physics.effects.backlash import EFFECT", "same name"),
    ],
)
def test_a_file_that_is_no_effect_is_refused(tmp_path, content: str, said: str) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "mine.py"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        Library([path])
    assert said in caught.value.render()


def test_unknown_effects_are_refused_with_the_list() -> None:
    with pytest.raises(InputError, match="no such effect"):
        LIBRARY["warp_drive"]
    with pytest.raises(InputError, match="learned effect"):
        LIBRARY["learned_whatever"]
