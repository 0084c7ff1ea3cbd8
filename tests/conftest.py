"""Fixtures shared by all tests; no test leaves its temporary folder."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from dtwin.config import quiet_environment, sample_recording

quiet_environment()


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
