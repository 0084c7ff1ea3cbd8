"""Fixtures shared by all tests; no test leaves its temporary folder."""

from __future__ import annotations

import gc
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Generator, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer.testing
from hypothesis import settings

from dtwin.config import quiet_environment, sample_recording
from dtwin.schema import Finding
from dtwin.serve import realtime

quiet_environment()
# Days and times of tests are those of the clock here, wherever that is.
os.environ["TZ"] = "UTC"
time.tzset()
# Not by a process in the background, which would outlive the test.
os.environ["DTWIN_MLFLOW"] = "now"
# Commands set it for the programs that they begin; those that run in this process would set it for the next test's scripts.
os.environ.setdefault("PYTHONSAFEPATH", "")
# Thousands of small files, each written through to its disk: in memory where there is room.
_MEMORY = Path("/dev/shm")
if "TMPDIR" not in os.environ and _MEMORY.is_dir() and shutil.disk_usage(_MEMORY).free > 4 << 30:
    os.environ["TMPDIR"] = tempfile.tempdir = str(_MEMORY)
# Building the tree of commands takes longer than most commands do.
typer.testing._get_command = cache(typer.testing._get_command)
# A loop in a test's own process would fault in all that a worker reserves, 1.5 GB: 4 (MCL_ONFAULT) locks what is used.
realtime._LOCK_CURRENT_AND_FUTURE |= 4
# How long an example takes depends on what else the computer does.
settings.register_profile("any computer", deadline=None)
settings.load_profile("any computer")

# These look at servers that take half a minute to start: one worker, one start.
_SHARE_SERVERS = ("test_flows", "test_pages", "test_cell_flow", "test_dynamics_flow", "test_up")
# These share a browser.
_SHARE_BROWSER = ("test_ui", "test_ui_models", "test_ui_live", "test_ui_measuring", "test_ui_axe")
# These look for a twin's versions in MLflow: to tell it takes a third of a second a version, and more in a new home.
_LOOK_AT_MLFLOW = ("test_twins", "test_heat_twins", "test_ui_kinds", "test_home_moving")
# Begun in this order, so that no worker is left alone with minutes of work at the end.
_SLOWEST_FIRST = (
    "test_flows",
    "test_pages",
    "test_cell_flow",
    "test_dynamics_flow",
    "test_up",
    "test_pipeline",
    "test_scheduled",
    "test_serve_command",
    "test_rotation_speeds",
    "test_linuxcnc",
    "test_machine_campaign",
    "test_benchmarks",
    "test_freezes",
    *_SHARE_BROWSER,
    "test_diagnose",
    "test_twin_correction",
    "test_readme",
    "test_twins",
    "test_tutorials",
    "test_examples",
    "test_flow_run",
    "test_robot_faults",
    "test_loop",
    "test_fleet",
    "test_conformance",
    "test_single_recording",
    "test_record_command",
    "test_mill_story",
    "test_linuxcnc_page",
    "test_analogue_serving",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start with the slowest files."""
    items.sort(key=lambda item: _turn(item.path))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect without looking for garbage: what is collected stays, and is not looked at by the tests either."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        # The end of a loop would set it free again, and the next one look through it: a second each.
        gc.unfreeze = lambda: None
        gc.set_threshold(20_000, 20, 20)
        gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Keep a file on one worker; used with ``-n``, as in ``tests/run.sh``."""
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = Path(nodeid.partition("::")[0]).stem
            shared = {"servers": _SHARE_SERVERS, "browser": _SHARE_BROWSER}
            return next((name for name, files in shared.items() if file in files), file)

    return ByFile(config, log)


def _turn(file: Path) -> tuple[int, bool]:
    known = file.stem in _SLOWEST_FIRST
    turn = _SLOWEST_FIRST.index(file.stem) if known else len(_SLOWEST_FIRST)
    return turn, file.parent.name != "system"


@pytest.fixture(scope="module", autouse=True)
def _mlflow_is_told_of_no_twin(request: pytest.FixtureRequest) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        if request.path.stem not in _LOOK_AT_MLFLOW:
            patch.setattr("dtwin.twins.shelf.log_soon", lambda *args, **settings: None)
        yield


@pytest.fixture(autouse=True)
def _own_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.delenv("PREFECT_API_URL", raising=False)


@pytest.fixture(scope="session", autouse=True)
def _tables_made_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Copy the tables that MLflow made in the first home into those that follow: it takes a second to make them."""
    clients = sys.modules.get("dtwin.train._registry_client")
    if clients is None:
        yield
        return
    made, kept = clients.MlflowClient, tmp_path_factory.mktemp("tables") / "mlflow.db"

    def client(tracking_uri: str, registry_uri: str) -> Any:
        file = Path(tracking_uri.removeprefix("sqlite:///"))
        empty = file.is_file() and not file.stat().st_size
        if empty and kept.exists():
            shutil.copyfile(kept, file)
        found = made(tracking_uri=tracking_uri, registry_uri=registry_uri)
        if empty and not kept.exists():
            shutil.copyfile(file, kept.with_name("new.db")).replace(kept)
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clients, "MlflowClient", client)
        yield


@pytest.fixture(scope="session")
def real_recording() -> Path:
    return sample_recording()


def require_program(name: str, package: str, also: str = "") -> str:
    """Return the path of a program; absent it skips, or fails where everything must be there.

    ``also``: a folder that is looked into besides those of the path.
    """
    found = shutil.which(name) or shutil.which(name, path=also)
    if found is None:
        reason = f"{name} is not installed (Debian package {package})"
        if os.environ.get("DTWIN_REQUIRE_ALL"):
            pytest.fail(reason)
        pytest.skip(reason)
    return found


@pytest.fixture
def artifacts(request: pytest.FixtureRequest) -> Path:
    """Folder in which pictures of a test module stay: ``DTWIN_ARTIFACTS``, else ``.artifacts``."""
    root = Path(os.environ.get("DTWIN_ARTIFACTS") or request.config.rootpath / ".artifacts")
    folder = root / request.path.stem
    folder.mkdir(parents=True, exist_ok=True)
    return folder


_OF_CERTIFICATES = [
    "angle",
    "circle_table",
    "circular",
    "drift",
    "laser",
    "linear",
    "poses",
    "radius",
    "reading",
    "rotary",
    "rotation",
    "rtl",
    "run",
    "vendor",
]


@cache
def _in_german(message: str) -> str | None:
    from dtwin.report.language import _german_of

    return _german_of(message, str)


@pytest.fixture(autouse=True)
def _german(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What dtwin finds in a test of a kind of campaign that has a certificate, or what a twin lacks, can be said in German."""
    folder = request.path.parent.name
    if folder not in ("kinds", "physics"):
        yield
        return
    from dtwin.physics.diagnosis import Diagnosis

    told: set[str] = set()
    if folder == "physics":
        diagnosed = Diagnosis.__init__

        def tell_it(self: Diagnosis, *args: Any, **named: Any) -> None:
            diagnosed(self, *args, **named)
            told.update(
                f"{before}: {said}"
                for before, said in ((self.verdict, self.headline), ("next", (self.next_experiment or {}).get("text")))
                if said
            )

        monkeypatch.setattr(Diagnosis, "__init__", tell_it)
    made = Finding.__init__

    def tell(self: Finding, *args: Any, **named: Any) -> None:
        made(self, *args, **named)
        if self.severity != "info" and self.code.partition(".")[0] in _OF_CERTIFICATES:
            told.add(self.message)

    monkeypatch.setattr(Finding, "__init__", tell)
    yield
    assert [message for message in told if _in_german(message) is None] == []
