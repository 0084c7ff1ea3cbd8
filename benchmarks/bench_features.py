"""Windows per second of the feature kernel beside the usual script and tsfel, in one run.

Run: OMP_NUM_THREADS=1 python benchmarks/bench_features.py [--json]
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import time
import warnings
from collections.abc import Callable

import numpy as np
import scipy.stats

from dtwin.features.windows import WindowContract, batch_features

RATE_HZ, N, CHANNELS, BAND_HZ = 25_600.0, 1500, 9, (500.0, 2000.0)
SELECTION = (
    "mean_absolute_value",
    "variance",
    "rms",
    "shape_factor",
    "impulse_factor",
    "crest_factor",
    "kurtosis",
    "skewness",
    "mean_frequency",
    "band_power",
)


def recording(windows: int) -> np.ndarray:
    rng, t = np.random.default_rng(0), np.arange(windows * N) / RATE_HZ
    tones = [np.sin(2 * np.pi * (120 + 37 * c) * t) for c in range(CHANNELS)]
    return np.array(tones) + 0.2 * rng.standard_normal((CHANNELS, len(t))) + 0.05


def usual_script(x: np.ndarray) -> np.ndarray:
    """One call of numpy or scipy per feature, channel and window, as one would write it first."""
    frequency = np.fft.rfftfreq(N, 1 / RATE_HZ)
    band = (frequency >= BAND_HZ[0]) & (frequency < BAND_HZ[1])
    out = np.empty((x.shape[1] // N, len(x), len(SELECTION)))
    for i in range(len(out)):
        for c in range(len(x)):
            w = x[c, i * N : (i + 1) * N]
            mav, rms, peak = np.mean(np.abs(w)), np.sqrt(np.mean(w**2)), np.max(np.abs(w))
            power = np.abs(np.fft.rfft(w - np.mean(w))) ** 2
            power[-1] /= 2
            out[i, c] = (
                mav,
                np.var(w),
                rms,
                rms / mav,
                peak / mav,
                peak / rms,
                scipy.stats.kurtosis(w, fisher=False),
                scipy.stats.skew(w),
                np.sum(frequency * power) / np.sum(power),
                2 * np.sum(power[band]) / N**2,
            )
    return out


def by_tsfel() -> Callable[[np.ndarray], object]:
    import pandas as pd
    import tsfel

    wanted = {
        "statistical": (
            "Mean absolute deviation",
            "Variance",
            "Root mean square",
            "Max",
            "Kurtosis",
            "Skewness",
            "Mean",
        ),
        "spectral": ("Spectral centroid", "Fundamental frequency", "Max power spectrum"),
    }
    every = tsfel.get_features_by_domain()
    chosen = {d: {k: every[d][k] for k in names if k in every[d]} for d, names in wanted.items()}
    count = sum(len(v) for v in chosen.values())
    if count != len(SELECTION):
        raise SystemExit(f"tsfel offers {count} of {len(SELECTION)} matched features")

    def run(x: np.ndarray) -> object:
        frame = pd.DataFrame(x.T, columns=[f"c{c}" for c in range(CHANNELS)])
        with contextlib.redirect_stdout(io.StringIO()):
            # Window by window and without worker processes, which is its fastest way here.
            return [
                tsfel.time_series_features_extractor(chosen, frame.iloc[i : i + N], fs=RATE_HZ, verbose=0, n_jobs=None)
                for i in range(0, len(frame), N)
            ]

    return run


def windows_per_s(work: Callable[[np.ndarray], object], windows: int, repeats: int) -> float:
    x = recording(windows)
    work(x)
    best = min(_seconds(work, x) for _ in range(repeats))
    return windows / best


def _seconds(work: Callable[[np.ndarray], object], x: np.ndarray) -> float:
    start = time.perf_counter()
    work(x)
    return time.perf_counter() - start


def main() -> None:
    warnings.filterwarnings("ignore")
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    arguments = parser.parse_args()
    repeats = 1 if arguments.short else 0
    channels = tuple(f"c{c}_g" for c in range(CHANNELS))
    contract = WindowContract(RATE_HZ, N, N, channels, SELECTION, BAND_HZ)

    def ours(x: np.ndarray) -> np.ndarray:
        return batch_features(x, contract).values

    np.testing.assert_allclose(ours(recording(3)), usual_script(recording(3)), rtol=1e-6)
    rates = {
        "dtwin": windows_per_s(ours, 20 if arguments.short else 400, repeats or 7),
        "usual_script": windows_per_s(usual_script, 2 if arguments.short else 20, repeats or 5),
        "tsfel": windows_per_s(by_tsfel(), 1 if arguments.short else 4, repeats or 3),
    }
    result = {f"{k}_windows_per_s": round(v, 1) for k, v in rates.items()}
    result["ratio_to_usual_script"] = round(rates["dtwin"] / rates["usual_script"], 1)
    result["ratio_to_tsfel"] = round(rates["dtwin"] / rates["tsfel"], 1)
    if arguments.json:
        print(json.dumps(result))
        return
    print(f"{CHANNELS} channels x {N} samples x {len(SELECTION)} features, one core")
    for name, value in result.items():
        print(f"  {name:28s} {value:>10}")


if __name__ == "__main__":
    main()
