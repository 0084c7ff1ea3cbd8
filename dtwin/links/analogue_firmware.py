"""The analogue board's firmware, compiled for a real microcontroller."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path

from dtwin.errors import MissingPart

_PACKAGES = "gcc-avr avr-libc libsimavr-dev libelf-dev gcc"
_FIRMWARE = Path(__file__).parent / "firmware" / "analogue_correction.c"


def build_firmware(out: Path, baud: int = 250_000) -> Path:
    """Compile the firmware for an ATmega328P at 16 MHz and return the ELF file.

    ``baud``: of its serial port; 250000, 500000 and 1000000 are exact at 16 MHz.
    Raises ``MissingPart`` when avr-gcc is not here or does not compile it.
    """
    return _compiled(
        [
            "avr-gcc",
            "-mmcu=atmega328p",
            "-DF_CPU=16000000UL",
            f"-DBAUD={baud}UL",
            "-Os",
            "-std=gnu11",
            "-Wall",
            "-Wextra",
            "-Werror",
            str(_FIRMWARE),
        ],
        out,
    )


def _compiled(command: Sequence[str], out: Path) -> Path:
    """Run a compiler and return what it wrote.

    ``command``: compiler and arguments, without the output.
    Raises ``MissingPart`` when the compiler is not here, or fails.
    """
    # Inputs before libraries: the linker reads from left to right.
    full = [command[0], "-o", str(out), *command[1:]]
    try:
        done = subprocess.run(full, capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise MissingPart(
            f"{command[0]} is not installed", code="board.compiler", hint=f"apt install {_PACKAGES}"
        ) from error
    if done.returncode:
        raise MissingPart(
            f"{command[0]} does not compile {Path(full[-1]).name}"
            if full[-1].endswith(".c")
            else f"{command[0]} does not build {out.name}",
            code="board.build",
            got=done.stderr.strip()[:300],
            hint=f"apt install {_PACKAGES}",
        )
    return out
