"""Path inputs against finite differences of the kinematics."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin import kinematics
from dtwin.errors import InputError
from dtwin.features.path_inputs import PATH_INPUT_UNITS, PATH_INPUTS, STATE_FIELDS, PathInputs
from dtwin.kinematics import UR10E

TCP_MM = np.array([0.0, 0.0, 158.3])
CENTRE_MM = np.array([-550.0, 0.0, 300.0])
SEED_RAD = np.array([0.2, -1.9, 2.1, -1.77, -1.57, 0.3])
RADIUS_MM, RATE_HZ = 100.0, 500.0
INDEX = {name: i for i, name in enumerate(STATE_FIELDS)}
OUT = {name: i for i, name in enumerate(PATH_INPUTS)}


def circle(plane: str, sign: float, turns: float = 1.3, start_rad: float = 2.0) -> np.ndarray:
    """States of a uniform circle, at 250 mm/s, the tool pointing down."""
    first, second = kinematics.plane_axes(plane)
    n = int(turns * 2 * np.pi * RADIUS_MM / 250.0 * RATE_HZ)
    angle = start_rad + sign * 2.5 * np.arange(n) / RATE_HZ
    arm = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    along = sign * (np.cos(angle)[:, None] * second - np.sin(angle)[:, None] * first)
    position = CENTRE_MM + RADIUS_MM * arm
    down = np.diag([1.0, -1.0, -1.0])
    q = UR10E.inverse_many(position, down, TCP_MM, SEED_RAD)
    states = np.zeros((n, len(STATE_FIELDS)))
    states[:, 0] = 3.0 + np.arange(n) / RATE_HZ
    states[:, 1:7] = q
    states[:, 7:13] = np.gradient(q, axis=0) * RATE_HZ
    states[:, 13:16], states[:, 16:19] = position, 250.0 * along
    states[:, 19:22] = CENTRE_MM
    states[:, 22] = ("XY", "YZ", "ZX").index(plane)
    states[:, 23] = sign
    states[:, 24] = np.arange(n) / RATE_HZ
    return states


@pytest.mark.parametrize("plane", ["XY", "YZ", "ZX"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_circle_in_every_plane_and_direction(plane: str, sign: float) -> None:
    states = circle(plane, sign)
    found = PathInputs(INDEX, TCP_MM).batch(states)
    angle = found[:, OUT["path_angle_rad"]]
    expected = 2.0 + sign * 2.5 * np.arange(len(states)) / RATE_HZ
    np.testing.assert_allclose(angle, expected, atol=1e-9)
    np.testing.assert_allclose(found[:, OUT["commanded_speed_mm_s"]], 250.0, rtol=1e-12)
    np.testing.assert_allclose(found[1:, OUT["radial_acceleration_mm_s2"]], -(250.0**2) / RADIUS_MM, rtol=1e-3)
    assert np.abs(found[:, OUT["tangential_acceleration_mm_s2"]]).max() < 2.0
    assert (found[:, OUT["direction_sign"]] == sign).all()


@pytest.mark.parametrize("plane", ["XY", "YZ", "ZX"])
def test_levers_are_radial_motion_per_joint_angle(plane: str) -> None:
    states = circle(plane, 1.0)[::97]
    found = PathInputs(INDEX, TCP_MM).batch(states)
    for row, state in zip(found, states, strict=True):
        outward = kinematics.radial_unit(plane, float(row[0]))
        for j in range(6):
            q_plus, q_minus = state[1:7].copy(), state[1:7].copy()
            q_plus[j] += 1e-5
            q_minus[j] -= 1e-5
            step = UR10E.forward(q_plus, TCP_MM)[0] - UR10E.forward(q_minus, TCP_MM)[0]
            lever = float(outward @ step) / 2e-5
            assert row[OUT[f"lever_{j + 1}_mm_rad"]] == pytest.approx(lever, abs=1e-4)


def test_tangential_acceleration_has_the_sign_of_speeding_up() -> None:
    states = circle("XY", -1.0)
    states[:, 16:19] *= np.linspace(0, 1, len(states))[:, None]
    found = PathInputs(INDEX, TCP_MM).batch(states)
    rise = 250.0 / (len(states) - 1) * RATE_HZ
    np.testing.assert_allclose(found[1:, OUT["tangential_acceleration_mm_s2"]], rise, rtol=0.02, atol=3)


def test_served_one_by_one_is_the_batch_bit_for_bit() -> None:
    states = circle("ZX", -1.0)
    states[200, :] = states[199, :]
    inputs = PathInputs(INDEX, TCP_MM)
    served = np.array([inputs.update(state).copy() for state in states])
    assert served.tobytes() == inputs.batch(states).tobytes()


def test_a_repeated_state_keeps_the_acceleration() -> None:
    states = circle("XY", 1.0)
    states[100, :] = states[99, :]
    found = PathInputs(INDEX, TCP_MM).batch(states)
    assert np.array_equal(found[100], found[99])


def test_a_new_circle_starts_a_new_count_of_turns() -> None:
    states = circle("XY", 1.0, turns=2.2)
    inputs = PathInputs(INDEX, TCP_MM)
    for state in states:
        inputs.update(state)
    assert inputs.values[0] > 2 * np.pi
    moved = states[0].copy()
    moved[19] += 1.0
    moved[13] += 1.0
    assert inputs.update(moved)[0] == pytest.approx(2.0)
    inputs.reset()
    assert inputs.update(states[-1])[0] <= np.pi


def test_the_layout_may_have_other_fields_between() -> None:
    states = circle("XY", 1.0)[:50]
    wide = np.zeros((50, 60))
    place = {name: 59 - 2 * i for i, name in enumerate(STATE_FIELDS)}
    for name, i in place.items():
        wide[:, i] = states[:, INDEX[name]]
    assert np.array_equal(PathInputs(place, TCP_MM).batch(wide), PathInputs(INDEX, TCP_MM).batch(states))


def test_wrong_use_is_refused() -> None:
    with pytest.raises(InputError, match="lacks"):
        PathInputs({"timestamp_s": 0}, TCP_MM)
    states = circle("XY", 1.0)[:3]
    states[:, 22] = 5
    with pytest.raises(InputError, match="plane_id"):
        PathInputs(INDEX, TCP_MM).batch(states)


def test_every_input_states_its_unit() -> None:
    assert tuple(PATH_INPUT_UNITS) == PATH_INPUTS
