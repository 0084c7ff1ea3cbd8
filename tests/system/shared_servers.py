"""A real S3 server and a real PostgreSQL on loopback, and a proxy before the first that does what networks do."""

from __future__ import annotations

import contextlib
import http.client
import logging
import os
import re
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from conftest import require_program

BUCKET = "plant-store"
KEYS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_DEFAULT_REGION": "us-east-1"}
_HOP = {"connection", "keep-alive", "transfer-encoding", "host"}


@contextmanager
def running_store() -> Iterator[int]:
    """Yield the port of a moto server that has the bucket."""
    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.WARNING)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    port = int(server.get_host_and_port()[1])
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    connection.request(
        "PUT",
        f"/{BUCKET}",
        headers={"Authorization": "AWS4-HMAC-SHA256 Credential=key/20260101/us-east-1/s3/aws4_request"},
    )
    assert connection.getresponse().status == 200
    try:
        yield port
    finally:
        server.stop()


class StoreProxy:
    """Passes requests on to a store, unless told what goes wrong.

    Attributes:
        wrong (str): Empty, or ``no_conditions`` (headers dropped), ``busy`` (503), ``away`` (no answer), ``slow``,
            ``expired`` (credentials), ``skewed`` (clock), ``deaf`` (what is written is taken, and its answer lost), ``again`` (lists begin again).
        left (int): So many requests it goes wrong, then no more.
        passes (int): So many writes pass before it goes wrong.
        wait_s (float): How long ``slow`` lasts.
        asked (int): How many requests came.
        only (str): Method that goes wrong; every one when empty.
    """

    def __init__(self, port: int) -> None:
        self.behind, self.wrong, self.left, self.only = port, "", 1 << 30, ""
        self.passes, self.asked, self.wait_s = 0, 0, 0.3
        self._lock = threading.Lock()
        proxy = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def _any(self) -> None:
                proxy.answer(self)

            do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = _any

            def log_message(self, format: str, *args: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.port = int(self.server.server_address[1])
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def goes_wrong(self, method: str) -> str:
        with self._lock:
            self.asked += 1
            if not self.wrong or self.left <= 0 or (self.only and self.only != method):
                return ""
            if self.passes > 0:
                self.passes -= method == "PUT"
                return ""
            self.left -= 1
            return self.wrong

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        body = request.rfile.read(int(request.headers.get("Content-Length") or 0))
        wrong = self.goes_wrong(request.command)
        if wrong == "away":
            request.close_connection = True
            request.connection.shutdown(socket.SHUT_RDWR)
            return
        told = {"busy": (503, "SlowDown"), "expired": (400, "ExpiredToken"), "skewed": (403, "RequestTimeTooSkewed")}
        if wrong in told:
            status, code = told[wrong]
            _send(request, status, {}, f"<Error><Code>{code}</Code><Message>no</Message></Error>".encode())
            return
        if wrong == "slow":
            time.sleep(self.wait_s)
        headers = {k: v for k, v in request.headers.items() if k.lower() not in _HOP}
        if wrong == "no_conditions":
            headers = {k: v for k, v in headers.items() if k.lower() not in ("if-none-match", "if-match")}
        connection = http.client.HTTPConnection("127.0.0.1", self.behind, timeout=30)
        path = re.sub("continuation-token=[^&]*&?", "", request.path) if wrong == "again" else request.path
        connection.request(request.command, path, body, headers)
        reply = connection.getresponse()
        content = reply.read()
        connection.close()
        if wrong == "deaf":
            request.close_connection = True
            request.connection.shutdown(socket.SHUT_RDWR)
            return
        if wrong == "again" and "list-type=2" in request.path:
            more = b"<IsTruncated>true</IsTruncated><NextContinuationToken>t</NextContinuationToken>"
            content = re.sub(rb"<IsTruncated>[a-z]*</IsTruncated>", more, content)
        _send(request, reply.status, dict(reply.getheaders()), content)

    def close(self) -> None:
        self.server.shutdown()
        self.server.server_close()


def _send(request: BaseHTTPRequestHandler, status: int, headers: dict[str, str], content: bytes) -> None:
    with contextlib.suppress(OSError):
        request.send_response_only(status)
        for name, value in headers.items():
            if name.lower() not in (*_HOP, "content-length"):
                request.send_header(name, value)
        length = headers.get("Content-Length", headers.get("content-length")) if request.command == "HEAD" else None
        request.send_header("Content-Length", length or str(len(content)))
        request.end_headers()
        if request.command != "HEAD":
            request.wfile.write(content)


@dataclass(frozen=True)
class Postgres:
    """A running server.

    ``does``: runs ``pg_ctl`` with these arguments.
    """

    port: int
    does: Callable[..., None]


@contextmanager
def running_postgres(folder: Path) -> Iterator[Postgres]:
    """Yield a PostgreSQL with the databases ``mlflow`` and ``prefect`` of a user ``dtwin``."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin"))
    place = str(found[-1]) if found else ""
    initdb = require_program("initdb", "postgresql", place)
    control = require_program("pg_ctl", "postgresql", place)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    # It refuses to run as root.
    other = ["runuser", "-u", "postgres", "--"] if os.geteuid() == 0 else []
    folder.mkdir(parents=True, exist_ok=True)
    if other:
        shutil.chown(folder, "postgres")
        for above in folder.parents:
            with contextlib.suppress(OSError):
                above.chmod(above.stat().st_mode | 0o011)
    data = str(folder / "data")
    options = f"-p {port} -c listen_addresses=127.0.0.1 -c unix_socket_directories= -c fsync=off"
    quiet = {"stdout": subprocess.DEVNULL, "check": True, "cwd": "/"}
    subprocess.run([*other, initdb, "-D", data, "-A", "trust", "-U", "dtwin", "--no-sync", "-E", "UTF8"], **quiet)

    def does(*arguments: str) -> None:
        command = [*other, control, "-D", data, "-o", options, "-w", "-l", f"{data}/log", *arguments]
        subprocess.run(command, **quiet)

    does("start")
    try:
        for name in ("mlflow", "prefect"):
            createdb = require_program("createdb", "postgresql", place)
            subprocess.run([createdb, "-h", "127.0.0.1", "-p", str(port), "-U", "dtwin", name], **quiet)
        yield Postgres(port, does)
    finally:
        does("-m", "immediate", "stop")
