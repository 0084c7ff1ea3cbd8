"""What an equation for tones must show before it may move a slide."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from dtwin.features.tone_window import TONE_FEATURES, tone_columns
from dtwin.kinds.sinusoidal._bundle import AMPLITUDE, PHASE, SERVO_HZ
from dtwin.kinds.sinusoidal._groups import HELD_OUT, SENT_CREST, SENT_FREQUENCY, SENT_RMS, ToneGroups, dead_features
from dtwin.kinds.sinusoidal._laws import MOST_FEATURES
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.safety import Guard
from dtwin.train.gates import Verdict, vectors_proved

_LEAST_R2 = {"r2": 0.98, "phase_r2": 0.95}
MOST_ERROR_UM = 0.1
# What is wrong falls to a tenth within six windows.
MOST_RADIUS = 0.68
_TICK_BUDGET_US = 12.5
_WINDOWS = 12
_TICKS = 200
_STILL = 1e-3


class _AnsweredWindow:
    """What a bundle sends once it has settled on one window."""

    def __init__(self, bundle: Bundle) -> None:
        self.bundle = bundle
        self._compiled = CompiledBundle(bundle)

    def sent(self, features: Mapping[str, float], amplitude_um: float) -> complex:
        """Return sent over commanded tone as a vector."""
        self._compiled.window(np.array([features[n] for n in self.bundle.feature_inputs]))
        parts = []
        for angle in (np.pi / 2.0, 0.0):
            given = {PHASE: angle, AMPLITUDE: amplitude_um}
            rows = np.tile([given[name] for name in self.bundle.tick_inputs], (3, 1))
            first, second, third = self._compiled.run(rows)[:, 0].tolist()
            # The memory is of first order: three ticks tell where it settles (Aitken).
            bend = third - 2.0 * second + first
            settled = third if bend == 0.0 else first - (second - first) ** 2 / bend
            parts.append(settled / amplitude_um)
        return complex(1.0 + parts[0], parts[1])


def correction_radius(bundle: Bundle, groups: ToneGroups) -> tuple[float, str]:
    """Return the spectral radius of the correction on its own corrected motion, and where.

    The equation was fitted to motion without correction and reads motion with it. From one window to
    the next, the amplitude that is sent changes the features, and they the next amplitude; the features
    of every amplitude at a frequency are known from the campaign. That map is iterated, and its slope taken
    where it has come to; where it does not settle, the ratio of its last two changes is taken.
    """
    answers = _AnsweredWindow(bundle)
    worst, where = 0.0, ""
    for frequency in np.unique(groups.frequency_hz):
        here = groups.only(groups.frequency_hz == frequency)
        amplitudes = np.unique(here.amplitude_um)
        if len(amplitudes) < 2:
            continue
        for amplitude in amplitudes.tolist():
            radius = _radius(answers, here, amplitude)
            if not radius <= worst:
                worst, where = radius, f"{frequency:g} Hz, {amplitude:g} µm"
    return worst, where


def _radius(answers: _AnsweredWindow, here: ToneGroups, amplitude_um: float) -> float:
    def after(sent_um: float) -> float:
        return abs(answers.sent(_features_at(here, sent_um), amplitude_um)) * amplitude_um

    sizes = [amplitude_um]
    for _ in range(_WINDOWS):
        sizes.append(after(sizes[-1]))
        if not 0.0 < sizes[-1] < 100.0 * amplitude_um:
            return float("inf")
        if len(sizes) > 2 and abs(sizes[-1] - sizes[-2]) < _STILL * amplitude_um:
            break
    step = 0.01 * sizes[-1]
    slope = abs(after(sizes[-1] + step) - after(sizes[-1] - step)) / (2.0 * step)
    moved = abs(sizes[-1] - sizes[-2]), abs(sizes[-2] - sizes[-3])
    still = moved[0] < _STILL * amplitude_um
    return slope if still else max(slope, moved[0] / max(moved[1], 1e-12))


def _features_at(here: ToneGroups, sent_um: float) -> dict[str, float]:
    """Return features of a sent amplitude, straight between groups and on beyond the outermost."""
    sizes, place = np.unique(here.amplitude_um, return_inverse=True)
    k = int(np.clip(np.searchsorted(sizes, sent_um) - 1, 0, len(sizes) - 2))
    share = (sent_um - sizes[k]) / (sizes[k + 1] - sizes[k])

    def straight(values: Floats) -> float:
        # Repeats of a group count as their mean.
        low, high = (float(np.mean(values[place == at])) for at in (k, k + 1))
        return max(low + share * (high - low), 0.1 * low)

    features = {name: straight(values) for name, values in here.columns.items()}
    sent = {SENT_RMS: sent_um / np.sqrt(2.0), SENT_CREST: float(np.sqrt(2.0))}
    return features | sent | {SENT_FREQUENCY: float(here.frequency_hz[0])}


def dead_terms(bundle: Bundle, groups: ToneGroups) -> list[str]:
    """Return features that the window graph uses though they are constants on clean tones."""
    used = set(bundle.window_graph.inputs) if bundle.window_graph else set()
    return sorted(used & dead_features(groups))


def tone_gates(bundle: Bundle, metrics: Mapping[str, float]) -> list[Verdict]:
    """Judge a bundle for tones by everything that needs no motion.

    ``metrics``: what training logged: held-out scores, spectral radius, dead terms, latency.
    """
    used = features_used(bundle)
    radius = metrics.get("spectral_radius", float("nan"))
    dead = metrics.get("dead_terms", float("nan"))
    p99 = metrics.get("latency_p99_us", float("inf"))
    return [
        *_held_out(metrics),
        Verdict(
            "at most three features",
            max(len(u) for u in used.values()) <= MOST_FEATURES,
            "; ".join(f"{name}: {', '.join(columns) or 'none'}" for name, columns in used.items()),
        ),
        Verdict("no dead term", dead == 0.0, f"{dead:g} features in the equations are constants on clean sines"),
        Verdict(
            "stable on its own correction",
            radius <= MOST_RADIUS,
            f"spectral radius from window to window {radius:z.3f}; at most {MOST_RADIUS:g}",
        ),
        _bounded(bundle),
        vectors_proved(bundle),
        Verdict("latency", p99 <= _TICK_BUDGET_US, f"p99 {p99:z.2f} µs of {_TICK_BUDGET_US:g}"),
    ]


def _held_out(metrics: Mapping[str, float]) -> Iterator[Verdict]:
    for name, least in _LEAST_R2.items():
        values = {g: metrics.get(f"leave_{g}_out.{name}", float("nan")) for g in HELD_OUT}
        told = ", ".join(f"{group} out: {value:z.4f}" for group, value in values.items())
        what = "amplitude" if name == "r2" else "phase"
        yield Verdict(f"held-out {what}", all(v >= least for v in values.values()), f"R² {told}; at least {least}")
    errors = [metrics.get(f"leave_{g}_out.mae_um", float("nan")) for g in HELD_OUT]
    told = ", ".join(f"{1000 * error:z.1f} nm" for error in errors)
    yield Verdict(
        "held-out mean error", all(e <= MOST_ERROR_UM for e in errors), f"{told}; at most {1000 * MOST_ERROR_UM:g} nm"
    )


def features_used(bundle: Bundle) -> dict[str, Sequence[str]]:
    """Return the accelerometer's features that amplitude and phase error are made of."""
    assert bundle.window is not None
    assert bundle.window_graph is not None
    graph = bundle.window_graph
    sensor = set(tone_columns(bundle.window.channels[1]))
    assert len(sensor) == len(TONE_FEATURES)
    used: dict[str, Sequence[str]] = {}
    for output in ("amplitude_error_um", "phase_error_rad"):
        needed, pending = set(), [graph.outputs[output]]
        while pending:
            node = graph.nodes[pending.pop()]
            pending += node.args
            if node.op == "input":
                needed.add(node.name)
        used[output] = sorted(needed & sensor)
    return used


def _bounded(bundle: Bundle) -> Verdict:
    """Whatever windows and commands come in, what goes out is finite and inside the clamp."""
    rng = np.random.default_rng(7)
    compiled = CompiledBundle(bundle)
    low, high = bundle.box
    features = np.array([i.source == "feature" for i in bundle.inputs])
    guard = Guard(bundle.safety, low, high)
    raw = largest = 0.0
    for scale in (1.0, 3.0, 1e6):
        for _ in range(100):
            drawn = 0.5 * (low + high) + 0.5 * (high - low) * scale * rng.uniform(-1, 1, len(low))
            compiled.window(drawn[features])
            wanted = np.zeros((_TICKS, 3))
            wanted[:, 2] = compiled.run(np.tile(drawn[~features], (_TICKS, 1)))[:, 0]
            sent = guard.run(wanted, np.tile(drawn, (_TICKS, 1)), elapsed_s=1.0 / SERVO_HZ)
            if not (np.isfinite(wanted).all() and np.isfinite(sent).all()):
                return Verdict("bounded output", False, "not finite")
            largest = max(largest, float(np.max(np.abs(sent))))
            raw = max(raw, float(np.max(np.abs(wanted)))) if scale == 1.0 else raw
    return Verdict(
        "bounded output",
        largest <= bundle.safety.clamp_um * (1.0 + 1e-9),
        f"up to {raw:z.1f} µm inside the box, {largest:z.1f} µm after a clamp of "
        f"{bundle.safety.clamp_um:z.1f} µm whatever comes in",
    )
