"""A stand-in for NI's gRPC device server, so that the real ``nidaqmx`` client can be used.

``python -m studies.machines.daq_server --port 0`` prints one JSON line with the port when it is
ready. With ``--control`` it takes JSON lines on standard input, each answered by one on
standard output, and ends when its input ends::

    {"do": "overrun", "samples": 500}       the buffer overflows, with that many samples more
    {"do": "remove", "device": "cDAQ1Mod2"} the module is pulled out
    {"do": "restore"}                       all modules are back
    {"do": "silence", "seconds": 1.0}       no samples arrive
    {"do": "swap"}                          tasks report their channels in reverse order
    {"do": "status"}                        tasks and their state
    {"do": "quit"}

It is our own, not NI's: it proves our calls, their order, shapes and units and how we take
errors. It does not check the driver's timing, its own errors, TLS, synchronisation of chassis,
TEDS, open sensors, or the converter's filter. Calls that it does not know are answered as
unimplemented, never as done.
"""

from __future__ import annotations

import argparse
import ipaddress
import json
import sys
import threading
from collections.abc import Callable
from concurrent import futures
from pathlib import Path
from typing import Any

import grpc
import nidaqmx._stubs.nidaqmx_pb2 as messages
import nidaqmx._stubs.nidaqmx_pb2_grpc as stubs
from nidaqmx.constants import (
    AccelSensitivityUnits,
    AccelUnits,
    AcquisitionType,
    ChannelType,
    Coupling,
    ExcitationSource,
    FillMode,
    OverwriteMode,
    ReadRelativeTo,
)

from dtwin.errors import DtwinError, InputError
from dtwin.lake.parquet import columns_of, read_parquet
from studies.machines import _daq_device as device
from studies.machines._daq_sensors import Sensors

_DRIVER_VERSION = {0x1272: 24, 0x1923: 0, 0x2F22: 0}
_READ_POSITION, _TOTAL_ACQUIRED, _AVAILABLE, _N_CHANNELS = 0x1221, 0x192A, 0x1223, 0x217B
_RELATIVE_TO, _OFFSET, _OVERWRITE, _CHANNELS_TO_READ = 0x190A, 0x190B, 0x1211, 0x1823
_TASK_CHANNELS, _TASK_N_CHANNELS, _TASK_NAME, _TASK_DEVICES = 0x1273, 0x2181, 0x1276, 0x230E
_COUPLING, _CHANNEL_TYPE, _PHYSICAL_NAME = 0x64, 0x187F, 0x18F5
_RATE, _BUFFER = 0x1344, 0x186C


def _answers(work: Callable[..., Any]) -> Callable[..., Any]:
    """Turn an error of the virtual driver into what NI's server sends."""

    def answer(self: _DaqService, request: Any, context: Any) -> Any:
        try:
            return work(self, request)
        except device.DaqFault as fault:
            trailer = [("ni-error", str(fault.code))]
            if fault.samples is not None:
                trailer.append(("ni-samps-per-chan-read", str(fault.samples)))
            context.set_trailing_metadata(trailer)
            context.abort(grpc.StatusCode.UNKNOWN, str(fault))

    return answer


class _DaqService(stubs.NiDAQmxServicer):
    """The calls that an accelerometer acquisition needs; the others stay unimplemented."""

    def __init__(self, chassis: device.Chassis) -> None:
        self.chassis = chassis
        self._count = 0

    @_answers
    def GetSystemInfoAttributeUInt32(self, request: Any) -> Any:
        value = _known(_DRIVER_VERSION, request.attribute_raw)
        return messages.GetSystemInfoAttributeUInt32Response(value=value)

    @_answers
    def CreateTask(self, request: Any) -> Any:
        self._count += 1
        name = request.session_name or f"_unnamedTask<{self._count}>"
        self.chassis.tasks[name] = device.Task()
        response = messages.CreateTaskResponse(new_session_initialized=True)
        response.task.name = name
        return response

    @_answers
    def ClearTask(self, request: Any) -> Any:
        self.chassis.task(request.task.name)
        del self.chassis.tasks[request.task.name]
        return messages.ClearTaskResponse()

    @_answers
    def CreateAIAccelChan(self, request: Any) -> Any:
        if request.units_raw != AccelUnits.G.value:
            raise device.DaqFault(device.BAD_VALUE, "this stand-in measures in g only")
        in_mv = request.sensitivity_units_raw == AccelSensitivityUnits.MILLIVOLTS_PER_G.value
        channel = device.Channel(
            request.name_to_assign_to_channel or request.physical_channel,
            request.physical_channel,
            request.sensitivity / (1000.0 if in_mv else 1.0),
            request.current_excit_source_raw == ExcitationSource.INTERNAL.value and request.current_excit_val > 0,
        )
        self.chassis.add_channel(self.chassis.task(request.task.name), channel)
        return messages.CreateAIAccelChanResponse()

    @_answers
    def CfgSampClkTiming(self, request: Any) -> Any:
        if request.sample_mode_raw != AcquisitionType.CONTINUOUS.value:
            raise device.DaqFault(device.BAD_VALUE, "this stand-in samples continuously only")
        task = self.chassis.task(request.task.name)
        self.chassis.set_clock(task, request.rate, request.samps_per_chan)
        return messages.CfgSampClkTimingResponse()

    @_answers
    def StartTask(self, request: Any) -> Any:
        self.chassis.start(self.chassis.task(request.task.name))
        return messages.StartTaskResponse()

    @_answers
    def StopTask(self, request: Any) -> Any:
        self.chassis.task(request.task.name).started_s = None
        return messages.StopTaskResponse()

    @_answers
    def ReadAnalogF64(self, request: Any) -> Any:
        task = self.chassis.task(request.task.name)
        if request.fill_mode_raw != FillMode.GROUP_BY_CHANNEL.value:
            raise device.DaqFault(device.BAD_VALUE, "this stand-in reads channel by channel only")
        samples = self.chassis.read(task, request.num_samps_per_chan, request.timeout)
        if samples.size > request.array_size_in_samps:
            raise device.DaqFault(-200229, "the client's array is too small", 0)
        return messages.ReadAnalogF64Response(read_array=samples.ravel().tolist(), samps_per_chan_read=samples.shape[1])

    @_answers
    def GetTimingAttributeDouble(self, request: Any) -> Any:
        rate_hz = self.chassis.task(request.task.name).rate_hz
        value = _known({_RATE: rate_hz}, request.attribute_raw)
        return messages.GetTimingAttributeDoubleResponse(value=value)

    @_answers
    def GetTaskAttributeUInt32(self, request: Any) -> Any:
        n = len(self.chassis.task(request.task.name).channels)
        value = _known({_TASK_N_CHANNELS: n}, request.attribute_raw)
        return messages.GetTaskAttributeUInt32Response(value=value)

    @_answers
    def GetTaskAttributeString(self, request: Any) -> Any:
        task = self.chassis.task(request.task.name)
        modules = dict.fromkeys(c.physical.partition("/")[0] for c in task.channels)
        known = {_TASK_NAME: request.task.name, _TASK_CHANNELS: self._names(task), _TASK_DEVICES: ", ".join(modules)}
        value = _known(known, request.attribute_raw)
        return messages.GetTaskAttributeStringResponse(value=value)

    @_answers
    def GetReadAttributeString(self, request: Any) -> Any:
        names = self._names(self.chassis.task(request.task.name))
        value = _known({_CHANNELS_TO_READ: names}, request.attribute_raw)
        return messages.GetReadAttributeStringResponse(value=value)

    @_answers
    def GetReadAttributeUInt32(self, request: Any) -> Any:
        task = self.chassis.task(request.task.name)
        waiting = self.chassis.acquired(task) - task.position
        known = {_N_CHANNELS: len(task.channels), _AVAILABLE: waiting}
        value = _known(known, request.attribute_raw)
        return messages.GetReadAttributeUInt32Response(value=value)

    @_answers
    def GetReadAttributeUInt64(self, request: Any) -> Any:
        task = self.chassis.task(request.task.name)
        known = {_READ_POSITION: task.position, _TOTAL_ACQUIRED: self.chassis.acquired(task)}
        value = _known(known, request.attribute_raw)
        return messages.GetReadAttributeUInt64Response(value=value)

    @_answers
    def GetReadAttributeInt32(self, request: Any) -> Any:
        task = self.chassis.task(request.task.name)
        mode = OverwriteMode.OVERWRITE_UNREAD_SAMPLES
        where = ReadRelativeTo.CURRENT_READ_POSITION
        known = {
            _RELATIVE_TO: (ReadRelativeTo.MOST_RECENT_SAMPLE if task.newest else where).value,
            _OFFSET: task.offset,
            _OVERWRITE: (mode if task.overwrite else OverwriteMode.DO_NOT_OVERWRITE_UNREAD_SAMPLES).value,
        }
        value = _known(known, request.attribute_raw)
        return messages.GetReadAttributeInt32Response(value=value)

    @_answers
    def SetReadAttributeInt32(self, request: Any) -> Any:
        task, value = self.chassis.task(request.task.name), request.value_raw
        if request.attribute_raw == _RELATIVE_TO:
            task.newest = value == ReadRelativeTo.MOST_RECENT_SAMPLE.value
        elif request.attribute_raw == _OFFSET:
            task.offset = value
        elif request.attribute_raw == _OVERWRITE:
            task.overwrite = value == OverwriteMode.OVERWRITE_UNREAD_SAMPLES.value
        else:
            _known({}, request.attribute_raw)
        return messages.SetReadAttributeInt32Response()

    @_answers
    def GetBufferAttributeUInt32(self, request: Any) -> Any:
        samples = self.chassis.task(request.task.name).buffer_samples
        value = _known({_BUFFER: samples}, request.attribute_raw)
        return messages.GetBufferAttributeUInt32Response(value=value)

    @_answers
    def GetChanAttributeInt32(self, request: Any) -> Any:
        (channel, *_) = self._channels(request)
        coupling = Coupling.AC if channel.ac_coupled else Coupling.DC
        known = {_CHANNEL_TYPE: ChannelType.ANALOG_INPUT.value, _COUPLING: coupling.value}
        value = _known(known, request.attribute_raw)
        return messages.GetChanAttributeInt32Response(value_raw=value)

    @_answers
    def SetChanAttributeInt32(self, request: Any) -> Any:
        _known({_COUPLING: 0}, request.attribute_raw)
        for channel in self._channels(request):
            channel.ac_coupled = request.value_raw == Coupling.AC.value
        return messages.SetChanAttributeInt32Response()

    @_answers
    def GetChanAttributeString(self, request: Any) -> Any:
        (channel, *_) = self._channels(request)
        value = _known({_PHYSICAL_NAME: channel.physical}, request.attribute_raw)
        return messages.GetChanAttributeStringResponse(value=value)

    def _names(self, task: device.Task) -> str:
        names = [channel.name for channel in task.channels]
        return ", ".join(reversed(names) if self.chassis.swapped else names)

    def _channels(self, request: Any) -> list[device.Channel]:
        wanted = [name.strip() for name in request.channel.split(",")]
        channels = self.chassis.task(request.task.name).channels
        chosen = [c for c in channels if c.name in wanted or c.physical in wanted]
        if not chosen:
            raise device.DaqFault(device.NO_SUCH_CHANNEL, f"no channel {request.channel!r}")
        return chosen


def _known(values: dict[int, Any], attribute: int) -> Any:
    if attribute not in values:
        text = f"attribute 0x{attribute:X} is not known here"
        raise device.DaqFault(device.UNKNOWN_ATTRIBUTE, text)
    return values[attribute]


def _obey(chassis: device.Chassis, command: dict[str, Any]) -> dict[str, Any]:
    """Carry out one line of the control input and return the answer."""
    action = command.get("do")
    if action == "overrun":
        chassis.overrun(int(command["samples"]))
    elif action == "remove":
        chassis.removed.add(str(command["device"]))
    elif action == "restore":
        chassis.removed.clear()
    elif action == "silence":
        chassis.silent_until_s = chassis.clock() + float(command["seconds"])
    elif action == "swap":
        chassis.swapped = True
    elif action != "status":
        return {"done": False, "unknown": str(action)[:40]}
    running = [vars(task) | {"channels": len(task.channels)} for task in chassis.tasks.values()]
    return {"done": True, "tasks": running}


def _recorded(path: Path, channels: tuple[str, ...]) -> dict[str, Any]:
    """Return accelerations in g of a Parquet file by physical channel.

    Columns in ``_g`` are plugged in one by one, three to a module, as triaxial sensors are.
    """
    columns = {n: v for n, v in columns_of(read_parquet(path)).items() if n.endswith("_g")}
    used = [name for name in channels if not name.endswith(f"ai{device.CHANNELS_PER_MODULE - 1}")]
    if not columns or len(columns) > len(used):
        raise InputError(
            "the recording does not fit the modules",
            code="daq.recording",
            where=str(path),
            got=f"{len(columns)} columns in g",
            allowed=f"1 to {len(used)}",
        )
    return dict(zip(used, columns.values(), strict=False))


def main(arguments: list[str] | None = None) -> int:
    """Serve until the input ends (with ``--control``) or the process is ended."""
    parser = argparse.ArgumentParser(prog="python -m studies.machines.daq_server")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--modules", default="cDAQ1Mod1,cDAQ1Mod2")
    parser.add_argument("--signals", type=Path, help="Parquet file whose columns in g are played")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--control", action="store_true")
    options = parser.parse_args(arguments)
    try:
        if not ipaddress.ip_address(options.host).is_loopback:
            raise InputError("only loopback is served", code="daq.host", got=options.host)
        modules = tuple(options.modules.split(","))
        channels = tuple(f"{m}/ai{n}" for m in modules for n in range(device.CHANNELS_PER_MODULE))
        played = _recorded(options.signals, channels) if options.signals else None
        chassis = device.Chassis(modules, Sensors(channels, played, options.seed))
        _serve(chassis, f"{options.host}:{options.port}", options.control)
    except DtwinError as error:
        print(error.render(), file=sys.stderr)
        return error.exit_code
    return 0


def _serve(chassis: device.Chassis, address: str, control: bool) -> None:
    server = grpc.server(futures.ThreadPoolExecutor(4), options=[("grpc.so_reuseport", 0)])
    stubs.add_NiDAQmxServicer_to_server(_DaqService(chassis), server)
    port = server.add_insecure_port(address)
    server.start()
    print(json.dumps({"ready": True, "port": port}), flush=True)
    try:
        for line in sys.stdin if control else ():
            command = json.loads(line)
            if command.get("do") == "quit":
                break
            print(json.dumps(_obey(chassis, command)), flush=True)
        if not control:
            threading.Event().wait()
    except KeyboardInterrupt:
        pass
    finally:
        server.stop(None).wait()


if __name__ == "__main__":
    sys.exit(main())
