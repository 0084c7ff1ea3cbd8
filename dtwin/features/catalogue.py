"""The signal features: each defined once, with unit, formula and reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dtwin.errors import InputError
from dtwin.units import UNITS, unit_of

_MACHINE_CONDITION = "ISO 13373-2:2016; Randall, Vibration-based Condition Monitoring (2011)"
_MOMENTS = "Joanes and Gill, The Statistician 47 (1998), the population moment ratios"
_SPECTRUM = "Welch, IEEE Trans. Audio Electroacoust. 15 (1967), one segment, no taper"


@dataclass(frozen=True)
class _Feature:
    """Definition of one feature of one channel over one window x[0..n-1].

    Attributes:
        unit: Unit in terms of the channel's unit. One of "channel", "channel^2", "1", "Hz".
        formula: Definition; mu is the mean, P[k] the one-sided power of bin k >= 1 in channel^2.
        spectral: Whether a Fourier transform is needed.
    """

    name: str
    unit: str
    formula: str
    reference: str
    spectral: bool = False


FEATURES: tuple[_Feature, ...] = (
    _Feature("mean_absolute_value", "channel", "sum |x| / n", _MACHINE_CONDITION),
    _Feature("variance", "channel^2", "m2 = sum (x - mu)^2 / n", _MOMENTS),
    _Feature("rms", "channel", "sqrt(sum x^2 / n)", _MACHINE_CONDITION),
    _Feature("peak_amplitude", "channel", "max |x|", _MACHINE_CONDITION),
    _Feature("shape_factor", "1", "rms / mean_absolute_value", _MACHINE_CONDITION),
    _Feature("impulse_factor", "1", "max |x| / mean_absolute_value", _MACHINE_CONDITION),
    _Feature("crest_factor", "1", "max |x| / rms", _MACHINE_CONDITION),
    _Feature("kurtosis", "1", "(sum (x - mu)^4 / n) / m2^2; 3 for Gaussian noise", _MOMENTS),
    _Feature("skewness", "1", "(sum (x - mu)^3 / n) / m2^1.5", _MOMENTS),
    _Feature("dominant_frequency", "Hz", "frequency of the largest P[k]", _SPECTRUM, True),
    _Feature("mean_frequency", "Hz", "sum f[k] P[k] / sum P[k]", _SPECTRUM, True),
    _Feature("band_power", "channel^2", "sum P[k] over low <= f[k] < high", _SPECTRUM, True),
    _Feature("total_power", "channel^2", "sum x^2 / n, the mean included", _SPECTRUM),
)
FEATURE_NAMES: tuple[str, ...] = tuple(feature.name for feature in FEATURES)
_BY_NAME = {feature.name: feature for feature in FEATURES}


def feature(name: str) -> _Feature:
    """Return the definition of a feature. Raises ``InputError`` when there is no such feature."""
    if name not in _BY_NAME:
        raise InputError("unknown feature", code="features.unknown", got=name[:80], allowed=", ".join(FEATURE_NAMES))
    return _BY_NAME[name]


def positions(names: Sequence[str]) -> list[int]:
    """Return the positions of features in ``FEATURES``. Raises ``InputError`` when a name is unknown or given twice."""
    places = [FEATURE_NAMES.index(feature(name).name) for name in names]
    if len(set(places)) != len(places):
        raise InputError("a feature is selected twice", code="features.repeated", got=", ".join(names))
    return places


def feature_column(channel: str, name: str) -> str:
    """Return the column name of a feature, its unit at the end.

    Args:
        channel: Channel column, for example ``"wrist_x_g"``.
        name: Feature, for example ``"rms"``.

    Returns:
        For example ``"wrist_x_rms_g"`` or ``"wrist_x_variance_g2"``.

    Raises:
        InputError: When the channel's name ends with no known unit, or the feature is unknown.
    """
    channel_unit = unit_of(channel)
    suffix = next((s for s in UNITS if channel.endswith("_" + s)), None)
    if channel_unit is None or suffix is None:
        raise InputError("a channel's name must end with its unit", code="features.channel", got=channel[:80])
    kind = feature(name).unit
    ending = {"channel": suffix, "channel^2": suffix + "2", "1": "1", "Hz": "hz"}[kind]
    return f"{channel[: -len(suffix) - 1]}_{name}_{ending}"
