"""Windows and watch of signals that a control sends, against the code that trains."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dtwin.features.sine import fit_tone
from dtwin.features.tone_window import tone_contract
from dtwin.features.windows import StreamingWindow
from dtwin.links.layout import LiveValues
from dtwin.serve._axis_inputs import _ChannelWindows, _ToneWatch

RATE_HZ = 200.0


def test_windows_are_those_of_the_training_stream() -> None:
    contract = tone_contract(RATE_HZ, "tool_z_g")
    rng = np.random.default_rng(3)
    samples = rng.normal(size=(2, round(8.3 * RATE_HZ)))
    windows, stream = _ChannelWindows(contract), StreamingWindow(contract)
    expected = stream.push(samples).values
    kernel, found = contract.kernel(), []
    for number in range(samples.shape[1]):
        windows.push(samples[:, number])
        block, age_s = windows.newest_window()
        assert windows.ready == (number + 1 >= contract.n_samples)
        if block is None:
            continue
        assert age_s == 0.0
        values, codes = np.zeros((2, 12)), np.zeros(2, dtype=np.int64)
        flat = np.ascontiguousarray(block).reshape(-1)
        kernel.compute(flat, 0, contract.n_samples, values, codes)
        found.append(values)
    assert len(found) == 4
    np.testing.assert_array_equal(np.array(found), expected)
    assert windows.newest_window() == (None, pytest.approx(60 / RATE_HZ))
    windows.forget()
    assert windows.newest_window() == (None, math.inf)


def test_a_window_that_was_fetched_late_is_whole() -> None:
    contract = tone_contract(RATE_HZ, "tool_z_g")
    windows = _ChannelWindows(contract)
    samples = np.arange(2.0 * (contract.n_samples + 7)).reshape(2, -1)
    for number in range(samples.shape[1]):
        windows.push(samples[:, number])
    block, age_s = windows.newest_window()
    assert block is not None
    np.testing.assert_array_equal(block, samples[:, : contract.n_samples])
    assert age_s == pytest.approx(7 / RATE_HZ)


def foretold(watch: _ToneWatch, sent_um: float, lag: float, gain: float, lead: float) -> float:
    """Feed a second of a 12 Hz tone of 4 um, and return what the watch foretells."""
    t = np.arange(round(RATE_HZ)) / RATE_HZ
    angle = 2.0 * np.pi * 12.0 * t
    commanded, sent = 4.0 * np.sin(angle), sent_um * np.sin(angle + 0.2)
    for row in zip(commanded, sent, np.mod(angle + lead, 2.0 * np.pi), strict=True):
        watch.sample(*map(float, row))
    watch.window({"gain_1": gain, "phase_error_rad": lag}, inside=True)
    made = gain * np.exp(-1j * lag) * fit_tone(t, sent, 12.0).phasor
    assert watch.left_um == pytest.approx(abs(made - fit_tone(t, commanded, 12.0).phasor), rel=1e-6)
    return watch.left_um


def test_the_watch_foretells_what_is_left_whatever_the_lead_of_the_phase() -> None:
    watch = _ToneWatch(round(RATE_HZ))
    first = foretold(watch, 4.0, 0.1, 1.2, 0.0)
    assert foretold(watch, 4.0, 0.1, 1.2, 0.7) == pytest.approx(first, rel=1e-6)
    assert foretold(watch, 4.0 / 1.2, 0.2, 1.2, 0.3) == pytest.approx(0.0, abs=1e-9)
    assert watch.alarm == ""


def test_a_correction_that_grows_is_an_alarm_until_another_tone_begins() -> None:
    watch = _ToneWatch(round(RATE_HZ))
    foretold(watch, 4.2, 0.2, 1.0, 0.0)
    foretold(watch, 6.0, 0.2, 1.0, 0.0)
    assert "worse" in watch.alarm
    watch.forget()
    assert watch.alarm == ""


def test_values_are_good_for_three_of_their_own_periods() -> None:
    live = LiveValues({"bed_c": 1.0 / 30.0, "x_mm": 100.0})
    live.take({"bed_c": 21.0, "x_mm": 1.0, "unasked": 5.0}, 0.0)
    assert live.values.tolist() == [21.0, 1.0]
    live.take({"x_mm": 2.0}, 90.0)
    assert live.values.tolist() == [21.0, 2.0]
    live.take({}, 90.05)
    assert live.old() == ("bed_c", "x_mm")
    live.take({"bed_c": 22.0}, 91.0)
    assert live.old() == ("x_mm",)
    live.forget()
    assert live.old() == ("bed_c", "x_mm")
