"""A later session on the mill: every way of correcting, interleaved, in one mounting of the bar."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dtwin.kinds.circular._mill_evidence import CLOCK, TRANSPORT_S, ServedCorrection, oracle_correction
from dtwin.machines.mill import Correction, SetupErrors
from dtwin.machines.mill_parameters import CircularTest, NoiseParameters
from dtwin.progress import Progress, silent
from dtwin.schema import Run
from dtwin.serve.bundle import Bundle
from dtwin.train.closed_loop import Evidence
from dtwin.train.oracle import MeasuredWays, guard_shares, numbered
from dtwin.train.results import condition_name
from studies.thesis_mill import (
    DIRECTIONS,
    FEEDS_MM_MIN,
    PLANE,
    RADIUS_MM,
    circle,
    geometry,
    measure_warm,
    temperatures_c,
    thesis_mill,
)

NONE, ORACLE = "none", "oracle"
_WARM_UP = 2
# Short jobs with stops between them: the machine stays cooler than after hours of work.
_STOP_S = 900.0
_QUIET: Mapping[str, Any] = {
    "noise": NoiseParameters(rms_um=0.0),
    "setup_errors": SetupErrors(centre_mm=0.0, radius_um=0.0, jitter_us=0.0, trigger_samples=0.0),
}


@dataclass(frozen=True)
class Way:
    """One way of correcting.

    ``bundle``: what is served.
    ``change``: what the bench makes of the correction; it arrives as it is without.
    """

    bundle: Bundle
    change: Callable[[Correction], Correction] | None = None


@dataclass(frozen=True)
class LaterSession:
    """What was measured.

    ``runs``: by way, in order of time; the other ways' runs lie between.
    ``acted``: by way and name of a condition: share of the ticks in which each guard acted.
    ``temperature_c``: lowest and highest logged temperature.
    """

    runs: Mapping[str, tuple[Run, ...]]
    acted: Mapping[str, Mapping[str, Mapping[str, float]]]
    temperature_c: tuple[float, float]

    def measured(self, way: str, bundle: Bundle) -> MeasuredWays:
        """Return the runs of a way beside those without any correction.

        ``way``: one of the ways.
        ``bundle``: what was served in it.
        """
        delay_s = float(geometry()["correction_delay_s"])
        served = [replace(run, meta=replace(run.meta, correction=bundle.model_sha256)) for run in self.runs[way]]
        return MeasuredWays(
            numbered(sorted([*self.runs[NONE], *served], key=lambda run: run.meta.started)),
            CLOCK,
            {"position_loop_s": delay_s - TRANSPORT_S, "transport_s": TRANSPORT_S},
            self.runs[ORACLE],
            self.acted[way],
        )

    def evidence(self, way: str, bundle: Bundle) -> Evidence:
        """Return what the runs say of a way."""
        return self.measured(way, bundle).evidence(bundle.machine, bundle.model_sha256)

    def raw_um(self, way: str, feed: float) -> float:
        """Return the mean absolute reading of a way's runs, mounting and all.

        ``way``: one of the ways.
        ``feed``: feed in mm/min.
        """
        chosen = [run for run in self.runs[way] if run.meta.feed_mm_min == feed]
        return float(np.mean([np.abs(run.samples["deviation_um"]).mean() for run in chosen]))


def later_session(ways: Mapping[str, Way], *, seed: int, repeats: int, progress: Progress = silent) -> LaterSession:
    """Mount the bar anew on the cold machine, and measure all ways in random order.

    The oracle knows the repeatable error of every single circle, at its temperature, and has the
    guard and the delay of the first way.

    ``ways``: ways of correcting; ``none`` and ``oracle`` are added.
    ``seed``: of the session.
    ``repeats``: of every way, feed and direction.
    ``progress``: called with (done, total, what).
    """
    names = [NONE, ORACLE, *ways]
    tests, places = _interleaved(names, seed, repeats)
    # The same session without noise and mounting: its temperatures do not depend on corrections.
    bare = [replace(test, correction="") for test in tests]
    quiet = measure_warm(thesis_mill(seed, **_QUIET), bare, _WARM_UP)
    served: dict[str, ServedCorrection] = {}
    corrections: dict[str, Correction] = {}
    for test, name, known in zip(tests, places, quiet, strict=True):
        if name == ORACLE:
            corrections[test.correction] = _oracle(next(iter(ways.values())).bundle, known)
        elif name != NONE:
            made = ServedCorrection(ways[name].bundle, known.meta.covariates)
            served[test.correction] = made
            change = ways[name].change
            corrections[test.correction] = change(made) if change else made
    mill = thesis_mill(seed, corrections=_counted(corrections, progress))
    runs = measure_warm(mill, tests, _WARM_UP)
    found: dict[str, list[Run]] = {name: [] for name in names}
    counts: dict[tuple[str, str], list[Mapping[str, int]]] = defaultdict(list)
    for test, name, run in zip(tests, places, runs, strict=True):
        found[name].append(run)
        if name in ways:
            about = {"plane": PLANE, "radius_mm": RADIUS_MM, "feed_mm_min": test.feed_mm_min}
            guard = served[test.correction].acted[test.direction]
            counts[name, condition_name(about)].append(guard)
    acted: dict[str, dict[str, dict[str, float]]] = defaultdict(dict)
    for (name, condition), guards in counts.items():
        acted[name][condition] = guard_shares(guards)
    seen = temperatures_c(runs)
    return LaterSession(
        {name: tuple(chosen) for name, chosen in found.items()}, acted, (float(seen.min()), float(seen.max()))
    )


def _interleaved(names: Sequence[str], seed: int, repeats: int) -> tuple[list[CircularTest], list[str]]:
    """Return the circles in random order within each repeat, and the way of each."""
    rng = np.random.default_rng([seed, 41])
    tests: list[CircularTest] = []
    places: list[str] = []
    for repeat in range(1, repeats + 1):
        block = [(name, feed) for name in names for feed in FEEDS_MM_MIN]
        for number in rng.permutation(len(block)):
            name, feed = block[number]
            for direction in DIRECTIONS:
                # Every circle has its own temperature, hence its own correction.
                own = "" if name == NONE else f"{name} {len(tests)}"
                stop_s = _STOP_S if direction == DIRECTIONS[0] else 0.0
                tests.append(circle(direction, feed, repeat, "later", own, stop_s))
                places.append(name)
    return tests, places


def _oracle(bundle: Bundle, known: Run) -> Correction:
    angle = known.samples["angle_deg"] % 360.0
    order = np.argsort(angle)
    direction = str(known.meta.direction)
    error = {direction: (angle[order], known.samples["deviation_um"][order])}
    return oracle_correction(bundle, error, float(geometry()["correction_delay_s"]))


def _counted(corrections: Mapping[str, Correction], progress: Progress) -> Mapping[str, Correction]:
    total, done = len(corrections), 0

    def told(name: str, inner: Correction) -> Correction:
        def correct(test: CircularTest, command: Any) -> Any:
            nonlocal done
            done += 1
            progress(done, total, name)
            return inner(test, command)

        return correct

    return {name: told(name, inner) for name, inner in corrections.items()}
