"""Pictures of the documentation's front page: each is there, small, and photographed by its command."""

from __future__ import annotations

import importlib.util
import struct
from pathlib import Path
from types import ModuleType

import pytest
from conftest import require_program

from dtwin.acquire.ingest import ingest
from dtwin.acquire.virtual_mill import simulate_mill
from dtwin.config import Home
from dtwin.lake.store import Lake
from dtwin.twins.verbs import Twins

pytestmark = pytest.mark.system
DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def workbench() -> ModuleType:
    spec = importlib.util.spec_from_file_location("page_pictures", DOCS / "pictures" / "workbench.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def size_of(file: Path) -> tuple[int, int]:
    head = file.read_bytes()[:24]
    assert head[:8] == b"\x89PNG\r\n\x1a\n"
    return struct.unpack(">II", head[16:24])


def test_the_front_page_shows_what_the_command_writes(workbench: ModuleType) -> None:
    shown = (DOCS / "index.md").read_text(encoding="utf-8")
    for picture in workbench.PICTURES:
        file = DOCS / "pictures" / picture.file
        assert f"](pictures/{picture.file})" in shown
        assert 10_000 < file.stat().st_size <= 1000 * workbench.LARGEST_KB
        assert size_of(file)[0] == workbench._WIDTH


@pytest.mark.long
def test_pages_are_photographed(workbench: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CHROMIUM", str(require_program("chromium", "chromium")))
    home = Home(tmp_path / "home")
    simulate_mill(tmp_path / "mill", quick=True)
    ingest(tmp_path / "mill", Lake(home.lake))
    Twins(home).fit("mill-backlash", ["scale_mismatch", "squareness"], "mill")
    here = tuple(p for p in workbench.PICTURES if p.address.startswith(("/campaigns", "/twins")))
    made = workbench.photographed(home.root, tmp_path, here)
    assert [file.name for file in made] == ["test-sheet.png", "diagnosis.png"]
    assert all(size_of(file)[0] == workbench._WIDTH and file.stat().st_size > 10_000 for file in made)
    with pytest.raises(ValueError, match="404"):
        workbench.photographed(home.root, tmp_path, (workbench.Picture("x.png", "/campaigns/nix"),))
