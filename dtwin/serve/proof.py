"""Test vectors of a bundle: made when it is created, proved when it is loaded."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from dtwin.errors import GateRefusal, InputError
from dtwin.features.windows import WindowContract, batch_features
from dtwin.schema import Floats
from dtwin.serve.band import Band
from dtwin.serve.bundle import Bundle
from dtwin.serve.interface import TestVectors
from dtwin.serve.runtime import CompiledBundle

_TOLERANCE = 1e-12
_TICKS = 24


def _test_window(contract: WindowContract, seed: int) -> Floats:
    """Return a made-up window, shape (channels, n), from whole-number arithmetic alone.

    No library's random generator or sine is used, so that every host gets the same samples.

    ``seed``: start of the sequence (SplitMix64; Steele, Lea and Flood, OOPSLA 2014).
    """
    count = len(contract.channels) * contract.n_samples
    with np.errstate(over="ignore"):
        z = np.uint64(seed) + np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z ^= z >> np.uint64(31)
    noise = (z >> np.uint64(40)).astype(np.float64) / 2**23 - 1.0
    ramp = np.arange(contract.n_samples) % 37 / 37.0 - 0.5
    return noise.reshape(len(contract.channels), -1) * 0.25 + ramp


def with_vectors(bundle: Bundle, seed: int = 1) -> Bundle:
    """Return the bundle with test vectors drawn from its validity box.

    ``bundle``: any vectors that it has are replaced.
    Raises ``InputError`` when the model gives a value that is not finite inside its own validity box.
    """
    rng = np.random.default_rng(seed)
    low, high = bundle.box
    drawn = low + (high - low) * rng.random((_TICKS, len(low)))
    drawn[0], drawn[1], drawn[2] = low, high, 0.5 * (low + high)
    named = {item.name: drawn[:, k] for k, item in enumerate(bundle.inputs)}
    inputs = _rows(named, bundle.tick_inputs)
    features = _rows(named, bundle.feature_inputs)
    outputs = _reference_outputs(bundle, inputs, features)
    if not np.isfinite(np.array(outputs)).all():
        raise InputError(
            "the model is not finite everywhere inside its validity box",
            code="bundle.not_finite",
            hint="narrow the box, or guard the division or logarithm that leaves it",
        )
    window_values: tuple[float, ...] = ()
    if bundle.window is not None:
        batch = batch_features(_test_window(bundle.window, seed), bundle.window)
        window_values = tuple(batch.values[0].reshape(-1).tolist())
    vectors = TestVectors(inputs, features, outputs, seed, window_values)
    band = bundle.band
    if band is not None:
        halves = _reference_band(bundle, band, inputs, features)
        if not all(0.0 <= half < np.inf for row in halves for half in row):
            raise InputError("the band is not finite everywhere inside the validity box", code="bundle.not_finite")
        band = dataclasses.replace(band, vectors=halves)
    return dataclasses.replace(bundle, vectors=vectors, band=band)


def _reference_band(
    bundle: Bundle, band: Band, inputs: tuple[tuple[float, ...], ...], features: tuple[tuple[float, ...], ...]
) -> tuple[tuple[float, ...], ...]:
    rows = []
    for given, windowed in zip(inputs, features, strict=True):
        told = band.graph.evaluate(_values(bundle, given, windowed), {})[0]
        rows.append(tuple(told[o.name] for o in bundle.outputs))
    return tuple(rows)


def _values(bundle: Bundle, given: tuple[float, ...], windowed: tuple[float, ...]) -> dict[str, float]:
    """Return inputs and intermediate values of a tick by name."""
    values = dict(zip(bundle.tick_inputs, given, strict=True))
    values |= dict(zip(bundle.feature_inputs, windowed, strict=True))
    if bundle.window_graph is not None:
        values |= bundle.window_graph.evaluate(values, {})[0]
    return values


def _reference_outputs(
    bundle: Bundle, inputs: tuple[tuple[float, ...], ...], features: tuple[tuple[float, ...], ...]
) -> tuple[tuple[float, ...], ...]:
    """Return the outputs of successive ticks by the slow evaluation of the graphs.

    ``inputs``, ``features``: one row per tick, in the order of ``tick_inputs`` and ``feature_inputs``.
    """
    state = bundle.initial_state
    rows = []
    for given, windowed in zip(inputs, features, strict=True):
        out, state = bundle.tick_graph.evaluate(_values(bundle, given, windowed), state)
        rows.append(tuple(out[o.name] for o in bundle.outputs))
    return tuple(rows)


def prove(bundle: Bundle) -> None:
    """Check the compiled bundle against its test vectors on this host.

    Raises ``GateRefusal`` when the equation differs by more than 1e-12, or a feature by a single bit.
    """
    vectors = bundle.vectors
    compiled = CompiledBundle(bundle, fades=False)
    told, halves = [], []
    if len(vectors.inputs) != len(vectors.features):
        raise _unproved("test vectors are missing", f"{len(vectors.inputs)}, {len(vectors.features)}")
    for given, windowed in zip(vectors.inputs, vectors.features, strict=True):
        if len(given) != len(bundle.tick_inputs) or len(windowed) != len(bundle.feature_inputs):
            raise _unproved("a test vector has the wrong length", f"{len(given)}, {len(windowed)}")
        compiled.window(np.array(windowed))
        told.append(compiled.tick(np.array(given)).tolist())
        halves.append(compiled.band_um.tolist())
    _prove_values(vectors.outputs, told, "equation")
    if bundle.band is not None:
        _prove_values(bundle.band.vectors, halves, "band")
    if bundle.window is not None:
        _prove_features(bundle.window, vectors)


def _prove_values(told: Sequence[Sequence[float]], values: Sequence[Sequence[float]], what: str) -> None:
    actual = np.array(values)
    if not len(values) or list(map(len, told)) != list(map(len, values)):
        raise _unproved(f"the test vectors of the {what} are missing or of the wrong shape", str(actual.shape))
    expected = np.array(told)
    error = np.abs(actual - expected) / np.maximum(1.0, np.abs(expected))
    if not (error <= _TOLERANCE).all():
        raise _unproved(f"the {what} gives other values here", f"difference {error.max():.3g}")


def _prove_features(contract: WindowContract, vectors: TestVectors) -> None:
    values = batch_features(_test_window(contract, vectors.window_seed), contract).values
    expected = np.array(vectors.window_features)
    if values.size != expected.size or values.tobytes() != expected.tobytes():
        difference = "another count"
        if values.size == expected.size:
            difference = f"difference {np.abs(values.reshape(-1) - expected).max():.3g}"
        raise _unproved("the features differ from those of training", difference)


def _rows(named: dict[str, Floats], order: tuple[str, ...]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(named[name][k]) for name in order) for k in range(_TICKS))


def _unproved(message: str, got: str) -> GateRefusal:
    return GateRefusal(
        f"the bundle is not proved on this host: {message}",
        code="bundle.unproved",
        got=got,
        hint="train and promote with the versions of numpy and numba that serve",
    )
