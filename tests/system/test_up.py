"""``dtwin up`` as a user runs it: healthy, alone, and gone without a trace."""

from __future__ import annotations

import os
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from chromium import chromium
from command_here import command_here
from running_servers import Up, wait_for

from dtwin.config import Home
from dtwin.errors import StoreError
from dtwin.train.registry import Registry
from flows import mlflow_server
from flows.servers import Child

pytestmark = pytest.mark.system
pytest_plugins = ["shared_up"]


def refused(home: Home, *options: str) -> str:
    """What ``dtwin up`` says when it starts nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DTWIN_HOME", str(home.root))
        code, _, said = command_here("up", *options)
    assert code == 1
    return said


def descendants(pid: int) -> set[int]:
    """All processes below one, by the kernel's own lists."""
    found: set[int] = set()
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in map(int, task.read_text().split()):
            found |= {child} | descendants(child)
    return found


def fetched(url: str) -> str:
    with urllib.request.urlopen(url, timeout=120) as reply:
        assert reply.status == 200
        return str(reply.read().decode())


def listening(pids: set[int]) -> set[str]:
    """Addresses on which processes listen, as the kernel lists them."""
    inodes = set()
    for pid in pids:
        for link in Path(f"/proc/{pid}/fd").iterdir():
            try:
                target = str(link.readlink())
            except FileNotFoundError:  # the server closed it between the listing and now
                continue
            if target.startswith("socket:["):
                inodes.add(target[8:-1])
    lines = Path("/proc/net/tcp").read_text().splitlines()[1:]
    lines += Path("/proc/net/tcp6").read_text().splitlines()[1:]
    rows = [line.split() for line in lines]
    return {row[1].split(":")[0] for row in rows if row[3] == "0A" and row[9] in inodes}


def test_up_serves_both_pages_on_loopback_alone_and_leaves_nothing(shared_up: Up) -> None:
    up, home = shared_up, shared_up.home
    children = descendants(up.process.pid)
    assert len(children) >= 3
    for page in (up.addresses["prefect"], up.addresses["mlflow_enter"]):
        assert "<html" in fetched(page).lower()
    # 127.0.0.1 as the kernel writes it.
    assert listening(children) == {"0100007F"}

    served = wait_for(lambda: len(up.ask("/deployments/filter", {})) == 14, "not all flows are served")
    assert served
    times = [d["schedules"] for d in up.ask("/deployments/filter", {})]
    assert times == [[]] * 14, "--no-schedule has a schedule"

    _refuses_strangers(up)

    second = refused(home)
    assert "up.twice" in second
    assert up.addresses["prefect"] in second

    # Of the modules that share these servers, this one is the last.
    assert up.stop() == 0
    assert not [pid for pid in children if Path(f"/proc/{pid}").exists()]
    assert not (home.root / "servers.json").exists()
    logs = {path.name: path.read_text(errors="replace") for path in home.logs.iterdir()}
    assert set(logs) == {"prefect-server.log", "mlflow-server.log", "flows.log"}
    for name, text in logs.items():
        for told in text.split("Traceback")[1:]:
            # A refused run of test_flows, and what Prefect's server answers with 503 beside much other work.
            assert "keeps to its folders" in told or "database is locked" in told, f"{name}: {told}"


def _refuses_strangers(up: Up) -> None:
    """No other name, no other site, nobody without the auth string; the secrets are private."""
    for name in ("prefect-auth", "servers.json", "prefect/prefect.db", "mlflow/mlflow.db"):
        assert (up.home.root / name).stat().st_mode & 0o077 == 0, name
    assert up.home.root.stat().st_mode & 0o077 == 0
    page = up.addresses["prefect"]
    foreign = [
        {"Origin": "https://evil.example"},
        {"Origin": "null"},
        {"Host": "evil.example"},
        {"Host": "localhost:4200/evil"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
    ]
    for headers in foreign:
        assert _status(lambda h=headers: up.ask("/deployments/filter", {}, **h)) == 403, headers
    assert _status(lambda: up.ask("/deployments/filter", {}, Authorization="")) == 401
    assert _status(lambda: up.ask("/deployments/filter", {}, Authorization="Basic eDp5")) == 401
    _refuses_changes_of_models(up)
    before = len(up.ask("/flow_runs/filter", {}))
    deployment = next(d for d in up.ask("/deployments/filter", {}) if "campaign" in d["entrypoint"])
    secret = up.addresses["prefect_enter"].rpartition("#")[2]
    with foreign_page(_ATTACK % (page, deployment["id"], secret)) as address, chromium() as browser:
        opened = browser.new_page()
        opened.goto(address)
        opened.wait_for_function("document.title === 'done'", timeout=60_000)
        got = opened.evaluate("window.got")
        assert [answer for answer in got if not answer.startswith("blocked")] == []
        # The user's own way in still works.
        opened.goto(up.addresses["prefect_enter"])
        opened.wait_for_url(f"{page}/deployments*")
        opened.get_by_text("scheduled-training").first.wait_for(timeout=60_000)
        registry = Registry(up.home)
        with registry.open_run("one", {}) as run:
            registry.log(run, {}, {"leave_feed_mm_min_out.r2": 0.9}, {})
        opened.goto(up.addresses["mlflow_enter"])
        opened.get_by_text("Registered Models").first.wait_for(timeout=60_000)
        # Not behind an advertisement, nor in MLflow's mode for chat programs.
        assert opened.get_by_role("dialog").count() == 0
        assert opened.evaluate("localStorage['mlflow.workflowType_v1']") == '"machine_learning"'
        # What models are compared by has a column, which MLflow shows none of by itself.
        opened.goto(f"{up.addresses['mlflow']}/#/experiments/{registry.experiment()}/runs")
        opened.get_by_role("columnheader").get_by_text("leave_feed_mm_min_out.r2").wait_for(timeout=60_000)
    assert len(up.ask("/flow_runs/filter", {})) == before


def _refuses_changes_of_models(up: Up) -> None:
    """Every user of this computer reaches MLflow's port; who does not say the token neither reads nor changes models."""
    token = up.addresses["mlflow_enter"].rpartition("=")[2]
    page = up.addresses["mlflow"]

    def status(path: str, **headers: str) -> int:
        asked = urllib.request.Request(page + path, b"{}", {"Content-Type": "application/json", **headers})
        return _status(lambda: urllib.request.urlopen(asked, timeout=60).read())

    search = "/api/2.0/mlflow/runs/search"
    assert status(search) == 401
    assert status(search, Authorization="Bearer dtwin") == 401
    # A cookie goes to every port of this computer: it lets a browser in, and holds no secret that flows are started by.
    with urllib.request.urlopen(up.addresses["mlflow_enter"], timeout=60) as entered:
        cookie = entered.headers["set-cookie"].partition(";")[0]
    assert token not in cookie
    codes = [status(search, Cookie=told) for told in (cookie, f"{cookie}x", f"{cookie.partition('=')[0]}={token}")]
    assert codes == [200, 401, 401]
    assert status(search, Authorization=f"Bearer {token}", Host="evil.example") == 403
    assert status(search, Authorization=f"Bearer {token}", Origin="https://evil.example") == 403
    assert status(search, Authorization=f"Bearer {token}") == 200


_ATTACK = """<!doctype html><title>x</title><script>
const page = %r, id = %r, secret = %r;
window.got = [];
const body = JSON.stringify({parameters: {quick: true, out: "xorigin_out", to_lake: true}});
const ways = [
  () => fetch(page + "/api/deployments/filter", {method: "POST", body: "{}", headers: {"content-type": "application/json"}}),
  () => fetch(page + "/api/deployments/filter", {method: "POST", body: "{}", headers: {"content-type": "application/json", Authorization: "Basic " + secret}}),
  () => fetch(page + `/api/deployments/${id}/create_flow_run`, {method: "POST", mode: "no-cors", body}),
  () => fetch(page + "/api/health"),
  () => new Promise((done, no) => { const s = new WebSocket(page.replace("http", "ws") + "/api/events/in"); s.onopen = () => done("socket"); s.onerror = () => no(new Error("refused")); }),
];
(async () => {
  for (const way of ways) {
    try { const r = await way(); window.got.push(r.type === "opaque" ? "blocked: opaque" : `open ${r.status}`); }
    catch (error) { window.got.push("blocked: " + error.message); }
  }
  document.title = "done";
})();
</script>"""


@contextmanager
def foreign_page(text: str) -> Iterator[str]:
    """A page of another origin: another port of this computer."""

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("content-type", "text/html")
            self.end_headers()
            self.wfile.write(text.encode())

        def log_message(self, *_: object) -> None:
            return

    server = ThreadingHTTPServer(("127.0.0.1", 0), Page)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    server.server_close()


def _status(ask: Callable[[], object]) -> int:
    try:
        ask()
    except urllib.error.HTTPError as error:
        return error.code
    return 200


def test_a_port_in_use_is_said_before_anything_starts(tmp_path: Path) -> None:
    home = Home(tmp_path / "state")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for option in ("--prefect-port", "--mlflow-port"):
            said = refused(home, option, str(port))
            assert "up.port" in said
            assert f"{option} {port}" in said
    assert not (home.root / "servers.json").exists()


def test_a_bad_cron_line_is_said_before_anything_starts(tmp_path: Path) -> None:
    assert "schedule.cron" in refused(Home(tmp_path / "state"), "--cron", "whenever")
    assert not (tmp_path / "state" / "logs").exists()


def test_a_server_that_dies_is_named_with_the_end_of_its_log(tmp_path: Path) -> None:
    log = tmp_path / "logs" / "server.log"
    log.parent.mkdir()
    log.write_text("of an earlier day\n", encoding="utf-8")
    script = "import sys; print('the database is locked'); sys.exit(3)"
    child = Child("Prefect", [sys.executable, "-c", script], os.environ, log)
    child.process.wait(300)
    with pytest.raises(StoreError) as caught:
        child.require_alive()
    assert caught.value.got == "exit 3: the database is locked"
    assert caught.value.where == str(log)
    script = "import sys; sys.exit('Traceback\\nsqlite3.OperationalError: disk is full\\n' + '[SQL: x]\\n' * 99)"
    child = Child("Prefect", [sys.executable, "-c", script], os.environ, log)
    child.process.wait(300)
    with pytest.raises(StoreError, match=r"exit 1: sqlite3\.OperationalError: disk is full"):
        child.require_alive()


def test_a_child_that_will_not_end_is_ended_with_what_it_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flows.servers._STOP_S", 0.5)
    script = (
        "import signal, subprocess, sys, time; signal.signal(signal.SIGTERM, signal.SIG_IGN);"
        "kid = subprocess.Popen([sys.executable, '-c', 'import signal, time;"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(600)']);"
        "print(kid.pid, flush=True); time.sleep(600)"
    )
    log = tmp_path / "stubborn.log"
    child = Child("stubborn", [sys.executable, "-c", script], os.environ, log)
    grandchild = int(wait_for(log.read_text, "the child said nothing"))
    child.stop()
    assert child.process.returncode == -signal.SIGKILL
    wait_for(lambda: _ended(grandchild), "the grandchild lives")


@pytest.mark.parametrize(
    "child",
    [
        "import time; print('there', flush=True); time.sleep(600)",
        # As Prefect's runner, which waits for a server that has ended, too.
        "import os, signal; signal.signal(signal.SIGTERM, signal.SIG_IGN);"
        "from flows import __main__ as runner; print('there', flush=True);"
        "runner._LOOK_S = runner._GRACE_S = 0.1; runner._end_with(os.getppid())",
    ],
)
def test_children_end_when_up_is_killed(child: str, tmp_path: Path) -> None:
    home = Home(tmp_path / "state")
    program = (
        "import os, sys, time; from pathlib import Path; from flows.servers import Child;"
        f"c = Child('x', [sys.executable, '-c', {child!r}], os.environ,"
        f"Path({str(tmp_path)!r}) / 'x.log'); print(c.process.pid, flush=True); time.sleep(600)"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", program],
        env=dict(os.environ, DTWIN_HOME=str(home.root)),
        stdout=subprocess.PIPE,
        text=True,
    )
    assert parent.stdout is not None
    started = int(parent.stdout.readline())
    wait_for((tmp_path / "x.log").read_text, "the child said nothing")
    assert not _ended(started)
    parent.kill()
    parent.wait(300)
    parent.stdout.close()
    wait_for(lambda: _ended(started), "the child outlived its killed parent")


def _ended(pid: int) -> bool:
    """Gone, or a zombie that only waits for a parent that is not ours to be."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


_SHORT = """
import urllib.error, urllib.request
from prefect import flow, get_client
from flows._runtime import run

@flow
def asked():
    with get_client(sync_client=True) as client:
        page = str(client.api_url).rstrip("/")
    wanted = urllib.request.Request(page + "/flows/filter", b"{}", {"Content-Type": "application/json"})
    try:
        return urllib.request.urlopen(wanted, timeout=300).status
    except urllib.error.HTTPError as error:
        return error.code

print(run(asked))
"""


def test_the_server_of_a_flow_without_up_answers_no_stranger(tmp_path: Path) -> None:
    """What a stranger began there would run at the next `dtwin up`."""
    done = subprocess.run(
        [sys.executable, "-c", _SHORT],
        env=dict(os.environ, DTWIN_HOME=str(tmp_path / "home")),
        capture_output=True,
        text=True,
        check=False,
        timeout=200,
    )
    assert done.stdout.strip().endswith("401"), done.stderr[-1500:]


def test_mlflow_finds_its_tables_whole_and_makes_none_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # It makes them one by one: a server that was stopped meanwhile never started again.
    database = tmp_path / "mlflow" / "mlflow.db"
    whole: list[bool] = []

    def begun(*_: str) -> None:
        with closing(sqlite3.connect(database)) as opened:
            whole.append(bool(opened.execute("SELECT version_num FROM alembic_version").fetchone()))
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "environ", {**os.environ, "DTWIN_HOME": str(tmp_path)})
    monkeypatch.setattr(sys, "argv", ["mlflow_server", "--port", "1"])
    monkeypatch.setattr("mlflow.server.handlers.initialize_backend_stores", begun)
    with pytest.raises(KeyboardInterrupt):
        mlflow_server.main()
    assert whole == [True]
    database.write_bytes(b"no database")
    with pytest.raises(SystemExit, match=r"registry\.damaged"):
        mlflow_server.main()
