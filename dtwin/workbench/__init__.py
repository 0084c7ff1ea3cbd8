"""The workbench: the same verbs and the same figures as the command line, in a browser."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dtwin.offered import offered

if TYPE_CHECKING:
    from dtwin.workbench._listening_socket import listening as listening
    from dtwin.workbench._listening_socket import only_one as only_one
    from dtwin.workbench._server import run as run

_PLACES = {"_listening_socket": "listening only_one", "_server": "run"}
__all__ = " ".join(_PLACES.values()).split()
__getattr__ = offered(__name__, _PLACES)
