"""Wrist minus base: subtracted only where it helps."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from dtwin.errors import InputError
from dtwin.features.relative import coherence, wrist_minus_base

RATE_HZ = 1000.0


def noise(seed: int, n: int = 8192) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(n)


def test_coherence_agrees_with_scipy() -> None:
    common = noise(0)
    a, b = common + 0.7 * noise(1), 0.5 * common + 0.3 * noise(2)
    f, value = coherence(a, b, RATE_HZ, 256)
    g, expected = scipy.signal.coherence(a, b, RATE_HZ, nperseg=256)
    np.testing.assert_allclose(f, g)
    np.testing.assert_allclose(value[1:-1], expected[1:-1], rtol=1e-9)


def test_common_motion_is_removed() -> None:
    own, common = 0.3 * noise(3), noise(4)
    found = wrist_minus_base(own + common, common + 0.05 * noise(5), RATE_HZ, (20, 400))
    assert found.subtracted
    assert np.std(found.signal - own) < 0.1
    assert found.gain == pytest.approx(1.0, abs=0.05)


def test_unrelated_base_is_not_subtracted() -> None:
    wrist = noise(6)
    found = wrist_minus_base(wrist, noise(7), RATE_HZ, (20, 400))
    assert not found.subtracted
    assert np.array_equal(found.signal, wrist)
    assert "coherence" in found.reason


def test_coherent_base_of_opposite_sign_is_not_subtracted() -> None:
    common = noise(8)
    found = wrist_minus_base(common, -common, RATE_HZ, (20, 400))
    assert not found.subtracted
    assert found.coherence > 0.99
    assert "louder" in found.reason


def test_silent_sensor_is_not_subtracted() -> None:
    found = wrist_minus_base(noise(9), np.zeros(8192), RATE_HZ, (20, 400))
    assert not found.subtracted
    assert np.isfinite(found.coherence)


def test_too_short_a_record_is_refused() -> None:
    with pytest.raises(InputError, match="too short"):
        coherence(noise(0, 500), noise(1, 500), RATE_HZ, 256)
    with pytest.raises(InputError, match="differ"):
        coherence(noise(0, 5000), noise(1, 5001), RATE_HZ)
    with pytest.raises(InputError, match="no spectral line"):
        wrist_minus_base(noise(0), noise(1), RATE_HZ, (1.0, 2.0))
