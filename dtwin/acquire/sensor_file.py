"""The channel file: which sensor is on which input, how sensitive, how fast it is sampled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dtwin.acquire._daq import FULL_SCALE_MV, AccelerometerChannel, AccelerometerTask
from dtwin.acquire._daq_windows import DaqWindows
from dtwin.atomic import read_toml
from dtwin.errors import InputError
from dtwin.features.windows import WindowContract
from dtwin.schema import require_name
from dtwin.units import is_number

_MAX_BYTES = 1_000_000
_MOST_IEPE_MA = 20.0
_SAME_RATE = 1e-3
_TOP = {"sensors", "channel"}
_SENSORS = {"rate_hz": True, "block_s": False, "grpc_target": False, "timeout_s": False}
_CHANNEL = {"name": True, "input": True, "sensitivity_mv_g": True, "iepe_ma": True, "range_g": False}


@dataclass(frozen=True)
class _SensorSetup:
    """What a channel file says.

    ``channels``: in the order of the file.
    ``block_s``: time that one block of a recording covers.
    ``grpc_target``: ``host:port`` of an NI gRPC device server; None for the local driver.
    ``timeout_s``: wait for the server, and for samples.
    """

    path: Path
    rate_hz: float
    channels: tuple[AccelerometerChannel, ...]
    block_s: float = 0.1
    grpc_target: str | None = None
    timeout_s: float = 5.0

    def task(self) -> AccelerometerTask:
        """Return the closed instrument that records these channels."""
        return AccelerometerTask(
            self.channels, self.rate_hz, block_s=self.block_s, grpc_target=self.grpc_target, timeout_s=self.timeout_s
        )

    def windows(self, contract: WindowContract) -> DaqWindows:
        """Open what delivers the windows of a contract, from the channels that it names.

        ``contract``: what the model was trained on.
        """
        by_name = {channel.name: channel for channel in self.channels}
        missing = [name for name in contract.channels if name not in by_name]
        if missing:
            raise _wrong(
                self.path,
                "the model was trained with sensors that are not in the file",
                "sensors.channels",
                ", ".join(by_name),
                f"all of {', '.join(contract.channels)}",
            )
        if abs(self.rate_hz / contract.rate_hz - 1.0) > _SAME_RATE:
            raise _wrong(
                self.path,
                "the model was trained at another rate",
                "sensors.rate",
                f"{self.rate_hz:g} Hz",
                f"{contract.rate_hz:.10g} Hz",
            )
        chosen = [by_name[name] for name in contract.channels]
        return DaqWindows(contract, chosen, grpc_target=self.grpc_target, timeout_s=self.timeout_s)


def read_sensors(path: Path) -> _SensorSetup:
    """Read and check a channel file.

    ``path``: TOML with a table ``[sensors]`` and one ``[[channel]]`` per sensor.

    Raises ``InputError`` with the place of the first thing that is wrong.
    """
    document = _document(path)
    _require_keys(document, dict.fromkeys(_TOP, True), str(path))
    head, listed = document["sensors"], document["channel"]
    if not isinstance(head, dict) or not isinstance(listed, list):
        raise _wrong(
            path,
            "a channel file needs a table [sensors] and at least one [[channel]]",
            "sensors.toml",
            "something else",
            None,
        )
    where = f"{path} [sensors]"
    _require_keys(head, _SENSORS, where)
    setup = _SensorSetup(
        path,
        _number(head, "rate_hz", where, 1.0, 1e6),
        tuple(_channel(entry, n, path) for n, entry in enumerate(listed, start=1)),
        _number(head, "block_s", where, 0.001, 10.0, 0.1),
        _target(head, where),
        _number(head, "timeout_s", where, 0.1, 300.0, 5.0),
    )
    try:
        setup.task()
    except InputError as error:
        raise _wrong(path, error.message, "sensors.setup", error.got, error.allowed) from error
    return setup


def _document(path: Path) -> dict[str, Any]:
    try:
        return read_toml(path, _MAX_BYTES)
    except (OSError, ValueError, RecursionError) as error:
        raise _wrong(path, "the channel file cannot be read", "sensors.unreadable", str(error)[:200], None) from error


def _channel(entry: Any, number: int, path: Path) -> AccelerometerChannel:
    where = f"{path} channel {number}"
    if not isinstance(entry, dict):
        raise InputError("a channel must be a table", code="sensors.toml", where=where)
    _require_keys(entry, _CHANNEL, where)
    name, physical = require_name(entry["name"], f"name of channel {number}"), entry["input"]
    if not isinstance(physical, str) or not physical.strip():
        raise InputError(
            "a channel needs its input",
            code="sensors.input",
            where=where,
            got=repr(physical)[:60],
            allowed='module and input, for example "cDAQ1Mod1/ai0"',
        )
    sensitivity = _number(entry, "sensitivity_mv_g", where, 0.01, 1e5)
    return AccelerometerChannel(
        name,
        physical,
        sensitivity,
        _number(entry, "iepe_ma", where, 0.0, _MOST_IEPE_MA) / 1000.0,
        _number(entry, "range_g", where, 1e-6, FULL_SCALE_MV / sensitivity) if "range_g" in entry else None,
    )


def _number(
    table: Mapping[str, Any], name: str, where: str, low: float, high: float, default: float | None = None
) -> float:
    value = table.get(name, default)
    if not is_number(value) or not low <= value <= high:
        raise InputError(
            f"{name} is out of range",
            code="sensors.value",
            where=where,
            got=repr(value)[:60],
            allowed=f"a number from {low:g} to {high:g}",
        )
    return float(value)


def _target(head: Mapping[str, Any], where: str) -> str | None:
    value = head.get("grpc_target")
    if value is None:
        return None
    host, _, port = value.rpartition(":") if isinstance(value, str) else ("", "", "")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise InputError(
            "grpc_target is not an address",
            code="sensors.value",
            where=where,
            got=repr(value)[:80],
            allowed='"host:port" of an NI gRPC device server',
        )
    return str(value)


def _require_keys(table: Mapping[str, Any], known: Mapping[str, bool], where: str) -> None:
    unknown: Sequence[str] = sorted(set(table) - set(known))
    missing = [name for name, required in known.items() if required and name not in table]
    if unknown or missing:
        raise InputError(
            "unknown setting" if unknown else "a setting is missing",
            code="sensors.setting",
            where=where,
            got=", ".join(unknown)[:120] if unknown else f"no {', '.join(missing)}",
            allowed=", ".join(known),
        )


def _wrong(path: Path, text: str, code: str, got: str | None, allowed: str | None) -> InputError:
    return InputError(text, code=code, where=str(path), got=got, allowed=allowed)
