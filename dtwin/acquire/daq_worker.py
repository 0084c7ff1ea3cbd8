"""The process that reads the modules for serving; started by ``DaqWindows``, not by hand.

NI's client spends its time in Python and would hold up the serving loop. Here it fills a ring
in shared memory instead. Standard input is the life line: when it ends, sampling ends.
"""

from __future__ import annotations

import argparse
import json
import mmap
import os
import select
import sys
import time
from typing import Any

from dtwin.acquire.daq import AccelerometerChannel, AccelerometerTask
from dtwin.acquire.sample_ring import SampleRing
from dtwin.errors import DtwinError


def fill(task: AccelerometerTask, ring: SampleRing) -> None:
    """Read blocks into the ring until standard input ends."""
    task.start()
    while not select.select([sys.stdin], [], [], 0.0)[0]:
        block, lost = task.read_block()
        ring.write(block, lost, time.monotonic())


def main() -> int:
    """Open the modules, say so, and fill the ring; every failure is one message."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--memory", type=int, required=True)
    parser.add_argument("--messages", type=int, required=True)
    parser.add_argument("--capacity", type=int, required=True)
    parser.add_argument("--setup", required=True, help="JSON: channels, rate_hz, block_s, target")
    options = parser.parse_args()

    def say(message: dict[str, Any]) -> None:
        os.write(options.messages, (json.dumps(message) + "\n").encode())

    setup = json.loads(options.setup)
    channels = [AccelerometerChannel(**channel) for channel in setup["channels"]]
    memory = mmap.mmap(options.memory, SampleRing.size(len(channels), options.capacity))
    ring = SampleRing(memory, len(channels), options.capacity)
    try:
        with AccelerometerTask(
            channels, setup["rate_hz"], block_s=setup["block_s"], grpc_target=setup["target"],
            timeout_s=setup["timeout_s"],
        ) as task:  # fmt: skip
            say({"ready": True, "rate_hz": task.rate_hz})
            fill(task, ring)
    except DtwinError as error:
        say({"fault": error.as_dict(), "missing": type(error).__name__ == "MissingPart"})
        return error.exit_code
    except KeyboardInterrupt:
        pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
