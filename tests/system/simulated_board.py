"""The board's firmware and its simulator, compiled once for a module, as a plugin of its tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from simulated_analogue_board import build_board

from dtwin.errors import MissingPart
from dtwin.links.analogue_firmware import build_firmware


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board")
    try:
        build_firmware(folder / "analogue_correction-250000.elf")
        build_board(folder / "analogue_board")
    except MissingPart as error:
        if os.environ.get("DTWIN_REQUIRE_ALL"):
            raise
        pytest.skip(f"{error}: {error.hint}")
    return folder
