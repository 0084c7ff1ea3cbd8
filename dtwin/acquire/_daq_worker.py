"""The process that reads the modules for serving; started by ``DaqWindows``, not by hand.

NI's client spends its time in Python and would hold up the serving loop. Here it fills a ring
in shared memory instead. Standard input is the life line: when it ends, sampling ends. A module or
server that is lost is looked for until it is back; no window spans the gap.
"""

from __future__ import annotations

import argparse
import json
import mmap
import os
import select
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

from dtwin.acquire._daq import AccelerometerChannel, AccelerometerTask
from dtwin.acquire._sample_ring import SampleRing
from dtwin.errors import DeviceError, DtwinError

_BACK_OFF_S = 0.2
_LONGEST_BACK_OFF_S = 5.0
_SAME_RATE = 1e-6
_FOR_GOOD = ("daq.channel_order", "daq.setting", "daq.channel_absent", "daq.rate")

_Say = Callable[[Mapping[str, Any]], None]


def _fill(task: AccelerometerTask, ring: SampleRing) -> None:
    """Read blocks into the ring until standard input ends.

    Raises ``DeviceError`` when the module or its server fails.
    """
    task.start()
    while not _ended(0.0):
        block, lost = task.read_block()
        ring.write(block, lost, time.monotonic())


def _keep_filling(task: AccelerometerTask, ring: SampleRing, say: _Say) -> None:
    """Fill the ring, over as many openings as it takes.

    ``task``: open; its rate is the one that has to be met again.
    ``ring``: what is read is added to it.
    ``say``: told of every fault, and of every return.
    Raises ``DeviceError`` when the modules came back in another order or at another rate.
    """
    rate_hz = task.rate_hz
    while True:
        try:
            _fill(task, ring)
            return
        except DeviceError as error:
            if error.code in _FOR_GOOD:
                raise
            say({"fault": error.as_dict(), "missing": False})
        if not _reopened(task, rate_hz):
            return
        # How long it was away is not known: longer than any window looks back.
        ring.skip()
        say({"ready": True, "rate_hz": rate_hz})


def _reopened(task: AccelerometerTask, rate_hz: float) -> bool:
    """Look for the modules until they are there, or until standard input ends."""
    task.close()
    wait_s = _BACK_OFF_S
    while not _ended(wait_s):
        try:
            task.open()
        except DeviceError as error:
            if error.code in _FOR_GOOD:
                raise
            wait_s = min(2.0 * wait_s, _LONGEST_BACK_OFF_S)
            continue
        if abs(task.rate_hz / rate_hz - 1.0) > _SAME_RATE:
            raise DeviceError(
                "the module came back at another rate",
                code="daq.rate",
                got=f"{task.rate_hz:.10g} Hz",
                allowed=f"{rate_hz:.10g} Hz",
            )
        return True
    return False


def _ended(wait_s: float) -> bool:
    return bool(select.select([sys.stdin], [], [], wait_s)[0])


def main() -> int:
    """Open the modules, say so, and fill the ring; every failure is one message."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--memory", type=int, required=True)
    parser.add_argument("--messages", type=int, required=True)
    parser.add_argument("--capacity", type=int, required=True)
    parser.add_argument("--setup", required=True, help="JSON: channels, rate_hz, block_s, target")
    options = parser.parse_args()

    def say(message: Mapping[str, Any]) -> None:
        os.write(options.messages, (json.dumps(message) + "\n").encode())

    setup = json.loads(options.setup)
    channels = [AccelerometerChannel(**channel) for channel in setup["channels"]]
    memory = mmap.mmap(options.memory, SampleRing.size(len(channels), options.capacity))
    ring = SampleRing(memory, len(channels), options.capacity)
    try:
        with AccelerometerTask(
            channels,
            setup["rate_hz"],
            block_s=setup["block_s"],
            grpc_target=setup["target"],
            timeout_s=setup["timeout_s"],
        ) as task:
            say({"ready": True, "rate_hz": task.rate_hz})
            _keep_filling(task, ring, say)
    except DtwinError as error:
        say({"fault": error.as_dict(), "missing": type(error).__name__ == "MissingPart"})
        return error.exit_code
    except KeyboardInterrupt:
        pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
