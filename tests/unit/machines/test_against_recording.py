"""The committed machine resembles the real robot in the one recording there is of it."""

from __future__ import annotations

import numpy as np
import pytest
from recorded import BANDS_HZ, band_rms_um, burst_rms_um, highpassed, real_readings_um, stops, without_centre

from dtwin.machines.cobot import CircleCondition, CobotRecording, VirtualCobot

DIRECTIONS = ("CCW", "CW")


@pytest.fixture(scope="module")
def real() -> dict[str, np.ndarray]:
    return real_readings_um()


@pytest.fixture(scope="module")
def virtual() -> dict[str, CobotRecording]:
    cobot = VirtualCobot()
    return {d: cobot.measure(CircleCondition("XY", 100, 5000, d), setup="s1", repeat=1) for d in DIRECTIONS}


def real_turn(readings: np.ndarray) -> np.ndarray:
    first, _, last = stops(readings)
    return without_centre(readings[first:last])


def virtual_turn(recording: CobotRecording) -> np.ndarray:
    start, end = recording.window
    return without_centre(1e3 * recording.deviation_mm[start:end])


def test_total_and_bands_are_within_a_fifth(real: dict[str, np.ndarray], virtual: dict[str, CobotRecording]) -> None:
    wanted = {d: real_turn(real[d]) for d in DIRECTIONS}
    got = {d: virtual_turn(virtual[d]) for d in DIRECTIONS}
    for d in DIRECTIONS:
        assert got[d].std() == pytest.approx(wanted[d].std(), rel=0.2)
    both_wanted = np.sqrt(np.mean([band_rms_um(wanted[d]) ** 2 for d in DIRECTIONS], axis=0))
    both_got = np.sqrt(np.mean([band_rms_um(got[d]) ** 2 for d in DIRECTIONS], axis=0))
    ratio = dict(zip(BANDS_HZ, both_got / both_wanted, strict=True))
    assert all(0.8 < r < 1.2 for r in ratio.values()), ratio


def test_line_near_nine_and_a_half_hertz(virtual: dict[str, CobotRecording]) -> None:
    for recording in virtual.values():
        turn = virtual_turn(recording)
        lines = np.abs(np.fft.rfft(turn))
        hz = np.fft.rfftfreq(len(turn), 1 / 200)
        near = (hz > 7) & (hz < 13)
        assert hz[near][np.argmax(lines[near])] == pytest.approx(9.4, abs=0.66)  # bandwidth of the mode


def test_mean_feed_is_three_to_five_percent_low(virtual: dict[str, CobotRecording]) -> None:
    for recording in virtual.values():
        start, end = recording.window
        feed_mm_min = 2 * np.pi * 100 / ((end - start) / 200) * 60
        assert 0.95 < feed_mm_min / 5000 < 0.97


def test_stops_show_as_bursts(real: dict[str, np.ndarray], virtual: dict[str, CobotRecording]) -> None:
    for d in DIRECTIONS:
        readings = 1e3 * virtual[d].deviation_mm
        start, end = virtual[d].window
        quiet = np.median(np.abs(highpassed(readings)))
        wanted = burst_rms_um(real[d], stops(real[d]))
        got = burst_rms_um(readings, [start, (start + end) // 2, end])
        assert got > 4 * quiet
        assert 0.4 < got / wanted < 2.0


def test_next_turn_repeats_but_for_eight_micrometres(virtual: dict[str, CobotRecording]) -> None:
    for recording in virtual.values():
        start, end = recording.window
        readings = 1e3 * recording.deviation_mm
        half = (end - start) // 2
        before = readings[start - half + 300 : start]
        after = readings[end - half + 300 : end]
        assert 5 < (before - after).std() / np.sqrt(2) < 11
        assert np.corrcoef(before, after)[0, 1] > 0.95


def test_directions_do_not_resemble_each_other(virtual: dict[str, CobotRecording]) -> None:
    profiles = []
    grid = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    for recording in virtual.values():
        turn = virtual_turn(recording)
        truth = recording.truth
        start, end = recording.window
        t_s = truth.bar_start_s + np.arange(start, end) / 200
        angle = np.interp(t_s, truth.t_s, truth.angle_rad) % (2 * np.pi)
        order = np.argsort(angle)
        profiles.append(np.interp(grid, angle[order], turn[order], period=2 * np.pi))
    assert abs(np.corrcoef(profiles)[0, 1]) < 0.2
