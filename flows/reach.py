"""Which servers are up; needs neither Prefect nor MLflow."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from collections.abc import Mapping
from pathlib import Path

from dtwin.config import Home

SERVERS_FILE = "servers.json"


def running(state: Home) -> Mapping[str, str]:
    """Return what ``dtwin up`` wrote about its servers, empty when nothing is up.

    Parameters
    ----------
    state : Home
        Gives the file.
    """
    try:
        found = json.loads((state.root / SERVERS_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    # The file of a killed `dtwin up` stays behind.
    alive = isinstance(found, dict) and Path(f"/proc/{found.get('pid')}").is_dir()
    return found if alive else {}


def answers(url: str, timeout_s: float = 2.0) -> bool:
    """Tell whether an address answers with success.

    Parameters
    ----------
    url : str
        An http address.
    timeout_s : float
        How long to wait.
    """
    # No proxy: what is asked for here runs on this computer or is named by the user.
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(url, timeout=timeout_s) as reply:
            return bool(reply.status == 200)
    except (OSError, ValueError, urllib.error.URLError):
        return False
