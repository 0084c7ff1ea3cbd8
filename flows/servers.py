"""One Prefect server and one MLflow server on loopback, and the process that serves the flows.

Nothing of Prefect or MLflow is imported here: they run as processes of their own.
"""

from __future__ import annotations

import base64
import contextlib
import ctypes
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from dtwin.atomic import write_text
from dtwin.config import Home
from dtwin.errors import InputError, MissingPart, StoreError
from dtwin.locks import locked
from flows.own_pages import HOST
from flows.reach import SERVERS_FILE, answers, auth_string, mlflow_token, running

_HEALTHY_S, _STOP_S, _POLL_S = 120.0, 20.0, 0.25
_PR_SET_PDEATHSIG = 1
_TAIL = 400
# Below it libraries print what they did: pages of SQL.
_ERROR = re.compile(r"^(error\[|[\w.]*(Error|Exception)\b)", re.M)


@dataclass(frozen=True)
class UpRequest:
    """What to start.

    Attributes:
        prefect_port, mlflow_port: Ports on loopback; None for any free one.
        cron: When to train; None for only on request.
        folders: Folders besides the home that flows started on the page may use.
    """

    prefect_port: int | None = None
    mlflow_port: int | None = None
    cron: str | None = None
    folders: tuple[Path, ...] = ()


class Child:
    """A server or runner that was started, with its log.

    Args:
        name: For messages.
        command: What to run.
        env: Its whole environment.
        log: Receives what it prints.
        stops_its_own: Whether it ends its own children when it is interrupted.
    """

    def __init__(
        self, name: str, command: list[str], env: Mapping[str, str], log: Path, *, stops_its_own: bool = False
    ) -> None:
        self.name, self.log, self.stops_its_own = name, log, stops_its_own
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("ab") as output:
            self.begins = output.tell()
            # A group of its own: Ctrl-C reaches only us, and we stop them in order.
            self.process = subprocess.Popen(
                command,
                env=dict(env),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=_end_with_parent,
            )

    def require_alive(self) -> None:
        """Raise when the process has ended.

        Raises:
            StoreError: With the end of its log.
        """
        code = self.process.poll()
        if code is not None:
            raise StoreError(
                f"{self.name} ended by itself", code="up.ended", where=str(self.log), got=f"exit {code}: {self._tail()}"
            )

    def stop(self) -> None:
        """Ask the process to end, wait, then end it and everything it started."""
        if self.process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                if self.stops_its_own:
                    self.process.send_signal(signal.SIGINT)
                else:
                    os.killpg(self.process.pid, signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(_STOP_S)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def _tail(self) -> str:
        with self.log.open("rb") as file:
            file.seek(self.begins)
            said = file.read().decode(errors="replace").strip()
        named = [found.start() for found in _ERROR.finditer(said)]
        return said[named[-1] :][:_TAIL] if named else said[-_TAIL:]


class Servers:
    """What is up.

    Attributes:
        addresses (dict of str to str): ``prefect``, ``prefect_api`` and ``mlflow``; ``prefect_enter`` and
            ``mlflow_enter``, addresses that also tell the page the auth string, where the server was started here.
        children (list of Child): In the order in which they were started.
    """

    def __init__(self) -> None:
        self.addresses: dict[str, str] = {}
        self.children: list[Child] = []

    def watch(self) -> None:
        """Return never; raise when a child ends, or what a signal raises.

        Raises:
            StoreError: When a child has ended by itself.
        """
        while True:
            for child in self.children:
                child.require_alive()
            time.sleep(_POLL_S)


@contextlib.contextmanager
def servers(home: Home, request: UpRequest) -> Iterator[Servers]:
    """Start everything, wait until it is healthy, and stop it all at the end.

    A server that the user names with ``PREFECT_API_URL`` or an http ``MLFLOW_TRACKING_URI`` is
    used as it is and not started.

    Args:
        home: Stores, logs and ``servers.json``.
        request: What to start.

    Raises:
        InputError: When a port is in use, or the servers of this home are up already.
        MissingPart: When Prefect or MLflow is not installed.
        StoreError: When a server does not come up.
    """
    _require_installed()
    with _only_one(home):
        found = Servers()
        try:
            _start_prefect(home, request.prefect_port, found)
            _start_mlflow(home, request.mlflow_port, found)
            await_healthy(home, found)
            _start_flows(home, request, found)
            yield found
        finally:
            (home.root / SERVERS_FILE).unlink(missing_ok=True)
            for child in reversed(found.children):
                child.stop()


@contextlib.contextmanager
def prefect_alone(home: Home) -> Iterator[Servers]:
    """Start a Prefect server without waiting for it, and stop it at the end.

    It writes to the same database as the one of ``dtwin up``, which shows the runs afterwards.

    Args:
        home: Its state, log and ``servers.json``.

    Raises:
        InputError: When the servers of this home are up already, or are just being started.
    """
    with _only_one(home):
        found = Servers()
        try:
            _start_prefect(home, None, found)
            yield found
        finally:
            (home.root / SERVERS_FILE).unlink(missing_ok=True)
            for child in found.children:
                child.stop()


def await_healthy(home: Home, found: Servers) -> None:
    """Wait until servers answer, then tell other processes where they are.

    Args:
        home: Gets the file ``servers.json``.
        found: What was started.

    Raises:
        StoreError: When a server does not come up.
    """
    _await_answers(found)
    _write_addresses(home, found)


def _start_prefect(home: Home, wanted: int | None, found: Servers) -> None:
    named = os.environ.get("PREFECT_API_URL")
    if named:
        found.addresses |= {"prefect": named.removesuffix("/api"), "prefect_api": named}
        return
    port = _port(wanted, "--prefect-port")
    page = f"http://{HOST}:{port}"
    secret = auth_string(home)
    env = _environment(home) | {
        "PREFECT_SERVER_API_HOST": HOST,
        # Without it the page would look for its server on port 4200.
        "PREFECT_SERVER_API_PORT": str(port),
        "PREFECT_SERVER_API_AUTH_STRING": secret,
        "PREFECT_SERVER_CORS_ALLOWED_ORIGINS": page,
    }
    command = [sys.executable, "-P", "-m", "flows.prefect_server", "--port", str(port)]
    found.children.append(Child("Prefect", command, env, home.logs / "prefect-server.log"))
    entering = base64.b64encode(secret.encode()).decode()
    found.addresses |= {"prefect": page, "prefect_api": f"{page}/api", "prefect_enter": f"{page}/enter#{entering}"}


def _start_mlflow(home: Home, wanted: int | None, found: Servers) -> None:
    if home.mlflow_uri.startswith("http"):
        found.addresses["mlflow"] = home.mlflow_uri.rstrip("/")
        return
    port = _port(wanted, "--mlflow-port")
    if not home.mlflow_uri.startswith("sqlite"):
        from dtwin.train.registry import Registry

        # Makes the tables of an empty database, while no other process of this home does.
        Registry(home)
    artifacts = home.mlflow_artifacts
    if isinstance(artifacts, Path):
        artifacts.mkdir(parents=True, exist_ok=True)
    # At its defaults the server is fifteen processes and 2.4 GB.
    env = _environment(home) | {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
    if home.file.endpoint:
        env["MLFLOW_S3_ENDPOINT_URL"] = home.file.endpoint
    command = [sys.executable, "-P", "-m", "flows.mlflow_server", "--port", str(port)]
    found.children.append(Child("MLflow", command, env, home.logs / "mlflow-server.log"))
    page = f"http://{HOST}:{port}"
    found.addresses |= {"mlflow": page, "mlflow_enter": f"{page}/enter?token={mlflow_token(home)}"}


def _start_flows(home: Home, request: UpRequest, found: Servers) -> None:
    env = _environment(home) | {
        "PREFECT_API_URL": found.addresses["prefect_api"],
        "DTWIN_FOLDERS": os.pathsep.join(str(f.absolute()) for f in request.folders)
        or os.environ.get("DTWIN_FOLDERS", ""),
    }
    if "prefect_enter" in found.addresses:
        env["PREFECT_API_AUTH_STRING"] = auth_string(home)
    command = [sys.executable, "-P", "-m", "flows", f"--with={os.getpid()}"]
    command += ["--cron", request.cron] if request.cron else []
    found.children.append(Child("the flows", command, env, home.logs / "flows.log", stops_its_own=True))


def _await_answers(found: Servers) -> None:
    named = {"Prefect": "prefect_api", "MLflow": "mlflow"}
    waiting = {name: f"{found.addresses[key]}/health" for name, key in named.items() if key in found.addresses}
    end_s = time.monotonic() + _HEALTHY_S
    while waiting:
        for child in found.children:
            child.require_alive()
        waiting = {name: url for name, url in waiting.items() if not answers(url)}
        if waiting and time.monotonic() > end_s:
            name, url = next(iter(waiting.items()))
            raise StoreError(
                f"{name} does not answer",
                code="up.unhealthy",
                where=url,
                got=f"nothing for {_HEALTHY_S:g} s",
                hint="its log is below DTWIN_HOME/logs",
            )
        time.sleep(_POLL_S if waiting else 0.0)


def _environment(home: Home) -> dict[str, str]:
    kept = {k: v for k, v in os.environ.items() if k != "PREFECT_API_URL"}
    database = home.prefect_database
    return (
        kept
        | {"DTWIN_HOME": str(home.root), "PREFECT_HOME": str(home.prefect)}
        | ({"PREFECT_API_DATABASE_CONNECTION_URL": database} if database else {})
    )


def _write_addresses(home: Home, found: Servers) -> None:
    content = found.addresses | {"pid": str(os.getpid())}
    text = json.dumps(content, indent=1)
    write_text(home.root / SERVERS_FILE, text, "the servers' file", private=True)


def _port(wanted: int | None, option: str) -> int:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, wanted or 0))
        except OSError as error:
            raise InputError(
                "the port cannot be used",
                code="up.port",
                where=f"{option} {wanted}",
                got=error.strerror or str(error),
                hint=f"leave {option} out for a free one, or name another",
            ) from error
        return int(probe.getsockname()[1])


def _require_installed() -> None:
    for package, extra in (("prefect", "flows"), ("mlflow", "train")):
        if find_spec(package) is None:
            raise MissingPart(
                f"{package} is not installed",
                code=f"{package}.absent",
                hint=f"pip install '.[{extra}]' in a checkout of dtwin",
            )


def _end_with_parent() -> None:
    """Run in the child: nothing stays behind when this process is killed."""
    # What the servers make, databases first, is for its owner alone.
    os.umask(0o077)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)


@contextlib.contextmanager
def _only_one(home: Home) -> Iterator[None]:
    path = home.root / "locks" / "up.lock"
    try:
        home.made()
    except OSError as error:
        raise StoreError(
            "the state folder cannot be written", code="store.write", where=str(path), got=str(error)
        ) from error
    with locked(path) as mine:
        if not mine:
            raise InputError(
                "the servers of this home are up already",
                code="up.twice",
                where=str(home.root),
                got=running(home).get("prefect"),
                hint="open that page, or stop the other with Ctrl-C",
            )
        yield
