"""Whether a controller is known to be virtual. Whatever is not known to be, is real."""

from __future__ import annotations

import ipaddress
import socket
import struct
import time

from dtwin.links.ur_worker import RTDE_PORT

_VIRTUAL_VARIABLE = "output_int_register_1000"
"""Controllers have 48 registers of a kind and answer ``NOT_FOUND``; the virtual one has more.

Firmware fixes which variables exist, so no robot program can claim to be virtual.
"""

_HEADER = struct.Struct(">HB")
_SETUP_OUTPUTS, _REQUEST_VERSION = 79, 86


def is_loopback(host: str) -> bool:
    """Tell whether an address never leaves this computer. Raises ``OSError`` when the name is not known."""
    return ipaddress.ip_address(socket.gethostbyname(host)).is_loopback


def is_virtual(host: str, timeout_s: float = 2.0) -> bool:
    """Tell whether a controller is certainly the virtual one.

    It must live at a loopback address, which the virtual controller never leaves, and it must
    know a variable that no real controller has. No answer, a strange one, or one through a
    tunnel to a real robot counts as real.

    Args:
        timeout_s: Longest wait for each answer.
    """
    try:
        if not is_loopback(host):
            return False
        with socket.create_connection((host, RTDE_PORT), timeout_s) as connection:
            _ask(connection, _REQUEST_VERSION, struct.pack(">H", 2), timeout_s)
            reply = _ask(connection, _SETUP_OUTPUTS, struct.pack(">d", 1.0) + _VIRTUAL_VARIABLE.encode(), timeout_s)
    except (OSError, UnicodeError):
        return False
    return reply[1:] == b"INT32"


def _ask(connection: socket.socket, kind: int, payload: bytes, timeout_s: float) -> bytes:
    """Send one RTDE frame and return the payload of the answer of the same kind; what else comes does not prolong the wait."""
    until_s = time.monotonic() + timeout_s
    connection.sendall(_HEADER.pack(_HEADER.size + len(payload), kind) + payload)
    while True:
        size, answered = _HEADER.unpack(_exactly(connection, _HEADER.size, until_s))
        answer = _exactly(connection, max(size - _HEADER.size, 0), until_s)
        if answered == kind:
            return answer


def _exactly(connection: socket.socket, size: int, until_s: float) -> bytes:
    held = b""
    while len(held) < size:
        left_s = until_s - time.monotonic()
        if left_s <= 0.0:
            raise TimeoutError("the controller answers something else")
        connection.settimeout(left_s)
        received = connection.recv(size - len(held))
        if not received:
            raise ConnectionError("the controller closed the connection")
        held += received
    return held
