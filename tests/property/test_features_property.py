"""What must hold for every signal."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from windows_at_once import window_features

from dtwin.features.catalogue import FEATURE_NAMES, FEATURES
from dtwin.features.windows import StreamingWindow, WindowContract, batch_features

RATE_HZ = 1000.0
BAND_HZ = (40.0, 180.0)
INDEX = {name: i for i, name in enumerate(FEATURE_NAMES)}
SPECTRAL = [f.name for f in FEATURES if f.spectral]
seeds = st.integers(0, 2**32 - 1)
lengths = st.integers(3, 300)


def noise(seed: int, n: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.standard_normal((2, n)) * rng.uniform(0.1, 10) + rng.normal()


def features(x: np.ndarray) -> np.ndarray:
    return window_features(x, RATE_HZ, FEATURE_NAMES, BAND_HZ)[0]


@settings(deadline=None, max_examples=40)
@given(seeds, st.integers(0, 400), st.integers(1, 90), st.integers(2, 80), st.data())
def test_stream_in_any_blocks_is_the_batch_bit_for_bit(
    seed: int, n: int, hop: int, window: int, data: st.DataObject
) -> None:
    contract = WindowContract(RATE_HZ, window, hop, ("a_g", "b_g"), FEATURE_NAMES, BAND_HZ, "none")
    x = np.random.default_rng(seed).standard_normal((2, n)).astype(np.float32)
    stream, parts, at = StreamingWindow(contract, start_s=2.5), [], 0
    while at < n:
        step = data.draw(st.integers(0, 120))
        parts.append(stream.push(x[:, at : at + step]))
        at += step
    whole = batch_features(x, contract, start_s=2.5)
    streamed = [np.zeros((0, 2, len(FEATURE_NAMES)))] + [p.values for p in parts]
    assert np.concatenate(streamed).tobytes() == whole.values.tobytes()
    ends = np.concatenate([np.zeros(0)] + [p.end_s for p in parts])
    assert ends.tobytes() == whole.end_s.tobytes()


@settings(deadline=None, max_examples=40)
@given(seeds, lengths, st.integers(-20, 20))
def test_scaling_by_a_power_of_two_scales_by_the_unit(seed: int, n: int, power: int) -> None:
    x, scale = noise(seed, n), 2.0**power
    plain, scaled = features(x), features(scale * x)
    for item in FEATURES:
        factor = {"channel": scale, "channel^2": scale**2}.get(item.unit, 1.0)
        np.testing.assert_allclose(scaled[:, INDEX[item.name]], factor * plain[:, INDEX[item.name]], rtol=1e-11)


@settings(deadline=None, max_examples=40)
@given(seeds, lengths)
def test_sign_flips_only_the_skewness(seed: int, n: int) -> None:
    x = noise(seed, n)
    plain, flipped = features(x), features(-x)
    plain[:, INDEX["skewness"]] *= -1
    np.testing.assert_array_equal(flipped, plain)


@settings(deadline=None, max_examples=40)
@given(seeds, lengths)
def test_order_of_samples_matters_only_to_the_spectrum(seed: int, n: int) -> None:
    x = noise(seed, n)
    mixed = x[:, np.random.default_rng(seed).permutation(n)]
    time_domain = [INDEX[f.name] for f in FEATURES if not f.spectral]
    np.testing.assert_allclose(features(mixed)[:, time_domain], features(x)[:, time_domain], rtol=1e-8, atol=1e-8)


@settings(deadline=None, max_examples=40)
@given(seeds, lengths)
def test_time_reversal_changes_nothing(seed: int, n: int) -> None:
    x = noise(seed, n)
    keep = [i for name, i in INDEX.items() if name != "dominant_frequency"]
    np.testing.assert_allclose(features(x[:, ::-1])[:, keep], features(x)[:, keep], rtol=1e-8, atol=1e-8)


@settings(deadline=None, max_examples=200)
@given(
    hnp.arrays(
        np.float64,
        st.tuples(st.integers(1, 3), st.integers(2, 40)),
        elements=st.floats(width=64, allow_nan=True, allow_infinity=True),
    )
)
def test_nothing_makes_a_feature_that_is_not_finite(x: np.ndarray) -> None:
    for remove_mean in (False, True):
        values, codes = window_features(x, RATE_HZ, FEATURE_NAMES, BAND_HZ, remove_mean)
        assert np.isfinite(values).all()
        bad = ~np.isfinite(x).all(axis=1)
        assert (codes[bad] != 0).all()


@settings(deadline=None, max_examples=40)
@given(seeds, lengths)
def test_inequalities_of_the_shape_numbers(seed: int, n: int) -> None:
    found = features(noise(seed, n))
    for row in found:
        value = dict(zip(FEATURE_NAMES, row, strict=True))
        assert value["shape_factor"] >= 1 - 1e-12
        assert value["impulse_factor"] >= value["crest_factor"] * (1 - 1e-12)
        assert value["kurtosis"] >= 1 + value["skewness"] ** 2 - 1e-9
        assert 0 <= value["mean_frequency"] <= RATE_HZ / 2 * (1 + 1e-12)
        assert 0 <= value["band_power"] <= value["total_power"] * (1 + 1e-9)
