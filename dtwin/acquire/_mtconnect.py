"""A machine that speaks MTConnect as an instrument: its agent is polled, nothing is written to it."""

from __future__ import annotations

import contextlib
import http.client
import math
import time
import urllib.error
import urllib.request
from dataclasses import replace
from queue import Empty, Queue
from threading import Thread
from typing import Any
from urllib.parse import quote, urlencode, urlsplit

from dtwin.acquire._held import Held, Observed
from dtwin.acquire._mtconnect_documents import Header, Item, OutOfRange, read_probe, read_streams
from dtwin.acquire.instrument import Description, Reading
from dtwin.errors import DeviceError, InputError
from dtwin.links.opened import OpenAndClose
from dtwin.own_address import NoRedirection
from dtwin.schema import Finding

_MAX_BYTES = 16_000_000
_OVERRUN = "observations that the agent's buffer no longer held"
_RESTARTED = "the agent was restarted"
# A server, or what stands before it, that is not ready yet.
_NOT_READY = (502, 503, 504)
_LOOK_S = 0.2
_CLOCK_SET_S = 30.0
"""By how much an agent's clock differs from the time that has passed, beside the time of an answer, before it was set."""


class MTConnectRecorder(OpenAndClose):
    """Records the numbers of one device, and what it says of programs, modes and alarms.

    ``url``: of the agent, such as ``http://192.168.0.7:5000``.
    ``device``: name or uuid; empty when the agent has one only.
    ``rate_hz``: samples per second; values hold between their observations.
    ``count``: observations that one answer may bring.
    ``poll_s``: time between two questions when nothing is new.
    ``timeout_s``, ``patience_s``: for one answer, and for an agent that does not answer any more.
    """

    name = "mtconnect"

    def __init__(
        self,
        url: str,
        device: str = "",
        rate_hz: float = 10.0,
        *,
        count: int = 1000,
        poll_s: float = 0.2,
        timeout_s: float = 5.0,
        patience_s: float = 60.0,
    ) -> None:
        self.url, self._device = _checked(url), device
        self._rate_hz, self._count, self._poll_s = rate_hz, count, poll_s
        self._timeout_s, self._patience_s = timeout_s, patience_s
        self._items: dict[str, Item] = {}
        self._left: list[str] = []
        self._held: Held | None = None
        self._next, self._instance, self._known_s = 0, "", 0.0
        self._heard_s, self._created_s, self._set_s, self._before_s = math.nan, 0.0, 0.0, 0.0
        self._running = self._hurried = self._left_away = False

    def open(self) -> None:
        """Ask the agent what it knows."""
        self._items, self._left, name = read_probe(self._answer("probe"), self.url, self._device)
        columns = [c for item in self._items.values() for c in item.columns]
        if not columns:
            raise DeviceError(
                "the device tells no number that can be recorded",
                code="mtconnect.nothing",
                where=self.url,
                got="; ".join(self._left)[:200] or "no data items",
                hint="look at its /probe",
            )
        notes = {"agent": self.url, "device": name, "clock": "the agent's", "left_out": self._left[:50]}
        self._held = Held(self.name, self._rate_hz, columns, notes)

    def describe(self) -> Description:
        """Return the numbers of the device."""
        return self._sink().description

    def check(self) -> tuple[Finding, ...]:
        """Return which data items are left out, and whether the agent was away at the end."""
        findings = []
        if self._left:
            text = f"{len(self._left)} data items are not recorded: {'; '.join(self._left[:8])}"
            findings.append(Finding("mtconnect.left_out", "info", text, {"items": float(len(self._left))}))
        if self._left_away:
            findings.append(
                Finding("mtconnect.away", "warning", "the agent did not answer when recording was ended", {})
            )
        return tuple(findings)

    def start(self) -> None:
        """Begin with what holds now."""
        held = self._sink()
        held.restart()
        self._hurried = self._left_away = False
        self._heard_s, self._created_s, self._set_s, self._before_s = math.nan, 0.0, 0.0, 0.0
        header, observed = self._streams(self._answer("current"))
        # What has held for hours holds at the beginning.
        held.begin(header.created_s)
        held.take(replace(one, time_s=header.created_s) for one in observed)
        self._next, self._instance, self._known_s = header.next, header.instance, header.created_s
        self._running = True

    def read(self) -> Reading:
        """Return the samples that have become known, waiting for at least one."""
        held = self._sink()
        if not self._running:
            raise DeviceError("recording was not started", code="mtconnect.stopped", where=self.url)
        patience_s = self._patience_s + _CLOCK_SET_S
        until_s = time.monotonic() + patience_s
        while True:
            reading = held.reading(self._known_s)
            if reading.n_samples or reading.lost:
                return reading
            before, known_s = self._next, self._known_s
            try:
                self._ask()
            except DeviceError:
                if not self._hurried:
                    raise
                self._left_away = True
            if self._hurried:
                return held.reading(self._known_s)
            if self._next == before:
                time.sleep(self._poll_s)
            if self._next != before or self._known_s > known_s:
                until_s = time.monotonic() + patience_s
            elif time.monotonic() >= until_s:
                raise DeviceError(
                    "the agent's answers stay the same, their time included",
                    code="mtconnect.still",
                    where=self.url,
                    got=f"the same for {patience_s:g} s",
                    hint="a proxy that keeps answers, or an agent whose clock stands still",
                )

    def hurry(self) -> None:
        """Wait for nothing more."""
        self._hurried = True

    def stop(self) -> None:
        """End recording."""
        self._running = False

    def close(self) -> None:
        """Forget the agent; safe to call twice."""
        self.stop()
        self._held = None

    def _ask(self) -> None:
        """Take the next observations."""
        held = self._sink()
        asked = {"from": self._next, "count": self._count}
        try:
            header, observed = self._patiently("sample", asked)
        except OutOfRange:
            self._go_on(held)
            return
        if header.instance != self._instance or header.first > self._next:
            self._go_on(held)
            return
        held.take(observed)
        # Behind an answer that is full there may be more of the same time.
        full = header.next - self._next >= self._count
        newest_s = max((one.time_s for one in observed), default=self._known_s) if full else header.created_s
        self._next, self._known_s = max(header.next, self._next), max(self._known_s, newest_s)

    def _go_on(self, held: Held) -> None:
        """Go on with what holds now, after an agent that counts anew or no longer has what is next; tell the gap."""
        header, observed = self._patiently("current")
        held.lose(header.created_s, _RESTARTED if header.instance != self._instance else _OVERRUN)
        held.take(replace(one, time_s=header.created_s) for one in observed)
        self._next, self._instance, self._known_s = header.next, header.instance, header.created_s

    def _streams(self, answer: bytes) -> tuple[Header, list[Observed]]:
        """Return what an answer holds, its times as if the agent's clock had not been set meanwhile.

        A clock that is set forward would make hours of values that nobody observed; one that is set back would end the samples.
        """
        header, observed = read_streams(answer, self.url, self._items)
        now_s = time.monotonic()
        step_s = header.created_s - self._set_s - self._created_s - (now_s - self._heard_s)
        if abs(step_s) > _CLOCK_SET_S + self._timeout_s:
            self._before_s, self._set_s = self._set_s, self._set_s + step_s
            self._sink().say(f"the agent's clock was set by {step_s:+z.0f} s; times run on as before")
        header = replace(header, created_s=header.created_s - self._set_s)
        self._heard_s, self._created_s = now_s, header.created_s
        return header, [replace(one, time_s=self._as_before(one.time_s)) for one in observed]

    def _as_before(self, time_s: float) -> float:
        """Return a time by the clock as it was at the beginning; an answer may hold times of before and after it was set."""
        return min((time_s - self._set_s, time_s - self._before_s), key=lambda told_s: abs(told_s - self._known_s))

    def _patiently(self, what: str, query: dict[str, Any] | None = None) -> tuple[Header, list[Observed]]:
        """Return what an answer holds; the agent keeps what is observed while it cannot be reached, or a page stands in its place."""
        until_s, said = time.monotonic() + self._patience_s, False
        while True:
            try:
                return self._streams(self._answer(what, query))
            except (DeviceError, InputError) as error:
                spoilt = error.code == "mtconnect.document" or str(error.code).startswith("xml.")
                over = self._hurried or time.monotonic() >= until_s
                if not (spoilt or error.code == "mtconnect.absent") or over:
                    raise
                if spoilt and not said:
                    self._sink().say(f"the agent's answer was none: {error.message}; it is asked again")
                    said = True
                time.sleep(self._poll_s)

    def _answer(self, what: str, query: dict[str, Any] | None = None) -> bytes:
        """Return an answer: one whose head or body comes byte by byte keeps every timeout, and would never end."""
        answered: Queue[bytes | BaseException] = Queue()

        def ask() -> None:
            try:
                answered.put(self._asked(what, query))
            except BaseException as error:
                answered.put(error)

        Thread(target=ask, daemon=True).start()
        until_s = time.monotonic() + self._patience_s + self._timeout_s
        answer: bytes | BaseException | None = None
        while answer is None:
            try:
                answer = answered.get(timeout=_LOOK_S)
            except Empty:
                if self._hurried or time.monotonic() >= until_s:
                    answer = self._absent("an answer that did not end")
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def _asked(self, what: str, query: dict[str, Any] | None) -> bytes:
        path = f"/{quote(self._device, safe='')}/{what}" if self._device else f"/{what}"
        address = f"{self.url}{path}" + (f"?{urlencode(query)}" if query else "")
        request = urllib.request.Request(
            address, headers={"Accept": "application/xml, text/xml", "User-Agent": "dtwin"}
        )
        try:
            with urllib.request.build_opener(NoRedirection).open(request, timeout=self._timeout_s) as answer:
                return _bounded(answer.read(_MAX_BYTES + 1), address)
        except urllib.error.HTTPError as error:
            # Newer agents put the reason into the body.
            body = b""
            with error, contextlib.suppress(OSError, http.client.HTTPException):
                body = error.read(_MAX_BYTES + 1)
            if b"MTConnectError" in body[:4000]:
                return _bounded(body, address)
            raise DeviceError(
                "the agent refuses",
                code="mtconnect.absent" if error.code in _NOT_READY else "mtconnect.error",
                where=address,
                got=f"HTTP {error.code}",
            ) from error
        except (OSError, http.client.HTTPException) as error:
            raise self._absent(str(error)[:200]) from error

    def _absent(self, got: str) -> DeviceError:
        return DeviceError(
            "the agent does not answer",
            code="mtconnect.absent",
            where=self.url,
            got=got,
            hint="its address and port; whether it runs: open the address in a browser",
        )

    def _sink(self) -> Held:
        if self._held is None:
            raise DeviceError("the agent was not asked what it knows", code="mtconnect.closed", where=self.url)
        return self._held


def _bounded(data: bytes, where: str) -> bytes:
    if len(data) > _MAX_BYTES:
        raise DeviceError(
            "the agent's answer is too large",
            code="mtconnect.size",
            where=where,
            got=f"more than {_MAX_BYTES / 1e6:z.0f} MB",
            hint="a smaller count under [mtconnect]",
        )
    return data


def _checked(url: str) -> str:
    parts = urlsplit(url)
    try:
        usable = parts.scheme in ("http", "https") and bool(parts.hostname) and (parts.port or 1) > 0
    except ValueError:
        usable = False
    if not usable or parts.username or parts.query or parts.fragment:
        raise InputError(
            "not the address of an agent",
            code="mtconnect.url",
            # Without the name, the password or the token that may stand in it.
            got=url.rpartition("@")[2].partition("?")[0][:80],
            allowed="http://HOST:PORT or https://HOST:PORT",
        )
    return url.rstrip("/")
