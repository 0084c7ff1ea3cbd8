"""Every instrument and machine that dtwin knows: what it measures, what it needs, how to make it.

A new one is one entry here; the conformance test runs over all entries.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from dtwin.errors import InputError

if TYPE_CHECKING:
    from dtwin.acquire.instrument import Instrument
    from dtwin.acquire.runner import Bench


@dataclass(frozen=True)
class _Entry:
    """One kind of instrument or machine.

    ``role``: a stream of samples, or a machine with its instruments that runs planned tests.
    ``measures``: what it delivers, in a few words.
    ``needs``: extra of this package, and driver, that it needs; empty for none.
    ``make``: returns one from its settings; touches no device yet.
    """

    name: str
    role: Literal["instrument", "bench"]
    measures: str
    needs: str
    make: Callable[..., Any]


def instrument(name: str, **settings: Any) -> Instrument:
    """Return a closed instrument.

    ``name``: a key of ``_ENTRIES`` with the role ``instrument``.
    ``**settings``: as its class takes them; see ``ENTRIES[name].make``.
    """
    made: Instrument = _make(name, "instrument", settings)
    return made


def bench(name: str, **settings: Any) -> Bench:
    """Return a machine with its instruments; parameters and errors as for ``instrument``."""
    made: Bench = _make(name, "bench", settings)
    return made


def _make(name: str, role: str, settings: Mapping[str, Any]) -> Any:
    known = [entry.name for entry in _ENTRIES.values() if entry.role == role]
    if name not in known:
        raise InputError(f"there is no such {role}", code="instrument.unknown", got=name[:60], allowed=", ".join(known))
    try:
        return _ENTRIES[name].make(**settings)
    except TypeError as error:
        raise InputError(
            f"the settings do not fit the {role} {name}", code="instrument.settings", got=str(error)[:200]
        ) from error


def _accelerometers(**settings: Any) -> Instrument:
    """Return an ``AccelerometerTask``; channels may be mappings, as from a file."""
    from dtwin.acquire._daq import AccelerometerChannel, AccelerometerTask

    channels = [
        channel if isinstance(channel, AccelerometerChannel) else AccelerometerChannel(**channel)
        for channel in settings.pop("channels", ())
    ]
    return AccelerometerTask(channels, **settings)


def _serial(**settings: Any) -> Instrument:
    """Return a ``SerialInstrument``."""
    from dtwin.acquire._serial_port import SerialInstrument

    return SerialInstrument(**settings)


def _robot(**settings: Any) -> Instrument:
    """Return a ``RobotRecorder``."""
    from dtwin.acquire._robot import RobotRecorder

    return RobotRecorder(**settings)


def _mtconnect(**settings: Any) -> Instrument:
    """Return an ``MTConnectRecorder``."""
    from dtwin.acquire._mtconnect import MTConnectRecorder

    return MTConnectRecorder(**settings)


def _mqtt(**settings: Any) -> Instrument:
    """Return an ``MqttRecorder``."""
    from dtwin.acquire._mqtt import MqttRecorder

    return MqttRecorder(**settings)


def _virtual_cobot(**settings: Any) -> Bench:
    """Return a ``VirtualCobotBench``."""
    from dtwin.acquire.virtual import VirtualCobotBench

    return VirtualCobotBench(**settings)


_ALL = (
    _Entry(
        "accelerometers",
        "instrument",
        "acceleration in g, NI-9234 class modules",
        "the extra daq and the NI-DAQmx driver, or an NI gRPC device server",
        _accelerometers,
    ),
    _Entry("serial", "instrument", "any columns of a device on a serial line", "the extra serve", _serial),
    _Entry("controller", "instrument", "joints, path and corrections of a UR robot", "the extra serve", _robot),
    _Entry(
        "mtconnect",
        "instrument",
        "numbers, programs, modes and alarms of a machine with an MTConnect agent",
        "the extra lake",
        _mtconnect,
    ),
    _Entry("mqtt", "instrument", "numbers and texts that are published to a broker", "the extra stream", _mqtt),
    _Entry(
        "virtual-cobot",
        "bench",
        "circular tests with ball bar, accelerometers and controller",
        "the extra serve",
        _virtual_cobot,
    ),
)

_ENTRIES: dict[str, _Entry] = {entry.name: entry for entry in _ALL}
"""All instruments and machines by name."""


def recorders(sensors: Path | None, robot: str | None, streams: Path | None = None) -> list[Instrument]:
    """Return what records a machine while its reference instrument measures, closed.

    ``sensors``: channel file of the accelerometers.
    ``streams``: stream file of an agent or a broker.
    """
    instruments: list[Instrument] = []
    if sensors is not None:
        from dtwin.acquire.sensor_file import read_sensors

        instruments.append(read_sensors(sensors).task())
    if robot is not None:
        from dtwin.acquire._robot import RobotRecorder

        instruments.append(RobotRecorder(robot))
    if streams is not None:
        from dtwin.acquire._stream_file import read_streams_file

        instruments += read_streams_file(streams)
    return instruments
