"""The page about LinuxCNC is followed as far as a test has the time."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from shown_commands import blocks, follow, page

from dtwin.errors import MissingPart
from dtwin.machines.linuxcnc.session import require_linuxcnc

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]


def test_the_page_is_followed(tmp_path: Path) -> None:
    try:
        require_linuxcnc()
    except MissingPart as error:
        # A kernel that forbids namespaces is no part that could be installed.
        if os.environ.get("DTWIN_REQUIRE_ALL") and error.code != "linuxcnc.namespaces":
            raise
        pytest.skip(f"{error}: {error.hint}")
    said = follow(blocks(page("docs/how-to/linuxcnc.md")), tmp_path)
    assert "XY R20.0 F6000.0 CCW, 1257 samples at 1000 Hz" in said[-1][1]
    assert (tmp_path / "first" / "truth.toml").exists()
