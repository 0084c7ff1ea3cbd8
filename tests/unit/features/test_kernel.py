"""The features against scipy, and what they do with windows that have no shape."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal
import scipy.stats
from windows_at_once import window_features

from dtwin.errors import InputError
from dtwin.features.catalogue import FEATURE_NAMES, FEATURES, feature_column, positions
from dtwin.features.kernel import CONSTANT, NOT_FINITE, VALID

RATE_HZ = 1652.0
BAND_HZ = (100.0, 400.0)


def signal(n: int, seed: int = 0, channels: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    t = np.arange(n) / RATE_HZ
    tones = [np.sin(2 * np.pi * (120 + 40 * c) * t) for c in range(channels)]
    return np.array(tones) + 0.4 * rng.gamma(2.0, 1.0, (channels, n)) + 0.3


def by_scipy(x: np.ndarray) -> dict[str, float]:
    f, p = scipy.signal.periodogram(x, RATE_HZ, detrend="constant", scaling="spectrum")
    p[0] = 0.0
    mav, rms, peak = np.mean(np.abs(x)), np.sqrt(np.mean(x**2)), np.max(np.abs(x))
    return {
        "mean_absolute_value": mav,
        "variance": np.var(x),
        "rms": rms,
        "peak_amplitude": peak,
        "shape_factor": rms / mav,
        "impulse_factor": peak / mav,
        "crest_factor": peak / rms,
        "kurtosis": scipy.stats.kurtosis(x, fisher=False),
        "skewness": scipy.stats.skew(x),
        "dominant_frequency": f[np.argmax(p)],
        "mean_frequency": np.sum(f * p) / np.sum(p),
        "band_power": np.sum(p[(f >= BAND_HZ[0]) & (f < BAND_HZ[1])]),
        "total_power": np.mean(x**2),
    }


@pytest.mark.parametrize("n", [1500, 1501, 64, 17, 800])
def test_agrees_with_scipy(n: int) -> None:
    x = signal(n)
    values, codes = window_features(x, RATE_HZ, FEATURE_NAMES, BAND_HZ)
    assert codes.tolist() == [VALID] * 3
    for c in range(3):
        expected = by_scipy(x[c])
        for i, name in enumerate(FEATURE_NAMES):
            assert values[c, i] == pytest.approx(expected[name], rel=1e-9, abs=1e-12), name


def test_spectrum_of_white_noise_holds_the_variance() -> None:
    x = np.random.default_rng(3).standard_normal((2, 1024))
    values, _ = window_features(x, RATE_HZ, ["band_power", "variance"], (0.0, RATE_HZ / 2 + RATE_HZ))
    np.testing.assert_allclose(values[:, 0], values[:, 1], rtol=1e-12)


def test_selection_gives_the_wanted_order() -> None:
    x = signal(300)
    everything, _ = window_features(x, RATE_HZ, FEATURE_NAMES, BAND_HZ)
    some, _ = window_features(x, RATE_HZ, ["kurtosis", "rms"])
    assert np.array_equal(some, everything[:, positions(["kurtosis", "rms"])])


def test_detrended_window_does_not_see_the_offset() -> None:
    x = signal(512)
    plain, _ = window_features(x, RATE_HZ, FEATURE_NAMES, BAND_HZ, remove_mean=True)
    moved, _ = window_features(x + 7.0, RATE_HZ, FEATURE_NAMES, BAND_HZ, remove_mean=True)
    np.testing.assert_allclose(moved, plain, rtol=1e-9)


@pytest.mark.parametrize("level", [0.0, 0.1, -3.7, 1e-40, 12345.678])
def test_constant_window_is_finite_and_flagged(level: float) -> None:
    values, codes = window_features(np.full((1, 1500), level), RATE_HZ, FEATURE_NAMES, BAND_HZ)
    assert codes[0] == CONSTANT
    assert np.isfinite(values).all()
    assert values[0, positions(["variance", "kurtosis", "mean_frequency"])].tolist() == [0, 0, 0]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e200])
@pytest.mark.parametrize("where", [0, 700, 1499])
def test_one_bad_sample_zeroes_and_flags_its_channel_only(bad: float, where: int) -> None:
    x = signal(1500)
    x[1, where] = bad
    values, codes = window_features(x, RATE_HZ, FEATURE_NAMES, BAND_HZ)
    assert codes.tolist() == [VALID, NOT_FINITE, VALID]
    assert not values[1].any()
    assert np.isfinite(values).all()


def test_float32_samples_give_the_features_of_their_exact_values() -> None:
    x = signal(1500).astype(np.float32)
    single, _ = window_features(x, RATE_HZ, FEATURE_NAMES, BAND_HZ)
    double, _ = window_features(x.astype(np.float64), RATE_HZ, FEATURE_NAMES, BAND_HZ)
    assert np.array_equal(single, double)


def test_every_feature_states_unit_formula_and_reference() -> None:
    for item in FEATURES:
        assert item.formula
        assert item.reference
        assert item.unit in {"channel", "channel^2", "1", "Hz"}
    assert feature_column("wrist_x_g", "rms") == "wrist_x_rms_g"
    assert feature_column("wrist_x_g", "band_power") == "wrist_x_band_power_g2"
    assert feature_column("wrist_x_g", "kurtosis") == "wrist_x_kurtosis_1"
    assert feature_column("wrist_x_g", "mean_frequency") == "wrist_x_mean_frequency_hz"


def test_wrong_use_is_refused() -> None:
    x = signal(100)
    with pytest.raises(InputError, match="band"):
        window_features(x, RATE_HZ, ["band_power"])
    with pytest.raises(InputError, match="unknown feature"):
        window_features(x, RATE_HZ, ["frequency"])
    with pytest.raises(InputError, match="twice"):
        window_features(x, RATE_HZ, ["rms", "rms"])
