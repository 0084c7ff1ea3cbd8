"""Who may ask the workbench for what: token, host, origin, headers of every answer, the role that is needed, and the note that is made."""

from __future__ import annotations

import hmac
import html
import ipaddress
import json
import re
import secrets
from collections.abc import Callable
from dataclasses import dataclass, field
from urllib.parse import quote, urlencode

from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders, QueryParams
from starlette.requests import cookie_parser
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.own_address import is_foreign, names_this_computer
from dtwin.people import ROLES, Person, act_as, acting, note, read_people

_READING = ("GET", "HEAD")
# Of a request that changes something: what is read of it is in memory at once. Files are put into a tray, part by part.
_MOST_BYTES, _FILES = 1_000_000, "/api/trays/"
_MOVE_ON = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><title>dtwin</title>'
    '<link rel="icon" href="data:,"><noscript><meta http-equiv="refresh" content="0; url={to}"></noscript>'
    '<script src="/static/enter.js" data-key="{key}" data-to="{to}"></script><p><a href="{to}">To the workbench</a></p>'
)
KEY = "dtwin-key"
"""Header with the key of a page, which every change needs beside the cookie."""
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
    ``home``: whose people have tokens of their own, and whose record says what they did.
    ``token``: of who started the server, who may do all. One is needed for everything that changes something; for everything when others can reach the server.
    """

    host: str
    port: int
    private: bool = False
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)
    home: Home | None = None

    @property
    def cookie(self) -> str:
        """Name of the cookie. Cookies do not tell ports apart: every server of this computer that the browser asks gets it, so it only lets read."""
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

    def person(self, given: str) -> Person | None:
        """Return whose token it is; None for a wrong one."""
        if secrets.compare_digest(given.encode(), self.token.encode()):
            return self._starter()
        return None if self.home is None else read_people(self.home).of_token(given)

    def sealed(self, person: Person, use: str) -> str:
        """Return what a browser keeps of a person's token for a use, ``read`` or ``change``: of this start, and no way back to the token."""
        return hmac.new(self.token.encode(), f"{use} {person.token_sha256}".encode(), "sha256").hexdigest()

    def holder(self, given: str | None, use: str) -> Person | None:
        """Return whose token was sealed for a use; None when nobody's was."""
        if not given:
            return None
        people = (self._starter(), *(() if self.home is None else read_people(self.home).people))
        return next((p for p in people if secrets.compare_digest(given.encode(), self.sealed(p, use).encode())), None)

    def _starter(self) -> Person:
        return Person(acting(), ROLES, "")

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

        try:
            answer = self._refused(scope)
        except InputError:
            answer = _refusal("the list of people is not usable", "dtwin people list says what is wrong")
        who, home = scope.get("state", {}).get("who"), self.access.home
        if answer or scope["method"] in _READING or who is None or home is None:
            await (answer or self.app)(scope, receive, send_with_headers)
            return
        came: list[int] = []

        async def noted(message: Message) -> None:
            if message["type"] == "http.response.start":
                came.append(message["status"])
            await send_with_headers(message)

        act_as(who)
        hear, reason = _overheard(receive)
        try:
            await self.app(scope, hear, noted)
        finally:
            what = f"{scope['method']} {scope['path']}"
            # A home that was taken away is not begun anew by a note: it could not be moved back.
            if home.root.is_dir():
                await run_in_threadpool(note, home, what, reason(), str(came[0] if came else "died"), who)

    def _refused(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        if not self.access.knows_host(headers.get("host")):
            return _refusal("the address names another computer", "open the printed address")
        given = QueryParams(scope["query_string"]).get("token")
        if given is not None and scope["method"] in _READING:
            return self._entered(scope, given)
        cookies = cookie_parser(headers.get("cookie", ""))
        person = self.access.holder(cookies.get(self.access.cookie), "read")
        allowed = person is not None
        may = [] if person is None else [role for role in ROLES if person.may(role)]
        scope.setdefault("state", {}).update(allowed=allowed, who=None if person is None else person.name, may=may)
        if scope["method"] not in _READING:
            if headers.get("origin") is None or is_foreign(headers["origin"], headers["host"]):
                return _refusal("the request comes from another site", "use the workbench's page")
            if person is None or person != self.access.holder(headers.get(KEY), "change"):
                return _refusal("the token is missing", "open the address that dtwin ui printed")
            is_file = scope["method"] == "PUT" and scope["path"].startswith(_FILES)
            if not is_file and not _is_short(headers):
                return _refusal(f"the request is longer than {_MOST_BYTES} bytes, or does not say", "send less", 413)
            role = _role_for(scope["path"]) or OTHERWISE
            if not person.may(role):
                return _refusal(
                    f"{person.name} may not {role}", f"ask for the role: dtwin people add NAME --role {role}"
                )
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
        if (person := self.access.person(given)) is None:
            return _refusal(
                "the token is not of this start",
                "open the newest address that dtwin ui printed; each start has its own",
            )
        # A redirect would still count as coming from where the link was pressed, and then a
        # strict cookie is withheld; a page that moves on by itself does not.
        to, key = html.escape(quote(f"/{scope['path'].lstrip('/')}")), self.access.sealed(person, "change")
        answer = HTMLResponse(_MOVE_ON.format(to=to, key=key))
        read = self.access.sealed(person, "read")
        answer.set_cookie(self.access.cookie, read, httponly=True, samesite="strict", path="/")
        return answer


def _is_short(headers: Headers) -> bool:
    """Tell whether a request says that its body is short enough to be read at once."""
    length = headers.get("content-length", "0")
    # Of digits without end no number is made.
    short = length.isdecimal() and len(length) <= len(str(_MOST_BYTES)) and int(length) <= _MOST_BYTES
    return short and "transfer-encoding" not in headers


def _refusal(what: str, hint: str, status: int = 403) -> Response:
    return PlainTextResponse(f"refused: {what}\n  try: {hint}\n", status)


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
    (r"/api/machines/[^/]+/(event|next|tolerance|schedule|plans|facts|axis|drop)(/|$)", "measure"),
    (r"/api/machines$", "measure"),
)
"""Roles by the begin of an address, as regular expressions that a browser understands, too; the first that fits."""
OTHERWISE = "promote"
"""What an address needs that nobody thought of."""
_REASONS = ("because", "comment", "why", "note")
_MOST = 64_000


def _role_for(path: str) -> str | None:
    """Return the role that a change at an address needs, None for an address that nobody thought of."""
    return next((role for pattern, role in NEEDED if re.match(pattern, path)), None)


def _overheard(receive: Receive) -> tuple[Receive, Callable[[], str]]:
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
