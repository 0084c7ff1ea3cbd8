"""A twin as a bundle: the effects' own code, frozen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.kinds.circular.freeze import OUTPUT, twin_bundle, wrong_way
from dtwin.machines.mill import SetupErrors, VirtualMill
from dtwin.machines.mill_parameters import CircularTest, MillParameters, NoiseParameters
from dtwin.physics._reference_lines import over
from dtwin.physics.effect import Effect, Instance
from dtwin.physics.fit import Estimate
from dtwin.physics.library import Library, campaign_instances
from dtwin.physics.observations import Observations, observe
from dtwin.physics.problem import Term
from dtwin.physics.state import circular_state
from dtwin.physics.twin import Twin, ValidityBox
from dtwin.schema import PLANES, Floats
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.direction import Direction
from dtwin.train import twin_terms as module
from dtwin.train.traced import NotTraceable, Traced, expressions_of
from dtwin.train.twin_terms import choose

SOUND = MillParameters()
LIBRARY = Library()
# Their time since the last reversal is not finite at standstill.
AT_STANDSTILL = {"friction", "reversal_ringing", "reversal_spike", "structural_resonance"}


@pytest.fixture(scope="module")
def obs() -> Observations:
    tests = [
        CircularTest(plane, direction, radius, feed, setup=f"{plane}{radius}", abbe_offset_mm=40.0)
        for plane in PLANES
        for radius in (50.0, 120.0)
        for feed in (1500.0, 4000.0)
        for direction in ("CCW", "CW")
    ]
    quiet, centred = NoiseParameters(rms_um=0.0), SetupErrors(0.0, 0.0, 0.0, 0.0)
    mill = VirtualMill(SOUND, noise=quiet, setup_errors=centred, samples_per_turn=360)
    return observe(mill.campaign(), mill.measure(tests))


def radial_error_um(
    bundle: Bundle, angle_rad: Floats, plane: str, direction: str, radius_mm: float, feed_mm_min: float, **more: float
) -> Floats:
    fixed = {
        "direction_sign": 1.0 if direction == "CCW" else -1.0,
        "commanded_speed_mm_s": feed_mm_min / 60.0,
        "radius_mm": radius_mm,
        "plane_id": float(PLANES.index(plane)),
        **more,
    }
    return np.array(
        [bundle.tick_graph.evaluate({**fixed, "path_angle_rad": float(a)}, {})[0][OUTPUT] for a in angle_rad]
    )


def twin_with(instance: Instance, obs: Observations, shape: dict[str, float] | None = None) -> Twin:
    effect = instance.effect
    term = Term(instance, effect.start_shape if shape is None else shape)
    blank = dict.fromkeys(Estimate.__dataclass_fields__, 0.0)
    estimates = [
        Estimate(
            **blank  # type: ignore[arg-type]
            | {"effect": effect.name, "axis": instance.axis, "name": p.name, "unit": p.unit}
            | {"value": 1.5 + i, "identifiable": True}
        )
        for i, p in enumerate(effect.parameters)
    ]
    return Twin(
        "t", 1, "virtual-mill", "c", "fit", (term,), tuple(estimates), (), ValidityBox.of(obs), {}, (), (), {}, {}
    )


def of_library(obs: Observations) -> list[Instance]:
    found = campaign_instances(LIBRARY, "circular", obs.planes, obs.axes, {})
    return [i for i in found if not i.effect.setup]


def test_every_effect_of_the_library_is_frozen_as_it_is(obs: Observations, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "choose", lambda t: module.TermChoice(t.label, True, ""))
    angle = np.linspace(0.013, 6.27, 23)
    done, refused = set(), {}
    for instance in of_library(obs):
        twin = twin_with(instance, obs, instance.effect.start_shape | over(instance.effect, [obs]))
        try:
            bundle = twin_bundle(twin, obs).bundle
        except InputError as error:
            if instance.label != "gravity_sag Z":  # a ram does not sag along itself
                refused[instance.effect.name] = str(error)
            continue
        asked = {i.name for i in bundle.inputs if i.source == "covariate"}
        for row in range(0, obs.n_rows, 5):
            meta = obs.runs[row]
            logged = {k: np.full(len(angle), v) for k, v in meta.covariates.items()}
            mean_c = np.mean([m.covariates["temperature_c"] for m in obs.runs])
            logged["temperature_rise_c"] = logged["temperature_c"] - mean_c
            state = circular_state(meta, angle, feed_mm_s=meta.feed_mm_min / 60.0, columns=logged, geometry={})
            columns = instance.effect.columns(state, instance.axis, twin.terms[0].shape)
            got = radial_error_um(
                bundle,
                angle,
                meta.plane,
                meta.direction,
                meta.radius_mm,
                meta.feed_mm_min,
                **{k: v for k, v in meta.covariates.items() if k in asked},
            )
            np.testing.assert_allclose(
                got,
                columns @ twin.values(twin.terms[0]),
                rtol=1e-9,
                atol=1e-12,
                err_msg=f"{instance.label} {meta.plane} {meta.direction}",
            )
        done.add(instance.effect.name)
    # Needs session time, or divides by the speed at standstill.
    assert set(refused) <= {*AT_STANDSTILL, "thermal_drift", "warming_growth", "measurement_delay"}, refused
    assert {
        "backlash",
        "cyclic_error",
        "straightness",
        "guideway_shape",
        "guideway_wave",
        "servo_lag",
        "thermal_growth",
        "angular_error",
        "gravity_sag",
        "lateral_play_taper",
    } <= done


def test_joint_effects_of_a_robot_are_frozen_too(obs: Observations) -> None:
    geometry = {"type": "ur10e", "centre_mm": [-550.0, 0.0, 75.0], "tcp_mm": [0.0, 0.0, 158.3]}
    robot = replace(obs, campaign=replace(obs.campaign, machine_geometry=geometry))
    angle = np.linspace(0.1, 6.1, 7)
    for name in ("joint_cyclic", "joint_reversal", "joint_offset"):
        instance = Instance(LIBRARY[name], "2")
        twin = twin_with(instance, robot)
        graph = twin_bundle(twin, robot).bundle.tick_graph
        for row in (0, 3, 9, 17):
            meta = robot.runs[row]
            state = circular_state(meta, angle, feed_mm_s=meta.feed_mm_min / 60.0, columns={}, geometry=geometry)
            wanted = instance.effect.columns(state, "2", twin.terms[0].shape)
            for i, t in enumerate(angle.tolist()):
                joints = {
                    f"{text}": float(values[i, j])
                    for j in range(6)
                    for text, values in (
                        (f"q{j + 1}_rad", state.joints.q_rad),
                        (f"qd{j + 1}_rad_s", state.joints.qd_rad_s),
                        (f"lever_{j + 1}_mm_rad", state.joints.lever_mm),
                    )
                }
                sign = 1.0 if meta.direction == "CCW" else -1.0
                inputs = {
                    "path_angle_rad": t,
                    "direction_sign": sign,
                    "plane_id": float(PLANES.index(meta.plane)),
                    "radius_mm": meta.radius_mm,
                    "commanded_speed_mm_s": meta.feed_mm_min / 60.0,
                    **joints,
                }
                got = graph.evaluate(inputs, {})[0]["radial_um"]
                value = float(wanted[i] @ twin.values(twin.terms[0]))
                assert got == pytest.approx(value, rel=1e-9, abs=1e-12)
    with pytest.raises(InputError) as refusal:
        twin_bundle(twin_with(Instance(LIBRARY["joint_compliance"], "2"), robot), robot)
    assert "moments of the joints" in str(refusal.value.got)


def test_what_offsets_cannot_correct_is_left_out_with_the_reason(obs: Observations) -> None:
    choices = {i.effect.name: choose(Term(i, i.effect.start_shape)) for i in of_library(obs)}
    for name in ("instrument_artefact", "reversal_spike", "friction", "stick_slip"):
        assert not choices[name].included
        assert choices[name].how
    for name in ("squareness", "backlash", "straightness", "thermal_growth"):
        assert choices[name].included
    learned = Term(Instance(LIBRARY["learned_even_h3_f1_r0"]), {})
    assert "cause is not known" in choose(learned).how
    with pytest.raises(InputError, match="no effect that offsets"):
        twin_bundle(twin_with(Instance(LIBRARY["instrument_artefact"]), obs), obs)


def test_an_effect_of_a_channel_that_is_not_logged_is_left_out(obs: Observations) -> None:
    bare = replace(obs, runs=tuple(replace(m, covariates={}) for m in obs.runs))
    growth, square = Instance(LIBRARY["thermal_growth"]), Instance(LIBRARY["squareness"], "XY")
    twin = twin_with(growth, obs)
    other = twin_with(square, obs)
    both = replace(twin, terms=(*twin.terms, *other.terms), estimates=(*twin.estimates, *other.estimates))
    told = {t.label: t for t in twin_bundle(both, bare).terms}
    assert told["squareness XY"].included
    assert not told["thermal_growth"].included
    assert "a column that was not logged (temperature_rise_c)" in told["thermal_growth"].how


def test_the_correction_points_inwards_where_the_circle_is_too_large(obs: Observations) -> None:
    # Scale of X alone: at angle 0 the circle is 1.5e-3 * 50 um too large along X.
    twin = twin_with(Instance(LIBRARY["scale_mismatch"], "X"), obs)
    bundle = twin_bundle(twin, obs).bundle
    here = {"plane": "XY", "direction": "CW", "radius_mm": 50.0, "feed_mm_min": 2000.0}
    (error,) = radial_error_um(bundle, np.array([0.0]), **here)  # type: ignore[arg-type]
    assert error == pytest.approx(1.5 * 50.0 * 1e-3)
    vector = Direction(bundle.outputs).apply(np.array([error]), 0.0, 0.0).copy()
    np.testing.assert_allclose(vector, [-error, 0.0, 0.0])
    lost = Direction(wrong_way(bundle).outputs).apply(np.array([error]), 0.0, 0.0)
    np.testing.assert_allclose(lost, [error, 0.0, 0.0])
    # In YZ the X axis does not move.
    (none,) = radial_error_um(bundle, np.array([0.3]), **here | {"plane": "YZ"})  # type: ignore[arg-type]
    assert none == 0.0


def test_the_prediction_looks_ahead_along_the_motion(obs: Observations) -> None:
    twin = twin_with(Instance(LIBRARY["squareness"], "XY"), obs)
    now, later = (twin_bundle(twin, obs, horizon_s=h).bundle for h in (0.0, 0.05))
    for direction, sign in (("CCW", 1.0), ("CW", -1.0)):
        here = {"plane": "XY", "direction": direction, "radius_mm": 50.0, "feed_mm_min": 3000.0}
        ahead = sign * 0.05 * 50.0 / 50.0
        np.testing.assert_allclose(
            radial_error_um(later, np.array([0.4]), **here),  # type: ignore[arg-type]
            radial_error_um(now, np.array([0.4 + ahead]), **here),  # type: ignore[arg-type]
            rtol=1e-12,
        )


def test_outside_of_what_was_measured_the_box_says_so(obs: Observations) -> None:
    bundle = twin_bundle(twin_with(Instance(LIBRARY["squareness"], "XY"), obs), obs).bundle
    box = {i.name: (i.low, i.high) for i in bundle.inputs}
    assert box["radius_mm"] == pytest.approx((50.0, 120.0), rel=1e-5)
    assert box["commanded_speed_mm_s"][1] < 1.03 * 4000.0 / 60.0
    assert box["plane_id"] == pytest.approx((0.0, 2.0), abs=1e-5)


def decides(state: object, axis: str, shape: object) -> object:
    return np.zeros((state.n, 1)) if state.feed_mm_s > 3.0 else np.ones((state.n, 1))  # type: ignore[attr-defined]


def test_an_effect_that_cannot_be_written_down_is_named(obs: Observations) -> None:
    effect: Effect = replace(LIBRARY["squareness"], name="mine", regressors=decides)
    with pytest.raises(InputError) as refusal:
        twin_bundle(twin_with(Instance(effect, "XY"), obs), obs)
    assert "a decision that depends on the state" in str(refusal.value.got)


def test_operators_mean_what_numpy_means() -> None:
    builder = GraphBuilder()
    x = Traced([builder.input("x")])
    made = {
        "where": np.where(x > 1.0, x**2, -x),
        "mod": x % np.pi,
        "less": (x < 0.5) * 1.0,
        "clip": np.clip(x, 0.0, 1.0),
        "root": x**1.5,
        "odd": x**0.3,
        "hypot": np.hypot(x, 2.0),
        "both": ((x >= 0.2) & (x <= 0.9)) * 1.0,
    }
    graph = builder.graph({k: expressions_of(v, builder, 1)[0] for k, v in made.items()})
    for v in (0.1, 0.5, 0.9, 1.0, 2.5, 7.0):
        got, _ = graph.evaluate({"x": v}, {})
        want = {
            "where": v**2 if v > 1 else -v,
            "mod": v % np.pi,
            "less": float(v < 0.5),
            "clip": min(max(v, 0.0), 1.0),
            "root": v**1.5,
            "odd": v**0.3,
            "hypot": np.hypot(v, 2.0),
            "both": float(0.2 <= v <= 0.9),
        }
        for name, value in want.items():
            assert got[name] == pytest.approx(value, abs=1e-12), name
    for refused in (lambda: float(x), lambda: np.cumsum(x), lambda: np.floor(x), lambda: x[0]):
        with pytest.raises(NotTraceable):
            refused()
