"""Corrections per second through the analogue board, by the board's own clock.

The firmware runs in simavr, so that a second is 16 million cycles whatever the computer does
beside; the host's part is the real client on a pseudo-terminal. A correction counts when the
output changes. The limit is what the answers need on the line: 19 bytes each, of 10 bits on a
real line, of 11 in simavr. Requests (14 bytes) travel at the same time.

simavr takes 100 us for every byte on SPI, whatever its clock; a microcontroller takes 1 to 2. The
27 bytes that writing and reading back three channels needs cost 2.7 ms here: the line shows itself
in the eight-bit mode only, which uses no SPI.

Run: python benchmarks/bench_analogue.py [--json]   (needs avr-gcc and libsimavr)
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from simulated_analogue_board import AnalogueBoard

from dtwin.links.analogue import _BAUD, AnalogueOutput, _Output

CLOCK_HZ, ANSWER_BYTES = 16e6, 19
WARM_UP = 50


def measured(mode: _Output, in_flight: int, corrections: int) -> dict[str, float | str]:
    with tempfile.TemporaryDirectory() as scratch, AnalogueBoard(Path(scratch)) as board:
        # A busy computer may simulate the board slower than it is.
        output = AnalogueOutput(board.port, output=mode, watchdog_ms=1000, in_flight=in_flight, timeout_s=5.0)
        with output:
            output.engage()
            begun, first = time.monotonic(), len(board.changes)
            for i in range(corrections):
                # Every code is another one in both modes, so that every correction shows.
                output.send(np.array([(i % 100), 0.0, 0.0]))
            output.settle()
            wall_s = time.monotonic() - begun
            time.sleep(0.2)
            cycles = np.array(board.changes[first:][:corrections], dtype=float)
        steps_s = np.diff(cycles[WARM_UP:]) / CLOCK_HZ
        return {
            "output": mode,
            "in_flight": in_flight,
            "seen": len(cycles),
            "per_second_board": 1.0 / float(steps_s.mean()),
            "per_second_wall": corrections / wall_s,
            "longest_gap_ms": 1e3 * float(steps_s.max()),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    parser.add_argument("--corrections", type=int, default=3000)
    arguments = parser.parse_args()
    arguments.corrections = 100 if arguments.short else arguments.corrections
    load = os.getloadavg()[0]
    modes: tuple[_Output, ...] = ("dac", "pwm")
    found = [measured(m, n, arguments.corrections) for m in modes for n in (1, 4)]
    limits = {f"{bits} bits a byte": _BAUD / bits / ANSWER_BYTES for bits in (10, 11)}
    if arguments.json:
        print(json.dumps({"load_before": load, "limits_per_second": limits, "measured": found}))
        return
    print(f"{_BAUD} baud; load before {load:.2f}")
    for name, limit in limits.items():
        print(f"  limit of the line, {name}: {limit:.0f} corrections/s")
    simulated = limits["11 bits a byte"]
    for got in found:
        print(
            f"  {got['output']}, {got['in_flight']} in flight: {got['per_second_board']:.0f}/s by the board's clock "
            f"({100 * got['per_second_board'] / simulated:.0f} % of the simulated line), "
            f"{got['per_second_wall']:.0f}/s on the wall; longest gap {got['longest_gap_ms']:.1f} ms; "
            f"{got['seen']} of {arguments.corrections} seen"
        )


if __name__ == "__main__":
    main()
