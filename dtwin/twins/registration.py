"""Versions of twins in MLflow, which follows the shelf; a twin also works where MLflow is not installed.

The shelf is the queue: a version waits until a receipt beside it, ``vNNN.mlflow.json``, says where in
MLflow it is, so there is no moment at which a kill could lose one. One process at a time logs what
waits, oldest first. It is light to import: MLflow costs seconds, and comes when something waits.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dtwin.config import Home
from dtwin.documents import read_document, write_document
from dtwin.errors import StoreError, in_a_line
from dtwin.locks import locked

if TYPE_CHECKING:
    from dtwin.train.registry import Registry

_VERSION = re.compile(r"v(\d{3,})\.json")
_PLACE = ("parent_run_id", "run_id", "model", "model_version")
_HINT = "dtwin repair writes it again"
_children: list[subprocess.Popen[bytes]] = []


@dataclass(frozen=True)
class _Waiting:
    """A version of a twin that MLflow does not show yet, or not with its diagnosis.

    ``failed``: why it could not be logged; empty when nobody has tried.
    """

    path: Path
    failed: str

    @property
    def label(self) -> str:
        """Twin and version, for people."""
        return f"{self.path.parent.name} {self.path.stem}"

    def as_dict(self) -> dict[str, Any]:
        return {"twin": self.path.parent.name, "version": version_number(self.path), "failed": self.failed}


def version_paths(folder: Path) -> list[Path]:
    """Return the files of a twin's versions in the order of their numbers; none where there is no twin."""
    paths = {int(match[1]): path for path in folder.glob("v*.json") if (match := _VERSION.fullmatch(path.name))}
    return [paths[number] for number in sorted(paths)]


def version_name(version: int) -> str:
    """Return the name of a version's files, without what comes after the dot."""
    return f"v{version:03d}"


def version_number(path: Path) -> int:
    """Return the number of the version that a file of ``version_paths`` holds."""
    return int(path.stem[1:])


def place_of(path: Path, document: Mapping[str, Any]) -> dict[str, str]:
    """Return where a version is in MLflow; empty while it waits.

    ``document``: what it holds; versions of earlier releases say there themselves where they are.
    """
    file = _receipt(path)
    receipt = read_document(file, _HINT) if file.exists() else document.get("mlflow", {})
    return {key: receipt[key] for key in _PLACE if key in receipt}


def waiting(home: Home, name: str = "*") -> list[_Waiting]:
    """Return the versions of a twin, or of all, that wait for MLflow, oldest first; none where it is not installed."""
    return _still_waiting(_oldest_first(home, name))


def _oldest_first(home: Home, name: str = "*") -> list[Path]:
    """Return the files of all versions that MLflow is to have."""
    if find_spec("mlflow") is None:
        return []
    begun: dict[Path, int] = {}
    for folder in sorted((home.root / "twins").glob(name)):
        newest = 0
        for path in version_paths(folder):
            # No later than its successors, whatever a copy made of the times.
            newest = begun[path] = max(newest, _written_ns(path))
    return sorted(begun, key=begun.__getitem__)


def _still_waiting(paths: Iterable[Path]) -> list[_Waiting]:
    return [waiting for path in paths if (waiting := _waiting_at(path)) is not None]


def _waiting_at(path: Path) -> _Waiting | None:
    """Return a version if MLflow does not have it, or not its newest diagnosis."""
    receipt = _known(path)
    if "model_version" in receipt and receipt.get("diagnosis", "") == _sha256(diagnosis_path(path)):
        return None
    return _Waiting(path, receipt.get("failed", ""))


def _something_waits(home: Home) -> bool:
    """Tell whether a version waits: the newest is asked first, for that is the likely one."""
    return any(_waiting_at(path) is not None for path in reversed(_oldest_first(home)))


def waiting_text(left: Sequence[_Waiting]) -> str:
    """Return how many versions wait and why, for people; empty when none does."""
    if not left:
        return ""
    said = f"not yet in MLflow: {', '.join(item.label for item in left[:4])}"
    more = f" and {len(left) - 4} more" if len(left) > 4 else ""
    failed = next((f"{item.label} failed: {item.failed}" for item in left if item.failed), "")
    told = (
        f"; {failed}; dtwin repair tries again"
        if failed
        else "; a process in the background does it, else dtwin repair"
    )
    return said + more + told


def log_soon(home: Home, name: str, *, at_once: bool, ahead: bool = False) -> None:
    """Have what waits logged by a process that outlives this one, or ``at_once`` by this one.

    ``name``: the twin that has something new.
    ``at_once``: wait for it.
    ``ahead``: the process diagnoses the new version before; nothing is done ahead ``at_once``.
    """
    if at_once:
        left = [item for item in log_waiting(home) if item.path.parent.name == name]
        if left:
            raise StoreError(
                "the twin is kept, but MLflow did not take it",
                code="registry.write",
                where=left[0].label,
                got=left[0].failed,
                hint="dtwin repair tries again",
            )
        return
    if find_spec("mlflow") is None and not ahead:
        return
    # Asked for their end, or they would stay as zombies of a long-lived workbench.
    _children[:] = [child for child in _children if child.poll() is None]
    _children.append(
        subprocess.Popen(
            [sys.executable, "-P", "-m", "dtwin.twins._background", str(home.root), *([name] if ahead else [])],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    )


def log_waiting(home: Home) -> list[_Waiting]:
    """Log what waits, in this process, and return what could not be logged.

    In a home that can only be read nothing is logged.
    """
    if not _something_waits(home):
        return []
    if not os.access(home.root, os.W_OK):
        return waiting(home)
    with locked(_lock(home, "logging"), wait=True):
        return _log_all(home)


def _log_all(home: Home) -> list[_Waiting]:
    """Log what waits, and return what of it still does."""
    items = waiting(home)
    if items:
        _log_each(home, items)
    return _still_waiting(item.path for item in items if item.path.exists())


def _log_each(home: Home, items: Sequence[_Waiting]) -> None:
    # Whatever goes wrong stands in the receipts: nobody looks at this process.
    try:
        from dtwin.train.registry import Registry

        registry = Registry(home)
        registry.experiment()
    except Exception as error:
        for item in items:
            _fail(item.path, error)
        return
    blocked: set[Path] = set()
    for item in items:
        # A later version of a twin must not come before an earlier one.
        if item.path.parent in blocked:
            continue
        try:
            _log(registry, item.path)
        except Exception as error:
            blocked.add(item.path.parent)
            _fail(item.path, error)


def _log(registry: Registry, path: Path) -> None:
    """Log a version, or only its diagnosis when it is logged already; write the receipt."""
    from dtwin.train.twin_registry import log_twin, note_diagnosis

    known, digest = _known(path), _sha256(path)
    place = {key: known[key] for key in _PLACE if key in known}
    if "model_version" not in place:
        document = read_document(path)
        place = log_twin(registry, document, digest, description=_description(document), parent=_parent(path))
        _keep(path, {**place, "version": digest})
    file = diagnosis_path(path)
    noted = _sha256(file)
    if noted:
        note_diagnosis(registry, place["model"], place["model_version"], read_document(file))
    _keep(path, {**place, "version": digest, "diagnosis": noted})


def _description(document: Mapping[str, Any]) -> str:
    figures = {k: float("nan") if v is None else v for k, v in document["figures"].items()}
    return (
        f"{document['action']} on {document['campaign']}: RMS "
        f"{figures['rms_before_um']:z.2f} → {figures['rms_after_um']:z.2f} µm, "
        f"noise floor {figures['noise_floor_um']:z.2f} µm (unit of replication: the {document.get('replication', 'run')})."
    )


def _parent(path: Path) -> str | None:
    """Return the run that holds the earlier versions, None for the first."""
    every = version_paths(path.parent)
    at = every.index(path)
    return _known(every[at - 1]).get("parent_run_id") if at else None


def _known(path: Path) -> dict[str, Any]:
    """Return the receipt of a version; empty without one, and when it is damaged or another's.

    What is not known is looked up in MLflow before anything is logged.
    """
    digest = _sha256(path)
    with contextlib.suppress(StoreError):
        if _receipt(path).exists():
            receipt = read_document(_receipt(path))
            return receipt if receipt["version"] == digest else {}
        place = read_document(path).get("mlflow")
        return {**place, "version": digest} if place else {}
    return {}


def _keep(path: Path, receipt: Mapping[str, Any]) -> None:
    # The folder of a twin that was removed meanwhile is not made again.
    if path.exists():
        write_document(_receipt(path), receipt, "the receipt of MLflow")


def _fail(path: Path, error: Exception) -> None:
    said = f"{type(error).__name__}: {in_a_line(error)}"
    about = {"version": _sha256(path), "failed": said, "failed_at": datetime.now(UTC).isoformat()}
    _keep(path, {**_known(path), **about})


def _receipt(path: Path) -> Path:
    return path.with_suffix(".mlflow.json")


def diagnosis_path(path: Path) -> Path:
    """Return the file of the diagnosis of a version. ``path``: file of the version."""
    return path.with_suffix(".diagnosis.json")


def _sha256(path: Path) -> str:
    """Return the hash of a file, empty when there is none."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""


def _written_ns(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def _lock(home: Home, name: str) -> Path:
    return home.root / "locks" / f"twins-to-mlflow.{name}.lock"


def log_next(home: Home) -> None:
    """Log what waits, unless another process that has not begun yet will see the same."""
    if not _something_waits(home):
        return
    with contextlib.ExitStack() as held:
        with locked(_lock(home, "next")) as mine:
            if not mine:
                return
            held.enter_context(locked(_lock(home, "logging"), wait=True))
        _log_all(home)
