"""Window contract, batch and stream."""

from __future__ import annotations

import json

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.features.windows import StreamingWindow, WindowContract, batch_features

CONTRACT = WindowContract(
    rate_hz=1000.0,
    n_samples=64,
    hop=10,
    channels=("wrist_x_g", "wrist_y_g"),
    features=("rms", "kurtosis", "mean_frequency", "band_power"),
    band_hz=(50.0, 200.0),
    detrend="mean",
)


def test_contract_survives_json() -> None:
    assert WindowContract.from_dict(json.loads(json.dumps(CONTRACT.to_dict()))) == CONTRACT


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("rate_hz", 0.0),
        ("rate_hz", float("nan")),
        ("rate_hz", "1000"),
        ("n_samples", 1),
        ("n_samples", 10**9),
        ("n_samples", 64.0),
        ("n_samples", True),
        ("hop", 0),
        ("channels", []),
        ("channels", ["a_g", "a_g"]),
        ("channels", [1, 2]),
        ("features", ["rms", "nonsense"]),
        ("features", ["rms", "rms"]),
        ("features", []),
        ("band_hz", None),
        ("band_hz", [200.0, 50.0]),
        ("band_hz", [50.0]),
        ("band_hz", [50.0, 501.0]),
        ("detrend", "linear"),
    ],
)
def test_unusable_contract_is_refused(field: str, value: object) -> None:
    with pytest.raises(InputError):
        WindowContract.from_dict(CONTRACT.to_dict() | {field: value})


def test_unknown_or_missing_field_is_refused() -> None:
    plain = CONTRACT.to_dict()
    with pytest.raises(InputError, match="other fields"):
        WindowContract.from_dict(plain | {"taper": "hann"})
    del plain["hop"]
    with pytest.raises(InputError, match="other fields"):
        WindowContract.from_dict(plain)


def test_columns_name_channel_feature_and_unit() -> None:
    assert CONTRACT.columns[:4] == (
        "wrist_x_rms_g",
        "wrist_x_kurtosis_1",
        "wrist_x_mean_frequency_hz",
        "wrist_x_band_power_g2",
    )


def test_a_window_is_stamped_with_its_last_sample() -> None:
    x = np.zeros((2, 100))
    x[:, 63] = 1.0
    found = batch_features(x, CONTRACT, start_s=5.0)
    np.testing.assert_allclose(found.end_s, 5.0 + np.array([63, 73, 83, 93]) / 1000.0)
    late = np.zeros((2, 100))
    late[:, 64] = 1.0
    assert not batch_features(late, CONTRACT).values[0, :, 0].any()
    assert batch_features(late, CONTRACT).values[1, :, 0].all()


def test_recording_shorter_than_a_window_has_none() -> None:
    assert batch_features(np.zeros((2, 63)), CONTRACT).values.shape == (0, 2, 4)


def test_hop_longer_than_the_window() -> None:
    sparse = WindowContract(1000.0, 16, 50, ("a_g",), ("rms",))
    x = np.random.default_rng(0).standard_normal((1, 500))
    stream = StreamingWindow(sparse)
    parts = [stream.push(x[:, i : i + 7]) for i in range(0, 500, 7)]
    whole = batch_features(x, sparse)
    assert np.array_equal(np.concatenate([p.values for p in parts]), whole.values)


def test_newest_is_the_last_n_samples_whatever_the_hop() -> None:
    x = np.random.default_rng(1).standard_normal((2, 100))
    stream = StreamingWindow(CONTRACT)
    values, codes = np.zeros((2, 4)), np.zeros(2, dtype=np.int64)
    stream.push(x[:, :63])
    assert not stream.newest(values, codes)
    stream.push(x[:, 63:])
    assert stream.newest(values, codes)
    assert np.array_equal(values, batch_features(x[:, 36:], CONTRACT).values[0])


def test_after_a_gap_no_window_spans_it() -> None:
    x = np.random.default_rng(2).standard_normal((2, 200))
    stream = StreamingWindow(CONTRACT)
    stream.push(x[:, :60])
    stream.reset(start_s=9.0)
    after = stream.push(x[:, 60:])
    whole = batch_features(x[:, 60:], CONTRACT, start_s=9.0)
    assert np.array_equal(after.values, whole.values)
    assert np.array_equal(after.end_s, whole.end_s)


def test_wrong_channels_are_refused() -> None:
    with pytest.raises(InputError, match="not those of the window contract"):
        StreamingWindow(CONTRACT).push(np.zeros((3, 10)))
