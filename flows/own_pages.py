"""What the servers of ``dtwin up`` answer: this computer's own names, and their own pages."""

from __future__ import annotations

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import Receive, Scope, Send

from dtwin.own_address import is_foreign, names_this_computer

HOST = "127.0.0.1"
ENTER = "/enter"


def asks_from_elsewhere(headers: Headers) -> bool:
    """Tell whether a request uses another name of this computer, or comes from another page."""
    host = headers.get("host", "")
    return (
        not names_this_computer(host)
        or is_foreign(headers.get("origin"), host)
        or headers.get("sec-fetch-site", "none") not in ("none", "same-origin")
    )


async def refuse(why: str, status: int, scope: Scope, receive: Receive, send: Send) -> None:
    """Refuse a request, or a web socket."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
    else:
        await PlainTextResponse(f"refused: {why}\n", status)(scope, receive, send)
