"""What every instrument is to the rest of dtwin, and the loop that records one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from dtwin.schema import Finding

if TYPE_CHECKING:
    # Brings pyarrow, which a host that only serves does not have.
    from dtwin.acquire._recording import Recorder


@dataclass(frozen=True)
class Description:
    """What an open instrument delivers.

    ``rate_hz``: sample rate that it really has.
    ``columns``: signals; names of floating-point columns end in their unit.
    ``notes``: what else belongs to a recording.
    """

    group: str
    rate_hz: float
    columns: Mapping[str, np.dtype[Any]]
    notes: Mapping[str, Any]


@dataclass(frozen=True)
class Event:
    """Something that a machine says of itself: it holds until it says something else of the same name.

    ``at_s``: time since the first sample.
    ``text``: empty when it is over.
    """

    at_s: float
    name: str
    text: str
    alarm: bool = False


@dataclass(frozen=True)
class Reading:
    """Successive samples.

    ``columns``, (n,): the samples; n may be 0.
    ``lost``: samples that were lost just before these.
    ``events``: what the machine said meanwhile.
    """

    columns: Mapping[str, NDArray[Any]]
    lost: int = 0
    reason: str = ""
    events: tuple[Event, ...] = ()

    @property
    def n_samples(self) -> int:
        """Number of samples per column."""
        return len(next(iter(self.columns.values()))) if self.columns else 0


@runtime_checkable
class Instrument(Protocol):
    """A device that delivers samples once it is open and started.

    ``open`` raises ``MissingPart`` when a driver is not installed and ``DeviceError`` when the
    device does not answer. ``stop`` and ``close`` are safe to call twice and in any state.
    """

    name: str

    def open(self) -> None:
        """Connect and set up."""
        ...

    def describe(self) -> Description:
        """Return what it delivers; valid when open."""
        ...

    def check(self) -> tuple[Finding, ...]:
        """Return what is odd about the set-up, and after a recording about what came, too."""
        ...

    def start(self) -> None:
        """Begin to sample."""
        ...

    def read(self) -> Reading:
        """Return the samples that follow those of the last call, waiting for them."""
        ...

    def stop(self) -> None:
        """End sampling."""
        ...

    def close(self) -> None:
        """Release the device."""
        ...

    def __enter__(self) -> Self:
        """Open the instrument."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the instrument."""
        ...


@runtime_checkable
class Patient(Protocol):
    """An instrument that waits long for a device that is away."""

    def hurry(self) -> None:
        """Let ``read`` wait no more; another thread says so when recording is to end."""
        ...


def record(instrument: Instrument, recorder: Recorder, wanted: Callable[[int], bool]) -> int:
    """Record a started instrument; losses are recorded as gaps.

    ``recorder``: of the columns that the instrument describes.
    ``wanted``: asked with the number of samples so far; false ends the recording.
    Samples on the device's clock, lost ones included.
    Raises ``DeviceError`` when the device fails; what was read before is safe in the recorder.
    Raises ``StoreError`` when the disk is full.
    """
    while wanted(recorder.n_samples):
        reading = instrument.read()
        if reading.lost:
            recorder.gap(reading.lost, reading.reason)
        if reading.n_samples:
            recorder.append(reading.columns)
        if reading.events:
            recorder.say([(e.at_s, e.name, e.text, e.alarm) for e in reading.events])
    return recorder.n_samples
