"""The thesis's mill, told right: the tutorial is executed, and ends where it says."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from dtwin.cli import app
from dtwin.config import Home
from dtwin.serve.pointer import resolve
from studies.report.mill_story import mill_story_text

ROOT = Path(__file__).parents[2]
MACHINE = "told-right-mill"
pytestmark = [pytest.mark.system, pytest.mark.long]


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Run the page's commands with --json, and keep what they said."""
    folder = tmp_path_factory.mktemp("story")
    text = (ROOT / "docs" / "tutorials" / "mill-told-right.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.S | re.M)
    said: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DTWIN_HOME", str(folder / "home"))
        patch.chdir(folder)
        for line in (line for block in blocks for line in block.strip().splitlines()):
            done = CliRunner().invoke(app, [*line.split()[1:], "--json"])
            assert done.exit_code == 0, f"{line}\n{done.exception}\n{done.stdout}"
            said[line] = json.loads(done.stdout)
    return folder / "home", said


def story(told: Any) -> dict[str, Any]:
    return next(v for k, v in told[1].items() if k.startswith("dtwin demo mill"))


def test_a_map_of_one_session_is_right_in_it_and_makes_a_later_one_worse(told: Any) -> None:
    found = story(told)
    assert all(row["r2"] > 0.9 for row in found["learned"]["rows"])
    assert found["learned"]["mounting_share"] > 0.9
    served = found["later"]["ways"]["map of one session"]
    assert [c["feed_mm_min"] for c in served] == [100.0, 250.0, 500.0]
    assert all(c["worse"] and c["ratio"] > 1.2 for c in served)
    promised = max(row["after_um"] for row in found["learned"]["rows"])
    assert min(c["raw_after_um"] for c in served) > 10 * promised


def test_promotion_refuses_it_and_says_why(told: Any) -> None:
    gates = story(told)["map_gates"]
    assert all(v["passed"] for v in gates["offline"])
    assert "closed-loop evidence: none" in gates["without_evidence"]
    assert not gates["champion"]
    assert "no condition worse: XY R50 F100" in gates["with_evidence"]
    assert "error falls: 0 of 3" in gates["with_evidence"]


def test_what_was_missing_is_named_added_and_halves_the_error_in_every_feed(told: Any) -> None:
    home, _ = told
    found = story(told)
    twin = found["twin"]
    assert (twin["verdict"], twin["added"]) == ("missing_effect", "thermal_growth X")
    assert {g["grade"] for g in twin["grades"]} == {"law-confirmed"}
    (growth,) = [e for e in twin["estimates"] if e["effect"] == "thermal_growth X"]
    truth = (home / "campaigns" / twin["name"] / "truth.toml").read_text(encoding="utf-8")
    assert "growth_um_m_k = 20.0" in truth
    assert growth["value"] == pytest.approx(20.0, abs=1.0)
    for c in found["later"]["ways"]["told right"]:
        assert c["ratio"] + c["ratio_half_width"] <= 0.5
        assert c["halved"]
        assert c["after_um"] < 1.25 * c["oracle_um"]
        assert c["acted"] == {"ok": 1.0}
    assert found["twin_gates"]["champion"]
    served = resolve("latest", MACHINE, Home(home))
    assert served.version == int(found["twin_gates"]["version"])


def test_defects_are_caught_by_name_or_said_not_to_be(told: Any) -> None:
    found = story(told)
    by = {d["defect"]: d for d in found["defects"]}
    assert by["as it should be"]["caught"] == []
    assert "no condition worse" in by["sign flipped"]["caught"]
    assert "error falls" in by["axes swapped"]["caught"]
    assert by["trained at 1651 Hz"]["caught"] == ["train and serve agree"]
    assert by["1 s old, and its age known"]["caught"] == [f"guard of {MACHINE}: stale"]
    right = by["as it should be"]["ratio"]
    coarse = next(d for d in found["defects"] if d["defect"].startswith("8-bit"))
    assert coarse["ratio"] > 1.2 * right
    text = mill_story_text(found)
    for name in found["nothing_catches"]:
        assert re.search(rf"^{re.escape(name)} .* NOTHING$", text, re.M)


def test_the_text_tells_all_of_it(told: Any) -> None:
    text = mill_story_text(story(told))
    assert "grows in 3 of 3 feeds" in text
    assert "halved, or better, in every feed" in text
    assert "REFUSED" in text
    assert re.search(r"^100 +regression +0\.99, 0\.97 +-41\.3 % +-490\.7 %$", text, re.M)
    assert re.search(r"^100 +symbolic +1\.00, 0\.53 +-11\.6 % +-790\.8 %$", text, re.M)


def test_its_evidence_is_in_the_lake_and_refuses_the_map_again(told: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    home, _ = told
    monkeypatch.setenv("DTWIN_HOME", str(home))
    version = story(told)["map_gates"]["version"]
    done = CliRunner().invoke(app, ["promote", version, "--machine", MACHINE, "--json"])
    assert done.exit_code == 3
    found = json.loads(done.stdout)
    assert "no condition worse: XY R50 F100" in found["reason"]
    assert found["evidence"]["campaigns"] == {way: [f"evidence-{MACHINE}-v{version}"] for way in ("without", "with")}
