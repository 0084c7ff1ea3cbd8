"""Servers that several test modules look at, as a plugin of theirs."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from running_servers import Up, measured, running_up

from dtwin.config import Home


@pytest.fixture(scope="session")
def scheduled_up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Up]:
    """``dtwin up`` that trains every minute, on a home with one quick campaign.

    Servers take half a minute to start: modules that name this one as a plugin share them.
    """
    home = Home(tmp_path_factory.mktemp("up"))
    measured(home, "quick")
    with running_up(home, "--cron", "* * * * *") as up:
        yield up
