"""Accelerometers on NI-9234 class modules, through NI's own client, whose faults are told in one line that a user can act on.

The task samples continuously by the module's clock and is read block by block without gaps.
When the host was too slow (error -200279) reading goes on with the newest samples, and the
number of lost ones is reported with them.
"""

from __future__ import annotations

import contextlib
import mmap
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.acquire._sample_ring import SampleRing
from dtwin.acquire.instrument import Description, Reading
from dtwin.errors import DeviceError, InputError, MissingPart
from dtwin.links.opened import OpenAndClose
from dtwin.schema import Finding, Floats

_MASTER_HZ = 13_107_200.0 / 256.0
_SLOWEST_DIVISOR = 31
FULL_SCALE_MV = 5000.0
_OVERRUN = "overrun: the host read too slowly (-200279)"

_OVERWRITTEN = -200279
# A chassis on a network takes seconds to be set up.
_SET_UP_S, _AGAIN_S = 10.0, 1.0


@dataclass(frozen=True)
class AccelerometerChannel:
    """One sensor at one input.

    ``name``: column of its signal, ending in ``_g``.
    ``physical``: module and input, for example ``"cDAQ1Mod1/ai0"``.
    ``sensitivity_mv_g``: from the sensor's certificate; 1000 mV/g for a PCB 356B18.
    ``excitation_a``: constant current that feeds the sensor (IEPE); 0 for a sensor with a supply of its own.
    ``range_g``: largest acceleration to expect; None for the module's full scale.
    """

    name: str
    physical: str
    sensitivity_mv_g: float = 1000.0
    excitation_a: float = 0.002
    range_g: float | None = None

    @property
    def full_scale_g(self) -> float:
        """Acceleration at the module's full scale of 5 V."""
        return FULL_SCALE_MV / self.sensitivity_mv_g


class AccelerometerTask(OpenAndClose):
    """Hardware-timed acquisition of accelerometers.

    ``channels``: in the order of the blocks' rows.
    ``rate_hz``: wanted rate; ``self.rate_hz`` is the one that the module has, known once it is open.
    ``block_s``: time that one block covers; about 0.1 s suits a recording, 0.01 s serving.
    ``grpc_target``: ``host:port`` of an NI gRPC device server; the local driver by default.
    ``timeout_s``: wait for the server, and for samples beyond the length of a block.
    ``history_s``: time that ``newest_window`` can look back.
    Raises ``InputError`` when channels, rate or block make no sense.
    """

    name = "accelerometers"

    def __init__(
        self,
        channels: Sequence[AccelerometerChannel],
        rate_hz: float,
        *,
        block_s: float = 0.1,
        grpc_target: str | None = None,
        timeout_s: float = 5.0,
        history_s: float = 2.0,
    ) -> None:
        _require_sense(channels, rate_hz, block_s)
        self.channels = tuple(channels)
        self.asked_hz = self.rate_hz = float(rate_hz)
        self._block_s, self._history_s, self._timeout_s = block_s, history_s, timeout_s
        self._target = grpc_target
        self._server: Any = None
        self._task: Any = None
        self._running = False

    def open(self) -> None:
        """Create the task, set up its channels and clock, and read back what was accepted.

        Raises ``DeviceError`` when server, module or channel is absent, or the channels come in another order.
        """
        if self._task is not None:
            return
        try:
            with _daq_faults(self._where):
                self._create()
        except BaseException:
            self.close()
            raise

    def describe(self) -> Description:
        """Return the channels as columns in single precision, as a 24-bit converter has."""
        self._require_open()
        notes = {
            "rate_asked_hz": self.asked_hz,
            "channels": {
                c.name: {
                    "physical": c.physical,
                    "sensitivity_mv_g": c.sensitivity_mv_g,
                    "iepe_ma": 1000.0 * c.excitation_a,
                    "range_g": c.range_g or c.full_scale_g,
                }
                for c in self.channels
            },
        }
        columns = {c.name: np.dtype(np.float32) for c in self.channels}
        return Description(self.name, self.rate_hz, columns, notes)

    def check(self) -> tuple[Finding, ...]:
        """Return whether the rate is another than asked for."""
        self._require_open()
        if abs(self.rate_hz / self.asked_hz - 1) < 1e-9:
            return ()
        text = f"asked for {self.asked_hz:g} Hz, the module samples at {self.rate_hz:.10g} Hz"
        numbers = {"asked_hz": self.asked_hz, "rate_hz": self.rate_hz}
        return (Finding("daq.rate_coerced", "warning", text, numbers),)

    def start(self) -> None:
        """Begin to sample; the module's clock starts at sample 0."""
        self._require_open()
        if not self._running:
            with _daq_faults(self._where):
                self._task.start()
            self._position, self._running = 0, True
            n, capacity = len(self.channels), int(self._history_s * self.rate_hz) + self._block_n
            memory = mmap.mmap(-1, SampleRing.size(n, capacity))
            self._ring = SampleRing(memory, n, capacity)

    def read_block(self) -> tuple[Floats, int]:
        """Return the next block without a gap, or the newest after an overrun.

        Returns ``samples`` (channels, n): in g; the next call overwrites it.
        Returns ``lost``: samples per channel that were lost before it.
        """
        if not self._running:
            raise DeviceError("sampling was not started", code="daq.stopped", where=self._where)
        with _daq_faults(self._where):
            lost = self._read()
        self._position += lost + self._block_n
        self._ring.write(self._block, lost, time.monotonic())
        return self._block, lost

    def read(self) -> Reading:
        """Return the next block by columns, as ``Instrument`` has it."""
        block, lost = self.read_block()
        columns = {c.name: row.copy() for c, row in zip(self.channels, block, strict=True)}
        return Reading(columns, lost, _OVERRUN if lost else "")

    def newest_window(self, n_samples: int) -> tuple[Floats | None, float]:
        """Return the newest samples that were read, and the age of the last one in s.

        Returns ``window`` (channels, n_samples): none while there are not as many samples without a gap.
        Returns ``age_s``: infinite without a window.
        """
        window = np.empty((len(self.channels), n_samples))
        end, read_s = self._ring.newest(window) if self._running else (0, 0.0)
        return (window, time.monotonic() - read_s) if end else (None, float("inf"))

    def stop(self) -> None:
        """End sampling; safe to call twice."""
        if self._running:
            self._running = False
            # A module that is gone has stopped, too.
            with contextlib.suppress(DeviceError), _daq_faults(self._where):
                self._task.stop()

    def close(self) -> None:
        """Release module and connection, even when the module is gone; safe to call twice."""
        task, server = self._task, self._server
        self._task = self._server = None
        self._running = False
        with contextlib.suppress(Exception):
            # A lost device or server makes even this fail, and there is nothing left to do.
            if task is not None:
                task.close()
        if server is not None:
            server.close()

    def _create(self) -> None:
        import nidaqmx
        from nidaqmx.constants import AcquisitionType, Coupling, ExcitationSource, OverwriteMode
        from nidaqmx.stream_readers import AnalogMultiChannelReader

        self._task = task = nidaqmx.Task(grpc_options=self._connect())
        for channel in self.channels:
            added = task.ai_channels.add_ai_accel_chan(
                channel.physical,
                channel.name,
                min_val=-(channel.range_g or channel.full_scale_g),
                max_val=channel.range_g or channel.full_scale_g,
                sensitivity=channel.sensitivity_mv_g,
                current_excit_source=ExcitationSource.INTERNAL if channel.excitation_a > 0 else ExcitationSource.NONE,
                current_excit_val=channel.excitation_a,
            )
            added.ai_coupling = Coupling.AC
        task.timing.cfg_samp_clk_timing(
            self.asked_hz,
            sample_mode=AcquisitionType.CONTINUOUS,
            samps_per_chan=int(self.asked_hz * max(2.0, 4 * self._block_s)),
        )
        # So the module goes on after an overrun, and what was lost can be counted.
        task.in_stream.overwrite = OverwriteMode.OVERWRITE_UNREAD_SAMPLES
        self.rate_hz = float(task.timing.samp_clk_rate)
        self._require_order(list(task.channel_names))
        self._block_n = max(1, round(self._block_s * self.rate_hz))
        self._block = np.zeros((len(self.channels), self._block_n))
        self._reader = AnalogMultiChannelReader(task.in_stream)
        self._reader.verify_array_shape = False

    def _connect(self) -> Any:
        """Return the options of a server that answers, or None for the local driver."""
        if self._target is None:
            return None
        import grpc
        import nidaqmx

        limit = [("grpc.max_receive_message_length", 256 * 1024 * 1024)]
        self._server = grpc.insecure_channel(self._target, options=limit)
        try:
            grpc.channel_ready_future(self._server).result(self._timeout_s)
        except grpc.FutureTimeoutError as error:
            raise DeviceError(
                f"no NI gRPC device server answered within {self._timeout_s:g} s",
                code="daq.server_absent",
                where=self._target,
                hint="start ni-grpc-device-server there and check address and port",
            ) from error
        # A call has no limit of its own: a server that is frozen would hold the recording for ever.
        read_s = self._block_s + 2.0 * self._timeout_s

        class Limited(grpc.UnaryUnaryClientInterceptor):
            """Limits every call, the more so once one was too late."""

            late = False

            def intercept_unary_unary(self, going_on: Any, details: Any, request: Any) -> Any:
                limit_s = _AGAIN_S if self.late else read_s if "Read" in details.method else read_s + _SET_UP_S
                call = going_on(details._replace(timeout=limit_s), request)
                self.late = call.code() == grpc.StatusCode.DEADLINE_EXCEEDED
                return call

        return nidaqmx.GrpcSessionOptions(grpc.intercept_channel(self._server, Limited()), "")

    def _read(self) -> int:
        """Read a block into ``self._block`` and return how many samples were lost before."""
        from nidaqmx.constants import ReadRelativeTo
        from nidaqmx.errors import DaqError

        timeout_s = self._block_s + self._timeout_s
        try:
            self._reader.read_many_sample(self._block, self._block_n, timeout_s)
            return 0
        except DaqError as error:
            if error.error_code != _OVERWRITTEN:
                raise
        stream = self._task.in_stream
        stream.relative_to, stream.offset = ReadRelativeTo.MOST_RECENT_SAMPLE, -self._block_n
        try:
            self._reader.read_many_sample(self._block, self._block_n, timeout_s)
            return int(stream.curr_read_pos) - self._block_n - self._position
        finally:
            stream.relative_to, stream.offset = ReadRelativeTo.CURRENT_READ_POSITION, 0

    @property
    def _where(self) -> str:
        return self._target or "the local driver"

    def _require_open(self) -> None:
        if self._task is None:
            raise DeviceError("the acquisition is not open", code="daq.closed", where=self._where)

    def _require_order(self, names: list[str]) -> None:
        wanted = [channel.name for channel in self.channels]
        if names != wanted:
            raise DeviceError(
                "the driver has the channels in another order",
                code="daq.channel_order",
                where=self._where,
                got=", ".join(names),
                allowed=", ".join(wanted),
            )


def _require_sense(channels: Sequence[AccelerometerChannel], rate_hz: float, block_s: float) -> None:
    names = [c.name for c in channels]
    slowest = _MASTER_HZ / _SLOWEST_DIVISOR
    problem = None
    if not names or len(set(names)) < len(names):
        problem = "no channel, or a name twice"
    elif not all(name.endswith("_g") for name in names):
        problem = "a channel whose name does not end in _g"
    elif len({c.physical for c in channels}) < len(names):
        problem = "one input twice"
    elif not all(c.sensitivity_mv_g > 0 for c in channels):
        problem = "a sensitivity that is not positive"
    elif not all(0 < (c.range_g or c.full_scale_g) <= c.full_scale_g for c in channels):
        problem = "a range beyond the module's full scale of 5 V"
    elif not slowest * 0.999 <= rate_hz <= _MASTER_HZ * 1.001:
        problem = f"{rate_hz:g} Hz; an NI-9234 samples at 1651.6 to 51200 Hz"
    elif not 0.001 <= block_s <= 10.0:
        problem = f"blocks of {block_s:g} s; 0.001 to 10 s are sensible"
    if problem:
        raise InputError("unusable acquisition set-up", code="daq.setup", got=problem)


_CODES: dict[int, tuple[str, str, str]] = {
    -200220: (
        "daq.device_absent",
        "no acquisition module of this name is there",
        "check the name in NI MAX or with nilsdev, the cable and the power",
    ),
    -200170: ("daq.channel_absent", "the module has no such channel", "an NI-9234 has ai0 to ai3"),
    -200077: (
        "daq.setting",
        "the module does not offer this setting",
        "check rate, sensitivity and excitation current",
    ),
    -201003: ("daq.removed", "the acquisition module does not answer any more", "plug it in again, then start again"),
    -50103: (
        "daq.busy",
        "the module is used by another program",
        "end the other program; after a killed one restart the NI gRPC device server",
    ),
    -200284: ("daq.silent", "the module delivers no samples", "check the chassis, then start again"),
    -200361: (
        "daq.overflow",
        "the module's own buffer overflowed: the bus is too slow",
        "use a faster port, fewer channels or a lower rate",
    ),
}


@contextlib.contextmanager
def _daq_faults(where: str) -> Iterator[None]:
    """Turn the errors of NI's client into ours.

    ``where``: driver or server, for the message.
    """
    try:
        import nidaqmx.errors as ni
    except ImportError as error:
        raise _package_missing("nidaqmx") from error
    try:
        yield
    except ImportError as error:
        raise _package_missing(error.name or "nidaqmx") from error
    except (ni.DaqNotFoundError, ni.DaqNotSupportedError) as error:
        raise MissingPart(
            "the NI-DAQmx driver is not installed",
            code="daq.driver",
            hint="get it from https://www.ni.com/downloads, or give a gRPC target",
        ) from error
    except ni.DaqError as error:
        raise _device_error(where, error.error_code, str(error)) from error
    except ni.RpcError as error:
        raise DeviceError(
            "the NI gRPC device server is gone or refuses",
            code="daq.server_lost",
            where=where,
            got=str(error).splitlines()[0][:200],
            hint="check the server and the network, then start again",
        ) from error


def _device_error(where: str, number: int, text: str) -> DeviceError:
    fallback = ("daq.fault", "the acquisition failed", "look up the number at ni.com")
    code, message, hint = _CODES.get(number, fallback)
    got = f"{text.splitlines()[0][:200]} ({number})"
    return DeviceError(message, code=code, where=where, got=got, hint=hint)


def _package_missing(name: str) -> MissingPart:
    return MissingPart(
        f"the package {name} is not installed", code="daq.package", hint="pip install '.[daq]' in a checkout of dtwin"
    )
