"""Which role what is asked of the workbench needs, and the note that is made of it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable

from starlette.types import Message, Receive

NEEDED = (
    (r"/api/jobs/", "measure"),
    (r"/api/live/[^/]+/stop$", "stop"),
    (r"/api/models/", "promote"),
    (r"/api/twins(/|$)", "train"),
    # An effect is a program that the server runs: whoever may write one may do what the server may.
    (r"/api/effects(/|$)", "promote"),
    (r"/api/(campaigns|machines)/[^/]+/(find|together)$", "train"),
    (r"/api/campaigns/[^/]+/(amend$|runs/)", "measure"),
    (r"/api/(trays|measuring)(/|$)", "measure"),
    (r"/api/machines/[^/]+/(event|next|tolerance|schedule|plans|facts|axis)(/|$)", "measure"),
    (r"/api/machines$", "measure"),
)
"""Roles by the begin of an address, as regular expressions that a browser understands, too; the first that fits."""
OTHERWISE = "promote"
"""What an address needs that nobody thought of."""
_REASONS = ("because", "comment", "why", "note")
_MOST = 64_000


def role_for(path: str) -> str | None:
    """Return the role that a change at an address needs, None for an address that nobody thought of."""
    return next((role for pattern, role in NEEDED if re.match(pattern, path)), None)


def overheard(receive: Receive) -> tuple[Receive, Callable[[], str]]:
    """Return how to receive a request, and what then tells the reason that stands in it."""
    body = bytearray()

    async def hear() -> Message:
        message = await receive()
        if message["type"] == "http.request" and len(body) <= _MOST:
            body.extend(message.get("body", b""))
        return message

    def reason() -> str:
        try:
            said = json.loads(bytes(body)) if len(body) <= _MOST else {}
            return next((str(said[key]) for key in _REASONS if said.get(key)), "")
        except (ValueError, AttributeError, RecursionError):
            return ""

    return hear, reason
