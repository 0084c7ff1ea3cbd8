"""An operator is asked, and answers, in the browser."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect
from test_ui import PATIENCE_MS
from workbench_server import Workbench, running_workbench

from dtwin.config import Home
from dtwin.pipeline.desk import DONE, KEEP, REPEAT, Desk, Question, enter_desk
from dtwin.processes import process

pytestmark = pytest.mark.system
pytest_plugins = ["chromium"]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Workbench]:
    with running_workbench(tmp_path / "home") as started:
        yield started


def test_what_is_asked_is_shown_and_answered(bench: Workbench, browser: Browser, tmp_path: Path) -> None:
    assert "No campaign is being measured" in bench.ask("/measuring")[1]
    folder = tmp_path / "shop"
    folder.mkdir()
    shown: list[str] = []
    desk = Desk(folder, shown.append, lambda: None)
    enter_desk(Home(bench.home), folder)
    first = Question("t001", "t001: run <b>the program</b>", (DONE,), ("t001.nc",), 1, 2)
    desk.ask(first)
    asked = json.loads(bench.ask("/api/measuring")[1])
    (name,) = asked
    # The page loads itself anew when the two differ, as they are written.
    (made_of,) = re.findall("data-seen='(.*?)'", bench.ask("/measuring")[1])
    assert json.dumps(json.loads(made_of)) == json.dumps(asked)
    address = f"/api/measuring/{name}/{first.id}"
    assert bench.ask(f"{address}/done", method="POST", body=b"{}")[0] == 403
    assert bench.act(f"{address}/keep")[0] == 400
    assert bench.act(f"/api/measuring/{name}/other/done")[0] == 400
    assert bench.act(f"/api/measuring/0123/{first.id}/done")[0] == 400
    assert desk.answer() is None
    with browser.new_page() as page:
        page.set_default_timeout(PATIENCE_MS)
        page.goto(bench.address)
        page.wait_for_url("**/machines")
        page.goto(f"{bench.base}/measuring")
        expect(page.locator("main")).to_contain_text("t001: run <b>the program</b>")
        page.get_by_role("button", name="Done").click()
        expect(page.get_by_role("button", name="Done")).to_be_disabled()
        assert _answered(desk) == DONE
        # The next question comes by itself.
        desk.ask(Question("t001", "t001 is spoilt", (REPEAT, KEEP)))
        page.get_by_role("button", name="Keep").click()
        assert _answered(desk) == KEEP
        desk.clear()
        expect(page.locator("main")).to_contain_text("No campaign is being measured")
    assert shown[-1] == "t001 is spoilt"


def _answered(desk: Desk) -> str:
    until = time.monotonic() + 300.0
    while (found := desk.answer()) is None:
        assert time.monotonic() < until
        time.sleep(0.05)
    return found


def test_a_file_that_is_no_question_shows_nothing_and_names_no_other_address(bench: Workbench, tmp_path: Path) -> None:
    folder = tmp_path / "shop"
    folder.mkdir()
    enter_desk(Home(bench.home), folder)
    question = {"run": "t001", "text": "Done?", "answers": ["done"], "asked_by": process(), "id": "0123456789ab"}
    (folder / "desk.json").write_text(json.dumps(question))
    assert len(json.loads(bench.ask("/api/measuring")[1])) == 1
    elsewhere: list[object] = [
        question | {"id": "../../models/mill-a/rollback#"},
        question | {"answers": ["../../../live/mill-a/stop#"]},
        question | {"answers": 5},
        {"asked_by": process()},
        # Of a campaign before the computer was started anew, whose number another process has now.
        question | {"asked_by": process().rpartition(" ")[0] + " 1"},
        [],
        5,
    ]
    for spoilt in elsewhere:
        (folder / "desk.json").write_text(json.dumps(spoilt))
        assert json.loads(bench.ask("/api/measuring")[1]) == {}
        assert "No campaign is being measured" in bench.ask("/measuring")[1]
