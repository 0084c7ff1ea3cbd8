"""What a process in the background does when a twin has a new version: it diagnoses it ahead, and tells MLflow.

Who fits a twin asks next what it lacks: the answer is kept then, or on its way.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from pathlib import Path

from dtwin.config import Home, quiet_environment
from dtwin.errors import DtwinError
from dtwin.locks import locked
from dtwin.shared_documents import following
from dtwin.twins.registration import log_next

# Nobody waits for MLflow.
_POLITE = 10
# Between two looks whether the home is still there.
_LOOKS_S = 5.0


def _main(root: Path, names: list[str]) -> None:
    threading.Thread(target=_end_without, args=(root,), daemon=True).start()
    home = Home(root)
    with following(home):
        for name in names:
            _diagnose(home, name)
        os.nice(_POLITE)
        log_next(home)


def _end_without(root: Path) -> None:
    """End this process when its home has vanished: nobody can read what it finds."""
    while root.exists():
        time.sleep(_LOOKS_S)
    os._exit(1)


def _diagnose(home: Home, name: str) -> None:
    """Diagnose the newest version; whoever asks for it meets the same error and is told.

    One process of a home does so at a time: where many twins are fitted one after the other, most are diagnosed when asked.
    """
    from dtwin.twins.of_kind import twins_with

    with locked(home.root / "locks" / "diagnosis-ahead.lock") as mine, contextlib.suppress(DtwinError):
        if mine:
            twins = twins_with(home, None, name)
            # This process does it, when the diagnosis can be read.
            twins.logs = False
            twins.diagnose(name)


if __name__ == "__main__":
    quiet_environment()
    _main(Path(sys.argv[1]), sys.argv[2:])
