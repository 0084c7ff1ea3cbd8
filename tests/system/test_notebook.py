"""The notebook and the page of the Python face are run: what they show is what works."""

from __future__ import annotations

import json
import re
import runpy
import sys
from pathlib import Path

import pytest
from shown_commands import ROOT, alike, blocks, page

import dtwin
from dtwin.notebook.open_home import OpenHome

sys.path.insert(0, str(ROOT / "docs" / "tutorials"))
import run_notebook

pytestmark = pytest.mark.system
PAGE = page("docs/reference/python.md")
NOTEBOOK = json.loads(run_notebook.NOTEBOOK.read_text(encoding="utf-8"))


def test_the_notebook_shows_what_it_showed(tmp_path: Path) -> None:
    for shown, kept in zip(run_notebook.shown(NOTEBOOK["cells"], tmp_path), run_notebook.kept(NOTEBOOK), strict=True):
        lines, before = shown.splitlines(), kept.splitlines()
        assert len(lines) == len(before), shown
        assert all(map(alike, before, lines)), shown


def test_the_page_of_the_notebook_is_made_from_it() -> None:
    assert run_notebook.PAGE.read_text(encoding="utf-8") == run_notebook.page(NOTEBOOK)


def test_the_notebook_is_one_that_jupyter_opens() -> None:
    assert (NOTEBOOK["nbformat"], NOTEBOOK["nbformat_minor"]) == (4, 5)
    names = [cell["id"] for cell in NOTEBOOK["cells"]]
    assert len(set(names)) == len(names)


def test_the_examples_of_the_python_page_hold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    lines = [line for block in blocks(PAGE) for line in block.lines]
    assert {block.language for block in blocks(PAGE)} == {"python"}
    Path("page.py").write_text("\n".join(lines), encoding="utf-8")
    left = runpy.run_path("page.py")
    assert left["home"].show("lathe-z").version == len(left["actions"])


def test_every_name_has_a_part_of_the_page_and_there_are_few() -> None:
    verbs = {name for name in vars(OpenHome) if not name.startswith("_")}
    assert set(re.findall(r"^## `(\w+)\(", PAGE, re.M)) == {"open_home", *verbs}
    assert len(verbs) + 1 <= 15
    assert len(dtwin.__all__) <= 15
