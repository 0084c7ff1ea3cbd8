"""Where things live and what they may do; environment variables override."""

from __future__ import annotations

import contextlib
import os
import re
import stat
from dataclasses import dataclass
from pathlib import Path

from dtwin.errors import InputError
from dtwin.home_file import Bucket, HomeFile, read_home_file

# Set before the libraries are imported; a user who wants telemetry sets them otherwise.
_TELEMETRY_OFF = {
    "DO_NOT_TRACK": "true",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "ORT_DISABLE_TELEMETRY": "1",
}
# What is asked of servers on this computer, with the secrets that they want, is none of a proxy's business.
_NO_PROXY = ("127.0.0.1", "localhost", "::1")
# Of what commands keep in a home, one is always among the first.
_OURS = ("lake", "locks", "machines", "twins", "mlflow", "fleet", "home.toml")
# What else may lie in it before the first command, or is all that this one left on a disk without permissions.
_BESIDE = (
    *("alerts.toml", "audit.jsonl", "bundles", "cells", "delivery-key", "desks", "kept", "logs", "lost+found"),
    *("people.toml", "plans", "prefect", "pulled", "recipes", "reports", "uploads", "workbench"),
)
# Tables and databases take a path as an address: with a % or a # they lay elsewhere. SQLite's longest path is 512 bytes.
_MISREAD, _LONGEST = re.compile(rb"[%?#\\\x00-\x1f\x7f]"), 450
# Matrices are small: threads of BLAS cost more than they give, and ten times that beside other work.
_THREADS = {"OMP_WAIT_POLICY": "passive", "OPENBLAS_NUM_THREADS": "1"}


SETTINGS: dict[str, tuple[str, str]] = {
    "DTWIN_HOME": ("`./.dtwin`", "folder of all state: lake, models, bundles, logs, servers"),
    "DTWIN_FOLDERS": (
        "none",
        "folders besides `DTWIN_HOME`, parted by `:`, that flows started on the Prefect page may read and write",
    ),
    "DTWIN_ENGINE": (
        "local",
        "where `dtwin fleet` and the flow `nightly` work: `local`, `dask://host:port`, `dask+tls://host:port`",
    ),
    "AWS_ACCESS_KEY_ID": ("none", "with `AWS_SECRET_ACCESS_KEY`, the key of a shared store; other `AWS_...` as usual"),
    "AWS_ENDPOINT_URL": ("Amazon's", "address of the shared store where `home.toml` names none"),
    "PGPASSWORD": ("none, or `~/.pgpass`", "password of the databases that `home.toml` names"),
    "MLFLOW_TRACKING_URI": (
        "the registry of `home.toml`, else a SQLite file in `DTWIN_HOME`",
        "where models are logged and registered",
    ),
    "MLFLOW_TRACKING_TOKEN": (
        "none",
        "what is said to an MLflow server that asks for it; that of `dtwin up` wants the part after the colon of `DTWIN_HOME/prefect-auth`",
    ),
    "MLFLOW_ALLOW_HTTP_REDIRECTS": ("false", "whether what is logged may go where an MLflow server sends it"),
    "DTWIN_MLFLOW": (
        "later",
        "`later`: MLflow is told of a twin's version in the background; `now`: before the command ends",
    ),
    "PREFECT_API_URL": (
        "the server of `dtwin up`, else one for the command",
        "Prefect server whose page shows the flows",
    ),
    "PREFECT_API_AUTH_STRING": (
        "made by `dtwin up`, in `DTWIN_HOME/prefect-auth`",
        "what flows and pages say to the Prefect server",
    ),
    "PREFECT_HOME": ("`DTWIN_HOME/prefect`", "Prefect's own state"),
    "PYTHON_JULIAPKG_EXE": ("`julia` on the path", "Julia for the PySR engine"),
    "DO_NOT_TRACK": ("true", "telemetry of libraries is off; set it otherwise to allow it"),
    "MLFLOW_DISABLE_TELEMETRY": ("true", "the same for MLflow"),
    "PREFECT_SERVER_ANALYTICS_ENABLED": ("false", "the same for Prefect's server"),
    "ORT_DISABLE_TELEMETRY": ("1", "the same for ONNX Runtime; `0` allows it"),
    "NO_PROXY": ("none", "hosts that are asked without the proxy of `HTTP_PROXY`; this computer always is"),
    "PYTHONSAFEPATH": ("1", "programs that commands begin take no code from the folder in which they are begun"),
    "OMP_WAIT_POLICY": ("passive", "threads of numerical libraries do not spin while they wait"),
}
"""Environment variables that a user may set: default, and what it is for."""


@dataclass(frozen=True)
class Home:
    """The folder that holds all state of dtwin.

    ``root``: ``DTWIN_HOME``, by default ``.dtwin`` in the current folder; absolute.
    """

    root: Path

    def made(self) -> Home:
        """Make the folder, readable by its owner alone, and return the home.

        Raises ``OSError`` when it can neither be made nor is there.
        """
        self.root.mkdir(mode=0o700, parents=True, exist_ok=True)
        return self._closed()

    def require_parts(self, *, named: bool = False) -> None:
        """Refuse a home whose path the libraries read as another one, or of which a part is a link that leads nowhere.

        It would look as if nothing was measured yet. ``named``: whether somebody asked for just this folder.
        """
        path = os.fsencode(self.root)
        if len(path) > _LONGEST or _MISREAD.search(path):
            raise InputError(
                "the path of the home cannot be used",
                code="home.path",
                got=repr(str(self.root))[:200] + (f", {len(path)} bytes" if len(path) > _LONGEST else ""),
                allowed=f"at most {_LONGEST} bytes, without % ? # \\ and control characters",
                hint="name another folder, by DTWIN_HOME or in open_home",
            )
        self._require_own(named or bool(os.environ.get("DTWIN_HOME")))
        for part in self.root.glob("*"):
            if part.is_symlink() and not part.exists():
                raise InputError(
                    "a part of the home is a link that leads nowhere",
                    code="home.link",
                    where=str(part),
                    got=str(part.readlink())[:200],
                    hint="mount the disk that it is on, or mend the link",
                )

    def _require_own(self, named: bool) -> None:
        """Refuse a folder that others use, too: it would be taken from them; and one of another user that nobody named."""
        with contextlib.suppress(OSError):
            mode, owner = self.root.stat().st_mode, self.root.stat().st_uid
            if owner != os.geteuid() and not named:
                raise InputError(
                    "the home in this folder is another user's",
                    code="home.owner",
                    where=str(self.root),
                    got=f"user {owner}",
                    allowed="your own: what its files state says where data and passwords are sent",
                    hint="cd to another folder, or name it all the same: DTWIN_HOME=.dtwin",
                )
            names = {path.name for path in self.root.glob("[!.]*")} if mode & 0o077 else set()
            if mode & stat.S_ISVTX or (names and not names & {*_OURS, *_BESIDE}):
                raise InputError(
                    "the home would be a folder that holds other things",
                    code="home.others",
                    where=str(self.root),
                    got=", ".join(sorted(names)[:5])[:120],
                    allowed="a folder of its own: only its owner may enter a home",
                    hint="name a new folder, by DTWIN_HOME or in open_home",
                )

    def tightened(self) -> Home:
        """Take the folder from other users when state of dtwin lies in it, and return the home."""
        # Another folder that was named by mistake, or a file, is none of ours; a path may be too long to look at.
        with contextlib.suppress(OSError):
            if any((self.root / name).exists() for name in _OURS):
                return self._closed()
        return self

    def _closed(self) -> Home:
        with contextlib.suppress(OSError):
            mode = self.root.stat().st_mode
            if mode & 0o077 and not mode & stat.S_ISVTX:
                self.root.chmod(0o700)
        return self

    @property
    def file(self) -> HomeFile:
        """What ``home.toml`` says of parts that are shared with other computers."""
        return read_home_file(self.root)

    @property
    def lake(self) -> Path | Bucket:
        """Delta tables: a folder here, or one of the shared store."""
        bucket = self.file.bucket
        return self.root / "lake" if bucket is None else bucket / "lake"

    @property
    def reduced(self) -> Path:
        """Runs averaged to one value per degree: a short cut, made again when it is missing."""
        return self.root / "reduced"

    @property
    def campaigns(self) -> Path:
        """Campaign folders that dtwin itself recorded."""
        return self.root / "campaigns"

    @property
    def machines(self) -> Path:
        """Records of machines: axes, tolerances, events."""
        return self.root / "machines"

    @property
    def plans(self) -> Path:
        """Plans of tests whose measurement is waited for."""
        return self.root / "plans"

    @property
    def bundles(self) -> Path:
        """Promoted models, frozen for serving."""
        return self.root / "bundles"

    @property
    def reports(self) -> Path:
        """HTML reports."""
        return self.root / "reports"

    @property
    def logs(self) -> Path:
        """Logs of servers and child processes."""
        return self.root / "logs"

    @property
    def prefect(self) -> Path:
        """Prefect's own state."""
        return self.root / "prefect"

    @property
    def mlflow_artifacts(self) -> Path | Bucket:
        """MLflow's artifacts when no server is configured."""
        file = self.file
        shared = file.bucket if file.registry.startswith("postgresql:") else None
        return self.root / "mlflow" / "artifacts" if shared is None else shared / "artifacts"

    @property
    def mlflow_uri(self) -> str:
        """Tracking store: ``MLFLOW_TRACKING_URI``, else the registry of ``home.toml``, else a local SQLite file."""
        shared = self.file.registry.replace("postgresql:", "postgresql+psycopg2:")
        return os.environ.get("MLFLOW_TRACKING_URI") or shared or f"sqlite:///{self.root}/mlflow/mlflow.db"

    @property
    def no_registry_yet(self) -> bool:
        """Whether nothing was registered here yet; opening a registry would make it."""
        local = self.mlflow_uri.removeprefix("sqlite:///")
        return local != self.mlflow_uri and not Path(local).is_file()

    @property
    def prefect_database(self) -> str:
        """Prefect's database where ``home.toml`` names one; empty for the local one."""
        return self.file.flows.replace("postgresql:", "postgresql+asyncpg:")

    @property
    def engine(self) -> str:
        """Where the work of a fleet is done: ``DTWIN_ENGINE``, by default on this computer."""
        return os.environ.get("DTWIN_ENGINE") or "local"

    @property
    def mlflow_at_once(self) -> bool:
        """Whether MLflow is told of a twin's version before the command ends: ``DTWIN_MLFLOW``.

        Raises ``InputError`` when it is neither ``now`` nor ``later``.
        """
        when = os.environ.get("DTWIN_MLFLOW") or "later"
        if when not in ("now", "later"):
            raise InputError(
                "the setting is not known", code="settings.value", where="DTWIN_MLFLOW", got=when, allowed="now, later"
            )
        return when == "now"


def home() -> Home:
    """Return the state folder; nothing is created by asking."""
    return home_in(Path(os.environ.get("DTWIN_HOME") or ".dtwin"))


def home_in(folder: Path) -> Home:
    """Return the home in a folder; a ``~`` stands for somebody's own folder. Raises ``InputError`` when nobody has that name, or this folder is gone."""
    try:
        return Home(folder.expanduser().absolute())
    except RuntimeError as error:
        raise InputError("the home is in the folder of nobody", code="home.path", got=str(folder)[:200]) from error
    except FileNotFoundError as error:
        raise InputError(
            "the folder in which the command was typed is gone",
            code="home.path",
            got=str(folder)[:200],
            hint="cd to a folder that is there, or set DTWIN_HOME to a whole path",
        ) from error


def quiet_environment() -> None:
    """Set what libraries and the programs that are begun by this one take from the environment, unless the user has.

    Telemetry is off, pools of threads are polite, and this computer is asked without a proxy.
    """
    for name, value in (_TELEMETRY_OFF | _THREADS).items():
        os.environ.setdefault(name, value)
    kept = os.environ.get("no_proxy") or os.environ.get("NO_PROXY") or ""
    if kept.strip() != "*":
        hosts = [host for host in kept.split(",") if host.strip()]
        # Libraries differ in which of the two they read.
        for name in ("no_proxy", "NO_PROXY"):
            os.environ[name] = ",".join([*hosts, *(own for own in _NO_PROXY if own not in hosts)])


def sample_recording() -> Path:
    """Return the real UR10e ball-bar recording that travels with the package."""
    return _data("samples/ur10e_xy_r100_f5000.b5r")


def published_table(name: str) -> Path:
    """Return a file of published numbers that travels with the package."""
    return _data(f"published/{name}")


def example_campaigns() -> Path:
    """Return the folder of example campaigns that travels with the package."""
    return _data("examples")


def _data(name: str) -> Path:
    package = Path(__file__).parent
    installed, checkout = package / "_data" / name, package.parent / "data" / name
    return checkout if checkout.exists() and not installed.exists() else installed
