"""Commands for corrections as voltages."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from dtwin.commands._output import Json, emit
from dtwin.errors import InputError
from dtwin.report.text import table

_Port = Annotated[str, typer.Argument(help="Serial port of the board, like /dev/ttyACM0.")]
_Calibration = Annotated[Path | None, typer.Option("--calibration", help="What dtwin analogue calibrate wrote.")]

app = typer.Typer(
    name="analogue",
    help="Corrections as voltages, for controls that take them as encoder offsets.",
    no_args_is_help=True,
)


@app.command("build")
def build(
    out: Annotated[Path, typer.Option(help="ELF file to write.")] = Path("analogue_correction.elf"),
    baud: Annotated[int, typer.Option(help="Of the serial port.")] = 250_000,
) -> None:
    """Compile the board's firmware with avr-gcc (ATmega328P at 16 MHz)."""
    from dtwin.links.analogue_firmware import build_firmware

    if baud not in (250_000, 500_000, 1_000_000):
        raise InputError(
            "this baud rate is not exact at 16 MHz",
            code="analogue.baud",
            got=str(baud),
            allowed="250000, 500000, 1000000",
        )
    if out.exists() and not _is_elf(out):
        raise InputError(
            "what is there is no firmware, and would be lost",
            code="analogue.exists",
            where=str(out),
            allowed="a new file, or an ELF file of before",
            hint="--out",
        )
    build_firmware(out, baud)
    print(
        f"{out} written: tried in a simulator, not yet run on a board\n"
        f"next: avr-objcopy -O ihex {out} firmware.hex, then\n"
        f"      avrdude -c arduino -p m328p -P PORT -U flash:w:firmware.hex"
    )


def _is_elf(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(4) == b"\x7fELF"


@app.command("status")
def status(port: _Port, as_json: Json = False) -> None:
    """Ask the board how it is."""
    from dtwin.links.analogue import AnalogueOutput

    output = AnalogueOutput(port)
    try:
        board = output.open()
    finally:
        output.close()
    emit(
        vars(board),
        lambda: (
            f"engaged: {board.engaged}, watchdog tripped: {board.tripped} ({board.trips} times "
            f"since start), garbage: {board.bad_frames} frames, codes {board.applied}"
        ),
        as_json=as_json,
    )


@app.command("hold")
def hold(
    port: _Port,
    offset: Annotated[str, typer.Option(help="x,y,z in µm, like 25,0,0.")],
    seconds: Annotated[float, typer.Option(help="How long.")] = 10.0,
    calibration: _Calibration = None,
    pwm: Annotated[bool, typer.Option("--pwm", help="The eight-bit output.")] = False,
) -> None:
    """Hold a correction, for measuring what it does; the board goes neutral afterwards."""
    import numpy as np

    from dtwin.links.analogue import AnalogueOutput, AxisCalibration
    from dtwin.links.analogue_calibration import load

    try:
        wanted = np.array([float(part) for part in offset.split(",")])
    except ValueError:
        wanted = np.zeros(0)
    if wanted.shape != (3,) or not np.isfinite(wanted).all():
        raise InputError("three numbers are needed", code="analogue.offset", got=offset[:40], allowed="x,y,z in µm")
    known = (AxisCalibration(),) * 3 if calibration is None else load(calibration)
    until_s = time.monotonic() + seconds
    with AnalogueOutput(port, known, output="pwm" if pwm else "dac", watchdog_ms=200) as output:
        output.engage()
        while time.monotonic() < until_s:
            output.send(wanted)
            output.settle()
            time.sleep(0.02)
    print(f"held {seconds:g} s, {output.answered} of {output.sent} answered, then released")


@app.command("calibrate")
def calibrate_inputs(
    points: Annotated[Path, typer.Argument(help="CSV: axis,voltage_v,x_um,y_um,z_um.")],
    out: Annotated[Path, typer.Option(help="File to write.")] = Path("analogue.json"),
    port: Annotated[str | None, typer.Option(help="Board that is to keep the neutral codes.")] = None,
    as_json: Json = False,
) -> None:
    """Fit gain and neutral voltage of every axis to measurements; refuse swapped wires."""
    from dataclasses import asdict

    from dtwin.links.analogue import AnalogueOutput
    from dtwin.links.analogue_calibration import calibrate, calibration_rows, load, read_points, save

    fits = calibrate(read_points(points))
    save(out, fits)
    if port is not None:
        with AnalogueOutput(port, load(out)) as output:
            output.store_neutral()
    head = ("axis", "µm per V (k = 2)", "neutral, V (k = 2)", "noise, µm", "cross-talk", "readings")
    emit(
        {"file": str(out), "axes": {k: asdict(v) for k, v in fits.items()}},
        lambda: f"{table(head, calibration_rows(fits))}\n{out} written",
        as_json=as_json,
    )
