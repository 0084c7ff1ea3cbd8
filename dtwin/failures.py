"""What disks, folders and the registry's database do to any command or page, in words."""

from __future__ import annotations

import errno

from dtwin.config import home
from dtwin.errors import StoreError, in_a_line

# Of a disk or folder; any other error of the system is a mistake of ours.
_UNUSABLE = (
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.ENOSPC,
    errno.EDQUOT,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.EEXIST,
    errno.ENAMETOOLONG,
    errno.ELOOP,
    # A disk that fails, a share that went away, a device that is none.
    errno.EIO,
    errno.ESTALE,
    errno.ENOTCONN,
    errno.EREMOTEIO,
    errno.ENXIO,
    errno.ENODEV,
)
_LIBRARIES = {"mlflow.exceptions.MlflowException", "sqlalchemy.exc.SQLAlchemyError"}


def fault_of(error: Exception) -> StoreError | None:
    """Return what went wrong with a file, a folder or the model registry; None of a mistake of ours."""
    if isinstance(error, OSError):
        return _not_usable(error) if error.errno in _UNUSABLE else None
    # By name: nothing is imported for it.
    raised = {f"{kind.__module__}.{kind.__name__}" for kind in type(error).__mro__}
    if not raised & {*_LIBRARIES, "sqlite3.Error"}:
        return None
    elsewhere = not home().mlflow_uri.startswith("sqlite")
    if "sqlite3.Error" not in raised and not elsewhere and "(sqlite3." not in str(error):
        return None
    return StoreError(
        "the model registry was lost, or refused",
        code="registry.away",
        where=home().mlflow_uri.rpartition("@")[2] if elsewhere else str(home().root / "mlflow"),
        got=in_a_line(error),
        hint="run this again when it is back: what is done already is not done twice"
        if elsewhere
        else "see that there is free space, and run this again: another process may have held it; dtwin home check says whether it is damaged",
    )


def _not_usable(error: OSError) -> StoreError:
    """Say which file or folder of ours cannot be read or written, and why."""
    return StoreError(
        "a file or folder cannot be used",
        code="store.permission",
        where=str(error.filename or "an unnamed file"),
        got=error.strerror or str(error),
        hint="check permissions, free space and the disk or share itself, or set DTWIN_HOME to another folder",
    )
