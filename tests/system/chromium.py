"""How the tests start a browser: as root, and calling nobody; as a plugin of test modules, one browser that they share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial

import pytest
from conftest import require_program
from playwright.sync_api import Browser, sync_playwright

# Playwright's own list, which one of ours takes the place of, and two parts of the address bar, which no test looks
# at: every page that opens would load both, for 0.7 s of a processor.
_ABSENT = (
    "AvoidUnnecessaryBeforeUnloadCheckSync",
    "DestroyProfileOnBrowserClose",
    "HttpsUpgrades",
    "HttpsFirstBalancedModeAutoEnable",
    "LensOverlay",
    "MediaRouter",
    "PaintHolding",
    "ThirdPartyStoragePartitioning",
    "AvoidCorsURLLoaderRestartOnRedirect",
    "OptimizationHints",
    "NetworkTimeServiceQuerying",
    "AimEnabled",
    "PreconnectToSearch",
    "WebUIOmniboxPopup",
    "WebUIOmniboxAimPopup",
)
_FLAGS = [
    f"--disable-features={','.join(_ABSENT)}",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
_running = ExitStack()
_shared: list[Browser] = []


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """The browser of all modules that name this one as a plugin: each start takes four seconds of a processor."""
    if not _shared:
        _shared.append(_running.enter_context(chromium()))
    yield _shared[0]
    for context in _shared[0].contexts:
        context.close()


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(nextitem: pytest.Item | None) -> None:
    """Close the browser when the next test is of a module that does not share it."""
    if nextitem is None or __name__ not in getattr(getattr(nextitem, "module", None), "pytest_plugins", ()):
        _shared.clear()
        _running.close()


@contextmanager
def chromium() -> Iterator[Browser]:
    """A browser; the test is skipped where none is installed."""
    program = require_program("chromium", "chromium")
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=program, args=_FLAGS)
        # What moves while a page waits is drawn sixty times a second, by the processor.
        for opens in ("new_context", "new_page"):
            setattr(started, opens, partial(getattr(started, opens), reduced_motion="reduce"))
        yield started
        started.close()
