"""What an equation of a positioning error must not do, tried on the compiled bundle itself."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dtwin.kinds.linear._bundle import told
from dtwin.kinds.linear._models import MM_PER_IN
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle
from dtwin.train.gates import Verdict, bounded_output, latency_gate, vectors_proved

_SEAM_UM = 0.25
# What a correction may change while the axis moves by less than this.
_STANDSTILL_UM = 1.0
_OUTSIDE_UM = 1.0
_LEAST_EXPLAINED = 0.9
_CLOSE_IN = 1e-7
_COUNT_IN = 6.23e-6
_UM_PER_IN = 25_400.0
_PLACES = 41


class _PathAnswers:
    """Answers of one bundle along paths; each path begins with a fresh memory.

    ``bundle``: takes ``position_mm`` and perhaps ``direction_1``.
    """

    def __init__(self, bundle: Bundle) -> None:
        self._inputs = bundle.tick_inputs
        self._compiled = CompiledBundle(bundle)

    def along(self, position_in: Floats, standing: float | None = None) -> Floats:
        """Return the predicted error in um along successive positions, shape (n,).

        A bundle that asks for a direction gets the sign of the newest motion, as the published
        program computes it.

        ``position_in``, (n,): positions, tick by tick; the axis is taken to come from below.
        ``standing``: direction that is told while the axis stands still; that of the newest motion without.
        """
        step = np.sign(np.diff(position_in, prepend=position_in[0] - 1.0))
        if standing is None:
            last = np.maximum.accumulate(np.where(step != 0.0, np.arange(len(step)), 0))
            step = step[last]
        way = np.where(step < 0.0, 1.0, 0.0)
        if standing is not None:
            way = np.where(step == 0.0, standing, way)
        named = told(position_in * MM_PER_IN, way)
        self._compiled.reset()
        error: Floats = self._compiled.run(np.column_stack([named[name] for name in self._inputs]))
        return error[:, 0]


def along(bundle: Bundle, position_in: Floats) -> Floats:
    """Return the predicted error in um of a bundle along successive positions, shape (n,).

    ``bundle``: takes ``position_mm`` and perhaps ``direction_1``.
    ``position_in``, (n,): positions, tick by tick.
    """
    return _PathAnswers(bundle).along(position_in)


def positioning_gates(bundle: Bundle, pitch_in: float, reach_in: tuple[float, float]) -> list[Verdict]:
    """Judge the equation of a positioning error by everything that needs no machine.

    ``pitch_in``: travel in one turn of the screw.
    """
    places = np.linspace(reach_in[0] + 0.3 * pitch_in, reach_in[1] - 0.3 * pitch_in, _PLACES)
    answers = _PathAnswers(bundle)
    return [
        _seam(answers, pitch_in, reach_in),
        _outside(answers, reach_in),
        _reversal(answers, places),
        _standstill(answers, places),
    ]


def registered_positioning_gates(bundle: Bundle, metrics: Mapping[str, float]) -> list[Verdict]:
    """Judge a registered equation by everything that needs no motion.

    ``metrics``: what training logged: scores of runs left out, the screw, latency.
    """
    known = {name: metrics.get(name, float("nan")) for name in _LOGGED}
    pitch, low, high, share, rms, table, worst = known.values()
    shape = (
        positioning_gates(bundle, pitch, (low, high))
        if pitch > 0.0 and low < high
        else [Verdict("the screw is known", False, "training logged no pitch or no mapped travel")]
    )
    return [
        Verdict(
            "held-out runs",
            share >= _LEAST_EXPLAINED,
            f"{100 * share:z.1f} % of what the runs have in common is explained in runs left out; at "
            f"least {100 * _LEAST_EXPLAINED:z.0f} %",
        ),
        Verdict(
            "better than a table with backlash",
            rms < table,
            f"{rms:z.2f} µm RMS are left of runs left out, the table leaves {table:z.2f} µm",
        ),
        Verdict(
            "no slice worse than no correction",
            worst < 1.0,
            f"the worst tenth of the travel keeps {100 * worst:z.0f} % of its error, scatter included",
        ),
        *shape,
        bounded_output(bundle),
        vectors_proved(bundle),
        latency_gate(metrics),
    ]


_LOGGED = (
    "screw_pitch_in",
    "mapped_from_in",
    "mapped_to_in",
    "explained_share",
    "leave_run_out.rms_um",
    "table_rms_um",
    "leave_run_out.worst_slice_ratio",
)


def _seam(served: _PathAnswers, pitch_in: float, reach_in: tuple[float, float]) -> Verdict:
    turns = np.arange(np.ceil(reach_in[0] / pitch_in) + 1, np.floor(reach_in[1] / pitch_in))
    worst = {}
    for name, sign in (("forward", 1.0), ("reverse", -1.0)):
        seams = turns[:: int(sign)] * pitch_in
        path = np.column_stack([seams - sign * _CLOSE_IN, seams + sign * _CLOSE_IN]).ravel()
        # The axis arrives from well before the first seam, so that it rests on this flank.
        start = path[0] - sign * pitch_in / 2.0
        error = served.along(np.concatenate([[start], path]))[1:]
        jumps = error[1::2] - error[::2]
        worst[name] = float(jumps[np.argmax(np.abs(jumps))]) * sign
    told = ", ".join(f"{name} {jump:+z.2f} µm" for name, jump in worst.items())
    passed = max(abs(jump) for jump in worst.values()) <= _SEAM_UM
    return Verdict("no seam at a turn of the screw", passed, f"largest jump {told}; at most {_SEAM_UM:g} µm")


def _outside(served: _PathAnswers, reach_in: tuple[float, float]) -> Verdict:
    low, high = reach_in
    beyond = {low - 0.3: low, -0.1: low, -1.0: low, high + 0.3: high, high + 5.0: high}
    off: dict[float, float] = {}
    for place, end in beyond.items():
        # Both from the same side, so that both rest on the same flank.
        answers = served.along(np.array([place, end] if place < end else [end, place]))
        off[place] = float(abs(answers[1] - answers[0]))
    worst = max(off, key=lambda place: off[place] if np.isfinite(off[place]) else np.inf)
    passed = all(value <= _OUTSIDE_UM for value in off.values())
    return Verdict(
        "ends held outside of the mapped travel",
        passed,
        f"{off[worst]:z.1f} µm away from the end's value at {worst:g} in; at most {_OUTSIDE_UM:g} µm",
    )


def _reversal(served: _PathAnswers, places: Floats) -> Verdict:
    worst, where = 0.0, float(places[0])
    for place in places.tolist():
        answers = served.along(np.array([place - 0.05, place, place - _COUNT_IN]))
        change = abs(float(answers[2] - answers[1]))
        if change > worst:
            worst, where = change, place
    return Verdict(
        "no step at reversal",
        worst <= _STANDSTILL_UM,
        f"{worst:z.2f} µm at {where:z.3f} in when the axis turns back by one count "
        f"({_COUNT_IN * _UM_PER_IN:z.2f} µm); at most {_STANDSTILL_UM:g} µm",
    )


def _standstill(served: _PathAnswers, places: Floats) -> Verdict:
    worst = 0.0
    for place in places.tolist():
        jitter = place + _COUNT_IN * np.array([0.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0])
        path = np.concatenate([[place - 0.05, place], jitter])
        answers = np.concatenate([served.along(path, way)[1:] for way in (0.0, 1.0)])
        worst = max(worst, float(np.ptp(answers)))
    return Verdict(
        "defined at standstill",
        worst <= _STANDSTILL_UM,
        f"{worst:z.2f} µm between answers at one place, by one count of jitter and either direction "
        f"told; at most {_STANDSTILL_UM:g} µm",
    )
