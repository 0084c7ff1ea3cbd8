"""Which files a flow may touch that somebody started on the Prefect page."""

from __future__ import annotations

import os
from pathlib import Path

from prefect.runtime import deployment

from dtwin.config import home
from dtwin.errors import InputError

ALLOWED = "DTWIN_FOLDERS"


def confined(path: Path) -> Path:
    """Return a path that a flow may use.

    A flow that runs in the process of the command that was typed takes any path; one that was
    started on the page or by a schedule keeps to ``DTWIN_HOME`` and the folders that the user
    allowed.

    Raises:
        InputError: When the path lies elsewhere.
    """
    if not deployment.id:
        return path
    own = home().root
    listed = [Path(part) for part in os.environ.get(ALLOWED, "").split(os.pathsep) if part]
    # A path without a root is meant below DTWIN_HOME: the runner's own folder says nothing.
    place = (own / path.expanduser()).resolve()
    if any(place.is_relative_to(folder.resolve()) for folder in (own, *listed)):
        return place
    raise InputError(
        "a flow started on the page keeps to its folders",
        code="flow.path",
        got=str(path)[:200],
        allowed=f"what lies below {' or '.join(map(str, (own, *listed)))}",
        hint="dtwin up --allow FOLDER lets flows use a folder",
    )
