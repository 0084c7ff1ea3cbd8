"""The page about LinuxCNC is followed as far as a test has the time."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from real_linuxcnc import skip_without_linuxcnc
from shown_commands import blocks, follow, page

pytestmark = pytest.mark.system


@pytest.mark.long
def test_the_page_is_followed(tmp_path: Path) -> None:
    skip_without_linuxcnc()
    said = follow(blocks(page("docs/how-to/linuxcnc.md")), tmp_path)
    # A turn of R20 at 100 mm/s lasts 1256.6 servo cycles, which fall on 1256 or 1257 of them.
    assert re.search(r"XY R20 F6000 CCW, 125[67] samples at 1000 Hz", said[-1][1])
    assert (tmp_path / "first" / "truth.toml").exists()
