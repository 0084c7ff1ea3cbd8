"""How alerts reach people: e-mail (SMTP), a webhook (HTTP), MQTT; as ``DTWIN_HOME/alerts.toml`` states them."""

from __future__ import annotations

import json
import os
import smtplib
import socket
import ssl
import threading
import urllib.request
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from email.message import EmailMessage
from email.utils import parseaddr
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar
from urllib.parse import urlsplit

from dtwin.atomic import read_toml
from dtwin.config import Home
from dtwin.errors import DeviceError, InputError
from dtwin.own_address import NoRedirection, names_this_computer

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_Settings = TypeVar("_Settings", bound="DataclassInstance")
_WAIT_S = 15.0
# Each wait above begins anew with every byte that a server sends.
_LONGEST_S = 60.0
_MAX_BYTES = 100_000
_MOST_LINES = 1000


class Channel(Protocol):
    """Sends a message."""

    @property
    def name(self) -> str:
        """How the file calls it."""

    def send(self, title: str, text: str, alerts: Sequence[Mapping[str, str]]) -> None:
        """Send one message, or raise."""


class _Lines:
    """What a server says, line by line, and no more than ``_MOST_LINES``: each answer is kept whole, and may have any number of them."""

    def __init__(self, connected: socket.socket) -> None:
        self._file, self._read = connected.makefile("rb"), 0
        self.close = self._file.close

    def readline(self, longest: int) -> bytes:
        """Return a line, or the beginning of a longer one."""
        self._read += 1
        if self._read > _MOST_LINES:
            raise OSError(f"the server says more than {_MOST_LINES} lines")
        return self._file.readline(longest)


class _Smtp(smtplib.SMTP):
    """A connection whose server must come to an end."""

    def getreply(self) -> tuple[int, bytes]:
        """Return an answer."""
        if self.file is None and self.sock is not None:
            self.file = _Lines(self.sock)
        return super().getreply()


@dataclass(frozen=True)
class _Email:
    """SMTP. Secrets are in the environment, never in the file.

    ``smtp``: ``host:port``. On another computer the connection is encrypted (STARTTLS).
    ``password_from``: environment variable that holds the password of ``user``.
    """

    smtp: str
    sender: str
    to: Sequence[str]
    user: str = ""
    password_from: str = ""

    @property
    def name(self) -> str:
        """How the file calls it."""
        return "email"

    def send(self, title: str, text: str, alerts: Sequence[Mapping[str, str]]) -> None:
        """Send one message."""
        message = EmailMessage()
        message["Subject"], message["From"], message["To"] = title, self.sender, ", ".join(self.to)
        message.set_content(text)
        host, port = _host_and_port(self.smtp, "email.smtp")
        with _Smtp(host, port, timeout=_WAIT_S) as server:
            if not names_this_computer(host):
                server.starttls(context=ssl.create_default_context())
            if self.user:
                server.login(self.user, _secret(self.password_from, "email.password_from"))
            server.send_message(message)


class _OneOfSeveral(_Email):
    """E-mail to one receiver. Whom the server refuses is told later, and the others nothing twice."""

    @property
    def name(self) -> str:
        """How the file calls it, and who it is."""
        return f"email to {', '.join(self.to)}"


@dataclass(frozen=True)
class _Webhook:
    """A POST of JSON: ``title``, ``text``, ``alerts``. Not encrypted on this computer only.

    ``token_from``: environment variable that holds a bearer token.
    """

    url: str
    token_from: str = ""
    name = "webhook"

    def send(self, title: str, text: str, alerts: Sequence[Mapping[str, str]]) -> None:
        """Post one message."""
        body = json.dumps({"title": title, "text": text, "alerts": list(alerts)}).encode()
        head = {"Content-Type": "application/json", "User-Agent": "dtwin"}
        if self.token_from:
            head["Authorization"] = f"Bearer {_secret(self.token_from, 'webhook.token_from')}"
        request = urllib.request.Request(self.url, body, head)
        # A redirection would take the token elsewhere, and a proxy what is not encrypted.
        beside = [urllib.request.ProxyHandler({})] if request.type == "http" else []
        with urllib.request.build_opener(NoRedirection, *beside).open(request, timeout=_WAIT_S):
            pass


@dataclass(frozen=True)
class _Mqtt:
    """One message of JSON, as a webhook gets it, kept by the broker until it was delivered (QoS 1)."""

    broker: str
    topic: str = "dtwin/alerts"
    user: str = ""
    password_from: str = ""
    name = "mqtt"

    def send(self, title: str, text: str, alerts: Sequence[Mapping[str, str]]) -> None:
        """Publish one message, and wait until the broker has it."""
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion

        host, port = _host_and_port(self.broker, "mqtt.broker")
        client = Client(CallbackAPIVersion.VERSION2)
        if not names_this_computer(host):
            client.tls_set_context(ssl.create_default_context())
        if self.user:
            client.username_pw_set(self.user, _secret(self.password_from, "mqtt.password_from"))
        client.connect(host, port)
        client.loop_start()
        try:
            sent = client.publish(self.topic, json.dumps({"title": title, "text": text, "alerts": list(alerts)}), qos=1)
            sent.wait_for_publish(_WAIT_S)
            if not sent.is_published():
                raise DeviceError("the broker did not take the message", code="alert.mqtt", where=self.broker)
        finally:
            client.disconnect()
            client.loop_stop()


_KINDS: dict[str, type[_Email] | type[_Webhook] | type[_Mqtt]] = {"email": _Email, "webhook": _Webhook, "mqtt": _Mqtt}


def _alerts_file(home: Home) -> Path:
    """Return the file that states the channels."""
    return home.root / "alerts.toml"


def channels_of(home: Home) -> list[Channel]:
    """Return the channels that a home states; none without the file.

    Raises ``InputError`` when the file is not usable.
    """
    path = _alerts_file(home)
    try:
        stated = read_toml(path, _MAX_BYTES)
    except FileNotFoundError:
        return []
    except (OSError, ValueError, RecursionError) as error:
        raise _refused(str(path), str(error)[:120], "a TOML file") from error
    unknown = sorted(set(stated) - set(_KINDS))
    if unknown:
        raise _refused(str(path), ", ".join(unknown)[:120], ", ".join(_KINDS))
    channels = [_checked(_settings(_KINDS[name], stated[name], f"{path}: {name}"), str(path)) for name in stated]
    return [one for channel in channels for one in _by_receiver(channel)]


def _by_receiver(channel: Channel) -> Sequence[Channel]:
    if not isinstance(channel, _Email) or len(channel.to) == 1:
        return [channel]
    return [_OneOfSeveral(**vars(channel) | {"to": [address]}) for address in dict.fromkeys(channel.to)]


def deliver(channel: Channel, title: str, text: str, alerts: Sequence[Mapping[str, str]]) -> None:
    """Send one message by a channel, or raise; a server that never ends its answer holds up no night."""
    failed: list[Exception] = []

    def send() -> None:
        try:
            channel.send(title, text, alerts)
        except Exception as error:  # Whatever a library of a channel raises.
            failed.append(error)

    sending = threading.Thread(target=send, daemon=True)
    sending.start()
    sending.join(_LONGEST_S)
    if sending.is_alive():
        raise TimeoutError(f"its answer did not end within {_LONGEST_S:g} s")
    if failed:
        raise failed[0]


def try_channels(home: Home) -> dict[str, str]:
    """Send every channel a test message, and return why it failed, empty where it did not.

    Raises ``InputError`` when no channel is stated, or the file is not usable.
    """
    channels = channels_of(home)
    if not channels:
        raise _refused(str(_alerts_file(home)), "no such file, or nothing in it", ", ".join(_KINDS))
    outcomes = {}
    for channel in channels:
        try:
            deliver(channel, "dtwin: a test", "This is a test of dtwin alert test; nothing is wrong.\n", [])
            outcomes[channel.name] = ""
        except Exception as error:  # Whatever a library of a channel raises.
            outcomes[channel.name] = f"{type(error).__name__}: {error}"[:300]
    return outcomes


def _settings(kind: type[_Settings], stated: object, where: str) -> _Settings:
    names = [field.name for field in fields(kind)]
    if not isinstance(stated, Mapping) or not set(stated) <= set(names):
        # Names only: what is stated under a wrong one may be a secret.
        unknown = ", ".join(sorted(set(stated) - set(names))) if isinstance(stated, Mapping) else str(stated)
        raise _refused(where, unknown[:80], ", ".join(names))
    missing = [f.name for f in fields(kind) if f.default is MISSING and f.name not in stated]
    if missing:
        raise _refused(where, f"no {', '.join(missing)}", ", ".join(names))
    for name, value in stated.items():
        many = isinstance(value, list) and value and all(isinstance(one, str) for one in value)
        if not (many if name == "to" else isinstance(value, str)):
            raise _refused(f"{where}.{name}", str(value)[:60], "a list of addresses" if name == "to" else "text")
    return kind(**stated)


def _checked(channel: _Email | _Webhook | _Mqtt, where: str) -> Channel:
    """Refuse what could not be sent, or would be sent openly to another computer."""
    if isinstance(channel, _Email):
        _host_and_port(channel.smtp, f"{where}: email.smtp")
        for address in (channel.sender, *channel.to):
            if "@" not in parseaddr(address)[1] or any(ord(c) < 32 for c in address):
                raise _refused(f"{where}: email", address[:60], "an address such as shop@example.com")
    elif isinstance(channel, _Webhook):
        parts = urlsplit(channel.url)
        if "@" in parts.netloc:
            # What stands before it may be a password.
            allowed = "an address without name and password; token_from names a variable that holds a token"
            raise _refused(f"{where}: webhook.url", f"{parts.scheme}://...@{parts.hostname}", allowed)
        if not (parts.scheme == "https" or (parts.scheme == "http" and names_this_computer(parts.netloc))):
            raise _refused(f"{where}: webhook.url", channel.url[:80], "https://..., or http:// on this computer")
    else:
        _host_and_port(channel.broker, f"{where}: mqtt.broker")
        if not channel.topic or any(mark in channel.topic for mark in "#+\0"):
            raise _refused(f"{where}: mqtt.topic", channel.topic[:60], "a topic without # and +")
    return channel


def _host_and_port(text: str, where: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not colon or not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise _refused(where, text[:60], "host:port")
    return host, int(port)


def _secret(variable: str, where: str) -> str:
    # The line end of the file that it came from is no part of it.
    value = os.environ.get(variable, "").strip()
    if not value:
        raise _refused(where, variable or "not stated", "an environment variable that holds the secret")
    # Libraries show a header that they refuse, and with it the secret.
    if not value.isprintable():
        raise _refused(where, f"{variable} holds more than one line", "one line")
    return value


def _refused(where: str, got: str, allowed: str) -> InputError:
    return InputError(
        "the channels for alerts are not usable",
        code="alert.channels",
        where=where,
        got=got,
        allowed=allowed,
        hint="docs/how-to/fleet.md#alerts",
    )
