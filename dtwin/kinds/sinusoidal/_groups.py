"""Groups of tones: features of the first five seconds, errors of the last one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from dtwin.errors import InputError
from dtwin.features.catalogue import feature_column
from dtwin.features.sine import fit_tone
from dtwin.features.tone_window import HORIZON_S, SENT, TONE_FEATURES, tone_columns, tone_contract, tone_features
from dtwin.features.windows import WindowContract
from dtwin.kinds.sinusoidal._check import HEARD, accelerometer, commanded, followed, heard
from dtwin.lake.store import Lake
from dtwin.schema import Floats, Run
from dtwin.units import UM_PER_MM

SENT_RMS, SENT_FREQUENCY, SENT_CREST = (
    feature_column(SENT, name) for name in ("rms", "dominant_frequency", "crest_factor")
)
HELD_OUT = ("frequency_hz", "amplitude_um")
_FEWEST = 3
_CLEAN = 0.999
_DEAD = 0.02
_SAME = 0.999


@dataclass(frozen=True)
class ToneGroups:
    """What a model of tones is fitted to and judged by.

    ``frequency_hz``, ``amplitude_um`` (n,): of the command.
    ``features`` (n, 12): of the accelerometer, in the order of the contract's features.
    ``sent_rms_um`` (n,): of the command.
    ``amplitude_error_um``, ``phase_error_deg`` (n,): tool minus command in amplitude, and its lag, in the last second.
    ``beyond_encoder_um`` (n,): amplitude of tool minus encoder, as a vector, in the last second.
    ``heard`` (n,): share of the tone in the accelerometer's power.
    ``traces`` (2, samples): command and tool in um over time.
    """

    contract: WindowContract
    frequency_hz: Floats
    amplitude_um: Floats
    features: Floats
    sent_rms_um: Floats
    amplitude_error_um: Floats
    phase_error_deg: Floats
    beyond_encoder_um: Floats
    heard: Floats
    traces: tuple[Floats, ...]

    @property
    def n(self) -> int:
        """Number of groups."""
        return len(self.frequency_hz)

    @property
    def names(self) -> tuple[str, ...]:
        """Columns of the features, units at their ends."""
        return tone_columns(self.contract.channels[1])

    @property
    def columns(self) -> dict[str, Floats]:
        """Features by column."""
        return {name: self.features[:, i] for i, name in enumerate(self.names)}

    def feature(self, name: str) -> Floats:
        """Return one of the twelve by its short name, shape (n,)."""
        return self.features[:, TONE_FEATURES.index(name)]

    def label(self, group: str) -> Floats:
        """Return what a group is left out by."""
        return self.frequency_hz if group == "frequency_hz" else self.amplitude_um

    def only(self, chosen: NDArray[np.bool_]) -> ToneGroups:
        """Return some of the groups."""
        arrays = {name: value[chosen] for name, value in vars(self).items() if name not in ("contract", "traces")}
        traces = tuple(t for t, keep in zip(self.traces, chosen, strict=True) if keep)
        return ToneGroups(contract=self.contract, traces=traces, **arrays)


def load_tone_groups(lake: Lake, rows: list[dict[str, Any]]) -> ToneGroups:
    """Read the groups of a campaign, runs with errors left out."""
    usable = [r for r in rows if r["n_errors"] == 0 and r["status"] == "complete"]
    return groups_of([lake.load(row) for row in usable], f"campaign {rows[0]['campaign']}")


def groups_of(runs: list[Run], where: str) -> ToneGroups:
    """Return the groups of runs with a probe at the tool and an accelerometer.

    ``runs``: with samples and signals.
    Raises ``InputError`` when no run has all of them, or rates and channels differ.
    """
    groups = [group for run in runs if (group := _group(run)) is not None]
    if not groups:
        raise InputError(
            "no run can be learned from",
            code="train.tones",
            where=where,
            got=f"{len(runs)} runs",
            allowed="tool_z_mm, an accelerometers signal, six seconds",
            hint="dtwin check says more",
        )
    contracts = {g["contract"] for g in groups}
    if len(contracts) > 1:
        raise InputError("groups have different rates or channels", code="features.contract", where=where)
    names = [n for n in groups[0] if n not in ("contract", "trace")]
    arrays = {name: np.array([g[name] for g in groups]) for name in names}
    return ToneGroups(contract=contracts.pop(), traces=tuple(g["trace"] for g in groups), **arrays)


def heard_groups(everything: ToneGroups) -> ToneGroups:
    """Return the groups that the accelerometer hears.

    Raises ``InputError`` when fewer than three frequencies or three amplitudes remain: none could be left out.
    """
    groups = everything.only(everything.heard >= HEARD)
    counts = [len(np.unique(groups.label(name))) for name in HELD_OUT]
    if min(counts) < _FEWEST:
        raise InputError(
            "too few tones to judge a model by what was left out",
            code="train.grid",
            got=f"{counts[0]} frequencies and {counts[1]} amplitudes that the accelerometer hears",
            allowed=f"{_FEWEST} of each at least",
            hint="dtwin check says how much of a tone is heard",
        )
    return groups


def noise_floor_um(groups: ToneGroups) -> tuple[float, int]:
    """Return what repeats of a tone disagree by in the amplitude error, and its degrees of freedom.

    NaN and 0 without repeats.
    """
    tones = np.column_stack([groups.frequency_hz, groups.amplitude_um])
    place = np.unique(tones, axis=0, return_inverse=True)[1].ravel()
    error = groups.amplitude_error_um
    mean = (np.bincount(place, weights=error) / np.bincount(place))[place]
    freedom = groups.n - int(place.max()) - 1
    floor = float(np.sqrt(np.sum((error - mean) ** 2) / freedom)) if freedom else float("nan")
    return floor, freedom


def _group(run: Run) -> Mapping[str, Any] | None:
    signal = accelerometer(run)
    errors, told, tone = followed(run, HORIZON_S), commanded(run), heard(run)
    if signal is None or errors is None or tone is None:
        return None
    group, channel = signal
    contract = tone_contract(group.rate_hz, channel)
    if group.n_samples < contract.n_samples:
        return None
    t, command = run.samples["t_s"], run.samples["cmd_z_mm"] * UM_PER_MM
    tool, encoder = run.samples["tool_z_mm"] * UM_PER_MM, run.samples["act_z_mm"] * UM_PER_MM
    # Each device has a clock of its own; of a tone the window holds the same wherever it begins.
    sent = np.interp(group.t_s - group.start_s, t - t[0], command)
    windowed = tone_features(sent, group.columns[channel], contract)
    return {
        "contract": contract,
        "frequency_hz": told.frequency_hz,
        "amplitude_um": told.amplitude_um,
        "features": windowed[1],
        "sent_rms_um": windowed[0, TONE_FEATURES.index("rms")],
        "amplitude_error_um": errors.amplitude_error_um,
        "phase_error_deg": errors.tool_lag_deg,
        "beyond_encoder_um": _vector_um(t, tool - encoder, told.frequency_hz),
        "heard": tone.share,
        "trace": np.stack([command, tool]),
    }


def _vector_um(t: Floats, difference: Floats, frequency_hz: float) -> float:
    last = t > t[-1] - HORIZON_S
    return fit_tone(t[last], difference[last], frequency_hz).amplitude


def exponent(acceleration: Floats, error_um: Floats) -> float:
    """Return p of ``error = c * acceleration^p``, least squares in um.

    ``acceleration``, ``error_um`` (n,): positive; the groups with the largest error decide.
    """
    start = float(np.log(error_um.max() / acceleration.max()))

    def rest(x: Floats) -> Floats:
        return np.exp(x[0] + x[1] * np.log(acceleration)) - error_um

    return float(least_squares(rest, [start, 1.0]).x[1])


def feature_findings(groups: ToneGroups) -> Iterator[str]:
    """Say which features are constants on clean tones, and which tell the same.

    ``groups``: all groups; the clean ones are those that the accelerometer hears almost alone.
    """
    clean = groups.only(groups.heard > _CLEAN)
    if clean.n < 3:
        yield "too few clean tones to tell constant features"
        return
    for name in ("crest_factor", "impulse_factor", "shape_factor", "kurtosis", "skewness"):
        values = clean.feature(name)
        middle, spread = float(np.median(values)), float(np.std(values))
        if spread < _DEAD * max(abs(middle), 1.0):
            yield (
                f"{name} is a dead constant on clean sines: {middle:z.3f} ± {spread:z.3f} over "
                f"{clean.n} groups; as a factor of an equation it only rescales another constant"
            )
    sizes = ("rms", "mean_absolute_value", "peak_amplitude", "variance", "total_power")
    logs = np.log(np.column_stack([clean.feature(name) for name in sizes]))
    if np.min(np.corrcoef(logs.T)) > _SAME:
        yield f"{', '.join(sizes)} tell the same on clean sines: one of them is enough"


def dead_features(groups: ToneGroups) -> set[str]:
    """Return the columns of the features that are constants on clean tones."""
    dead = {text.split(" ")[0] for text in feature_findings(groups) if "dead constant" in text}
    channel = groups.contract.channels[1]
    return {column for column, name in zip(tone_columns(channel), TONE_FEATURES, strict=True) if name in dead}
