"""A board that is not here: the real firmware in simavr behind a pseudo-terminal.

Only the microcontroller's silicon and the converter chip are simulated; see
``simulated_analogue_board.c``. The firmware is compiled with avr-gcc as for a real board.
"""

from __future__ import annotations

import subprocess
import threading
from pathlib import Path
from types import TracebackType
from typing import Self

from dtwin.links.analogue_firmware import _compiled, build_firmware

_BOARD = Path(__file__).with_name("simulated_analogue_board.c")


def build_board(out: Path) -> Path:
    """Compile the simulated board and return the program."""
    return _compiled(["gcc", "-O2", "-I/usr/include/simavr", str(_BOARD), "-lsimavr", "-lelf"], out)


class AnalogueBoard:
    """A running board.

    ``folder``: where programs and the EEPROM's content are kept.
    ``stuck_bits``: bits of the x channel that never become one: a broken converter.
    ``changes``: clock cycles (16 MHz) at which a voltage changed.
    ``changed_to``: what the three voltages were then.
    """

    def __init__(self, folder: Path, *, baud: int = 250_000, stuck_bits: int = 0) -> None:
        self._folder, self._baud, self._stuck = folder, baud, stuck_bits
        self._process: subprocess.Popen[str] | None = None
        self._volts: dict[str, tuple[float, float, float]] = {}
        self._changed = threading.Condition()
        self.port = ""
        self.changes: list[int] = []
        self.changed_to: list[tuple[float, float, float]] = []

    def __enter__(self) -> Self:
        """Build what is not there, and switch the board on."""
        firmware = self._folder / f"analogue_correction-{self._baud}.elf"
        program = self._folder / "analogue_board"
        if not firmware.exists():
            build_firmware(firmware, self._baud)
        if not program.exists():
            build_board(program)
        self._process = subprocess.Popen(
            [str(program), str(firmware), str(self._baud), str(self._folder / "eeprom.bin"), hex(self._stuck)],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("port "):
                self.port = line.split()[1]
                break
        threading.Thread(target=self._listen, daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Switch the board off; its EEPROM keeps."""
        assert self._process is not None
        self._process.terminate()
        self._process.wait(300)

    @property
    def process_id(self) -> int:
        """Process id of the simulator."""
        assert self._process is not None
        return self._process.pid

    def volts(self, source: str = "dac") -> tuple[float, float, float]:
        """Return the voltages at the terminals now: source ``dac`` or ``pwm``."""
        with self._changed:
            return self._volts.get(source, (0.0, 0.0, 0.0))

    def wait_for(self, wanted: tuple[float, float, float], source: str = "dac", timeout_s: float = 300.0) -> bool:
        """Wait until the terminals are within a step of the wanted voltages."""
        step = 0.0002 if source == "dac" else 0.04

        def there() -> bool:
            now = self._volts.get(source, (0.0, 0.0, 0.0))
            return all(abs(a - b) <= step for a, b in zip(now, wanted, strict=True))

        with self._changed:
            return self._changed.wait_for(there, timeout_s)

    def _listen(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        for line in self._process.stdout:
            words = line.split()
            if len(words) == 5 and words[1] in ("dac", "pwm"):
                with self._changed:
                    volts = float(words[2]), float(words[3]), float(words[4])
                    self.changes.append(int(words[0]))
                    self.changed_to.append(volts)
                    self._volts[words[1]] = volts
                    self._changed.notify_all()
