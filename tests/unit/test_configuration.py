"""What the environment may set is listed, for people and for the documentation."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from dtwin.config import SETTINGS, quiet_environment

ROOT = Path(__file__).parents[2]
READ = re.compile(r"environ(?:\.get|\.setdefault)?[(\[]\s*\"([A-Z_]+)\"")


def test_every_variable_that_the_code_reads_is_listed() -> None:
    sources = [p for folder in ("dtwin", "flows", "studies") for p in (ROOT / folder).rglob("*.py")]
    read = {name for path in sources for name in READ.findall(path.read_text(encoding="utf-8"))}
    assert len(read) > 3
    assert read <= set(SETTINGS)


def test_onnx_runtime_begins_no_telemetry(tmp_path: Path) -> None:
    environment = {k: v for k, v in os.environ.items() if k != "ORT_DISABLE_TELEMETRY"} | {
        "HOME": str(tmp_path),
        "XDG_CACHE_HOME": str(tmp_path),
    }
    code = "from dtwin.config import quiet_environment; quiet_environment(); import onnxruntime"
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    assert not list(tmp_path.rglob("*")), "it keeps an identifier of the computer here, and what it will send"


def test_a_program_that_is_begun_takes_no_code_from_the_folder_of_the_command(tmp_path: Path) -> None:
    ran = tmp_path / "ran"
    for name in ("mlflow", "numpy", "json"):
        (tmp_path / f"{name}.py").write_text(f"open({str(ran)!r}, 'a').close()\n")
    code = (
        "import subprocess, sys; from dtwin import cli; from dtwin.processes import running_beside; "
        "held = running_beside('dtwin.serve._journal', sys.argv[1] + '.jsonl'); held.__enter__(); "
        "held.__exit__(None, None, None); "
        "cli._run = lambda: subprocess.run([sys.executable, '-m', 'dtwin.twins.registration', sys.argv[1]]); cli.main()"
    )
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"}
    subprocess.run(
        [sys.executable, "-P", "-c", code, str(tmp_path / "home")], env=environment, cwd=tmp_path, check=True
    )
    assert not ran.exists()


@pytest.mark.parametrize("stated", ["", "plant.example,localhost", "*"])
def test_this_computer_is_asked_without_a_proxy(monkeypatch: pytest.MonkeyPatch, stated: str) -> None:
    monkeypatch.setenv("no_proxy", "")  # so that it is as it was after the test
    monkeypatch.delenv("no_proxy")
    monkeypatch.setenv("NO_PROXY", stated)
    monkeypatch.setenv("http_proxy", "http://proxy.plant.example:3128")
    for _ in range(2):
        quiet_environment()
    for host in ("127.0.0.1", "localhost", *filter(None, stated.replace("*", "store.example").split(","))):
        assert urllib.request.proxy_bypass(host)
    assert bool(urllib.request.proxy_bypass("other.example")) == (stated == "*")
    assert os.environ["NO_PROXY"].count("localhost") == (stated != "*")
