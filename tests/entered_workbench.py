"""A browser that entered the workbench by the address that it printed."""

from __future__ import annotations

import re

from starlette.testclient import TestClient

from dtwin.workbench._access import KEY


def enter(browser: TestClient, token: str) -> None:
    """Take the cookie, and the key that a page sends with every change."""
    found = re.search(r'data-key="(\w+)"', browser.get("/", params={"token": token}).text)
    assert found
    browser.headers[KEY] = found[1]
