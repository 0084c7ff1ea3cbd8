"""Which servers are up; needs neither Prefect nor MLflow."""

from __future__ import annotations

import json
import os
import secrets
import urllib.error
import urllib.request
from collections.abc import Mapping
from pathlib import Path

from dtwin.atomic import write_text
from dtwin.config import Home
from dtwin.errors import InputError

SERVERS_FILE = "servers.json"
AUTH_FILE = "prefect-auth"
_SHORTEST = 24


def running(state: Home) -> Mapping[str, str]:
    """Return what ``dtwin up`` wrote about its servers, empty when nothing is up.

    Args:
        state: Gives the file.
    """
    try:
        found = json.loads((state.root / SERVERS_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    # The file of a killed `dtwin up` stays behind.
    alive = isinstance(found, dict) and Path(f"/proc/{found.get('pid')}").is_dir()
    return found if alive else {}


def auth_string(state: Home) -> str:
    """Return what clients and pages say to this home's Prefect server; made at the first start.

    Args:
        state: Gives the file, which its owner alone can read.
    """
    path = state.root / AUTH_FILE
    try:
        kept = path.read_text(encoding="ascii").strip()
        if len(kept) > _SHORTEST:
            return kept
    except (OSError, ValueError):
        pass
    made = f"dtwin:{secrets.token_urlsafe(32)}"
    write_text(path, made, "the auth string of the Prefect server", private=True)
    return made


def mlflow_token(state: Home) -> str:
    """Return what clients and pages say to this home's MLflow server: the part of the auth string after its colon.

    Args:
        state: Gives the file.
    """
    return auth_string(state).partition(":")[2]


def answers(url: str, timeout_s: float = 2.0) -> bool:
    """Tell whether an address answers with success.

    Args:
        url: An http address.
        timeout_s: How long to wait.
    """
    # No proxy: what is asked for here runs on this computer or is named by the user.
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(url, timeout=timeout_s) as reply:
            return bool(reply.status == 200)
    except (OSError, ValueError, urllib.error.URLError):
        return False


def running_server(state: Home) -> str | None:
    """Return the API address of the server to report to, None when there is none.

    Args:
        state: Where ``dtwin up`` says what is running.

    Raises:
        InputError: When ``PREFECT_API_URL`` names a server that does not answer.
    """
    named = os.environ.get("PREFECT_API_URL")
    if named:
        if answers(f"{named}/health"):
            return named
        raise InputError(
            "the Prefect server does not answer",
            code="prefect.absent",
            where="PREFECT_API_URL",
            got=named,
            hint="dtwin up starts one; unset PREFECT_API_URL to run without",
        )
    url = running(state).get("prefect_api")
    return url if url is not None and answers(f"{url}/health") else None
