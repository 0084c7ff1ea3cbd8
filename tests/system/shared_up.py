"""Servers that several test modules look at, as a plugin of theirs."""

from __future__ import annotations

from contextlib import ExitStack

import pytest
from running_servers import Up, measured, running_up

from dtwin.config import Home

_running = ExitStack()


@pytest.fixture(scope="session")
def shared_up(tmp_path_factory: pytest.TempPathFactory) -> Up:
    """``dtwin up`` on a home with one quick campaign.

    Servers take half a minute to start: modules that name this one as a plugin share them.
    """
    home = Home(tmp_path_factory.mktemp("up"))
    measured(home, "quick", radii=2)
    return _running.enter_context(running_up(home, "--no-schedule"))


def pytest_runtest_teardown(nextitem: pytest.Item | None) -> None:
    """Stop the servers when the next test is of a module that does not share them."""
    if nextitem is None or __name__ not in getattr(getattr(nextitem, "module", None), "pytest_plugins", ()):
        _running.close()
