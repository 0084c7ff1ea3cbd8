"""Windows over a recording and over a stream; both give the same bits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.features.catalogue import feature, feature_column
from dtwin.features.kernel import Codes, WindowKernel
from dtwin.schema import Floats

_MAX_SAMPLES = 1_000_000
_MAX_CHANNELS = 256
# Windows that are computed together: the memory that a long recording needs.
_AT_ONCE = 512


@dataclass(frozen=True)
class WindowContract:
    """What a model was trained on and must be served with.

    Attributes:
        n_samples, hop: Samples per window, and samples from one window's end to the next one's.
        channels: Channel columns, units at their ends; the order is part of the contract.
        band_hz: Band of ``band_power``.
        detrend: What is taken out of a window first. One of "none", "mean".
    """

    rate_hz: float
    n_samples: int
    hop: int
    channels: tuple[str, ...]
    features: tuple[str, ...]
    band_hz: tuple[float, float] | None = None
    detrend: str = "none"

    def __post_init__(self) -> None:
        problem = self._problem()
        if problem:
            raise InputError("unusable window contract", code="window.contract", got=problem)
        for name in self.features:
            feature(name)

    def _problem(self) -> str | None:
        if not (math.isfinite(self.rate_hz) and self.rate_hz > 0):
            return f"rate_hz = {self.rate_hz}"
        if not 2 <= self.n_samples <= _MAX_SAMPLES:
            return f"n_samples = {self.n_samples}"
        if not 1 <= self.hop <= _MAX_SAMPLES:
            return f"hop = {self.hop}"
        if not 1 <= len(self.channels) <= _MAX_CHANNELS or not self.features:
            return "no channel, too many channels, or no feature"
        if len(set(self.channels)) < len(self.channels):
            return "a channel is named twice"
        if len(set(self.features)) < len(self.features):
            return "a feature is named twice"
        if self.detrend not in ("none", "mean"):
            return f"detrend = {self.detrend!r}"
        return self._band_problem()

    def _band_problem(self) -> str | None:
        if self.band_hz is None:
            return "band_power without band_hz" if "band_power" in self.features else None
        low, high = self.band_hz
        return None if 0 <= low < high <= self.rate_hz / 2 + 1e-9 else f"band_hz = {self.band_hz}"

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the feature columns, channel by channel, units at their ends."""
        return tuple(feature_column(c, f) for c in self.channels for f in self.features)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        plain = asdict(self)
        return {k: list(v) if isinstance(v, tuple) else v for k, v in plain.items()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> WindowContract:
        """Return the contract that ``to_dict`` described.

        Raises ``InputError`` when a field is missing, unknown or of the wrong type.
        """
        expected = set(cls.__dataclass_fields__)
        if set(data) != expected:
            raise InputError(
                "a window contract has other fields",
                code="window.fields",
                got=", ".join(sorted(map(str, set(data) ^ expected)))[:200],
                allowed=", ".join(sorted(expected)),
            )
        try:
            band = data["band_hz"]
            return cls(
                rate_hz=_number(data["rate_hz"]),
                n_samples=_whole(data["n_samples"]),
                hop=_whole(data["hop"]),
                channels=tuple(_text(c) for c in data["channels"]),
                features=tuple(_text(f) for f in data["features"]),
                band_hz=None if band is None else (_number(band[0]), _number(band[1])),
                detrend=_text(data["detrend"]),
            )
        except (TypeError, IndexError) as error:
            raise InputError(
                "a field of the window contract has the wrong type", code="window.type", got=str(error)[:200]
            ) from error

    def kernel(self, rows: int | None = None) -> WindowKernel:
        """Return the computation that this contract describes, of so many rows of samples: by default one a channel."""
        rows = rows or len(self.channels)
        return WindowKernel(rows, self.n_samples, self.rate_hz, self.features, self.band_hz, self.detrend == "mean")


@dataclass(frozen=True)
class WindowFeatures:
    """Features of successive windows.

    Attributes:
        values: Always finite. Shape (windows, channels, features).
        codes: VALID, CONSTANT or NOT_FINITE. Shape (windows, channels).
        end_s: Time of the last sample of each window on the clock of the recording. Shape (windows,).
    """

    values: Floats
    codes: Codes
    end_s: Floats


def _window_count(n_samples: int, contract: WindowContract) -> int:
    """Return how many whole windows fit in ``n_samples`` samples."""
    return max(0, (n_samples - contract.n_samples) // contract.hop + 1)


def batch_features(signals: NDArray[np.floating], contract: WindowContract, start_s: float = 0.0) -> WindowFeatures:
    """Return the features of every window of a recording.

    Args:
        signals: Samples, channels in the order of the contract. Shape (channels, n).
        start_s: Time of the first sample.

    Raises:
        InputError: When the channels are not those of the contract.
    """
    _require_channels(signals.shape, contract)
    samples = np.ascontiguousarray(signals, dtype=np.float64)
    flat, stride = samples.reshape(-1), samples.shape[1]
    count = _window_count(stride, contract)
    values = np.zeros((len(contract.channels), count, len(contract.features)))
    codes = np.zeros((len(contract.channels), count), dtype=np.int64)
    for first in range(0, count, _AT_ONCE):
        some = slice(first, min(first + _AT_ONCE, count))
        # The rows of one computation are successive windows of a channel: each begins a hop after the one before.
        kernel = contract.kernel(some.stop - first)
        for channel in range(len(contract.channels)):
            begin = channel * stride + first * contract.hop
            kernel.compute(flat, begin, contract.hop, values[channel, some], codes[channel, some])
    ends = np.arange(count) * contract.hop + contract.n_samples - 1
    return WindowFeatures(
        np.ascontiguousarray(values.transpose(1, 0, 2)),
        np.ascontiguousarray(codes.T),
        start_s + ends / contract.rate_hz,
    )


class StreamingWindow:
    """Windows over blocks of any size, as they arrive; ``start_s`` is the time of the first sample."""

    def __init__(self, contract: WindowContract, start_s: float = 0.0) -> None:
        self.contract = contract
        self.start_s = start_s
        self.seen = 0
        self._kernel = contract.kernel()
        self._capacity = 2 * contract.n_samples
        self._buffer = np.zeros((len(contract.channels), self._capacity))
        self._flat = self._buffer.reshape(-1)
        self._held = 0

    def reset(self, start_s: float = 0.0) -> None:
        """Forget all samples, as after a gap; the next sample is the first."""
        self.start_s, self.seen, self._held = start_s, 0, 0

    def push(self, block: NDArray[np.floating]) -> WindowFeatures:
        """Take the next k samples, shape (channels, k), and return the windows that they complete; k may be zero."""
        _require_channels(block.shape, self.contract)
        ends = self._ends(block.shape[1])
        values = np.zeros((len(ends), len(self.contract.channels), len(self.contract.features)))
        codes = np.zeros(values.shape[:2], dtype=np.int64)
        taken = 0
        for i, end in enumerate(ends):
            upto = end + 1 - self.seen + taken
            self._append(block[:, taken:upto])
            taken = upto
            self._compute_newest(values[i], codes[i])
        self._append(block[:, taken:])
        return WindowFeatures(values, codes, self.start_s + ends / self.contract.rate_hz)

    def newest(self, values: Floats, codes: Codes) -> bool:
        """Write the features of the newest ``n_samples`` samples, wherever the hop stands.

        Until a whole window has been seen, write nothing and return False.
        """
        if self._held < self.contract.n_samples:
            return False
        self._compute_newest(values, codes)
        return True

    def _ends(self, k: int) -> NDArray[np.int64]:
        n, hop = self.contract.n_samples, self.contract.hop
        before, after = (_window_count(self.seen, self.contract), _window_count(self.seen + k, self.contract))
        return np.arange(before, after, dtype=np.int64) * hop + n - 1

    def _compute_newest(self, values: Floats, codes: Codes) -> None:
        first = self._held - self.contract.n_samples
        self._kernel.compute(self._flat, first, self._capacity, values, codes)

    def _append(self, block: NDArray[np.floating]) -> None:
        k, n = block.shape[1], self.contract.n_samples
        self.seen += k
        if k > n:
            block, k = block[:, -n:], n
        if self._held + k > self._capacity:
            keep = n - k
            self._buffer[:, :keep] = self._buffer[:, self._held - keep : self._held]
            self._held = keep
        self._buffer[:, self._held : self._held + k] = block
        self._held += k


def _require_channels(shape: tuple[int, ...], contract: WindowContract) -> None:
    if len(shape) != 2 or shape[0] != len(contract.channels):
        raise InputError(
            "the samples are not those of the window contract",
            code="window.channels",
            got=f"array of shape {shape}",
            allowed=f"({len(contract.channels)}, any): {', '.join(contract.channels)[:200]}",
        )


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r} is not a number")
    return float(value)


def _whole(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{value!r} is not a whole number")
    return value


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not text")
    return value
