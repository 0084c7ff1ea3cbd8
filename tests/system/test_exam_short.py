"""The hidden-effect exam in its short form: the same code, a few cases."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.system, pytest.mark.long]
SCRIPT = Path(__file__).parents[2] / "benchmarks" / "hidden_effect" / "run.py"
VERDICTS = {"missing_effect", "ambiguous", "unknown_effect", "nothing_missing", "need_repeats", "variance_effect"}


def _exam(out: Path, *options: str) -> str:
    done = subprocess.run(
        [sys.executable, str(SCRIPT), "--short", "--out", str(out), *options],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    out = tmp_path_factory.mktemp("exam") / "cases.jsonl"
    return out, _exam(out)


def _records(out: Path) -> list[dict]:
    return [json.loads(line) for line in out.read_text().splitlines()]


def test_every_case_is_answered_and_marked(short):
    records = _records(short[0])
    assert len(records) == 3
    assert all(r["verdict"] in VERDICTS for r in records)
    assert all(r["right"] for r in records if r["row"] == "one_repeat")
    assert all(r["right"] for r in records if r["row"] == "single_one")


def test_the_controls_sat_the_same_cases_and_everything_says_the_most(short):
    seen = [r for r in _records(short[0]) if r.get("controls")]
    assert {r["row"] for r in seen} == {"null_plain", "single_one"}
    for record in seen:
        everything = record["controls"]["everything"]
        assert len(everything) > 5 + len(record["group"])
        assert all(set(names) <= {*everything, "?"} for names in record["controls"].values())


def test_a_finished_exam_adds_nothing_and_prints_the_same_table(short):
    out, table = short
    before = out.read_bytes()
    # A line that was cut off is not a case.
    with out.open("a") as cut:
        cut.write('{"row": "null_pl\n')
    assert _exam(out) == table
    assert out.read_bytes().startswith(before)
    assert out.read_text().count("\n") == before.count(b"\n") + 1
