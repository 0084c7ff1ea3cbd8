"""Every benchmark in its short form: it runs, and says what it is to say. No time is judged here."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from virtual_robot import free_address

FOLDER = Path(__file__).parents[2] / "benchmarks"
pytestmark = pytest.mark.system


def short(script: str, *options: str) -> Any:
    done = subprocess.run(
        [sys.executable, str(FOLDER / script), "--short", "--json", *options],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return json.loads(done.stdout)


@pytest.mark.long
def test_a_shared_home_says_what_it_asks_of_its_store() -> None:
    found = short("bench_shared_home.py", "--way-ms=1")
    asked = {(row["work"], row["there"]): row["requests"] for row in found["rows"]}
    assert asked["follow, nothing new", 1] == 1
    assert asked["list a campaign", 1] >= 3
    assert {there for _, there in asked} == {1, 3}


def test_none_is_left_out() -> None:
    there = {p.name for p in FOLDER.glob("*.py")}
    assert there == {
        "bench_analogue.py",
        "bench_decision.py",
        "bench_equation.py",
        "bench_features.py",
        "bench_fit.py",
        "bench_fleet.py",
        "bench_flips.py",
        "bench_help.py",
        "bench_ingest.py",
        "bench_loop.py",
        "bench_shared_home.py",
        "bench_tone_tick.py",
        "bench_verbs.py",
        "bench_workbench.py",
        "bench_growth.py",
        "bench_databases.py",
        "cobot_family.py",
        "contradictions.py",
        "correction_band.py",
        "heat_decoys.py",
        "machine_years.py",
        "mechanism_bias.py",
        "next_test.py",
        "one_cobot.py",
        "outside_axis.py",
        "outside_home.py",
        "outside_machine.py",
        "outside_tone.py",
        "plant_year.py",
        "sister_machines.py",
        "two_instruments.py",
        "uncertainty_coverage.py",
    }
    # test_freezes and test_exam_short run these.
    assert {p.parent.name for p in FOLDER.glob("*/run.py")} == {"freezes", "hidden_effect"}
    listed = (FOLDER / "README.md").read_text(encoding="utf-8")
    for name in [*there, "freezes/run.py", "hidden_effect/run.py"]:
        assert f"`{name}`" in listed, f"{name} is not described"


@pytest.mark.long
def test_a_plant_over_months_tells_what_happened_and_nothing_else() -> None:
    found = short("plant_year.py")
    assert found["told"] == {"spoilt.b5r failed": 3, "mill-002 overdue": 6, "mill-000 changed": 7}
    assert found["false"] == []
    # Nothing is taken, or diagnosed, twice or not at all.
    taken = [night["taken_in"] for night in found["nights"]]
    assert taken == [night["diagnosed"] for night in found["nights"]] == 4 * [3] + 3 * [2]
    assert (found["campaigns"], found["runs"]) == (sum(taken), 4 * sum(taken))


@pytest.mark.long
def test_loop() -> None:
    found = short("bench_loop.py", f"--host={free_address()}")
    assert set(found["clients"]) == {"naive", "loop", "loop with priority"}
    for one in found["clients"].values():
        assert one["ticks"] > 0
        assert 0.0 <= one["late_share"] <= 1.0
    assert found["clients"]["loop"]["own_status"]["fault"] is None


@pytest.mark.long
def test_correction_band() -> None:
    found = short("correction_band.py")
    for kind in ("circular", "linear"):
        whole, *parts = [row for row in found if row["kind"] == kind]
        assert whole["machines"] == sum(row["machines"] for row in parts) == 30
        # 30 machines tell a share of 95 % to some 8 %.
        assert 0.82 <= whole["covered"] <= 1.0
        # What fading takes away is small beside the band, whatever the size of the error.
        for row in (whole, *parts):
            assert abs(row["left_faded_um"] - row["left_um"]) < 0.26 * row["half_um"]
            assert row["held_out_faded_um"] < 1.01 * row["held_out_um"]
    # Where there is next to nothing to correct, it helps.
    nothing = next(r for r in found if (r["kind"], r["error_over_band"]) == ("circular", "0 to 0.5"))
    assert nothing["left_faded_um"] < nothing["left_um"]


@pytest.mark.long
def test_flips() -> None:
    found = short("bench_flips.py")
    assert set(found) == {"lake", "twins", "reduced", "bundles"}
    for counts in found.values():
        assert set(counts) <= {"noticed", "harmless"}
        assert sum(counts.values()) == 30
    assert found["bundles"] == {"noticed": 30}


@pytest.mark.long
@pytest.mark.parametrize(
    ("script", "ratios"),
    [
        ("bench_help.py", ["ratio"]),
        (
            "bench_decision.py",
            [
                "as any process.usual_script_over_features_and_equation",
                "as the loop, by default.usual_script_over_features_and_equation",
            ],
        ),
        ("bench_equation.py", ["ratio_of_p50.pyfunc", "ratio_of_p50.forest"]),
        ("bench_features.py", ["ratio_to_usual_script", "ratio_to_tsfel"]),
        ("bench_fit.py", ["times_faster"]),
        ("bench_ingest.py", ["steps.lake.x_plain", "steps.commit.x_plain"]),
        ("bench_tone_tick.py", ["calls"]),
        ("bench_workbench.py", ["runs"]),
        ("bench_growth.py", ["last_to_first.ingest_s", "last_to_first.runs_s"]),
        ("bench_databases.py", ["last_to_first.fit_and_log_s", "last_to_first.flow_s"]),
    ],
)
def test_what_is_timed(script: str, ratios: list[str]) -> None:
    if script == "bench_features.py":
        pytest.importorskip("tsfel")
    found = short(script)
    for ratio in ratios:
        value = found
        for name in ratio.split("."):
            value = value[name]
        assert float(value) > 0.0
    if script == "bench_ingest.py":
        assert found["bit_flips"]["silent"] == 0


@pytest.mark.long
def test_analogue() -> None:
    if not (shutil.which("avr-gcc") and Path("/usr/include/simavr").exists()):
        pytest.skip("avr-gcc or simavr is not installed")
    assert [one["output"] for one in short("bench_analogue.py")["measured"]] == ["dac"] * 2 + ["pwm"] * 2


@pytest.mark.long
def test_mechanism_bias() -> None:
    (rows,) = short("mechanism_bias.py").values()
    assert all({"parameter", "set", "found", "bias"} <= set(row) for row in rows)


@pytest.mark.long
def test_verbs() -> None:
    printed = short("bench_verbs.py")
    assert set(printed) == {"later", "now", "discover"}
    assert len(printed.pop("discover")) == 1
    for found in printed.values():
        assert set(found) == {"fit", "compare", "diagnose", "add", "history"}
        assert all(cpu_s > 0.0 for cpu_s in found.values())


@pytest.mark.long
def test_machine_years() -> None:
    rows = {row["story"]: row for row in short("machine_years.py")}
    assert rows["nothing"]["false_alarms_per_200_tests"] <= 3.0
    assert rows["crash, 1.5 µm"]["found"] > 0.9
    assert rows["crash, 1.5 µm"]["at_the_right_test"] > 0.8


@pytest.mark.long
def test_next_test() -> None:
    (row,) = short("next_test.py")
    assert 0 < row["told by all"] <= row["faults"]
    assert 0.0 < row["proposed, min"] <= row["full, min"] * 1.5


@pytest.mark.long
def test_uncertainty_coverage() -> None:
    rows = {(row["kind"], row["figure"]): row["covered"] for row in short("uncertainty_coverage.py")}
    assert set(rows) >= {
        ("linear", "A"),
        ("linear", "B"),
        ("circular", "D"),
        ("circular", "H"),
        ("poses", "AD"),
        ("poses", "dAP"),
        ("drift", "d"),
        ("rotation", "TIR"),
    }
    # 60 machines: three standard deviations below 95 of 100.
    assert min(rows.values()) > 0.86, rows


@pytest.mark.long
def test_two_instruments() -> None:
    for row in short("two_instruments.py"):
        assert row["of these named with both"] == row["not told by the ball bar"]
        assert row["a false name in one twin"] <= row["a false name by one test"]


@pytest.mark.long
def test_contradictions() -> None:
    rows = short("contradictions.py")
    quiet = [row for row in rows if "friction" not in row["story"]]
    assert len(quiet) == 5
    assert [row["a false contradiction"] for row in quiet] == [0] * 5
    assert [row["since the right day"] for row in quiet] == [1] * 5


@pytest.mark.long
def test_heat_decoys() -> None:
    for row in short("heat_decoys.py"):
        assert row["told with a decoy"] <= row["fitted with a decoy"]
        assert row["sure"] + row["in a group"] + row["nowhere"] == row["causes"] > 0


@pytest.mark.long
def test_one_cobot() -> None:
    row = short("one_cobot.py")
    assert (row["a false contradiction"], row["a change found, since the right day"]) == (0, 1)


@pytest.mark.long
def test_outside_machine() -> None:
    everyday, null = short("outside_machine.py")["rows"]
    assert (everyday["row"], null["row"]) == ("everyday", "null")
    assert set(everyday) == {
        "row",
        "machines",
        "faults that show",
        "named",
        "false names per machine",
        "something unresolved",
        "median s",
        "median s of simulation",
    }
    # Nothing is wrong, and nothing is said to be.
    assert (null["faults that show"], null["named"]) == (0, 0)
    assert (null["false names per machine"], null["something unresolved"]) == (0.0, 0)
    assert 0 < everyday["named"] <= everyday["faults that show"] == 3


def test_outside_axis() -> None:
    found = short("outside_axis.py")
    full, null = found["rows"]
    assert (full["row"], null["row"]) == ("full", "null")
    # Nothing is wrong, and nothing is said to be.
    assert (null["faults that show"], null["named"], null["good runs left out"]) == (0, 0, 0)
    assert (null["false names per machine"], null["something unresolved"]) == (0.0, 0)
    # The first machine has play, and waves of a screw whose pitch is not stated.
    shown = {row["mechanism"]: row["shows"] for row in found["mechanisms"]}
    assert shown == {"backlash": 1, "periodic": 1}
    assert 0 < full["named"] <= full["faults that show"] == 2
    assert full["named"] == sum(row["named"] for row in found["mechanisms"])
    assert full["false names per machine"] == sum(row["times"] for row in found["false names"])


@pytest.mark.long
def test_outside_tone() -> None:
    found = short("outside_tone.py")
    null, single = found["rows"]
    assert (null["row"], single["row"]) == ("null", "single")
    # Nothing is wrong, and nothing is said to be.
    assert (null["faults that show"], null["named"], null["false names per machine"]) == (0, 0, 0.0)
    assert found["mechanisms"] == [{"mechanism": "servo loop", "shows": 1, "named": single["named"]}]


@pytest.mark.long
def test_outside_home() -> None:
    found = short("outside_home.py")
    arm, drift = found["rows"]
    assert (arm["row"], drift["row"]) == ("arm-single", "drift-single")
    # An offset of the elbow is told, among more than three names; what follows the bed is named.
    assert (arm["faults that show"], arm["false names per machine"], arm["something unresolved"]) == (1, 0.0, 0)
    assert (drift["faults that show"], drift["named"], drift["false names per machine"]) == (1, 1, 0.0)
    assert found["mechanisms"][0] == {"mechanism": "follows", "shows": 1, "named": 1}


@pytest.mark.long
def test_cobot_family() -> None:
    (shipped,) = short("cobot_family.py")
    assert shipped["passed"]
    for condition in shipped["conditions"]:
        before, after, best = (condition[k] for k in ("uncompensated", "compensated", "oracle"))
        assert best < after < 0.5 * before


@pytest.mark.long
def test_fleet() -> None:
    rows = short("bench_fleet.py")["rows"]
    assert [row["how"] for row in rows] == [
        "plain loop",
        "in line",
        "two processes",
        "Dask, 1 worker",
        "Dask, 2 workers",
    ]
    assert all(row["of_plain"] > 0.0 for row in rows)


@pytest.mark.long
def test_sister_machines() -> None:
    rows = short("sister_machines.py")
    assert len(rows) == 6
    for row in rows.values():
        assert row["error_ratio"] < 1.1
        assert row["odd_named"] <= row["odd"]
