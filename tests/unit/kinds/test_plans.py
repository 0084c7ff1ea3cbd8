"""Plans of every kind: one command, what they could detect, options that would do nothing."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from dtwin.cli import app
from dtwin.errors import InputError
from dtwin.kinds.kind import Kind, NotOffered
from dtwin.kinds.linear._planned import _CONTROLS
from dtwin.kinds.registry import kind_named, kinds
from dtwin.physics.experiment import detectable
from dtwin.physics.library import Library
from dtwin.plan_file import planned_document

HEAD = {"name": "p", "machine": "m"}
LINEAR = HEAD | {
    "kind": "linear",
    "axis": "X",
    "unit": "mm",
    "start": 0.0,
    "end": 300.0,
    "step": 12.0,
    "runs": 3,
    "dwell_s": 6.0,
    "feed_min": 500.0,
    "overshoot": 1.0,
    "axis_low": -5.0,
    "axis_high": 305.0,
    "axes": "XYZ",
    "pitch": 10.0,
}
TONES = HEAD | {"kind": "sinusoidal", "frequencies_hz": [10.0, 40.0], "amplitudes_um": [2.0, 6.0], "repeats": 3}
PLANS: dict[str, dict[str, Any]] = {
    "circular": {
        "plan": HEAD,
        "grid": {"plane": "XY", "radius_mm": 100.0, "feed_mm_min": [500.0, 1000.0], "repeats": 2},
    },
    "linear": {"plan": LINEAR},
    "sinusoidal": {"plan": TONES},
    "volumetric": {"plan": HEAD | {"kind": "volumetric", "hours": 30.0}},
}


def toml(document: dict[str, dict[str, Any]]) -> str:
    """Return a plan file; JSON writes text, numbers and lists as TOML does."""
    lines = []
    for name, table in document.items():
        lines += [f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


@pytest.fixture(params=PLANS)
def plan(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path]:
    kind = str(request.param)
    file = tmp_path / "plan.toml"
    file.write_text(toml(PLANS[kind]), encoding="utf-8")
    return kind, file


def run(*words: object) -> dict[str, Any]:
    done = CliRunner().invoke(app, ["plan", *map(str, words), "--json"], catch_exceptions=False)
    assert done.exit_code == 0
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def sizes(kind: str, noise_um: float = 1.0, **changed: Any) -> dict[str, float]:
    """Return from which size on a plan sees each effect."""
    document = {"plan": PLANS[kind]["plan"] | changed}
    record = kind_named(kind)
    found = detectable(record.foreseen(record.plan(document, "test")), Library(), noise_um=noise_um)
    return {effect.label: effect.amplitude for effect in found}


def test_every_kind_that_plans_has_a_plan_here() -> None:
    assert {kind.name for kind in kinds() if kind.offers("plan")} == set(PLANS)


def test_a_plan_says_its_names_its_time_and_what_it_cannot_tell(plan: tuple[str, Path]) -> None:
    kind, file = plan
    found = run(file)
    assert (found["name"], found["machine"]) == ("p", "m")
    assert found["total_s"] > 0.0
    assert all(finding["code"].startswith("plan.") for finding in found["findings"])
    assert ("order" in found) == (kind in ("circular", "sinusoidal"))


@pytest.mark.parametrize(
    ("verb", "option", "key"), [("foreseen", "--check", "detectable"), ("programs", "--out", "programs")]
)
def test_an_option_acts_or_is_refused(plan: tuple[str, Path], tmp_path: Path, verb: str, option: str, key: str) -> None:
    kind, file = plan
    words = [file, option, *([tmp_path / "out"] if option == "--out" else [])]
    if kind_named(kind).offers(verb):
        assert run(*words)[key]
        return
    with pytest.raises(NotOffered) as refused:
        run(*words)
    assert refused.value.got == kind
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--control", "iso"], "without --out"),
        (["--noise-um", "2"], "without --check"),
        (["--check", "--noise-um", "0"], "0 µm"),
        (["--check", "--noise-um", "nan"], "nan µm"),
        (["--out", "programs", "--control", "smoke"], "smoke"),
    ],
)
def test_options_that_would_do_nothing_are_refused(tmp_path: Path, words: list[str], told: str) -> None:
    file = tmp_path / "plan.toml"
    file.write_text(toml(PLANS["linear"]), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        run(file, *words)
    assert told in (refused.value.got or "")


def test_a_dialect_is_refused_where_programs_have_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no programs are written for this control"):
        run("--out", tmp_path / "out", "--control", "iso")
    assert not (tmp_path / "out").exists()


def test_the_record_names_the_dialects_that_are_written() -> None:
    assert kind_named("linear").controls == _CONTROLS


@pytest.mark.parametrize("kind", ["linear", "sinusoidal"])
def test_what_is_detected_grows_with_the_noise_and_falls_with_repeats(kind: str) -> None:
    count = "runs" if kind == "linear" else "repeats"
    once, twice, more = sizes(kind), sizes(kind, 2.0), sizes(kind, **{count: 12})
    seen = [label for label, size in once.items() if math.isfinite(size)]
    assert any(label.startswith("backlash ") for label in seen)
    assert [twice[label] for label in seen] == pytest.approx([2.0 * once[label] for label in seen])
    # Four times the runs: half the size, and less, for the spread is then known better.
    assert all(more[label] < 0.51 * once[label] for label in seen)
    assert not any(map(math.isfinite, sizes(kind, **{count: 1}).values()))


def test_a_step_that_divides_into_the_pitch_sees_no_error_of_the_screw() -> None:
    assert math.isfinite(sizes("linear")["screw_error X"])
    assert math.isinf(sizes("linear", step=10.0)["screw_error X"])


def test_a_delay_shows_in_proportion_to_the_frequency() -> None:
    slow, fast = (sizes("sinusoidal", frequencies_hz=[f])["tracking_delay Z"] for f in (10.0, 20.0))
    assert slow == pytest.approx(2.0 * fast, rel=0.02)


@pytest.mark.parametrize(
    "kind", [kind for kind in kinds() if kind.offers("proposals")], ids=lambda kind: str(kind.name)
)
@pytest.mark.parametrize(
    "known", [{}, {"travel_mm": 150.0}, {"travel_mm": 2000.0, "pitch_mm": 10.0}, {"travel_mm": 37.0, "pitch_mm": 5.08}]
)
def test_every_proposal_is_a_plan_that_the_kind_takes_and_foresees(kind: Kind, known: dict[str, float]) -> None:
    documents = kind.proposals("m", {axis: known for axis in "XYZ"})
    assert len({document["plan"]["name"] for document in documents}) == len(documents) > 0
    for document in documents:
        planned = planned_document(document, "a proposal")
        assert planned.kind == kind.name
        obs = kind.foreseen(planned)
        assert not obs.y_um.any()
        assert min(planned.duration_s, planned.mounting_s) > 0.0
    axes = {axis for document in documents for axis in kind.foreseen(planned_document(document, "p")).axes}
    assert axes == set("XYZ")


def test_no_circle_is_proposed_for_a_single_axis() -> None:
    assert kind_named("circular").proposals("m", {"Z": {}}) == []
