from __future__ import annotations

import dataclasses

import pytest

from dtwin.features.path_inputs import PATH_INPUT_UNITS
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.interface import Input, Output, SafetyLimits
from dtwin.train.closed_loop import Evidence
from dtwin.train.gates import Verdict, evidence_gate, offline_gates

GOOD = {
    "leave_feed_mm_min_out.r2": 0.9,
    "leave_radius_mm_out.r2": 0.8,
    "leave_feed_mm_min_out.worst_slice_ratio": 0.5,
    "latency_p99_us": 3.0,
}


def bundle(**changes: object) -> Bundle:
    builder = GraphBuilder()
    angle = builder.input("path_angle_rad")
    graph = builder.graph({"radial_um": 20.0 * builder.apply("cos", 2.0 * angle)})
    unit = str(changes.pop("unit", PATH_INPUT_UNITS["path_angle_rad"]))
    rate = float(changes.pop("rate_hz", 500.0))  # type: ignore[arg-type]
    return create_bundle(
        name="m",
        machine="mill-a",
        model_version=0,
        inputs=[Input("path_angle_rad", unit, "path", rate, "path", -20.0, 20.0)],
        outputs=[Output("radial_um", str(changes.pop("frame", "path_radial")), str(changes.pop("role", "error")))],
        tick_graph=graph,
        safety=SafetyLimits(clamp_um=15.0),
    )


def failed(verdicts: list[Verdict]) -> set[str]:
    return {v.gate for v in verdicts if not v.passed}


def test_a_sound_model_passes_and_is_clamped() -> None:
    verdicts = offline_gates(bundle(), GOOD)
    assert failed(verdicts) == set()
    assert "15 µm after a clamp" in next(v.reason for v in verdicts if v.gate == "bounded output")


@pytest.mark.parametrize(
    ("metrics", "gate"),
    [
        ({"leave_feed_mm_min_out.r2": 0.1}, "held-out conditions"),
        ({"leave_radius_mm_out.r2": -0.4}, "held-out conditions"),
        ({"leave_feed_mm_min_out.worst_slice_ratio": 1.2}, "no slice worse than no correction"),
        ({"latency_p99_us": 500.0}, "latency"),
    ],
)
def test_each_figure_can_refuse(metrics: dict[str, float], gate: str) -> None:
    assert failed(offline_gates(bundle(), GOOD | metrics)) == {gate}


def test_a_radius_left_out_is_told_and_not_judged() -> None:
    worse = {"leave_radius_mm_out.worst_slice_ratio": 1.15}
    (slices,) = [v for v in offline_gates(bundle(), GOOD | worse) if "slice" in v.gate]
    assert slices.passed
    assert slices.reason.endswith("with its radius left out 115 %, not judged")


def test_missing_figures_refuse() -> None:
    assert {"held-out conditions", "latency"} <= failed(offline_gates(bundle(), {}))


def test_another_unit_or_rate_breaks_the_contract() -> None:
    assert failed(offline_gates(bundle(unit="deg"), GOOD)) == {"train and serve agree"}
    assert failed(offline_gates(bundle(rate_hz=125.0), GOOD)) == {"train and serve agree"}


def test_changed_test_vectors_break_the_contract() -> None:
    sound = bundle()
    vectors = dataclasses.replace(sound.vectors, outputs=tuple((v[0] + 1e-6,) for v in sound.vectors.outputs))
    assert failed(offline_gates(dataclasses.replace(sound, vectors=vectors), GOOD)) == {"train and serve agree"}


def evidence(**changes: object) -> Evidence:
    condition = {
        "plane": "XY",
        "radius_mm": 100.0,
        "feed_mm_min": 1000.0,
        "before_um": 50.0,
        "floor_um": 2.0,
        "better": True,
        "worse": False,
    } | changes
    return Evidence(
        "virtual", SOUND.machine, SOUND.model_sha256, {"without": ("a",), "with": ("a",)}, (condition,), (), 5
    )


SOUND = bundle()


def test_evidence_must_belong_to_bundle_and_machine() -> None:
    assert failed(evidence_gate(evidence(), SOUND, real=False)) == set()
    assert failed(evidence_gate(evidence(), SOUND, real=True)) == {"evidence is of this kind of machine"}
    other = bundle(frame="base_x")
    assert "evidence belongs to this bundle" in failed(evidence_gate(evidence(), other, real=False))


def test_one_worse_condition_or_no_gain_refuses() -> None:
    worse = evidence(better=False, worse=True)
    assert failed(evidence_gate(worse, SOUND, real=False)) == {"no condition worse", "error falls"}
    assert failed(evidence_gate(evidence(better=False), SOUND, real=False)) == {"error falls"}


def test_what_lies_near_the_noise_floor_need_not_fall() -> None:
    quiet = evidence(better=False, floor_um=20.0)
    both = dataclasses.replace(quiet, conditions=(*quiet.conditions, *evidence().conditions))
    assert failed(evidence_gate(both, SOUND, real=False)) == set()


def test_a_fifth_of_the_travel_does_not_speak_for_the_rest() -> None:
    name = SOUND.inputs[0].name
    inputs = tuple(dataclasses.replace(i, source="controller", low=-25.0, high=325.0) for i in SOUND.inputs)
    axis = dataclasses.replace(SOUND, inputs=inputs)
    given = dataclasses.replace(evidence(), model_sha256=axis.model_sha256)
    part = dataclasses.replace(given, reached={name: (0.0, 60.0)})
    assert failed(evidence_gate(part, axis, real=False)) == {"evidence covers what is served"}
    most = dataclasses.replace(given, reached={name: (0.0, 300.0), "t_s": (0.0, 9.0)})
    assert failed(evidence_gate(most, axis, real=False)) == set()
