"""Who may ask the workbench for what: token, host, origin, and headers of every answer."""

from __future__ import annotations

import html
import ipaddress
import secrets
from dataclasses import dataclass, field
from urllib.parse import quote, urlencode

from starlette.datastructures import Headers, MutableHeaders, QueryParams
from starlette.requests import cookie_parser
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from dtwin.own_address import is_foreign, names_this_computer

_READING = ("GET", "HEAD")
_MOVE_ON = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><title>dtwin</title>'
    '<link rel="icon" href="data:,">'
    '<meta http-equiv="refresh" content="0; url={to}"><p><a href="{to}">To the workbench</a></p>'
)
_HEADERS = {
    # Plotly sets style attributes; everything else is only from here, and no script is inline.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; connect-src 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


@dataclass(frozen=True)
class Access:
    """What a request needs.

    ``host``: address that the server listens on.
    ``private``: whether reading needs the token too: where several people use the computer.
    ``token``: needed for everything that changes something; for everything when others can reach the server.
    """

    host: str
    port: int
    private: bool = False
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)

    @property
    def cookie(self) -> str:
        """Name of the cookie; cookies do not tell ports apart."""
        return f"dtwin_{self.port}"

    @property
    def shared(self) -> bool:
        """Whether other computers can reach the server."""
        return not _is_loopback(self.host)

    @property
    def address(self) -> str:
        """Address of the first page, with the token."""
        shown = "127.0.0.1" if self.host in ("0.0.0.0", "::") else self.host
        name = f"[{shown}]" if ":" in shown else shown
        return f"http://{name}:{self.port}/?{urlencode({'token': self.token})}"

    def knows(self, given: str | None) -> bool:
        """Tell whether a token is the right one."""
        return given is not None and secrets.compare_digest(given.encode(), self.token.encode())

    def knows_host(self, header: str | None) -> bool:
        """Tell whether a Host header names this server."""
        return names_this_computer(header, also=self.host, any_address=self.shared)


def _is_loopback(host: str) -> bool:
    """Tell whether only this computer can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Guarded:
    """An application behind the checks of ``Access``."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self.app = app
        self.access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        answer = self._refused(scope)
        await (answer or self.app)(scope, receive, send_with_headers)

    def _refused(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        if not self.access.knows_host(headers.get("host")):
            return _refusal("the address names another computer", "open the printed address")
        given = QueryParams(scope["query_string"]).get("token")
        if given is not None and scope["method"] in _READING:
            return self._entered(scope, given)
        cookies = cookie_parser(headers.get("cookie", ""))
        allowed = self.access.knows(cookies.get(self.access.cookie))
        scope.setdefault("state", {})["allowed"] = allowed
        if scope["method"] not in _READING:
            if headers.get("origin") is None or is_foreign(headers["origin"], headers["host"]):
                return _refusal("the request comes from another site", "use the workbench's page")
            if not allowed:
                return _refusal("the token is missing", "open the address that dtwin ui printed")
            return None
        # A delivery asks for a proof of its own, which no browser has.
        if scope["path"].startswith(("/static/", "/delivery/")):
            return None
        if (self.access.shared or self.access.private) and not allowed:
            return _refusal("the token is missing", "open the address that dtwin ui printed")
        # A page of another site, or of another server here, could make this one compute.
        if headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            return _refusal("another site asks for this page", "type the address, or reload here")
        return None

    def _entered(self, scope: Scope, given: str) -> Response:
        if not self.access.knows(given):
            return _refusal(
                "the token is not of this start",
                "open the newest address that dtwin ui printed; each start has its own",
            )
        # A redirect would still count as coming from where the link was pressed, and then a
        # strict cookie is withheld; a page that moves on by itself does not.
        answer = HTMLResponse(_MOVE_ON.format(to=html.escape(quote(f"/{scope['path'].lstrip('/')}"))))
        answer.set_cookie(self.access.cookie, given, httponly=True, samesite="strict", path="/")
        return answer


def _refusal(what: str, hint: str) -> Response:
    return PlainTextResponse(f"refused: {what}\n  try: {hint}\n", 403)
