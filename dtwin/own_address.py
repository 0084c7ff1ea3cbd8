"""Requests that are not what they seem: from pages of others, or answered by a redirection."""

from __future__ import annotations

import ipaddress
import re
import urllib.request
from typing import Any

# host:port as a browser sends it; anything else, a path behind it for example, is no host.
_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+)(?::\d{1,5})?")


def names_this_computer(host: str | None, *, also: str = "", any_address: bool = False) -> bool:
    """Tell whether a Host header names this computer.

    A page of another site can point its own name at this computer (DNS rebinding); then the
    header holds that name.

    ``also``: another name that is ours.
    ``any_address``: whether every numeric address is: for servers that listen on more than loopback.
    """
    match = _HOST.fullmatch(host or "")
    if match is None:
        return False
    name = match[1].strip("[]").lower()
    if name in ("localhost", also.lower()):
        return True
    try:
        return ipaddress.ip_address(name).is_loopback or any_address
    except ValueError:
        return False


def is_foreign(origin: str | None, host: str) -> bool:
    """Tell whether an Origin header names another page than one of ``host``; none does not."""
    return origin is not None and origin != f"http://{host}"


class NoRedirection(urllib.request.HTTPRedirectHandler):
    """Handler of an opener that follows no redirection: another address is another host, and a token would go there, too."""

    def redirect_request(self, *_: Any) -> None:
        """Follow none."""
