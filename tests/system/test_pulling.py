"""A serving host fetches its bundles over a real workbench, and keeps the last good ones when that is away or lies."""

from __future__ import annotations

import contextlib
import http.server
import json
import shutil
import socket
import threading
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import uvicorn
from served_robot import MACHINE, Server, end_what_is_left, promote, wait_until_corrected, wait_until_released
from virtual_robot import virtual_robot

from dtwin.config import Home
from dtwin.config import home as dtwin_home
from dtwin.errors import DtwinError, GateRefusal, InputError, StoreError
from dtwin.serve import pulling
from dtwin.serve.delivery import KEY_FILE, MAC, NONCE, delivery, install, make_key
from dtwin.serve.pointer import clear_trial, resolve
from dtwin.serve.pulling import _pull, pulled
from dtwin.serve.withdrawn import stop_serving, withdrawn_why
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application

pytestmark = pytest.mark.system


@contextmanager
def workbench(home: Home) -> Iterator[str]:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        # A question that comes before the server is up waits.
        listening.listen()
        port = int(listening.getsockname()[1])
        app = application(Bench(home, Access("127.0.0.1", port, True), None))
        server = uvicorn.Server(uvicorn.Config(app, log_level="error", lifespan="off"))
        thread = threading.Thread(target=server.run, args=([listening],))
        thread.start()
        try:
            yield f"http://127.0.0.1:{port}"
        finally:
            server.should_exit = True
            thread.join()


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Home:
    home = Home(tmp_path_factory.mktemp("source") / "home")
    make_key(home)
    return home


@pytest.fixture(scope="module")
def address(source: Home) -> Iterator[str]:
    with workbench(source) as url:
        yield url


@pytest.fixture
def host(source: Home, tmp_path: Path) -> Home:
    """A serving host that has the key."""
    shutil.rmtree(source.bundles, ignore_errors=True)
    promote(source)
    home = dtwin_home().made()
    shutil.copy(source.root / KEY_FILE, home.root / KEY_FILE)
    return home


def test_what_was_promoted_there_is_served_here(source: Home, host: Home, address: str) -> None:
    assert _pull(address, MACHINE, host)
    found = resolve("latest", MACHINE, host)
    assert (found.version, found.state) == (3, "champion")
    assert found.path.read_bytes() == (source.bundles / MACHINE / "v3.json").read_bytes()
    assert not _pull(address, MACHINE, host)
    promote(source, "trial", model_version=4)
    stop_serving(MACHINE, source, 3, "it does harm")
    assert _pull(address, MACHINE, host)
    assert resolve("trial", MACHINE, host).version == 4
    assert withdrawn_why(MACHINE, host, 3) == "it does harm"
    with pytest.raises(GateRefusal, match="withdrawn"):
        resolve("latest", MACHINE, host)
    clear_trial(MACHINE, source)
    assert _pull(address, MACHINE, host)
    with pytest.raises(InputError, match="no model on trial"):
        resolve("trial", MACHINE, host)
    with pytest.raises(StoreError, match="delivers nothing"):
        _pull(address, "another", host)


def test_nobody_without_the_key_gets_anything(source: Home, host: Home, address: str) -> None:
    for headers in ({}, {NONCE: "1", MAC: "0" * 64}):
        with pytest.raises(urllib.request.HTTPError, match="403"):
            urllib.request.urlopen(
                urllib.request.Request(f"{address}/delivery/{MACHINE}", headers=headers), timeout=120
            )
    (host.root / KEY_FILE).write_text("ab" * 32)
    with pytest.raises(StoreError, match="delivers nothing"):
        _pull(address, MACHINE, host)
    (host.root / KEY_FILE).chmod(0o644)
    with pytest.raises(InputError, match="not usable"):
        _pull(address, MACHINE, host)
    (host.root / KEY_FILE).unlink()
    with pytest.raises(InputError, match="no key"):
        _pull(address, MACHINE, host)
    assert not host.bundles.exists()


Lie = Callable[[bytes, dict[str, str]], tuple[bytes, dict[str, str]]]


@contextmanager
def between(address: str, lie: Lie) -> Iterator[str]:
    """Somebody on the way who changes answers."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked = urllib.request.Request(address + self.path, headers={n: self.headers[n] for n in (NONCE, MAC)})
            with urllib.request.urlopen(asked, timeout=120) as reply:
                content, headers = lie(reply.read(), {MAC: reply.headers[MAC]})
            self.send_response(200)
            for name, value in headers.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def test_an_answer_that_was_changed_or_is_of_yesterday_is_none(source: Home, host: Home, address: str) -> None:
    kept: list[tuple[bytes, dict[str, str]]] = []

    def recorded(content: bytes, headers: dict[str, str]) -> tuple[bytes, dict[str, str]]:
        kept.append((content, headers))
        return content, headers

    with between(address, recorded) as url:
        assert _pull(url, MACHINE, host)
    stop_serving(MACHINE, source, 3, "withdrawn")
    lies: dict[str, Lie] = {
        "changed": lambda content, headers: (content.replace(b"withdrawn", b"all right"), headers),
        "yesterday": lambda content, headers: kept[0],
        "cut": lambda content, headers: (content[:-1], headers),
        "unsigned": lambda content, headers: (content, {}),
    }
    for lie in lies.values():
        with between(address, lie) as url, pytest.raises(GateRefusal, match="not signed"):
            _pull(url, MACHINE, host)
    assert resolve("latest", MACHINE, host).state == "champion"
    assert _pull(address, MACHINE, host)
    assert withdrawn_why(MACHINE, host, 3) == "withdrawn"


def test_what_does_not_hold_is_not_put_in_force(source: Home, host: Home, address: str) -> None:
    _pull(address, MACHINE, host)
    before = {path.name: path.read_bytes() for path in (host.bundles / MACHINE).iterdir()}
    good = json.loads(delivery(source, MACHINE))
    other = json.loads(json.dumps(good).replace("24.0", "25.0"))
    wrong = [
        other,
        good | {"bundles": {}},
        good | {"bundles": {"../v3.json": good["bundles"]["v3.json"]}},
        good | {"machine": "cobot-b"},
        good | {"sealed": {}},
        {"machine": MACHINE},
        [],
    ]
    for content in wrong:
        with pytest.raises(DtwinError):
            install(host, MACHINE, json.dumps(content).encode())
    assert {path.name: path.read_bytes() for path in (host.bundles / MACHINE).iterdir()} == before
    assert not list(host.root.glob(".pulled-*"))


def test_a_version_that_is_withdrawn_there_is_released_here_and_a_lost_link_stops_nothing(
    source: Home, host: Home
) -> None:
    try:
        with virtual_robot("--feed-mm-min=3000") as robot:
            options = (f"--machine={MACHINE}", f"--host={robot.host}", "--json")
            with workbench(source) as url:
                server = Server(*options, f"--pull={url}")
                wait_until_corrected(robot)
                stop_serving(MACHINE, source, 3, "the error grew")
                code, out, _ = server.end()
                wait_until_released(robot)
                assert code != 0
                assert "the error grew" in out
                promote(source, model_version=5)
                _pull(url, MACHINE, host)
            server = Server(*options, f"--pull={url}", "--duration=2")
            code, out, err = server.end()
            assert code == 0, err
            assert "serving what was fetched at" in err
            assert json.loads(out)["model"]["version"] == 5
    finally:
        end_what_is_left()


def test_a_host_that_never_fetched_anything_serves_nothing(host: Home) -> None:
    with pytest.raises(StoreError, match="does not answer"), pulled("http://127.0.0.1:9", MACHINE, host, print):
        pytest.fail("it went on")
    for url in ("ftp://h/x", "file:///etc/passwd", "nonsense"):
        with pytest.raises(InputError, match="address"):
            _pull(url, MACHINE, host)


@pytest.mark.parametrize(
    "begun",
    [
        "",
        "HTTP/1.1 100 Continue\r\nA: ",
        "HTTP/1.1 200 OK\r\nA: ",
        "HTTP/1.1 200 OK\r\n\r\n",
        "HTTP/1.1 403 No\r\n\r\n",
    ],
    ids=("nothing", "go on", "head", "body", "refusal"),
)
def test_a_server_that_sends_a_byte_now_and_then_is_given_up(
    host: Home, monkeypatch: pytest.MonkeyPatch, begun: str
) -> None:
    ended = threading.Event()

    class Drips(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.wfile.write(begun.encode())
            with contextlib.suppress(OSError):
                while not ended.wait(0.05):
                    self.wfile.write(b" ")

        def log_message(self, format: str, *args: object) -> None:
            pass

    monkeypatch.setattr(pulling, "_LONGEST_S", 0.3)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Drips) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        # Without a limit it ends, too, but when the server does.
        timer = threading.Timer(60.0, ended.set)
        timer.start()
        with pytest.raises(StoreError, match="delivers nothing" if "403" in begun else "does not answer"):
            _pull(f"http://127.0.0.1:{server.server_address[1]}", MACHINE, host)
        timer.cancel()
        ended.set()
        server.shutdown()
