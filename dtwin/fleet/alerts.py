"""What is kept of a fleet, worst first, and what somebody should look at, told once while it lasts, and what is not to be told for a while."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import date, timedelta
from pathlib import Path
from typing import Any, get_args

from dtwin.config import Home
from dtwin.documents import read_document, write_document
from dtwin.errors import InputError
from dtwin.fleet.channels import Channel, deliver
from dtwin.fleet.jobs import DIAGNOSES
from dtwin.local_time import local_day
from dtwin.locks import locked
from dtwin.physics.diagnosis import Verdict
from dtwin.pipeline.kept import kept_already

_SORTS = ("failed", "withdrawn", "drifted", "changed", "limit", "overdue")
# What happens on one night and is not found again on the next.
_PASSING = ("failed", "withdrawn")
_MOST_DAYS = 3653


@dataclass(frozen=True)
class Alert:
    """One thing that somebody should look at.

    ``sort``: one of ``_SORTS``.
    ``about``: the machine, campaign or file.
    ``text``: what it is, one line.
    ``since``: day on which it began, where it may begin anew before it is over.
    """

    sort: str
    about: str
    text: str
    since: str = ""

    def __post_init__(self) -> None:
        # A line end, or bytes of a file's name that are no text, would stop the whole message.
        for name in ("about", "text"):
            shown = "".join(c if c.isprintable() else "\ufffd" for c in getattr(self, name))
            object.__setattr__(self, name, shown)

    @property
    def key(self) -> str:
        """What it is silenced by."""
        return f"{self.sort}:{self.about}"

    @property
    def once(self) -> str:
        """What it is told once by."""
        return f"{self.key} {self.since}".rstrip()

    def as_dict(self) -> dict[str, str]:
        """Return a JSON-ready mapping."""
        return {"sort": self.sort, "about": self.about, "text": self.text, "key": self.key}


@dataclass(frozen=True)
class Told:
    """What became of alerts.

    ``sent``: number of alerts in the message to each channel; a channel that has nothing new gets none.
    ``failed``: why a channel could not be reached; it is told the next time.
    ``silenced``: keys that are not told now.
    """

    sent: Mapping[str, int]
    failed: Mapping[str, str]
    silenced: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {"sent": dict(self.sent), "failed": dict(self.failed), "silenced": list(self.silenced)}


def tell(home: Home, alerts: Sequence[Alert], channels: Sequence[Channel], today: date | None = None) -> Told:
    """Send each channel one message with the alerts that it was not told of; what is over may be told again later."""
    with locked(_path(home).with_suffix(".lock"), wait=True):
        return _tell(home, alerts, channels, today or local_day())


def _tell(home: Home, alerts: Sequence[Alert], channels: Sequence[Channel], day: date) -> Told:
    state = _state(home)
    silent = {key for key, until in state["silent"].items() if until > day.isoformat()}
    open_now = {alert.once for alert in alerts}
    told: dict[str, list[str]] = {}
    unsent: dict[str, list[dict[str, str]]] = {}
    sent, failed = {}, {}
    for channel in channels:
        known = {once for once in state["told"].get(channel.name, []) if once in open_now}
        owed = [Alert(**said) for said in state["unsent"].get(channel.name, [])]
        every = [*alerts, *(alert for alert in owed if alert.once not in open_now)]
        new = [alert for alert in every if alert.once not in known and alert.key not in silent]
        if new:
            try:
                deliver(channel, _title(new), _lines(new), [alert.as_dict() for alert in sorted_alerts(new)])
                sent[channel.name] = len(new)
                known |= {alert.once for alert in new}
            except Exception as error:  # Whatever a library of a channel raises: the others are told.
                failed[channel.name] = f"{type(error).__name__}: {error}"[:300]
                unsent[channel.name] = [asdict(alert) for alert in new if alert.sort in _PASSING]
        told[channel.name] = sorted(known)
    state |= {"told": told, "unsent": unsent}
    state["silent"] = {key: until for key, until in state["silent"].items() if until > day.isoformat()}
    write_document(_path(home), state, "the state of alerts")
    return Told(sent, failed, tuple(sorted(silent & {alert.key for alert in alerts})))


def silence(home: Home, key: str, days: float, today: date | None = None) -> str:
    """Tell nobody of something for some days, and return the day it ends on; 0 days tells again.

    ``key``: sort and what it is about, as alerts are listed: ``overdue:mill-1``.
    """
    sort, colon, about = key.partition(":")
    if not colon or not about or sort not in _SORTS:
        raise InputError(
            "no alert is called so",
            code="alert.key",
            got=key[:60],
            allowed=", ".join(f"{name}:NAME" for name in _SORTS),
            hint="dtwin fleet nightly lists them",
        )
    if not 0 <= days <= _MOST_DAYS:
        raise InputError("not a number of days", code="alert.days", got=f"{days:g}", allowed=f"0 to {_MOST_DAYS}")
    until = ((today or local_day()) + timedelta(days=math.ceil(days))).isoformat()
    with locked(_path(home).with_suffix(".lock"), wait=True):
        _silence(home, key, until if days else "")
    return until


def _silence(home: Home, key: str, until: str) -> None:
    state = _state(home)
    others = {name: end for name, end in state["silent"].items() if name != key}
    state["silent"] = others | ({key: until} if until else {})
    write_document(_path(home), state, "the state of alerts")


def sorted_alerts(alerts: Sequence[Alert]) -> list[Alert]:
    """Return alerts by sort and by what they are about."""
    return sorted(alerts, key=lambda alert: (_SORTS.index(alert.sort), alert.about))


def _title(alerts: Sequence[Alert]) -> str:
    about = sorted({alert.about for alert in alerts})
    more = f" and {len(about) - 3} more" if len(about) > 3 else ""
    return f"dtwin: {len(alerts)} to look at: {', '.join(about[:3])}{more}"


def _lines(alerts: Sequence[Alert]) -> str:
    return "\n".join(f"{alert.sort:<10}{alert.about}: {alert.text}" for alert in sorted_alerts(alerts)) + "\n"


def _path(home: Home) -> Path:
    return home.root / "fleet" / "alerts.json"


def _state(home: Home) -> dict[str, Any]:
    path = _path(home)
    alerts = read_document(path, "remove the file: every open alert is told once more") if path.exists() else {}
    return {name: dict(alerts.get(name, {})) for name in ("told", "unsent", "silent")}


def fleet_view(home: Home, machines: Collection[str] = ()) -> list[dict[str, Any]]:
    """Return the newest diagnosis of these machines, or of all, the largest systematic error over its floor first."""
    newest: dict[str, dict[str, Any]] = {}
    folder = home.root / "kept" / DIAGNOSES
    for file in sorted(folder.glob("*.json")):
        diagnosed = kept_already(home, DIAGNOSES, file.stem)
        if diagnosed is None or (machines and diagnosed["machine"] not in machines):
            continue
        before = newest.get(diagnosed["machine"])
        if before is None or str(diagnosed["started"]) >= str(before["started"]):
            newest[diagnosed["machine"]] = diagnosed
    return sorted((line_of(diagnosed) for diagnosed in newest.values()), key=lambda line: -(line["over_floor"] or 0.0))


def line_of(diagnosed: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is shown of a diagnosis.

    Raises ``KeyError``, ``TypeError`` or ``ValueError`` for what is none.
    """
    if diagnosed["verdict"] not in get_args(Verdict) or not isinstance(diagnosed["headline"], str):
        raise ValueError(f"a verdict {str(diagnosed['verdict'])[:40]} is not known")
    floor, systematic = diagnosed["noise_floor_um"], diagnosed["systematic_rms_um"]
    names = ("machine", "campaign", "kind", "started", "verdict", "headline", "systematic_rms_um", "noise_floor_um")
    return {name: diagnosed[name] for name in names} | {
        "over_floor": systematic / floor if floor and systematic is not None else None,
        "found": [" or ".join(_label(s) for s in group) for group in diagnosed["found"]],
        "unresolved": diagnosed["unresolved"] is not None,
    }


def _label(suspect: dict[str, Any]) -> str:
    return f"{suspect['effect']} {suspect['axis']}".rstrip()
