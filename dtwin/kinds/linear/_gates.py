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
from dtwin.units import UM_PER_MM, shown_number

_SEAM_UM = 0.25
# What a correction may change while the axis moves by less than this.
_STANDSTILL_UM = 1.0
_OUTSIDE_UM = 1.0
_LEAST_EXPLAINED = 0.9
_CLOSE_MM = 2.5e-6
_COUNT_MM = 1.58e-4
_PLACES = 41


class _PathAnswers:
    """Answers of one bundle along paths; each path begins with a fresh memory.

    ``bundle``: takes ``position_mm`` and perhaps ``direction_1``.
    """

    def __init__(self, bundle: Bundle) -> None:
        self._inputs = bundle.tick_inputs
        self._compiled = CompiledBundle(bundle)

    def along(self, position_mm: Floats, standing: float | None = None) -> Floats:
        """Return the predicted error in um along successive positions, shape (n,).

        A bundle that asks for a direction gets the sign of the newest motion, as the published
        program computes it.

        ``position_mm``, (n,): positions, tick by tick; the axis is taken to come from below.
        ``standing``: direction that is told while the axis stands still; that of the newest motion without.
        """
        step = np.sign(np.diff(position_mm, prepend=position_mm[0] - 1.0))
        if standing is None:
            last = np.maximum.accumulate(np.where(step != 0.0, np.arange(len(step)), 0))
            step = step[last]
        way = np.where(step < 0.0, 1.0, 0.0)
        if standing is not None:
            way = np.where(step == 0.0, standing, way)
        named = told(position_mm, way)
        self._compiled.reset()
        error: Floats = self._compiled.run(np.column_stack([named[name] for name in self._inputs]))
        return error[:, 0]


def along(bundle: Bundle, position_mm: Floats) -> Floats:
    """Return the predicted error in um of a bundle along successive positions, shape (n,).

    ``bundle``: takes ``position_mm`` and perhaps ``direction_1``.
    ``position_mm``, (n,): positions, tick by tick.
    """
    return _PathAnswers(bundle).along(position_mm)


def positioning_gates(bundle: Bundle, pitch_mm: float, reach_mm: tuple[float, float]) -> list[Verdict]:
    """Judge the equation of a positioning error by everything that needs no machine.

    ``pitch_mm``: travel in one turn of the screw; without one, 0, there are no seams.
    """
    places = np.linspace(reach_mm[0] + 0.3 * pitch_mm, reach_mm[1] - 0.3 * pitch_mm, _PLACES)
    answers = _PathAnswers(bundle)
    return [
        *([_seam(answers, pitch_mm, reach_mm)] if pitch_mm else []),
        _outside(answers, reach_mm),
        _reversal(answers, places),
        _standstill(answers, places),
    ]


def registered_positioning_gates(bundle: Bundle, metrics: Mapping[str, float]) -> list[Verdict]:
    """Judge a registered equation by everything that needs no motion.

    ``metrics``: what training logged: scores of runs left out, the screw, latency.
    """
    pitch_mm, *reach_mm = screw_logged(metrics)
    share, rms, table, worst = (metrics.get(name, float("nan")) for name in _LOGGED)
    shape = (
        positioning_gates(bundle, pitch_mm, (reach_mm[0], reach_mm[1]))
        if pitch_mm >= 0.0 and reach_mm[0] < reach_mm[1]
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


_SCREW = ("screw_pitch", "mapped_from", "mapped_to")
_LOGGED = ("explained_share", "leave_run_out.rms_um", "table_rms_um", "leave_run_out.worst_slice_ratio")


def screw_metrics(pitch_mm: float, reach_mm: tuple[float, float]) -> dict[str, float]:
    """Return what training logs of the screw and the mapped travel."""
    return dict(zip((f"{name}_mm" for name in _SCREW), (pitch_mm, *reach_mm), strict=True))


def screw_logged(metrics: Mapping[str, float]) -> tuple[float, float, float]:
    """Return pitch, begin and end of the mapped travel in mm; NaN where training logged none.

    Older versions logged inches.
    """
    pitch, low, high = (
        metrics.get(f"{name}_mm", MM_PER_IN * metrics.get(f"{name}_in", float("nan"))) for name in _SCREW
    )
    return pitch, low, high


def _seam(served: _PathAnswers, pitch_mm: float, reach_mm: tuple[float, float]) -> Verdict:
    turns = np.arange(np.ceil(reach_mm[0] / pitch_mm) + 1, np.floor(reach_mm[1] / pitch_mm))
    worst = {}
    for name, sign in (("forward", 1.0), ("reverse", -1.0)):
        seams = turns[:: int(sign)] * pitch_mm
        path = np.column_stack([seams - sign * _CLOSE_MM, seams + sign * _CLOSE_MM]).ravel()
        # The axis arrives from well before the first seam, so that it rests on this flank.
        start = path[0] - sign * pitch_mm / 2.0
        error = served.along(np.concatenate([[start], path]))[1:]
        jumps = error[1::2] - error[::2]
        worst[name] = float(jumps[np.argmax(np.abs(jumps))]) * sign
    told = ", ".join(f"{name} {jump:+z.2f} µm" for name, jump in worst.items())
    passed = max(abs(jump) for jump in worst.values()) <= _SEAM_UM
    return Verdict("no seam at a turn of the screw", passed, f"largest jump {told}; at most {_SEAM_UM:g} µm")


def _outside(served: _PathAnswers, reach_mm: tuple[float, float]) -> Verdict:
    low, high = reach_mm
    # Of a travel above zero also below zero, where remainders of the published equation turn their sign.
    below = min(low, 0.0)
    beyond = {low - 8.0: low, below - 2.54: low, below - 25.4: low, high + 8.0: high, high + 125.0: high}
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
        f"{off[worst]:z.1f} µm away from the end's value at {shown_number(worst, 4)} mm; at most {_OUTSIDE_UM:g} µm",
    )


def _reversal(served: _PathAnswers, places: Floats) -> Verdict:
    worst, where = 0.0, float(places[0])
    for place in places.tolist():
        answers = served.along(np.array([place - 1.3, place, place - _COUNT_MM]))
        change = abs(float(answers[2] - answers[1]))
        if change > worst:
            worst, where = change, place
    return Verdict(
        "no step at reversal",
        worst <= _STANDSTILL_UM,
        f"{worst:z.2f} µm at {where:z.1f} mm when the axis turns back by one count "
        f"({_COUNT_MM * UM_PER_MM:z.2f} µm); at most {_STANDSTILL_UM:g} µm",
    )


def _standstill(served: _PathAnswers, places: Floats) -> Verdict:
    worst = 0.0
    for place in places.tolist():
        jitter = place + _COUNT_MM * np.array([0.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0])
        path = np.concatenate([[place - 1.3, place], jitter])
        answers = np.concatenate([served.along(path, way)[1:] for way in (0.0, 1.0)])
        worst = max(worst, float(np.ptp(answers)))
    return Verdict(
        "defined at standstill",
        worst <= _STANDSTILL_UM,
        f"{worst:z.2f} µm between answers at one place, by one count of jitter and either direction "
        f"told; at most {_STANDSTILL_UM:g} µm",
    )
