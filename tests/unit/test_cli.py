from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest


def run(*arguments: str, code: str = "") -> subprocess.CompletedProcess[str]:
    command = ["-c", code] if code else ["-m", "dtwin", *arguments]
    return subprocess.run([sys.executable, *command], capture_output=True, text=True, check=False)


def test_help_names_every_command_and_imports_nothing_heavy() -> None:
    shown = run("--help")
    assert shown.returncode == 0
    for command in ("demo", "plan", "simulate", "ingest", "runs", "check", "features", "train",
                    "models", "promote", "rollback", "serve", "report", "twin", "effects",
                    "record", "up", "ui"):  # fmt: skip
        assert f"\n  {command} " in shown.stdout
    heavy = [
        "numpy",
        "pandas",
        "scipy",
        "pyarrow",
        "mlflow",
        "prefect",
        "sklearn",
        "numba",
        "plotly",
        "fastapi",
    ]
    code = f"import dtwin.cli, sys; print([m for m in {heavy!r} if m in sys.modules])"
    assert run(code=code).stdout.strip() == "[]"


def test_without_a_command_the_help_is_shown() -> None:
    assert "Usage:" in run().stdout + run().stderr


def test_check_speaks_json_and_nothing_else(real_recording: Path) -> None:
    found = json.loads(run("check", str(real_recording), "--json").stdout)
    codes = {f["code"] for r in found["runs"] for f in r["findings"]}
    assert {"arc.window_short", "motion.stops", "angle.misregistered", "feed.differs"} <= codes


def test_a_mistake_is_a_message_with_exit_code_1_and_json_when_wanted(tmp_path: Path) -> None:
    (tmp_path / "x.b5r").write_text("<a>")
    plain = run("check", str(tmp_path / "x.b5r"))
    assert plain.returncode == 1
    assert plain.stderr.startswith("error[xml.malformed]")
    assert "Traceback" not in plain.stderr
    wanted = run("check", str(tmp_path / "x.b5r"), "--json")
    assert json.loads(wanted.stdout)["error"]["code"] == "xml.malformed"
    assert wanted.stderr == ""


@pytest.mark.parametrize("blocked", ["pyarrow", "mlflow"])
def test_a_missing_part_is_named_without_a_traceback(blocked: str) -> None:
    command = {"pyarrow": "runs", "mlflow": "models"}[blocked]
    code = (
        f"import sys; sys.modules[{blocked!r}] = None\n"
        f"sys.argv = ['dtwin', {command!r}]\n"
        "from dtwin.cli import main; main()"
    )
    done = run(code=code)
    assert done.returncode == 1
    assert f"needs the package {blocked}" in done.stderr
    assert "Traceback" not in done.stderr
