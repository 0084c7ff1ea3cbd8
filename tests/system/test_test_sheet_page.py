"""The page about test sheets and machines is followed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from shown_commands import blocks, follow, here, page

pytestmark = pytest.mark.system


def test_the_page_is_followed(tmp_path: Path) -> None:
    said = follow(blocks(page("docs/how-to/test-sheet.md")), tmp_path, here)
    by = {command.split("dtwin ", 1)[1]: text for command, text in said}
    untold = by["check examples/hidden-effect"]
    assert "ISO 230-4, circular test: no tolerance is stated" in untold
    # Runs are told to a hundredth of a micrometre, as the sheet above them.
    assert re.search(r"\nr001 +\d+\.\d\d +\d+\.\d\d  ", untold)
    assert "hit the vice" in by["machine show virtual-mill"]
    assert "cannot say" in by["machine show virtual-mill"]
    assert "ISO 230-4, circular test: cannot say" in by["check hidden-effect"]
