"""Error motions of three axes: names, chain, identification, thermal models, intervals."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.kinds.volumetric._chain import COEFFICIENTS, coefficient, design, identifiability
from dtwin.kinds.volumetric._identify import Artefact, Balls
from dtwin.kinds.volumetric._thermal_model import fit_thermal, inflation
from dtwin.kinds.volumetric._training import _volumetric_bundle
from dtwin.serve.runtime import CompiledBundle
from studies.heat import interval_curve, reduction_pct, slot_errors_um, slot_places_mm, slot_ranges_um, worse_steps
from studies.thermal_memory import fit_remembering
from studies.volumetric_paper import PRINTED

STROKES = {"x": (30.0, 1460.0), "y": (50.0, 1200.0), "z": (460.0, 1490.0)}
RNG = np.random.default_rng(5)


def places(n: int) -> np.ndarray:
    low, high = np.array([STROKES[axis] for axis in "xyz"]).T
    return RNG.uniform(low, high, (n, 3))


def turned_mm(angle_um_m: dict[str, float], carried_mm: np.ndarray) -> np.ndarray:
    """Turn what an axis carries by whole rotation matrices."""
    a, b, c = (1e-6 * angle_um_m.get(letter, 0.0) for letter in "ABC")
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return about_z @ about_y @ about_x @ carried_mm


def test_the_chain_agrees_with_rotation_matrices() -> None:
    x, y, z = at = np.array([300.0, 900.0, 1300.0])
    travel = {a: (2 * p - sum(STROKES[a])) / np.ptp(STROKES[a]) for a, p in zip("xyz", at, strict=True)}
    angles = {"EAX2": 8.0, "EBX1": -5.0, "ECZ1": 6.0, "EAZ1": 4.0, "EC0": 7.0, "EB0": -3.0, "EA0": 2.0}
    second = (3 * travel["x"] ** 2 - 1) / 2
    point = np.array([0.0, y, 0.0])
    point = np.array([0.0, 0.0, z]) + turned_mm(
        {"C": angles["ECZ1"] * travel["z"], "A": angles["EAZ1"] * travel["z"]}, point
    )
    point = np.array([x, 0.0, 0.0]) + turned_mm(
        {"A": angles["EAX2"] * second, "B": angles["EBX1"] * travel["x"]}, point
    )
    point = turned_mm({"A": angles["EA0"], "B": angles["EB0"], "C": angles["EC0"]}, point)
    ours = design(at[None, :], STROKES, tuple(angles))[0] @ np.array(list(angles.values()))
    assert np.abs(1e3 * (point - at) - ours).max() < 1e-3


@pytest.mark.parametrize("name", ["EX", "EXQ1", "FX0", "EXX9", "EXX0", "EX1", ""])
def test_names_that_mean_nothing_are_refused(name: str) -> None:
    with pytest.raises(InputError) as caught:
        coefficient(name)
    assert caught.value.code == "volumetric.coefficient"


def test_what_points_can_tell_and_what_distances_can() -> None:
    columns = design(places(400), STROKES).reshape(-1, 24)
    assert identifiability(columns, COEFFICIENTS).rank == 24
    for extra in ("EBZ1", "EAY1", "ECY1"):
        more = design(places(400), STROKES, (*COEFFICIENTS, extra)).reshape(-1, 25)
        found = identifiability(more, (*COEFFICIENTS, extra))
        assert (found.rank, extra in (*found.unseen, *found.entangled)) == (24, True)
    one, other = places(400), places(400)
    apart = (design(one, STROKES) - design(other, STROKES)).transpose(0, 2, 1)
    unit = (one - other) / np.linalg.norm(one - other, axis=1)[:, None]
    distances = np.einsum("nkd,nd->nk", apart, unit)
    found = identifiability(distances, COEFFICIENTS)
    assert found.rank == 18
    lost = {"EX0", "EY0", "EZ0", "EA0", "EB0", "EC0"}
    assert lost <= set((*found.unseen, *found.entangled))


def array(poses: int = 5) -> Balls:
    at = [places(12) for _ in range(poses)]
    fixed = places(4)
    return Balls(
        np.vstack([fixed, *at]),
        np.zeros((4 + 12 * poses, 3)),
        np.repeat(np.arange(poses + 1), [4] + [12] * poses),
        np.concatenate([np.arange(4), *[np.arange(12)] * poses]),
    )


def test_motions_are_recovered_wherever_the_array_stands() -> None:
    balls, truth = array(), RNG.normal(0, 5, 24)
    artefact = Artefact(STROKES, held_out=(5,))
    moved = artefact.predicted_um(balls, truth)
    for pose in range(1, 6):
        rows = balls.pose == pose
        arm_m = 1e-3 * (balls.position_mm[rows] - balls.position_mm[rows].mean(axis=0))
        moved[rows] += RNG.normal(0, 50, 3) + np.cross(RNG.normal(0, 20, 3), arm_m)
    found = artefact.identify(balls, moved)
    assert np.abs(found.values - truth).max() < 1e-9
    assert found.held_out_um < 1e-9
    noisy = artefact.identify(balls, moved + RNG.normal(0, 1.0, moved.shape))
    assert 0.85 < noisy.left_um < 1.15
    assert np.abs((noisy.values - truth) / noisy.uncertainty).max() < 5.0


def test_without_balls_on_the_table_the_rigid_motions_are_not_guessed() -> None:
    whole = array()
    rows = whole.pose > 0
    balls = Balls(whole.position_mm[rows], whole.error_um[rows], whole.pose[rows], whole.ball[rows])
    with pytest.raises(InputError) as caught:
        Artefact(STROKES).identify(balls, np.zeros((int(rows.sum()), 3)))
    assert (caught.value.code, "EX0" in str(caught.value.got)) == ("volumetric.rank", True)


def slow(n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.convolve(rng.normal(0, 1, n + 40), np.ones(30) / 5, mode="same")[20 : n + 20]


def test_the_temperatures_that_act_are_chosen_and_the_others_not() -> None:
    rise = np.column_stack([slow(240, k) for k in range(12)])
    noise = np.random.default_rng(9).normal(0, 0.05, 240)
    motion = 3.0 * rise[:, 4] - 2.0 * rise[:, 7] + noise
    names = [f"s{k}" for k in range(12)]
    model = fit_thermal("EXX1", motion, rise, names)
    assert set(model.sensors) == {"s4", "s7"}
    per_k = dict(zip(model.sensors, model.per_k, strict=True))
    assert (per_k["s4"], per_k["s7"]) == (pytest.approx(3.0, abs=0.02), pytest.approx(-2.0, abs=0.02))


def test_a_slow_body_is_given_a_memory_and_runs_free() -> None:
    rise = np.column_stack([slow(300, k) for k in range(6)])
    rise -= rise[0]
    motion = np.zeros(300)
    for i in range(1, 300):
        motion[i] = 0.9 * motion[i - 1] + 0.5 * rise[i, 2]
    model = fit_remembering("EZ0", motion, rise, [f"s{k}" for k in range(6)])
    assert model.sensors == ("s2",)
    assert model.memory == pytest.approx(0.9, abs=1e-6)
    assert np.abs(model.run(rise[:, [2]]) - motion).max() < 1e-6


def test_alike_sensors_are_reported() -> None:
    first = slow(100, 1)
    alike = np.column_stack([first, first + 0.01 * slow(100, 2), slow(100, 3)])
    found = inflation(alike)
    assert found[:2].min() > 100.0 > found[2]


def test_interval_statistics_in_closed_form() -> None:
    ramp = np.arange(11, dtype=float)
    curve = interval_curve(ramp, [1, 5, 10])
    assert curve.worst.tolist() == [1.0, 5.0, 10.0]
    assert curve.mean.tolist() == [1.0, 5.0, 10.0]
    assert curve.p95_spread[0] == pytest.approx(0.5)
    flat = interval_curve(np.where(np.arange(11) % 2, 1.0, 0.0), [1, 5, 10])
    assert worse_steps(curve, flat) == []
    assert worse_steps(flat, curve) == [5, 10]
    with pytest.raises(InputError):
        interval_curve(ramp, [11])


def test_slots_see_what_drifts_between_them() -> None:
    depth = np.outer(np.arange(20.0), np.ones(16))
    assert slot_errors_um(depth, 2).tolist() == list(range(16))
    assert slot_ranges_um(depth).tolist() == [15.0] * 5
    inside = slot_places_mm(STROKES)
    assert inside.shape == (16, 3)
    assert all(STROKES["xyz"[k]][0] < v < STROKES["xyz"[k]][1] for row in inside for k, v in enumerate(row))
    with pytest.raises(InputError):
        slot_errors_um(depth, 5)


def test_the_printed_reductions_follow_from_the_printed_pairs() -> None:
    assert all(abs(printed - reduction_pct(before, after)) <= 1.0 for _, before, after, printed in PRINTED)
    assert reduction_pct(7.5, 2.9) == pytest.approx(61.3, abs=0.05)


def test_the_served_equation_is_the_model() -> None:
    rise = np.column_stack([slow(120, k) for k in range(3)])
    names = ["bed_c", "ram_c", "table_c"]
    models = [fit_thermal(name, rise @ RNG.normal(0, 3, 3), rise, names) for name in COEFFICIENTS]
    begun, seen = dict.fromkeys(names, 22.0), dict.fromkeys(names, (15.0, 30.0))
    bundle = _volumetric_bundle(models, STROKES, begun, seen, "heat", "mill", switched_off=("EXX2",))
    compiled = CompiledBundle(bundle)
    at, now = places(5), np.array([23.5, 21.0, 24.25])
    kept = [model for model in models if model.name != "EXX2"]
    motion = [float(m.run((now - 22.0)[[names.index(s) for s in m.sensors]][None, :])[0]) for m in kept]
    expected = design(at, STROKES, [m.name for m in kept]) @ np.array(motion)
    given = dict(zip(names, now.tolist(), strict=True))
    for row, place in zip(expected, at, strict=True):
        inputs = given | {f"{axis}_mm": float(v) for axis, v in zip("xyz", place, strict=True)}
        got = compiled.tick(np.array([inputs[i.name] for i in bundle.inputs]))
        assert np.abs(np.asarray(got)[:3] - row).max() < 1e-9
    with pytest.raises(InputError):
        _volumetric_bundle(models, STROKES, begun, seen, "heat", "mill", switched_off=COEFFICIENTS)
