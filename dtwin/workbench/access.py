"""Who may ask the workbench for what: token, host, origin, and headers of every answer."""

from __future__ import annotations

import html
import ipaddress
import secrets
from dataclasses import dataclass, field
from urllib.parse import quote, urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders, QueryParams
from starlette.requests import cookie_parser
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

READING = ("GET", "HEAD")
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

    Attributes
    ----------
    host : str
        Address that the server listens on.
    port : int
        Its port.
    token : str
        Needed for everything that changes something; for everything when others can reach
        the server.
    """

    host: str
    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)

    @property
    def cookie(self) -> str:
        """Name of the cookie; cookies do not tell ports apart."""
        return f"dtwin_{self.port}"

    @property
    def shared(self) -> bool:
        """Whether other computers can reach the server."""
        return not is_loopback(self.host)

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
        """Tell whether a Host header names this server.

        A page of another site can point its own name at this computer (DNS rebinding); then
        the header holds that name.
        """
        if not header:
            return False
        try:
            name = urlsplit(f"//{header}").hostname or ""
        except ValueError:
            return False
        if name in ("localhost", self.host.lower()):
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        return self.shared or address.is_loopback


def is_loopback(host: str) -> bool:
    """Tell whether only this computer can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Guarded:
    """An application behind the checks of ``Access``.

    Parameters
    ----------
    app : ASGI application
        What is guarded.
    access : Access
        What a request needs.
    """

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
                    headers[name] = value
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        answer = self._refused(scope)
        await (answer or self.app)(scope, receive, send_with_headers)

    def _refused(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        if not self.access.knows_host(headers.get("host")):
            return _refusal("the address names another computer", "open the printed address")
        given = QueryParams(scope["query_string"]).get("token")
        if given is not None and scope["method"] in READING:
            return self._entered(scope, given)
        cookies = cookie_parser(headers.get("cookie", ""))
        allowed = self.access.knows(cookies.get(self.access.cookie))
        scope.setdefault("state", {})["allowed"] = allowed
        if scope["method"] not in READING:
            if headers.get("origin") not in self._origins(headers):
                return _refusal("the request comes from another site", "use the workbench's page")
            if not allowed:
                return _refusal("the token is missing", "open the address that dtwin ui printed")
        elif self.access.shared and not allowed and not scope["path"].startswith("/static/"):
            return _refusal("the token is missing", "open the address that dtwin ui printed")
        return None

    def _origins(self, headers: Headers) -> tuple[str, ...]:
        return (f"http://{headers['host']}",)

    def _entered(self, scope: Scope, given: str) -> Response:
        if not self.access.knows(given):
            return _refusal(
                "the token is not of this start",
                "open the newest address that dtwin ui printed; each start has its own",
            )
        # A redirect would still count as coming from where the link was pressed, and then a
        # strict cookie is withheld; a page that moves on by itself does not.
        answer = HTMLResponse(_MOVE_ON.format(to=html.escape(quote(scope["path"] or "/"))))
        answer.set_cookie(self.access.cookie, given, httponly=True, samesite="strict", path="/")
        return answer


def _refusal(what: str, hint: str) -> Response:
    return PlainTextResponse(f"refused: {what}\n  try: {hint}\n", 403)
