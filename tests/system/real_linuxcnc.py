"""Whether a real LinuxCNC can run here, for the tests that need it."""

from __future__ import annotations

import os

import pytest

from dtwin.errors import MissingPart
from dtwin.machines.linuxcnc.instance import require_linuxcnc


def skip_without_linuxcnc() -> None:
    """Skip where LinuxCNC cannot run, or fail where every part must be there."""
    try:
        require_linuxcnc()
    except MissingPart as error:
        # A kernel that forbids namespaces is no part that could be installed.
        if os.environ.get("DTWIN_REQUIRE_ALL") and error.code != "linuxcnc.namespaces":
            raise
        pytest.skip(f"{error}: {error.hint}")
