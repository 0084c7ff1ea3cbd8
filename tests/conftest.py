"""Fixtures shared by all tests; no test leaves its temporary folder."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from dtwin.config import quiet_environment, sample_recording

quiet_environment()

# These look at servers that take half a minute to start: one worker, one start.
_SHARE_SERVERS = ("test_flows", "test_pages")
# Begun in this order, so that no worker is left alone with minutes of work at the end.
_SLOWEST_FIRST = (
    "test_flows",
    "test_pages",
    "test_pipeline",
    "test_scheduled",
    "test_serve_command",
)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep a file on one worker, and start with the slowest; see ``tests/run.sh``."""
    if not config.pluginmanager.hasplugin("xdist"):
        return
    for item in items:
        file = item.path.stem
        group = "servers" if file in _SHARE_SERVERS else file
        item.add_marker(pytest.mark.xdist_group(group))
    items.sort(key=lambda item: _turn(item.path))


def _turn(file: Path) -> tuple[int, bool]:
    known = file.stem in _SLOWEST_FIRST
    turn = _SLOWEST_FIRST.index(file.stem) if known else len(_SLOWEST_FIRST)
    return turn, file.parent.name != "system"


@pytest.fixture(autouse=True)
def _own_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.delenv("PREFECT_API_URL", raising=False)


@pytest.fixture(scope="session")
def real_recording() -> Path:
    return sample_recording()


def require_program(name: str, package: str) -> str:
    """Return the path of a program; absent it skips, or fails where everything must be there."""
    found = shutil.which(name)
    if found is None:
        reason = f"{name} is not installed (Debian package {package})"
        if os.environ.get("DTWIN_REQUIRE_ALL"):
            pytest.fail(reason)
        pytest.skip(reason)
    return found
