"""Newest accelerometer windows for the serving loop, read by a process of their own."""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import select
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from dtwin.acquire._daq import AccelerometerChannel
from dtwin.acquire._sample_ring import SampleRing
from dtwin.errors import DeviceError, InputError, MissingPart
from dtwin.features.windows import WindowContract
from dtwin.links.opened import Closed
from dtwin.processes import end_child
from dtwin.schema import Floats

_FILTER_SAMPLES = 40.0
"""About what a delta-sigma converter's filter holds back; NI states no formula for the 9234."""

_CLOSE_S = 3.0
_CONNECT_EXTRA_S = 15.0
_LEAST_BLOCKS = 8
# Between reads; part of the age of what is served.
_BLOCK_S = 0.01


class DaqWindows(Closed):
    """Delivers windows to the serving loop without waiting.

    ``contract``: what the model was trained on; rate and channels must be met exactly.
    ``channels``: the contract's channels, in its order.
    ``grpc_target``: as for ``AccelerometerTask``.
    ``timeout_s``: as for ``AccelerometerTask``.
    """

    def __init__(
        self,
        contract: WindowContract,
        channels: Sequence[AccelerometerChannel],
        *,
        grpc_target: str | None = None,
        timeout_s: float = 2.0,
    ) -> None:
        names = tuple(channel.name for channel in channels)
        if names != contract.channels:
            raise InputError(
                "the sensors are not those that the model was trained on",
                code="daq.channels",
                got=", ".join(names)[:200],
                allowed=", ".join(contract.channels)[:200],
            )
        self._contract, self._where = contract, grpc_target or "the local driver"
        blocks_n = int(_BLOCK_S * contract.rate_hz) + 1
        capacity = contract.n_samples + _LEAST_BLOCKS * blocks_n
        size = SampleRing.size(len(names), capacity)
        memory = os.memfd_create("dtwin-daq")
        os.ftruncate(memory, size)
        self._ring = SampleRing(mmap.mmap(memory, size), len(names), capacity)
        self._window = np.zeros((len(names), contract.n_samples))
        self._end, self._read_s = 0, -np.inf
        self._fault: DeviceError | MissingPart | None = None
        self._over = False
        setup = {
            "channels": [asdict(channel) for channel in channels],
            "rate_hz": contract.rate_hz,
            "block_s": _BLOCK_S,
            "target": grpc_target,
            "timeout_s": timeout_s,
        }
        self._start(memory, capacity, json.dumps(setup))
        self._await_ready(timeout_s + _CONNECT_EXTRA_S)

    @property
    def contract(self) -> WindowContract:
        """What is delivered."""
        return self._contract

    def newest_window(self) -> tuple[Floats | None, float]:
        """Return a window (channels, n_samples) newer than the last one, or None, and its age.

        Windows never span a gap. A device that fails delivers no windows until it is back: the
        age grows, and ``fault`` tells why. The array is overwritten by the next window.

        Returns ``window`` (channels, n_samples): in g; None before a whole hop of samples has come.
        Returns ``age_s``: of the newest sample of the newest window, with the converter's filter; infinite before the
        first.
        """
        window: Floats | None = None
        if self._ring.end >= self._end + self._contract.hop or not self._end:
            end, read_s = self._ring.newest(self._window)
            if end:
                self._end, self._read_s = end, read_s
                window = self._window
        delay_s = _FILTER_SAMPLES / self._contract.rate_hz
        return window, time.monotonic() - self._read_s + delay_s

    def fault(self) -> DeviceError | MissingPart | None:
        """Return why no windows come, or None; a device that is back is no fault any more."""
        if not self._over and not self._process.stdin.closed:  # type: ignore[union-attr]
            self._listen(0.0)
        return self._fault

    @property
    def over(self) -> bool:
        """Whether the reading process has ended, as ``fault`` found: it looks for a lost module, and nothing looks for it."""
        return self._over

    def close(self) -> None:
        """End sampling and release the modules; safe to call twice."""
        if self._process.stdin is not None and not self._process.stdin.closed:
            end_child(self._process, _CLOSE_S)
            os.close(self._messages)

    def _start(self, memory: int, capacity: int, setup: str) -> None:
        self._messages, theirs = os.pipe2(os.O_CLOEXEC)
        options = [f"--memory={memory}", f"--messages={theirs}", f"--capacity={capacity}"]
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "dtwin.acquire._daq_worker", *options, f"--setup={setup}"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            pass_fds=(memory, theirs),
            start_new_session=True,
        )
        os.close(theirs)
        os.close(memory)

    def _await_ready(self, timeout_s: float) -> None:
        try:
            message = self._listen(timeout_s)
            if self._fault is not None:
                raise self._fault
            if message is None:
                text = f"the acquisition was not ready within {timeout_s:g} s"
                raise DeviceError(text, code="daq.silent", where=self._where)
            if abs(message["rate_hz"] / self._contract.rate_hz - 1) > 1e-6:
                raise DeviceError(
                    "the module samples at another rate than the model was trained on",
                    code="daq.rate",
                    where=self._where,
                    got=f"{message['rate_hz']:.10g} Hz",
                    allowed=f"{self._contract.rate_hz:.10g} Hz",
                    hint="train at a rate that the module has: 51200 Hz divided by 1 to 31",
                )
        except BaseException:
            self._process.kill()
            self.close()
            raise

    def _listen(self, timeout_s: float) -> dict[str, Any] | None:
        """Return a message of the worker; note its fault, or its death."""
        ready, _, _ = select.select([self._messages], [], [], timeout_s)
        if not ready:
            return None
        said = os.read(self._messages, 65536).splitlines()
        if not said:
            self._over = True
            code = None
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = self._process.wait(_CLOSE_S)
            if self._fault is None:
                self._fault = DeviceError(
                    f"the acquisition process died (exit code {code})",
                    code="daq.worker_died",
                    where=self._where,
                    hint="start again",
                )
            return None
        # Several may have come together; the last one is how it stands.
        message: dict[str, Any] = json.loads(said[-1])
        self._fault = None
        if "fault" in message:
            fields = dict(message["fault"])
            kind = MissingPart if message["missing"] else DeviceError
            self._fault = kind(fields.pop("message"), **fields)
        return message
