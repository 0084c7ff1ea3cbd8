from __future__ import annotations

import asyncio
import io
import json
import select
import socket
import sqlite3
import subprocess
import sys
import threading
import time
import tomllib
import zipfile
from contextlib import ExitStack
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import uvicorn
from entered_workbench import enter
from starlette.testclient import TestClient

from dtwin.acquire.ingest import ingest
from dtwin.config import Home
from dtwin.errors import InputError, StoreError
from dtwin.lake.store import Lake
from dtwin.links import layout
from dtwin.machine_record import events_of, keep_record, tolerances_of, with_event
from dtwin.physics.experiment import planned_observations
from dtwin.physics.gridding import Condition
from dtwin.pipeline.kept import kept_already
from dtwin.plan import expand, training_plan
from dtwin.progress import Tell, tell
from dtwin.serve import safety
from dtwin.serve._lease import lease
from dtwin.serve.live_board import _PID, _SHOWN, live_board
from dtwin.serve.served_time import events_path
from dtwin.twins.measured import pure_rms_um
from dtwin.workbench import server as _server
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench, Cache
from dtwin.workbench._import_routes import _for_the_page
from dtwin.workbench._jobs import Jobs
from dtwin.workbench._live_routes import _latched_by, sessions
from dtwin.workbench._plan_routes import experiment_documents, grids_of, plans_zip
from dtwin.workbench._twin_routes import decimal
from dtwin.workbench.server import _Connection, application


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("0,5", 0.5),
        ("0.5", 0.5),
        (" 1 234,5 ", 1234.5),
        ("1.234,5", 1234.5),
        ("1,234.5", 1234.5),
        ("1.234.567", 1234567.0),
        ("-3", -3.0),
        ("\u22123,2", -3.2),
        ("2e3", 2000.0),
        (",5", 0.5),
    ],
)
def test_numbers_as_people_type_them(text: str, meant: float) -> None:
    assert decimal(text, "x") == meant


@pytest.mark.parametrize("text", ["", "viel", "1e999", "nan", "1,2,", "0x10", "1" * 99, "--1"])
def test_what_is_not_a_number_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="x is not a number"):
        decimal(text, "x")


@pytest.mark.parametrize(
    ("host", "known"),
    [
        ("127.0.0.1:1", True),
        ("localhost:1", True),
        ("[::1]:1", True),
        ("evil.example:1", False),
        ("192.0.2.7:1", False),
        ("", False),
        ("127.0.0.1.evil.example", False),
    ],
)
def test_loopback_is_known_by_its_own_names_only(host: str, known: bool) -> None:
    assert Access("127.0.0.1", 1).knows_host(host) is known


def test_a_shared_server_is_known_by_addresses_but_not_by_names() -> None:
    access = Access("0.0.0.0", 1)
    assert access.shared
    assert access.knows_host("192.0.2.7:1")
    assert not access.knows_host("evil.example:1")


def _conditions(*wanted: tuple[Any, float, float, Any]) -> dict[str, Any]:
    conditions = [Condition(*one).as_dict() for one in wanted]
    return {"conditions": conditions, "repeats": 3}


def test_a_full_grid_is_one_plan_that_measures_exactly_it() -> None:
    experiment = _conditions(
        *((p, r, f, d) for p in ("XY", "YZ") for r in (50.0, 100.0) for f in (1000.0, 2000.0) for d in ("CCW", "CW"))
    )
    (document,) = experiment_documents("next", "mill-a", experiment)
    plan = expand(document, "plan")
    assert plan.n_runs == 3 * 16
    assert set(plan.directions) == {"CCW", "CW"}


def test_what_is_no_grid_becomes_several_plans_and_nothing_more() -> None:
    wanted = {("XY", 50.0, 1000.0, "CCW"), ("XY", 100.0, 2000.0, "CW"), ("YZ", 50.0, 1000.0, "CCW")}
    measured = set()
    for document in experiment_documents("next", "mill-a", _conditions(*wanted)):
        plan = expand(document, "plan")
        measured |= {(t.plane, t.radius_mm, t.feed_mm_min, d) for t in plan.tests for d in plan.directions}
    assert measured == wanted


def test_programs_come_with_the_plan() -> None:
    documents = experiment_documents("next", "mill-a", _conditions(("XY", 50.0, 1000.0, "CCW")))
    with zipfile.ZipFile(io.BytesIO(plans_zip(documents))) as archive:
        names = archive.namelist()
        assert tomllib.loads(archive.read("next.toml").decode()) == documents[0]
        assert {"next.toml", "next/t001.nc", "next/t003.script"} <= set(names)
        assert "G3" in archive.read("next/t001.nc").decode()
        assert "G2 " not in archive.read("next/t001.nc").decode()


def test_nothing_to_measure_is_said() -> None:
    with pytest.raises(InputError, match="no run is proposed"):
        grids_of(None)


def test_without_repeats_there_is_no_noise_floor() -> None:
    plan = training_plan(radii_mm=[50.0], planes=["XY"], repeats=1)
    obs = planned_observations(plan)
    assert np.isnan(pure_rms_um(obs, np.ones(obs.y_um.shape)))


def test_a_result_is_made_once_also_when_two_ask() -> None:
    cache, made, begun = Cache(), [], threading.Barrier(4)

    def ask() -> None:
        begun.wait()
        cache.get("key", lambda: made.append(1))

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert made == [1]


def test_the_oldest_result_goes_first() -> None:
    cache = Cache(most=2)
    for key in ("a", "b", "a", "c"):
        cache.get(key, lambda key=key: key)  # type: ignore[misc]
    assert cache.get("a", lambda: "made again") == "a"
    assert cache.get("b", lambda: "made again") == "made again"


def test_a_job_says_what_went_wrong_and_the_next_one_runs(tmp_path: Path) -> None:
    jobs, done = Jobs(tmp_path), threading.Event()

    def wrong(_: Tell) -> str:
        raise InputError("no", code="x.y", hint="yes")

    def right(_: Tell) -> str:
        done.set()
        return "/there"

    bad, good = jobs.start("bad", wrong), jobs.start("good", right)
    assert done.wait(300)
    while not good.ended:
        pass
    assert (bad.state, "error[x.y]: no" in bad.error) == ("failed", True)
    assert good.address == "/there"


def test_a_job_shows_what_its_work_tells(tmp_path: Path) -> None:
    jobs, let_go = Jobs(tmp_path), threading.Event()
    told = threading.Event()

    def long(_: Tell) -> str:
        tell("sets of effects")
        told.set()
        let_go.wait(300)
        return ""

    job = jobs.start("long", long)
    assert told.wait(300)
    assert job.stage == "sets of effects"
    let_go.set()


def test_work_goes_on_after_a_time_in_which_nothing_could_be_noted(tmp_path: Path) -> None:
    notes, blocked, done = tmp_path / "jobs", threading.Event(), threading.Event()
    jobs = Jobs(notes)

    def fills_the_disk(_: Tell) -> str:
        notes.rename(tmp_path / "away")
        notes.write_text("")
        blocked.set()
        return ""

    def right(_: Tell) -> str:
        done.set()
        return ""

    first = jobs.start("fills the disk", fills_the_disk)
    assert blocked.wait(300)
    with pytest.raises(StoreError):
        jobs.start("cannot be noted", right)
    assert [job.title for job in jobs.unfinished() if job is not first] == []
    notes.unlink()
    jobs.start("right", right)
    assert done.wait(300)


def test_a_job_that_was_cut_off_is_known_at_the_next_start(tmp_path: Path) -> None:
    let_go, entered = threading.Event(), threading.Event()

    def long(_: Tell) -> str:
        entered.set()
        let_go.wait(300)
        return ""

    # What is left of notes that were damaged keeps no workbench from its start.
    for name, damaged in (("deep", "[" * 200_000), ("list", "[1]"), ("cut", '{"id": "')):
        (tmp_path / f"{name}.json").write_text(damaged)
    (tmp_path / "folder.json").mkdir()
    job = Jobs(tmp_path).start("long", long)
    assert entered.wait(300)
    again = Jobs(tmp_path).get(job.id)
    let_go.set()
    assert again is not None
    assert (again.state, "start it again" in again.stage) == ("interrupted", True)


def test_what_is_stated_while_other_work_runs_is_all_kept(tmp_path: Path) -> None:
    bench = Bench(Home(tmp_path), Access("127.0.0.1", 8765))
    keep_record(bench.home, "mill-a", {})
    let_go = threading.Event()
    bench.jobs.start("a long fit", lambda _: str(let_go.wait(300)))
    client = TestClient(
        application(bench), base_url="http://127.0.0.1:8765", headers={"Origin": "http://127.0.0.1:8765"}
    )
    enter(client, bench.access.token)
    half = {"name": "x", "campaign": chr(0xD800)}
    assert client.post("/api/twins", content=json.dumps(half)).status_code == 400
    assert client.post("/api/twins", content=json.dumps(half | {"name": [], "effects": chr(0xD800)})).status_code == 400
    told = [{"symbol": "H", "high_um": 3.0}, {"symbol": "G(CW)", "high_um": 4.0}]
    jobs = [client.post("/api/machines/mill-a/tolerance", json=one).json()["job"] for one in told]
    axis = {"axis": "X", "low_mm": -250.0, "high_mm": 250.0, "travel_mm": None}
    for address, body in (
        ("/api/machines/mill-a/facts", {"serial": "7"}),
        # Of another tab, which read the page before.
        ("/api/machines/mill-a/facts", {"notes": "moved"}),
        ("/api/machines/mill-a/axis", axis),
        ("/api/machines", {"machine": "mill-b", "type": "Fräse"}),
    ):
        jobs.append(client.post(address, json=body).json()["job"])
    assert client.post("/api/machines/mill-a/axis", json=axis | {"high_mm": -300.0}).status_code == 400
    let_go.set()
    deadline = time.monotonic() + 300.0
    while time.monotonic() < deadline and not all((job := bench.jobs.get(j)) and job.ended for j in jobs):
        time.sleep(0.01)
    assert set(tolerances_of(bench.home, "mill-a")) == {"H", "G(CW)"}
    page = client.get("/machines/mill-a").text
    assert "serial 7" in page
    assert "notes moved" in page
    assert 'value="-250"' in page
    assert "Fräse" in client.get("/machines").text


def test_what_was_stated_of_a_machine_is_taken_back_and_of_no_machine_nothing_is_done(tmp_path: Path) -> None:
    bench = Bench(Home(tmp_path), Access("127.0.0.1", 8765))
    keep_record(bench.home, "mill-a", {"tolerances": {"H": 3.0, "G(CW)": 4.0}})
    note = "hit <b>\n the vice "
    with_event(bench.home, "mill-a", "crash", "2026-01-02", note)
    client = TestClient(
        application(bench), base_url="http://127.0.0.1:8765", headers={"Origin": "http://127.0.0.1:8765"}
    )
    enter(client, bench.access.token)
    for what in ("next", "together", "event", "event/drop", "drop"):
        event = {"what": "crash", "on": "2026-01-02", "note": note.strip()}
        assert client.post(f"/api/machines/nobody/{what}", json=event).status_code == 404, what
    assert client.get("/machines/nobody").status_code == 404
    page = client.get("/machines/mill-a").text
    assert page.count("/tolerance/drop") == 2
    assert f'name="note" value="{escape(note)}"' in page
    assert client.post("/api/machines/mill-a/tolerance/drop", json={"symbol": "D"}).status_code == 400
    told = (("tolerance", {"symbol": "H"}), ("event", event))
    jobs = [client.post(f"/api/machines/mill-a/{what}/drop", json=one).json()["job"] for what, one in told]
    deadline = time.monotonic() + 300.0
    while time.monotonic() < deadline and not all((job := bench.jobs.get(j)) and job.ended for j in jobs):
        time.sleep(0.01)
    assert set(tolerances_of(bench.home, "mill-a")) == {"G(CW)"}
    assert events_of(bench.home, "mill-a") == ()
    assert "Remove this machine" in client.get("/machines/mill-a").text
    job = client.post("/api/machines/mill-a/drop", json={}).json()["job"]
    while time.monotonic() < deadline and not ((told_of := bench.jobs.get(job)) and told_of.ended):
        time.sleep(0.01)
    assert client.get("/machines/mill-a").status_code == 404


_BEGUN = """
import os, socket, sys
from pathlib import Path
from dtwin.acquire.ingest import ingest
from dtwin.config import Home
from dtwin.progress import Tell, tell
from dtwin.workbench import server as _server
warm = _server._warm
def watched(bench):
    loaded = set(sys.modules)
    warm(bench)
    later = [name for name in sys.modules if name.startswith("scipy") and name not in loaded]
    print("pandas" in loaded, later, file=sys.stderr, flush=True)
    os._exit(0)
_server._warm = watched
_server.run(Home(Path(sys.argv[1])), "127.0.0.1", socket.create_server(("127.0.0.1", 0)), None, print)
"""


def test_what_a_disk_or_the_registry_does_to_a_page_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    client = TestClient(
        application(Bench(Home(tmp_path), Access("127.0.0.1", 8765))),
        base_url="http://127.0.0.1:8765",
        raise_server_exceptions=False,
    )
    mistake = OSError(9, "Bad file descriptor")
    for error, status, told in (
        (mistake, 500, "Internal Server Error"),
        (OSError(28, "No space left on device", "x.json"), 400, "No space left on device"),
        (sqlite3.OperationalError("database or disk is full"), 400, "the model registry was lost, or refused"),
        (ValueError("a mistake of ours"), 500, "Internal Server Error"),
    ):

        def failing(*_: object, error: Exception = error) -> None:
            raise error

        monkeypatch.setattr(Bench, "campaigns", failing)
        answer = client.get("/campaigns")
        assert (answer.status_code, told in answer.text) == (status, True)
    monkeypatch.setattr(Bench, "campaigns", lambda *_: (_ for _ in ()).throw(mistake))
    # The server is to keep a traceback of it.
    with pytest.raises(OSError, match="Bad file descriptor"):
        TestClient(client.app, base_url="http://127.0.0.1:8765").get("/campaigns")


def test_figures_of_a_loop_that_is_held_up_or_was_killed_are_not_told_as_those_of_now(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = Home(tmp_path)
    client = TestClient(application(Bench(home, Access("127.0.0.1", 8765))), base_url="http://127.0.0.1:8765")

    def now() -> dict[str, Any]:
        told: dict[str, Any] = client.get("/api/live/mill-a/now").json()
        return told

    with (
        lease("127.0.0.9", "mill-a", home),
        live_board("mill-a", home, clamp_um=90.0, period_s=0.01, corrects=True) as board,
    ):
        assert board is not None
        for n in range(100):
            state = np.zeros(layout.N)
            # A stall of a minute before the newest second.
            state[layout.TIMESTAMP] = 0.01 * n + (60.0 if n >= 50 else 0.0)
            board.show(state, np.ones(3), safety.OK, (60.0 if n == 50 else 0.01, 0.001, 0.0), (0, 0), np.ones(3))
        told = now()
        assert (told["state"]["word"], told["ticks"]) == ("correcting", 100)
        assert told["rate_hz"] == pytest.approx(100.0)
        board._head[_SHOWN] -= 60.0
        told = now()
        assert (told["state"]["word"], told["ticks"]) == ("silent", 100)
        assert not {"rate_hz", "correction_um", "age_ms"} & set(told)
        board._head[_PID] += 1
        assert now()["state"]["word"] == "starting"
        assert client.get("/api/live/mill-a/correction").status_code == 400
        assert "has shown no tick yet" in client.get("/live").text
        # In another container: the kernel does not list its lock here.
        begun = {"time": "2026-03-02T08:00:00+00:00", "event": "serving", "session": "a", "mode": "live"}
        events_path(home, "mill-a").parent.mkdir(exist_ok=True)
        events_path(home, "mill-a").write_text(json.dumps(begun | {"model_sha256": "x"}) + "\n", encoding="utf-8")
        monkeypatch.setattr("dtwin.workbench._live_routes._locked_inodes", dict)
        text = client.get("/live").text
        assert "mill-a is held by a server that this page does not see" in text
        assert "gone without a word" not in text
        assert "Nothing is being served" not in text
    assert "gone without a word" in client.get("/live").text


def test_the_sheet_that_is_asked_for_first_is_made_when_the_server_starts(tmp_path: Path) -> None:
    home = Home(tmp_path)
    ingest(Path("data/examples/nothing-hidden"), Lake(home.lake))
    (campaign,) = {row["campaign"] for row in Lake(home.lake).runs()}
    _server._warm(Bench(home, Access("127.0.0.1", 8765)))
    assert kept_already(home, "sheets", campaign) is not None


def test_a_home_that_is_taken_away_is_told_and_not_begun_anew(tmp_path: Path) -> None:
    root = tmp_path / "home"
    access = Access("127.0.0.1", 8765, False, home=Home(root))
    client = TestClient(
        application(Bench(Home(root), access)),
        base_url="http://127.0.0.1:8765",
        headers={"Origin": "http://127.0.0.1:8765"},
    )
    enter(client, access.token)
    assert client.get("/machines").status_code == 200
    keep_record(Home(root), "mill-a", {})
    assert "mill-a" in client.get("/machines").text
    root.rename(tmp_path / "moved")
    for page in ("/machines", "/campaigns", "/live"):
        assert "home.gone" in client.get(page).text, page
    assert "home.gone" in client.post("/api/trays").text
    assert not root.exists()
    (tmp_path / "moved").rename(root)
    assert "mill-a" in client.get("/machines").text


def test_a_table_in_an_archive_is_asked_about_and_refusals_name_fields_of_the_form(tmp_path: Path) -> None:
    access = Access("127.0.0.1", 8765, False, home=Home(tmp_path / "home"))
    client = TestClient(
        application(Bench(Home(tmp_path / "home"), access)),
        base_url="http://127.0.0.1:8765",
        headers={"Origin": "http://127.0.0.1:8765"},
    )
    enter(client, access.token)
    rows = [f"{t},{way},{t + 0.001},{t + 0.002}" for way in ("forward", "reverse") for t in (0, 100, 200)]
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("axis.csv", "\n".join(["target_mm,direction,laser_mm,encoder_mm", *rows]))
    tray = client.post("/api/trays").json()["tray"]
    client.put(f"/api/trays/{tray}", params={"name": "lone.zip"}, content=packed.getvalue())
    (name,) = client.post(f"/api/trays/{tray}/tables").json()
    assert name == "lone-unpacked/axis.csv"
    found = client.post(f"/api/trays/{tray}/understand", json={"file": name, "told": {"axis": "X"}}).json()
    assert 'instrument in the form: "laser"' in found["refused"]
    assert "--" not in found["refused"]
    # What the refusal of a table of angles without units proposes is in the form.
    table = "Target,fwd 1,rev 1\n0,0.001,0.002\n90,90.001,90.002"
    client.put(f"/api/trays/{tray}", params={"name": "c.csv"}, content=table)
    asked = [{"axis": "C", "machine": "m", **more} for more in ({}, {"kind": "rotary"})]
    first, then = (
        client.post(f"/api/trays/{tray}/understand", json={"file": "c.csv", "told": told}).json() for told in asked
    )
    assert "kind in the form: rotary" in first["refused"]
    assert (then["refused"], then["kind"]) == ("", "rotary")
    assert 'name="kind"' in client.get("/").text
    # A command keeps its options.
    error = InputError("x", code="x", hint="wrong: dtwin amend c --set axis=X --because WHY")
    _for_the_page(error, tmp_path)
    assert str(error.hint).endswith("--set axis=X --because WHY")


def test_pandas_and_scipy_are_whole_before_a_second_thread_could_load_them(tmp_path: Path) -> None:
    ended = subprocess.run([sys.executable, "-c", _BEGUN, str(tmp_path)], capture_output=True, text=True, timeout=300)
    assert ended.stderr.strip() == "True []"


def test_a_session_after_the_clock_was_set_back_is_the_newest_of_its_machine(tmp_path: Path) -> None:
    home = Home(tmp_path)
    home.logs.mkdir(parents=True)
    begun = {"a": ["2026-03-02T08:00", "2026-03-02T09:00", "2026-03-01T09:05"], "b": ["2026-03-02T07:00"]}
    for machine, starts in begun.items():
        lines = [{"started": at, "duration_s": 1.0, "ended": "x", "clamp_um": 1.0, "largest_um": 0.0} for at in starts]
        text = "\n".join(json.dumps({**line, "reasons": {}}) for line in lines)
        (home.logs / f"serve-{machine}.jsonl").write_text(text, encoding="utf-8")
    assert [one["started"] for one in sessions(home)] == [*begun["a"][::-1], *begun["b"]]
    assert not _latched_by(sessions(home)[0])
    latched = _latched_by({"ended": "latched", "reasons": {"stale": 1, "outside_box": 764}})
    assert latched == "the state of the machine came too late (1 tick)"


def test_a_connection_that_asks_nothing_is_closed_and_slow_work_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing, a head that comes byte by byte, one after an answer, half a body, and an answer that nobody takes."""
    monkeypatch.setattr(_server, "_PATIENCE_S", 0.4)

    async def slow(scope: Any, receive: Any, send: Any) -> None:
        body = b"ok"
        if scope["path"] == "/much":
            body = bytes(40_000_000)
        else:
            await asyncio.sleep(1.0)
        head = [(b"content-length", b"%d" % len(body))]
        await send({"type": "http.response.start", "status": 200, "headers": head})
        await send({"type": "http.response.body", "body": body})

    with socket.create_server(("127.0.0.1", 0)) as listening:
        config = uvicorn.Config(slow, http=_Connection, lifespan="off", log_level="error", timeout_keep_alive=600)
        server = uvicorn.Server(config)
        serving = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
        serving.start()
        whole = b"GET / HTTP/1.1\r\nHost: a\r\n\r\n"
        for asked, answered in ((b"", False), (b"GET / HTTP/1.1\r\n", False), (whole, True)):
            with socket.create_connection(listening.getsockname(), timeout=60.0) as client:
                client.sendall(asked)
                if answered:
                    assert client.recv(4096).startswith(b"HTTP/1.1 200")
                client.settimeout(0.05)
                for _ in range(1200):  # Without a limit it goes on.
                    try:
                        if client.recv(4096) == b"":
                            break
                    except TimeoutError:
                        client.sendall(asked and b"x")
                    except ConnectionError:
                        break
                else:
                    pytest.fail(f"open still: {asked!r}")
        with socket.create_connection(listening.getsockname(), timeout=60.0) as client:
            client.sendall(b"PUT / HTTP/1.1\r\nHost: a\r\nContent-Length: 9\r\n\r\nhalf")
            while client.recv(4096):
                pass
        # Of very many that say nothing, one gives way to each that comes.
        monkeypatch.setattr(_server, "_MOST_OPEN", 5)
        monkeypatch.setattr(_server, "_PATIENCE_S", 600.0)
        with ExitStack() as held:
            clients = [
                held.enter_context(socket.create_connection(listening.getsockname(), timeout=60.0)) for _ in range(20)
            ]
            for _ in range(1200):
                if len(select.select(clients, [], [], 0.0)[0]) == 15:
                    break
                time.sleep(0.05)
            else:
                pytest.fail("as many are open as have come")
        monkeypatch.setattr(_server, "_PATIENCE_S", 0.4)
        with socket.create_connection(listening.getsockname(), timeout=60.0) as client:
            client.sendall(b"GET /much HTTP/1.1\r\nHost: a\r\n\r\n")
            assert client.recv(12) == b"HTTP/1.1 200"
            for _ in range(1200):
                if not server.server_state.connections:
                    break
                time.sleep(0.05)
            else:
                pytest.fail("an answer that nobody takes is held still")
        server.should_exit = True
        serving.join(60.0)
