"""A virtual chassis with four-channel accelerometer modules: tasks, clock, buffer, faults.

It knows nothing of gRPC. Error numbers are those of the real driver, as far as public.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from dtwin.schema import Floats
from studies.machines._daq_sensors import Sensors, Wiring

_FASTEST_HZ = 13_107_200.0 / 256.0
_SLOWEST_DIVISOR = 31
CHANNELS_PER_MODULE = 4

_NO_SUCH_DEVICE = -200220
NO_SUCH_CHANNEL = -200170
BAD_VALUE = -200077
_NO_SUCH_TASK = -200088
_OVERWRITTEN = -200279
_NOT_YET = -200284
_UNREACHABLE = -201003
_NOT_STARTED = -200983
_RESERVED = -50103
UNKNOWN_ATTRIBUTE = -200452

_POLL_S = 0.002


class DaqFault(Exception):
    """An error of the virtual driver.

    ``code``: number that the real driver uses.
    ``samples``: samples per channel that were read before it.
    """

    def __init__(self, code: int, message: str, samples: int | None = None) -> None:
        super().__init__(message)
        self.code, self.samples = code, samples


@dataclass
class Channel:
    """One channel of a task, as the client set it up.

    ``sensitivity_v_g``: sensitivity by which volts are turned into g.
    ``powered``: whether the module feeds the sensor.
    ``ac_coupled``: whether the bias is taken off; direct coupling until it is set.
    """

    name: str
    physical: str
    sensitivity_v_g: float
    powered: bool
    ac_coupled: bool = False


@dataclass
class Task:
    """One task of the virtual driver."""

    channels: list[Channel] = field(default_factory=list)
    rate_hz: float = 1000.0
    buffer_samples: int = 10_000
    started_s: float | None = None
    skipped: int = 0
    position: int = 0
    overwrite: bool = False
    newest: bool = False
    offset: int = 0
    failed: bool = False
    reads: int = 0


class Chassis:
    """Modules that can be there or not, and the tasks that use them.

    ``modules``: names such as ``"cDAQ1Mod1"``.
    ``clock``: monotonic time in s.
    """

    def __init__(self, modules: tuple[str, ...], sensors: Sensors, clock: Callable[[], float] = time.monotonic) -> None:
        self.modules, self.sensors, self.clock = modules, sensors, clock
        self.removed: set[str] = set()
        self.swapped = False
        self.silent_until_s = -math.inf
        self.tasks: dict[str, Task] = {}

    def task(self, name: str) -> Task:
        """Return a task by name, or the driver's error."""
        if name not in self.tasks:
            raise DaqFault(_NO_SUCH_TASK, f"task {name!r} does not exist")
        return self.tasks[name]

    def add_channel(self, task: Task, channel: Channel) -> None:
        """Add a channel that exists on a module that is there."""
        module, _, pin = channel.physical.partition("/")
        if module not in self.modules or module in self.removed:
            raise DaqFault(_NO_SUCH_DEVICE, f"device {module!r} does not exist")
        if pin not in [f"ai{n}" for n in range(CHANNELS_PER_MODULE)]:
            raise DaqFault(NO_SUCH_CHANNEL, f"{channel.physical!r} does not exist")
        if not channel.sensitivity_v_g > 0:
            raise DaqFault(BAD_VALUE, "the sensitivity must be positive")
        task.channels.append(channel)

    def set_clock(self, task: Task, rate_hz: float, buffer_samples: int) -> None:
        """Set the rate, coerced upwards to a divided master clock, and the buffer."""
        if not _FASTEST_HZ / _SLOWEST_DIVISOR * 0.999 <= rate_hz <= _FASTEST_HZ * 1.001:
            raise DaqFault(BAD_VALUE, f"a rate of {rate_hz} Hz is not supported")
        divisor = min(max(math.floor(_FASTEST_HZ / rate_hz + 1e-9), 1), _SLOWEST_DIVISOR)
        task.rate_hz = _FASTEST_HZ / divisor
        least = 10_000 if task.rate_hz <= 10_000 else 100_000
        task.buffer_samples = max(buffer_samples, least)

    def start(self, task: Task) -> None:
        """Start the converters; a module serves one running task only."""
        self._require_there(task)
        mine = {c.physical.partition("/")[0] for c in task.channels}
        for other in self.tasks.values():
            theirs = {c.physical.partition("/")[0] for c in other.channels}
            if other is not task and other.started_s is not None and mine & theirs:
                raise DaqFault(_RESERVED, "the module is in use by another task")
        task.started_s, task.position, task.skipped = self.clock(), 0, 0
        task.failed = False

    def acquired(self, task: Task) -> int:
        """Return the samples per channel taken since the start."""
        if task.started_s is None:
            return 0
        return int((self.clock() - task.started_s) * task.rate_hz) + task.skipped

    def overrun(self, samples: int) -> None:
        """Let every running task's clock jump, as if nobody had read for a buffer and more."""
        for task in self.tasks.values():
            if task.started_s is not None:
                task.skipped += task.buffer_samples + samples

    def read(self, task: Task, wanted: int, timeout_s: float) -> Floats:
        """Return samples in g, shape (channels, n), once they are there.

        ``wanted``: samples per channel; -1 for all that are there.
        ``timeout_s``: longest wait; negative waits for ever.
        """
        task.reads += 1
        first = self._first(task)
        n = max(self.acquired(task) - first, 0) if wanted < 0 else wanted
        deadline_s = math.inf if timeout_s < 0 else self.clock() + timeout_s
        while self.acquired(task) < first + n or self.clock() < self.silent_until_s:
            self._require_there(task)
            if self.clock() >= deadline_s:
                raise DaqFault(_NOT_YET, "the samples are not there yet", 0)
            time.sleep(_POLL_S)
        self._require_there(task)
        self._require_kept(task, first)
        task.position = first + n
        return np.array([self._samples_g(task, c, first, n) for c in task.channels])

    def _first(self, task: Task) -> int:
        if task.started_s is None:
            raise DaqFault(_NOT_STARTED, "the task is not started")
        start = self.acquired(task) if task.newest else task.position
        return max(start + task.offset, 0)

    def _require_kept(self, task: Task, first: int) -> None:
        lost = self.acquired(task) - task.buffer_samples > first
        # Without permission to overwrite, the real driver stops for good.
        task.failed = task.failed or (lost and not task.overwrite)
        if lost or task.failed:
            raise DaqFault(_OVERWRITTEN, "samples were overwritten before they were read", 0)

    def _require_there(self, task: Task) -> None:
        gone = {c.physical.partition("/")[0] for c in task.channels} & self.removed
        if gone:
            raise DaqFault(_UNREACHABLE, f"device {min(gone)!r} cannot be accessed")

    def _samples_g(self, task: Task, channel: Channel, first: int, n: int) -> Floats:
        wiring = Wiring(channel.powered, channel.ac_coupled)
        volts = self.sensors.volts(channel.physical, wiring, first, n, task.rate_hz)
        return volts / channel.sensitivity_v_g
