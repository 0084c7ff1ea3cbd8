"""The window that tells amplitude and phase of the next second: five seconds, twelve features."""

from __future__ import annotations

import numpy as np

from dtwin.features.catalogue import feature_column
from dtwin.features.windows import WindowContract
from dtwin.schema import Floats

_WINDOW_S, HORIZON_S = 5.0, 1.0
# The twelve of the published table, in its order.
TONE_FEATURES = (
    "dominant_frequency",
    "mean_absolute_value",
    "variance",
    "peak_amplitude",
    "rms",
    "kurtosis",
    "skewness",
    "crest_factor",
    "impulse_factor",
    "shape_factor",
    "mean_frequency",
    "total_power",
)
SENT = "sent_z_um"
# The same without correction; a watch compares both.
COMMANDED = "command_z_um"
# What a tick must know of the commanded sine, at the instant when its correction will arrive.
COMMAND_PHASE, COMMAND_AMPLITUDE = "command_phase_rad", "command_amplitude_um"


def tone_contract(rate_hz: float, channel: str) -> WindowContract:
    """Return the window of the sent command and one accelerometer channel, a column with its unit at the end."""
    return WindowContract(
        rate_hz=rate_hz,
        n_samples=round(_WINDOW_S * rate_hz),
        hop=round(HORIZON_S * rate_hz),
        channels=(SENT, channel),
        features=TONE_FEATURES,
        detrend="mean",
    )


def tone_columns(channel: str) -> tuple[str, ...]:
    """Return the columns of the twelve features of a channel."""
    return tuple(feature_column(channel, name) for name in TONE_FEATURES)


def tone_features(sent_um: Floats, acceleration: Floats, contract: WindowContract) -> Floats:
    """Return the features of the first window, shape (2, 12).

    ``sent_um``, ``acceleration``, shape (n,): the command as it was sent, and the accelerometer, at the contract's
    rate.
    ``contract``: from :func:`tone_contract`.
    """
    block = np.stack([sent_um, acceleration])[:, : contract.n_samples]
    values = np.zeros((2, len(contract.features)))
    codes = np.zeros(2, dtype=np.int64)
    flat = np.ascontiguousarray(block, dtype=np.float64).reshape(-1)
    contract.kernel().compute(flat, 0, block.shape[1], values, codes)
    return values
