"""How the tests start a browser: as root, and calling nobody."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

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
