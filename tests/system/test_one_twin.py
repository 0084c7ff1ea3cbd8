"""One machine, one twin: as a new user would, from folders of a ball bar and two lasers to a name that none has alone."""

from __future__ import annotations

import re
import time
from pathlib import Path

import numpy as np
import pytest
from command_here import printed, refused, said
from entered_workbench import enter
from laser_axis import write_laser
from mill_and_laser import write_circles
from starlette.testclient import TestClient

from dtwin.acquire.ingest import ingest
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.lake.store import Lake
from dtwin.machines.mill_parameters import MillParameters
from dtwin.report.text import listed, micrometres
from dtwin.report.twin_of_campaigns import diagnosis_text
from dtwin.twins.several_campaigns import require_together
from dtwin.twins.verbs import Twins
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application

pytestmark = pytest.mark.system


ALL = ("bar", "laser-x", "laser-y")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with campaigns of two machines, and a home that took them in."""
    root = tmp_path_factory.mktemp("one-twin")
    write_circles(root / "bar", "mill-7", MillParameters().with_axis("X", scale_ppm=30.0, play_um=3.0))
    write_laser(root / "laser-x", "mill-7", "X", 30.0, 3.0, 2)
    write_laser(root / "laser-y", "mill-7", "Y", 0.0, 0.0, 3)
    write_laser(root / "later", "mill-7", "X", 30.0, 7.0, 4)
    write_laser(root / "mended", "mill-7", "X", 30.0, 0.2, 5)
    write_laser(root / "elsewhere", "mill-8", "X", 0.0, 0.0)
    for name in (*ALL, "later", "mended", "elsewhere"):
        ingest(root / name, Lake(root / "home" / "lake"))
    return root


@pytest.fixture
def home(made: Path, monkeypatch: pytest.MonkeyPatch) -> Home:
    monkeypatch.setenv("DTWIN_HOME", str(made / "home"))
    return Home(made / "home")


def test_what_one_test_leaves_open_is_named_by_one_twin(home: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = said("twin", "fit", "bar", "--effects", "", "--name", "alone")
    assert "campaigns" not in alone
    open_groups = [group for group in said("twin", "diagnose", "alone")["found"] if len(group) > 1]
    assert [group[0]["effect"] for group in open_groups] == ["scale_mismatch"]
    made = said("twin", "fit", *ALL, "--effects", "", "--name", "all")
    assert [c["campaign"] for c in made["campaigns"]] == list(ALL)
    told = said("twin", "diagnose", "all")
    assert told["verdict"] == "missing_effect"
    assert [[s["effect"] for s in group] for group in told["found"]] == [["lead_error"], ["backlash"]]
    assert {s["campaign"] for s in told["settled"]} == {"bar"}
    # What they say together is kept, and what each says by itself.
    with monkeypatch.context() as kept:
        kept.setattr("dtwin.twins.verbs.diagnose_several", None)
        assert said("twin", "diagnose", "all") == told
        text = printed("twin", "diagnose", "all")
    assert "settled: bar could not tell" in text
    # Each row says of which campaign it is, beside what is left of that one.
    rows = [re.split(" {2,}", line) for line in text.splitlines()]
    left = {c["campaign"]: micrometres(c["residual_rms_um"]) for c in told["campaigns"]}
    ranked = [row for row in rows if len(row) > 5 and row[1] in ALL]
    assert [row[0] for row in ranked] == [f"{c['effect']} {c['axis']}".rstrip() for c in told["candidates"]]
    assert all(row[2] == left[row[1]] for row in ranked)
    assert "scale_mismatch XY or " in text
    assert "unless the machine changed" not in text
    told["settled"][0]["judged"][0]["said"] = "is a part"
    assert "unless the machine changed between 2025-01-" in diagnosis_text("all", told)
    told["settled"][0]["judged"][0]["said"] = "agrees"
    monkeypatch.setattr("dtwin.twins.verbs.kept_several", lambda *_: None)
    monkeypatch.setattr("dtwin.physics.several_diagnosis.diagnose", None)
    assert said("twin", "diagnose", "all") == told


def test_discover_adds_it_and_nothing_is_missing_then(home: Home) -> None:
    printed("twin", "fit", *ALL, "--effects", "", "--name", "found")
    found = said("twin", "discover", "found")
    assert found["added"] == ["lead_error X", "backlash X"]
    assert found["final"]["verdict"] == "nothing_missing"
    shown = said("twin", "show", "found")
    sizes = {f"{e['effect']} {e['axis']}": e for e in shown["effects"]}
    for label, truth, unit in (("lead_error X", 30.0, "ppm"), ("backlash X", 3.0, "um")):
        assert sizes[label]["value"] == pytest.approx(truth, abs=1.5 * sizes[label]["k2"])
        assert sizes[label]["unit"] == unit
    assert shown["contradictions"] == []
    # The file is the twin: what was stored opens as what was made.
    again = Twins(home).newest("found")
    assert again.as_dict()["parameters"] == shown["parameters"]


def test_the_loop_goes_on(home: Home) -> None:
    printed("twin", "fit", *ALL, "--effects", "lead_error:X,backlash:X", "--name", "loop")
    added = said("twin", "add", "loop", "squareness")
    assert added["figures"]["rms_after_um"] <= added["before"]["rms_after_um"] + 1e-3
    assert refused("twin", "add", "loop", "scale_mismatch", "--axis", "X").code == "twin.has_effect"
    removed = said("twin", "remove", "loop", "squareness")
    assert [e["effect"] for e in removed["effects"]] == ["lead_error", "backlash"]
    back = said("twin", "restore", "loop", "--version", "2")
    assert [e["effect"] for e in back["effects"]] == ["lead_error", "backlash", "squareness"]
    compared = said("twin", "compare", "loop")
    assert [c["campaign"] for c in compared["campaigns"]] == list(ALL)
    assert all(c["residual_rms_um"] < 1.2 * c["noise_floor_um"] for c in compared["campaigns"])
    assert said("twin", "compare", "loop", "--on", "laser-x")["campaign"] == "laser-x"
    # A campaign that it was not fitted to: sizes are those of the machine, by the name that they have there.
    later = said("twin", "compare", "loop", "--on", "later")
    assert later["residual_rms_um"] == pytest.approx(2.0, abs=0.3)
    rungs = said("twin", "history", "loop")["rungs"]
    assert [r["campaigns"] for r in rungs] == [list(ALL)] * 4
    page = home.root / "loop.html"
    printed("twin", "show", "loop", "--html", str(page))
    assert "laser-y" in page.read_text(encoding="utf-8")


def test_mistakes_are_refused_with_the_reason(home: Home) -> None:
    printed("twin", "fit", *ALL, "--effects", "backlash:X", "--name", "wrong")
    assert refused("twin", "fit", "bar", "elsewhere", "--effects", "", "--name", "no").code == "twin.machines"
    assert refused("twin", "fit", "bar", "bar", "--effects", "", "--name", "no").code == "twin.campaign_twice"
    with pytest.raises(InputError, match="has no twin"):
        require_together([("bar", "mill-7", "circular"), ("spindle", "mill-7", "rotation")])
    assert refused("twin", "budget", "wrong").code == "budget.campaign"
    assert said("twin", "budget", "wrong", "--on", "bar")["shares"]
    which = refused("twin", "correct", "wrong")
    assert (which.code, which.allowed) == ("twin.which", ", ".join(ALL))
    assert refused("twin", "correct", "wrong", "--on", "later").code == "twin.campaign"


def test_the_sizes_of_all_correct_the_path_of_one(home: Home) -> None:
    printed("twin", "fit", *ALL, "--effects", "lead_error:X,backlash:X", "--name", "moved")
    made = said("twin", "correct", "moved", "--on", "bar", "--trial")
    assert made["campaign"] == "bar"
    # Circles of one feed do not confirm a law; what lasers tell is not enough for every feed.
    assert made["objections"] == [f"{label}: shape-consistent" for label in ("scale_mismatch X", "backlash X")]
    # The one feed is left out of all circles, and foretold by the lasers, which know none.
    assert {g["gate"]: g["passed"] for g in made["gates"]}["held-out conditions"]
    assert [t["included"] for t in made["terms"]] == [True, True]
    assert all(p["rms_predicted_um"] < 0.3 * p["rms_before_um"] for p in made["predicted"])
    told = made["by_others"]
    assert (told["campaigns"], told["unknown"]) == (["laser-x", "laser-y"], [])
    assert told["after_um"] < 0.3 * told["before_um"]
    rows = printed("export", "moved", "--as", "csv", "--out", str(home.root / "moved.csv"))
    assert "travel -100 to 100 mm" in rows
    # Lost motion was mended; a laser says so by another name of the cause, and without one of the campaigns.
    mended = said("twin", "confirm", "moved", "backlash:X", "--after", "mended", "--after", "laser-y")
    assert (mended["grade"], mended["before_campaign"]) == ("intervention-confirmed", "bar, laser-x")
    kept = said("twin", "confirm", "moved", "scale_mismatch:X", "--after", "mended")
    assert kept["grade"] is None
    assert kept["changes"][0]["after"] == pytest.approx(30.0, abs=1.0)
    assert refused("twin", "confirm", "moved", "friction:X", "--after", "mended").code == "twin.no_effect"
    every = [part for name in ALL for part in ("--after", name)]
    assert refused("twin", "confirm", "moved", "backlash:X", *every).code == "twin.not_after"
    assert 'name="on"' in client(home).get("/twins/moved/versions").text


def test_a_laser_that_contradicts_the_ball_bar_is_named_on_command_and_page(home: Home) -> None:
    made = said("twin", "fit", "bar", "later", "--effects", "backlash:X,lead_error", "--name", "apart")
    (told,) = made["contradictions"]
    assert (told["effect"], told["axis"]) == ("backlash", "X")
    assert abs(told["difference"]) == pytest.approx(4.0, abs=1.0)
    assert "contradiction since 2026-03-02" in printed("twin", "show", "apart")
    assert "contradiction since 2026-03-02" in client(home).get("/twins/apart").text
    shown = (("twin", "show", "apart"), ("twin", "compare", "apart"), ("twin", "diagnose", "apart"))
    for words in shown:
        assert "nothing is recorded between 2025-01-01 and 2026-03-02" in printed(*words)
    printed("machine", "event", "mill-7", "crash", "--on", "2025-06-07", "--note", "vice")
    for words in shown:
        assert "since the crash of 2025-06-07 (vice)" in printed(*words)
    assert "since the crash of 2025-06-07 (vice)" in client(home).get("/twins/apart").text


def client(home: Home) -> TestClient:
    return TestClient(application(Bench(home, Access("127.0.0.1", 8765))), base_url="http://127.0.0.1:8765")


def test_pages_of_the_twin_show_all_its_campaigns(home: Home) -> None:
    printed("twin", "fit", *ALL, "--effects", "lead_error", "--name", "seen")
    printed("twin", "diagnose", "seen")
    open_page = client(home).get
    compare = open_page("/twins/seen")
    # Circles alone do not tell the scales of two axes from the radius; the lasers do.
    assert "not told" not in compare.text
    assert "cannot be told apart" not in compare.text
    assert all(f"/campaigns/{name}" in compare.text for name in ALL)
    said = open_page("/twins/seen/diagnose").text
    assert "found by itself" in said.partition("of each other")[2].partition("</section>")[0]
    for address in ("", "?on=laser-x", "/versions", "/report.html"):
        assert open_page(f"/twins/seen{address}").status_code == 200, address
    for figure in ("overlay/angle?on=laser-x", "map?on=laser-y", "waterfall", "ranked", "signature?effect=backlash X"):
        assert open_page(f"/api/twins/seen/{figure}").status_code == 200, figure
    assert "/campaigns/laser-y" in open_page("/twins").text


def test_the_budget_of_a_program_is_on_the_page_of_a_twin(home: Home) -> None:
    printed("twin", "fit", "bar", "--effects", "backlash:X,scale_mismatch", "--name", "parts")
    bench = Bench(home, Access("127.0.0.1", 8765))
    opened = TestClient(
        application(bench), base_url="http://127.0.0.1:8765", headers={"Origin": "http://127.0.0.1:8765"}
    )
    enter(opened, bench.access.token)
    (own, *others), *_ = said("twin", "diagnose", "parts")["undecided"]
    page = opened.get("/twins/parts/budget").text
    assert "left without it" in page
    assert "Preload or renew" in page
    assert "these runs do not tell" in page
    assert f"these runs do not tell {own} from {listed(others)}" in printed("twin", "budget", "parts")
    part = home.root / "part.nc"
    program = "G21 G90 G17\nG0 X80 Y60\nG1 X160 F2000\nG1 Y100\nG1 X80\nG1 Y60\nM30\n"
    told = {"program": program, "file": "part.nc", "x_mm": 120.0, "y_mm": 80.0, "z_mm": 0.0}
    job = opened.post("/api/twins/parts/program", json=told).json()["job"]
    deadline = time.monotonic() + 300.0
    while time.monotonic() < deadline and not ((made := bench.jobs.get(job)) and made.ended):
        time.sleep(0.01)
    page = opened.get("/twins/parts/budget").text
    assert "part.nc, with version 1 of the twin" in page
    assert "240 mm at feed" in page
    assert "Backlash X: Preload or renew" in page
    part.write_text(program, encoding="ascii")
    printed("twin", "fit", *ALL, "--effects", "lead_error:X,backlash:X", "--name", "several")
    printed("twin", "fit", "bar", "--effects", "backlash", "--name", "both-axes")
    # The play of Y is nothing: there is nothing to renew.
    for program_of in ((), ("--program", str(part), "--origin", "120,80,0")):
        lines = printed("twin", "budget", "both-axes", *program_of).split("\n")
        assert "backlash Y: These runs do not tell it from zero." in lines
        assert any(line.startswith("backlash X: Preload") for line in lines)
    causes = said("twin", "budget", "several", "--program", str(part), "--origin", "120,80,0")["causes"]
    # 30 ppm over 40 mm at the sides, the mean square of a third of it between them.
    assert [c["label"] for c in causes] == ["backlash X", "lead_error X"]
    assert causes[1]["rms_um"][""] == pytest.approx(1.2 * np.sqrt((2.0 / 3.0) * (1.0 / 3.0) + 1.0 / 3.0), abs=0.03)
    assert causes[1]["rms_um"]["YZ"] == 0.0
    # What a ball bar calls otherwise has the twin's name on its circles, and in the machine's history, too.
    assert [s["label"] for s in said("twin", "budget", "several", "--on", "bar")["shares"]] == [
        c["label"] for c in causes
    ]
    (lead,) = [s for s in said("machine", "show", "mill-7")["series"] if s["title"] == "Lead error, X"]
    assert {"bar", "laser-x"} <= {point["campaign"] for point in lead["points"]}
    printed("twin", "fit", "laser-x", "--effects", "lead_error", "--name", "strokes")
    assert refused("twin", "budget", "strokes", "--program", str(part)).code == "budget.circles"
    assert opened.post("/api/twins/parts/program", json={**told, "program": "G1 X\u00e4"}).status_code == 400
