"""Generic inputs of the comparison models: path, joints, motion, accelerometer features."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.features.alignment import align_stops
from dtwin.features.path_inputs import PATH_INPUTS
from dtwin.features.windows import WindowContract, WindowFeatures, batch_features
from dtwin.schema import Floats
from dtwin.train.campaign_rows import Rows
from dtwin.train.dataset import TICK_HZ, TickRun

WINDOW_FEATURES = ("rms", "peak_amplitude", "mean_frequency", "band_power")
BAND_HZ = (4.0, 40.0)
WINDOW_SAMPLES, HOP = 512, 83


@dataclass(frozen=True)
class GenericInputs:
    """Inputs of the comparison models over all rows.

    ``values``, (n, k): one row per row of the campaign.
    ``names``: columns.
    ``sensor``, (k,): which columns come from accelerometers.
    ``contract``: how the accelerometer features are made; None without accelerometers.
    """

    values: Floats
    names: tuple[str, ...]
    sensor: np.ndarray[tuple[int], np.dtype[np.bool_]]
    contract: WindowContract | None


def generic_inputs(rows: Rows) -> GenericInputs:
    """Return path inputs, harmonics of the path angle, and accelerometer features."""
    path = np.concatenate([run.inputs[run.arc] for run in rows.runs]).astype(float)
    angle = path[:, 0]
    columns = [path[:, 1:]]
    names = list(PATH_INPUTS[1:])
    for k in (1, 2, 3):
        columns += [np.cos(k * angle)[:, None], np.sin(k * angle)[:, None]]
        names += [f"cos_{k}_1", f"sin_{k}_1"]
    contract = _contract_of(rows)
    n_path = len(names)
    if contract is not None:
        columns.append(np.concatenate([_sensor_features(run, contract) for run in rows.runs]))
        names += list(contract.columns)
    sensor = np.arange(len(names)) >= n_path
    return GenericInputs(np.column_stack(columns), tuple(names), sensor, contract)


def _contract_of(rows: Rows) -> WindowContract | None:
    """Return the window contract of a campaign's accelerometers, None when a run has none, or lacks a channel of the first."""
    groups = [run.accelerometers for run in rows.runs]
    first = groups[0]
    if first is None or any(g is None or abs(g.rate_hz - first.rate_hz) > 1e-6 for g in groups):
        return None
    channels = {name for name in first.columns if name.endswith("_g")}
    if not channels or not all(g is not None and channels <= {*g.columns} for g in groups):
        return None
    return WindowContract(
        rate_hz=first.rate_hz,
        n_samples=WINDOW_SAMPLES,
        hop=HOP,
        channels=tuple(name for name in first.columns if name.endswith("_g")),
        features=WINDOW_FEATURES,
        band_hz=BAND_HZ,
        detrend="mean",
    )


def _window_features(run: TickRun, contract: WindowContract) -> WindowFeatures:
    """Return the features of every window of a run's accelerometers."""
    if run.accelerometers is None:
        raise InputError("the run has no accelerometers", code="train.signals", where=run.meta.run_id)
    if run.accelerometers.n_samples < contract.n_samples:
        raise InputError(
            "the accelerometers hold less than a window",
            code="train.signals",
            where=run.meta.run_id,
            got=f"{run.accelerometers.n_samples} readings",
            allowed=f"{contract.n_samples} at least",
            hint="dtwin leave-out CAMPAIGN RUN --because TEXT",
        )
    block = np.stack([run.accelerometers.columns[name] for name in contract.channels])
    return batch_features(block, contract)


def _sensor_features(run: TickRun, contract: WindowContract) -> Floats:
    """Return the newest window's features at each row of a run, shape (rows, features).

    The accelerometers' clock is brought to the controller's by the stops; a row sees the
    newest window that had ended by then, never a later one.
    """
    features = _window_features(run, contract)
    flat = features.values.reshape(len(features.values), -1)
    ends_s = np.asarray(features.end_s) + _accelerometer_lag_s(run, contract)
    newest = np.clip(np.searchsorted(ends_s, run.arc / TICK_HZ, side="right") - 1, 0, None)
    return np.asarray(flat[newest])


def _accelerometer_lag_s(run: TickRun, contract: WindowContract) -> float:
    """Return controller time minus accelerometer time, by the stops; 0 when they show none."""
    if run.accelerometers is None:
        return 0.0
    first = PATH_INPUTS.index("acceleration_x_mm_s2")
    acceleration = np.linalg.norm(run.inputs[::4, first : first + 3].astype(float), axis=1)
    wrist = np.asarray(run.accelerometers.columns[contract.channels[0]], dtype=float)
    try:
        aligned = align_stops(wrist[::4], run.accelerometers.rate_hz / 4, acceleration, TICK_HZ / 4, max_lag_s=1.5)
    except InputError:
        return 0.0
    return aligned.lag_s if aligned.correlation > 0.2 else 0.0
