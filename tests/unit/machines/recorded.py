"""Reads the real ball-bar recording and computes the figures that virtual ones must meet."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

BANDS_HZ = ((0, 1), (1, 2), (2, 5), (5, 8), (8, 12), (12, 20), (20, 40))
SAMPLE = Path(__file__).parents[3] / "data" / "samples" / "ur10e_xy_r100_f5000.b5r"


def real_readings_um() -> dict[str, np.ndarray]:
    blocks = re.findall(
        r"<RUN_DIRECTION>(C?CW)</RUN_DIRECTION>\s*<RUN_TEMP.*?<READINGS>(.*?)</READINGS>", SAMPLE.read_text(), re.DOTALL
    )
    return {
        direction: 1e3 * np.array([float(x) for x in re.findall(r"[+-]\d+\.\d+", "".join(t.split()))])
        for direction, t in blocks
    }


def highpassed(readings_um: np.ndarray, corner_hz: float = 20.0) -> np.ndarray:
    spectrum = np.fft.rfft(readings_um)
    spectrum[np.fft.rfftfreq(len(readings_um), 1 / 200) < corner_hz] = 0
    return np.fft.irfft(spectrum, len(readings_um))


def stops(readings_um: np.ndarray) -> list[int]:
    """Samples of the strongest bursts above 20 Hz that are half a revolution apart."""
    power = np.convolve(highpassed(readings_um) ** 2, np.ones(20) / 20, "same")
    power[:100] = 0
    power[-20:] = 0
    found: list[int] = []
    while len(found) < 3:
        peak = int(np.argmax(power))
        found.append(peak)
        power[max(0, peak - 400) : peak + 400] = 0
    return sorted(found)


def without_centre(readings_um: np.ndarray) -> np.ndarray:
    angle = 2 * np.pi * np.arange(len(readings_um)) / len(readings_um)
    terms = np.column_stack([np.ones(len(angle)), np.cos(angle), np.sin(angle)])
    return readings_um - terms @ np.linalg.lstsq(terms, readings_um, rcond=None)[0]


def band_rms_um(profile_um: np.ndarray) -> np.ndarray:
    lines = np.abs(np.fft.rfft(profile_um) / len(profile_um)) ** 2
    hz = np.fft.rfftfreq(len(profile_um), 1 / 200)
    return np.array([np.sqrt(2 * lines[(hz >= low) & (hz < high)].sum()) for low, high in BANDS_HZ])


def burst_rms_um(readings_um: np.ndarray, places: list[int]) -> float:
    fast = highpassed(readings_um)
    return float(np.sqrt(np.mean([np.mean(fast[p - 20 : p + 20] ** 2) for p in places])))
