"""The pages that say how to add something are followed to the letter."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from shown_commands import blocks, follow, here, page

from dtwin.kinds import registry
from dtwin.kinds.kind import NotOffered
from dtwin.kinds.registry import kind_named, machine_named
from dtwin.notebook.open_home import open_home

pytestmark = pytest.mark.system


def forget() -> None:
    """Have the package of the pages read anew: a reader edits it between two commands."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "level_kind"]:
        del sys.modules[name]
    importlib.invalidate_caches()
    registry._of_others.cache_clear()
    registry.kind_named.cache_clear()


@pytest.fixture
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return a folder in which ``pip`` installs nothing outside of it, and asks no network."""
    for name, value in {
        "PREFIX": str(tmp_path / "installed"),
        "NO_DEPS": "1",  # Of this one option pip takes the value for whether to isolate.
        "NO_BUILD_ISOLATION": "0",
        "DISABLE_PIP_VERSION_CHECK": "1",
        "NO_INDEX": "1",
    }.items():
        monkeypatch.setenv(f"PIP_{name}", value)
    yield tmp_path
    forget()


def test_a_package_of_others_grows_by_a_kind_a_reader_and_a_machine(
    fresh: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def runner(command: str, folder: Path) -> str:
        forget()
        said = here(command, folder)
        if command.startswith("pip "):
            (installed,) = (folder / "installed").rglob("dtwin_level_kind-*.dist-info")
            monkeypatch.syspath_prepend(installed.parent)
            # What the interpreter would take from the .pth file there when it starts.
            monkeypatch.syspath_prepend(folder / "level-kind")
        return said

    follow(blocks(page("docs/how-to/add-a-kind.md")), fresh, runner)
    with pytest.raises(NotOffered, match="training is not offered for level"):
        kind_named("level").training()
    drawn = open_home(fresh / "home").plot("levels-of-march", "x1")
    assert max(drawn.data[0].y) == pytest.approx(0.2)
    follow(blocks(page("docs/how-to/add-a-reader.md")), fresh, runner)
    follow(blocks(page("docs/how-to/add-a-virtual-machine.md")), fresh, runner)
    assert machine_named("planer").kind == "level"
    straight = json.loads(here("dtwin check straight --json", fresh))["straightness_um"]
    assert all(value < 0.5 for value in straight.values())


def test_a_control_takes_a_correction_and_lets_it_go(tmp_path: Path) -> None:
    follow(blocks(page("docs/how-to/add-a-control.md")), tmp_path, here)


def test_an_effect_in_a_file_is_fitted_and_found_absent(tmp_path: Path) -> None:
    follow([b for b in blocks(page("docs/how-to/add-an-effect.md")) if "pytest" not in b.lines[0]], tmp_path, here)
    shown = json.loads(here("dtwin twin show mine --effects-path belt_stretch.py --json", tmp_path))
    belt = [p for p in shown["parameters"] if p["effect"] == "belt_stretch"]
    assert len(belt) == 2
    assert all(abs(p["value"]) < 2.0 * p["uncertainty"] for p in belt)
