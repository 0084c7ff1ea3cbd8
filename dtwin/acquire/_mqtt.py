"""What is published to a broker as an instrument: topics become columns, nothing is published."""

from __future__ import annotations

import json
import math
import os
import queue
import ssl
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from dtwin.acquire._held import Held, Observed
from dtwin.acquire._mtconnect_documents import seconds
from dtwin.acquire.instrument import Description, Reading
from dtwin.acquire.xmlsafe import number_or_none
from dtwin.errors import DeviceError, InputError, MissingPart
from dtwin.links.opened import OpenAndClose
from dtwin.schema import Finding
from dtwin.units import is_number, require_units

if TYPE_CHECKING:
    from paho.mqtt.client import Client

_MAX_BYTES = 100_000
_MOST_WAITING, _MOST_WAITING_BYTES = 200_000, 100_000_000
_AWAY = "the broker could not be reached"
_BEHIND_S = 0.5
# A broker that is frozen keeps the connection: it is asked this often, and given up after twice as long.
_KEEP_ALIVE_S = 5
# By how much a sender's clock is ahead of the time that has passed before it was set, or never was right.
_CLOCK_SET_S = 30.0
# Milliseconds since 1970 have been above it since 1973, seconds are not before the year 5138.
_LATEST_S = 1e11
_ABSENT = object()


class MqttRecorder(OpenAndClose):
    """Records numbers and texts that machines publish.

    ``broker``: ``HOST:PORT``.
    ``columns``: topic to column; ``topic#member.of.json`` takes a member of a message of JSON.
    ``events``: topic to what it tells of: its text holds until the next, an empty one ends it.
    ``alarms``: topics of ``events`` that are alarms.
    ``rate_hz``: samples per second; values hold between their messages.
    ``clock``: ``receiver``: when a message came here; ``sender``: as its member ``time`` says, in seconds or milliseconds
    since 1970, or as ISO 8601.
    ``tls``: whether the connection is encrypted, and the broker's certificate checked.
    ``password_from``: environment variable with the password of ``user``.
    ``timeout_s``, ``patience_s``: for the broker, and for a first message or one that went away.
    """

    name = "mqtt"

    def __init__(
        self,
        broker: str,
        columns: Mapping[str, str],
        rate_hz: float = 1.0,
        *,
        events: Mapping[str, str] | None = None,
        alarms: tuple[str, ...] = (),
        clock: str = "receiver",
        time: str = "",
        tls: bool = False,
        user: str = "",
        password_from: str = "",
        timeout_s: float = 5.0,
        patience_s: float = 60.0,
    ) -> None:
        self._host, self._port = _address(broker)
        self.broker = broker
        require_units(columns.values(), f"topics at {broker}")
        self._columns, self._events, self._alarms = dict(columns), dict(events or {}), set(alarms)
        _require_topics([*self._columns, *self._events])
        twice = sorted({c for c in columns.values() if list(columns.values()).count(c) > 1})
        if twice or clock not in ("receiver", "sender") or (clock == "sender") != bool(time) or not columns:
            raise InputError(
                "the settings of [mqtt] do not go together",
                code="mqtt.settings",
                where=broker,
                got=f"clock {clock}, time {time or 'not stated'}, columns named twice: {', '.join(twice) or 'none'}",
                allowed='clock = "receiver"; or clock = "sender" and time = the member that says when; columns of different names',
            )
        self._sender_time = time
        self._rate_hz, self._tls, self._user, self._password_from = rate_hz, tls, user, password_from
        self._timeout_s, self._patience_s = timeout_s, patience_s
        self._client: Client | None = None
        self._heard: queue.SimpleQueue[tuple[float, str, bytes, bool]] = queue.SimpleQueue()
        self._held = Held(self.name, rate_hz, list(columns.values()), {"broker": broker, "clock": f"the {clock}'s"})
        self._running, self._hurried, self._away_s, self._refused = False, False, math.nan, 0
        # Each of one thread: of those that wait there is the difference.
        self._put_bytes = self._taken_bytes = 0
        self._newest_s = self._monotonic_s = self._offset_s = math.nan
        self._spoilt: set[str] = set()
        self._retained: dict[str, list[Observed]] = {}
        self._set_s: dict[str, float] = {}

    def open(self) -> None:
        """Connect and subscribe."""
        if self._client is not None:
            return
        try:
            from paho.mqtt.client import Client
            from paho.mqtt.enums import CallbackAPIVersion
        except ImportError as error:
            raise MissingPart(
                "MQTT needs a package that is not installed",
                code="mqtt.package",
                got="paho-mqtt",
                hint="pip install '.[stream]' in a checkout of dtwin",
            ) from error
        self._set_clock()
        client = Client(CallbackAPIVersion.VERSION2)
        client.connect_timeout = self._timeout_s
        if self._tls:
            client.tls_set_context(ssl.create_default_context())
        if self._user:
            client.username_pw_set(self._user, os.environ.get(self._password_from, ""))
        refused: list[str] = []
        ready: queue.SimpleQueue[bool] = queue.SimpleQueue()
        topics = sorted({key.partition("#")[0] for key in (*self._columns, *self._events)})

        def connected(client: Client, data: Any, flags: Any, code: Any, properties: Any) -> None:
            if code.is_failure:
                refused.append(str(code))
                ready.put(False)
            else:
                client.subscribe([(topic, 1) for topic in topics])

        def subscribed(client: Client, data: Any, number: int, codes: Any, properties: Any) -> None:
            denied = [topic for topic, code in zip(topics, codes, strict=False) if code.is_failure]
            refused.extend(f"may not read {topic}" for topic in denied)
            ready.put(not denied)

        def heard(client: Client, data: Any, message: Any) -> None:
            try:
                self._hear(message.topic, bytes(message.payload), retained=message.retain)
            except UnicodeDecodeError:
                # It would end the thread of the client, and the last values would hold for ever.
                self._refused += 1

        client.on_connect, client.on_subscribe, client.on_message = connected, subscribed, heard
        try:
            client.connect(self._host, self._port, _KEEP_ALIVE_S)
            client.loop_start()
            well = ready.get(timeout=self._timeout_s)
        except (OSError, ValueError, queue.Empty) as error:
            client.loop_stop()
            raise self._absent(str(error) or "no answer") from error
        if not well:
            client.loop_stop()
            raise self._absent(", ".join(refused))
        self._client = client

    def describe(self) -> Description:
        """Return the columns."""
        return self._held.description

    def check(self) -> tuple[Finding, ...]:
        """Return how many messages were refused so far, and whether the broker was away at the end."""
        findings = []
        if self._refused:
            text = (
                f"{self._refused} messages were no numbers, too long, without their time, or more than could wait here"
            )
            findings.append(Finding("mqtt.refused", "warning", text, {"messages": float(self._refused)}))
        if self._hurried and not math.isnan(self._away_s):
            findings.append(Finding("mqtt.away", "warning", f"{_AWAY} when recording was ended", {}))
        return tuple(findings)

    def start(self) -> None:
        """Begin with the first message."""
        self._require_open()
        self._set_clock()
        self._held.restart()
        for kept in (self._spoilt, self._retained, self._set_s):
            kept.clear()
        self._newest_s = self._monotonic_s = self._away_s = math.nan
        self._running, self._hurried = True, False

    def read(self) -> Reading:
        """Return the samples that have become known, waiting for at least one."""
        client = self._require_open()
        if not self._running:
            raise DeviceError("recording was not started", code="mqtt.stopped", where=self.broker)
        until_s = time.monotonic() + self._patience_s
        while True:
            self._take()
            reading = self._held.reading(self._known_s())
            if reading.n_samples or reading.lost:
                return reading
            if not client.is_connected() and math.isnan(self._away_s):
                self._away_s = time.monotonic()
                self._held.say(f"{_AWAY}; values of up to {2 * _KEEP_ALIVE_S} s before may be old")
            silent = math.isnan(self._newest_s) or not math.isnan(self._away_s)
            if self._hurried and not math.isnan(self._newest_s):
                return reading
            if silent and (self._hurried or time.monotonic() >= until_s):
                refused = f" that can be used, {self._refused} refused" if self._refused else ""
                raise DeviceError(
                    "nothing was heard",
                    code="mqtt.silent",
                    where=self.broker,
                    got=f"{round(self._patience_s - max(until_s - time.monotonic(), 0.0), 1):g} s without a message{refused}",
                    hint="mosquitto_sub -v -t '#' shows what is published",
                )
            time.sleep(min(0.05, 0.5 / self._rate_hz))

    def hurry(self) -> None:
        """Wait for nothing more."""
        self._hurried = True

    def stop(self) -> None:
        """End recording; what comes is thrown away."""
        self._running = False

    def close(self) -> None:
        """Leave the broker; safe to call twice."""
        self.stop()
        client, self._client = self._client, None
        if client is not None:
            client.disconnect()
            client.loop_stop()

    def _set_clock(self) -> None:
        """Take this computer's clock as it is now: it may be set while recording, and times run on."""
        self._offset_s = time.time() - time.monotonic()

    def _hear(self, topic: str, payload: bytes, *, retained: bool = False) -> None:
        """Keep a message; called by the thread of the client.

        ``retained``: whether it was published before, and the broker kept it.
        """
        payload = payload[: _MAX_BYTES + 1]
        waiting_bytes = self._put_bytes - self._taken_bytes + len(payload)
        if self._heard.qsize() < _MOST_WAITING and waiting_bytes <= _MOST_WAITING_BYTES:
            self._put_bytes += len(payload)
            self._heard.put((self._offset_s + time.monotonic(), topic, payload, retained))
        else:
            self._refused += 1

    def _take(self) -> None:
        """Turn what was heard into observations."""
        while True:
            try:
                came_s, topic, payload, retained = self._heard.get_nowait()
            except queue.Empty:
                return
            self._taken_bytes += len(payload)
            observed, wrong = self._observed(came_s, topic, payload)
            self._refused += wrong
            if not observed:
                continue
            if self._sender_time and math.isnan(self._newest_s):
                if retained:
                    # Its time may be yesterday's, and no clock begins with that.
                    self._retained[topic] = observed
                    continue
                held = [one for kept in self._retained.values() for one in kept]
                observed = [*(replace(one, time_s=observed[0].time_s) for one in held), *observed]
            elif self._sender_time:
                observed = self._as_before(topic, observed)
            if not math.isnan(self._away_s):
                self._held.lose(observed[0].time_s, _AWAY)
                self._away_s = math.nan
            self._held.take(observed)
            newest_s = max(one.time_s for one in observed)
            if not newest_s <= self._newest_s:
                self._newest_s, self._monotonic_s = newest_s, time.monotonic()

    def _as_before(self, topic: str, observed: list[Observed]) -> list[Observed]:
        """Return what a message tells, its time as if the sender's clock had not been set forward: nobody observed the hours between."""
        expected_s = self._newest_s + time.monotonic() - self._monotonic_s
        told_s = observed[0].time_s
        step_s = min((0.0, self._set_s.get(topic, 0.0)), key=lambda step_s: abs(told_s - step_s - expected_s))
        if told_s - step_s - expected_s > _CLOCK_SET_S:
            self._set_s[topic] = step_s = told_s - expected_s
            self._held.say(f"{topic}: the sender's clock is {step_s:+z.0f} s ahead; times run on as before")
        return [replace(one, time_s=one.time_s - step_s) for one in observed]

    def _known_s(self) -> float:
        """Return until when everything has been heard: by the sender's clock as far as it is known here."""
        if math.isnan(self._newest_s) or not math.isnan(self._away_s):
            return self._newest_s if not math.isnan(self._newest_s) else -math.inf
        return self._newest_s + max(0.0, time.monotonic() - self._monotonic_s - _BEHIND_S)

    def _observed(self, came_s: float, topic: str, payload: bytes) -> tuple[list[Observed], bool]:
        """Return the observations of a message, and whether a part of it was refused."""
        keys = [k for k in (*self._columns, *self._events) if k.partition("#")[0] == topic]
        try:
            content = None if len(payload) > _MAX_BYTES else _content(payload)
        except (ValueError, RecursionError):
            content = None
        try:
            time_s = came_s if not self._sender_time else _time_of(content, self._sender_time, topic)
        except (ValueError, DeviceError):
            # What is no JSON has no time of its own: it is as new as what is known.
            time_s = -math.inf if isinstance(content, dict) else self._known_s()
            if math.isinf(time_s):
                return [], True
        observed, wrong = [], False
        for key in keys:
            value = _member(content, key.partition("#")[2])
            if key in self._columns:
                number = _number(value)
                wrong = wrong or number is None
                if value is not _ABSENT:
                    observed.append(Observed(self._columns[key], time_s, math.nan if number is None else number))
                    self._tell(self._columns[key], payload, number)
            elif value is not None and value is not _ABSENT:
                text = "" if value is False else "on" if value is True else str(value)[:200]
                observed.append(Observed(self._events[key], time_s, text, key in self._alarms))
        return observed, wrong

    def _tell(self, column: str, payload: bytes, number: float | None) -> None:
        """Say once of each column that what came for it was no number."""
        if number is None and column not in self._spoilt:
            self._spoilt.add(column)
            got = payload[:40].decode("utf-8", "replace")
            self._held.say(f"{column}: what came was no number ({got}): missing until the next one")

    def _absent(self, got: str) -> DeviceError:
        return DeviceError(
            "the broker does not answer, or refuses",
            code="mqtt.absent",
            where=self.broker,
            got=got[:200],
            hint="its address and port; user and password_from where it wants them; tls = true",
        )

    def _require_open(self) -> Client:
        if self._client is None:
            raise DeviceError("the broker is not connected", code="mqtt.closed", where=self.broker)
        return self._client


def _content(payload: bytes) -> Any:
    """Return JSON, or the text as it is."""
    text = payload.decode("utf-8").strip()
    try:
        return json.loads(text)
    except ValueError:
        return text


def _member(content: Any, path: str) -> Any:
    """Return a member of JSON by its names with points between; ``_ABSENT`` when a message of JSON says nothing of it."""
    for name in path.split(".") if path else ():
        if isinstance(content, dict) and name not in content:
            return _ABSENT
        content = content[name] if isinstance(content, dict) else None
    return content


def _number(value: Any) -> float | None:
    if isinstance(value, str):
        return number_or_none(value.replace(",", ".", 1))
    return float(value) if is_number(value) else None


def _time_of(content: Any, path: str, where: str) -> float:
    value = _member(content, path)
    if isinstance(value, str):
        return seconds(value, where)
    # In microseconds, or of no clock at all, it would stand still here: a float tells no seconds then.
    if not is_number(value) or not 0.0 < value < 1000.0 * _LATEST_S:
        raise ValueError(path)
    return float(value) / 1000.0 if value > _LATEST_S else float(value)


def _address(broker: str) -> tuple[str, int]:
    host, _, port = broker.rpartition(":")
    if not host or "@" in host or not port.isdigit() or not 0 < int(port) < 65536:
        # Without the name and the password that may stand in it.
        got = broker.rpartition("@")[2][:80]
        raise InputError("not the address of a broker", code="mqtt.broker", got=got, allowed="HOST:PORT")
    return host.strip("[]"), int(port)


def _require_topics(keys: list[str]) -> None:
    # What ends in # is no topic and a member, but all topics below one.
    parts = {key: key.partition("#")[0] for key in keys}
    bad = [key for key, topic in parts.items() if not topic or key.endswith("#") or any(c in topic for c in "+\0")]
    if bad:
        raise InputError(
            "not a topic",
            code="mqtt.topic",
            got=", ".join(bad)[:120],
            allowed="a whole topic without + and #; after a # the member of a message of JSON",
        )
