"""Documents of an MTConnect agent: what it knows (`/probe`) and what it observed (`/sample`)."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from xml.etree.ElementTree import Element

from dtwin.acquire._held import Observed
from dtwin.acquire.xmlsafe import number_or_none, parse_vendor_xml
from dtwin.errors import DeviceError, InputError

# Unit of the standard, with the suffix of a column and the factor into it.
_UNITS: Mapping[str, tuple[str, float]] = {
    "MILLIMETER": ("mm", 1.0),
    "MILLIMETER/SECOND": ("mm_s", 1.0),
    "MILLIMETER/SECOND^2": ("mm_s2", 1.0),
    "DEGREE": ("deg", 1.0),
    "DEGREE/SECOND": ("deg_s", 1.0),
    "REVOLUTION/MINUTE": ("hz", 1.0 / 60.0),
    "REVOLUTION/SECOND": ("hz", 1.0),
    "CELSIUS": ("c", 1.0),
    "PERCENT": ("pct", 1.0),
    "AMPERE": ("a", 1.0),
    "VOLT": ("v", 1.0),
    "NEWTON": ("n", 1.0),
    "NEWTON_METER": ("nm", 1.0),
    "KILOGRAM": ("kg", 1.0),
    "PASCAL": ("kpa", 1e-3),
    "HERTZ": ("hz", 1.0),
    "SECOND": ("s", 1.0),
    "COUNT": ("1", 1.0),
}
_3D = {"MILLIMETER_3D": "mm", "DEGREE_3D": "deg"}
# Events that say what the machine does; blocks and lines change with every move.
_STATES = ("PROGRAM", "EXECUTION", "CONTROLLER_MODE", "EMERGENCY_STOP", "TOOL_ID", "TOOL_NUMBER", "MESSAGE", "ALARM")
_UNAVAILABLE = "UNAVAILABLE"
_LEVELS = ("Warning", "Fault")


@dataclass(frozen=True)
class Item:
    """A data item that is recorded.

    ``columns``: of a number, one for each part; empty for an event or a condition.
    ``factor``: from the agent's unit into that of the columns.
    """

    name: str
    columns: tuple[str, ...] = ()
    factor: float = 1.0
    condition: bool = False


@dataclass(frozen=True)
class Header:
    """What an agent says of its buffer.

    ``created_s``: seconds since 1970, by the agent's clock.
    """

    instance: str
    first: int
    next: int
    created_s: float


def read_probe(data: bytes, where: str, device: str) -> tuple[dict[str, Item], list[str], str]:
    """Return the items by their id, what is left out with the reason, and the name of the device.

    ``device``: name or uuid; empty when the agent has one only.
    """
    root = _document(data, where, "MTConnectDevices")
    devices = [e for e in root.iter() if _tag(e) == "Device"]
    chosen = [d for d in devices if not device or device in (d.get("name"), d.get("uuid"))]
    if len(chosen) != 1:
        raise InputError(
            "the agent has no such device" if device else "the agent has several devices, or none",
            code="mtconnect.device",
            where=where,
            got=device or f"{len(devices)} devices",
            allowed=", ".join(str(d.get("name")) for d in devices)[:200] or "one device",
            hint='device = "NAME" under [mtconnect]',
        )
    items: dict[str, Item] = {}
    left: list[str] = []
    taken: set[str] = set()
    for told in (e for e in chosen[0].iter() if _tag(e) == "DataItem"):
        item_id, name = told.get("id") or "", told.get("name") or told.get("id") or "unnamed"
        made, why = _item(told, name, item_id, taken)
        if made is not None and item_id:
            items[item_id] = made
            taken.update(made.columns)
        elif why:
            left.append(f"{name}: {why}")
    return items, left, str(chosen[0].get("name", ""))


def _item(told: Element, name: str, item_id: str, taken: set[str]) -> tuple[Item | None, str]:
    category, kind = told.get("category", ""), told.get("type", "")
    if category == "CONDITION":
        return Item(name, condition=True), ""
    if category == "EVENT":
        return (Item(kind.lower()), "") if kind in _STATES else (None, "")
    unit = told.get("units", "")
    if told.get("representation", "VALUE") != "VALUE":
        return None, f"{told.get('representation')} is not read"
    base = _plain(name)
    if unit in _3D:
        columns: tuple[str, ...] = tuple(f"{base}_{axis}_{_3D[unit]}" for axis in "xyz")
        factor = 1.0
    elif unit in _UNITS:
        suffix, factor = _UNITS[unit]
        columns = (f"{base}_{suffix}",)
    else:
        return None, f"unit {unit or 'not stated'}"
    if taken & set(columns):
        # Names need not differ, ids do.
        columns = tuple(f"{_plain(item_id)}_{c}" for c in columns)
    return Item(name, columns, factor), ""


def read_streams(data: bytes, where: str, items: Mapping[str, Item]) -> tuple[Header, list[Observed]]:
    """Return the header and the observations of known items, in the order of their sequence.

    Raises ``OutOfRange`` when the agent has nothing at that place any more, ``DeviceError`` when it answers with
    another error.
    """
    root = _document(data, where, "MTConnectStreams")
    observed: list[tuple[int, Observed]] = []
    for element in root.iter():
        item = items.get(element.get("dataItemId", ""))
        stamp = element.get("timestamp")
        if item is not None and stamp is not None:
            number = _whole(element.get("sequence", "0"))
            observed += [(number, one) for one in _observed(element, item, seconds(stamp, where))]
    observed.sort(key=lambda pair: pair[0])
    return _header(root, where), [one for _, one in observed]


def _observed(element: Element, item: Item, time_s: float) -> Iterator[Observed]:
    text = " ".join((element.text or "").split())
    if item.condition:
        level, code = _tag(element), element.get("nativeCode", "")
        name = f"{item.name} {code}".strip()
        if level in _LEVELS:
            yield Observed(name, time_s, f"{level}: {text}" if text else level, alarm=True)
        else:
            # All of it is over when no code is named.
            yield Observed(name, time_s, "", alarm=True)
    elif item.columns:
        parts = text.split()
        unknown = text == _UNAVAILABLE or len(parts) != len(item.columns)
        for column, part in zip(item.columns, parts if not unknown else [""] * len(item.columns), strict=True):
            yield Observed(column, time_s, _number(part) * item.factor)
    else:
        yield Observed(item.name, time_s, "" if text == _UNAVAILABLE else text)


class OutOfRange(Exception):
    """The agent's buffer does not reach to the number that was asked for."""


def _document(data: bytes, where: str, wanted: str) -> Element:
    root = parse_vendor_xml(data, where)
    if _tag(root) == "MTConnectError":
        errors = [
            (e.get("errorCode", _tag(e)), " ".join((e.text or "").split())) for e in root.iter() if _tag(e) == "Error"
        ]
        codes = {code for code, _ in errors} | {_tag(e) for e in root.iter()}
        if codes & {"OUT_OF_RANGE", "OutOfRange"}:
            raise OutOfRange(str(errors)[:200])
        raise DeviceError("the agent refuses", code="mtconnect.error", where=where, got=str(errors)[:200])
    if _tag(root) != wanted:
        raise DeviceError(
            "this is no MTConnect agent",
            code="mtconnect.document",
            where=where,
            got=_tag(root)[:60],
            allowed=wanted,
            hint="the address of the agent itself, such as http://192.168.0.7:5000",
        )
    return root


def _header(root: Element, where: str) -> Header:
    head = next((e for e in root if _tag(e) == "Header"), None)
    if head is None or not head.get("nextSequence") or not head.get("instanceId"):
        raise DeviceError("the agent's answer has no header", code="mtconnect.document", where=where)
    return Header(
        str(head.get("instanceId")),
        _whole(head.get("firstSequence", "0")),
        _whole(head.get("nextSequence", "0")),
        seconds(head.get("creationTime", ""), where),
    )


def seconds(stamp: str, where: str) -> float:
    """Return the seconds since 1970 of a time as ISO 8601 writes it; UTC where it names no zone."""
    try:
        # A duration may follow after an @.
        when = datetime.fromisoformat(stamp.partition("@")[0])
    except ValueError as error:
        raise DeviceError("a time is not readable", code="stream.time", where=where, got=stamp[:60]) from error
    return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()


def _plain(name: str) -> str:
    """Return the beginning of a column's name."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:60] or "item"


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        return 0


def _number(text: str) -> float:
    value = number_or_none(text)
    return math.nan if value is None else value


def _tag(element: Element) -> str:
    """Return the tag without its namespace: it names the version of the standard."""
    return element.tag.rsplit("}", 1)[-1]
