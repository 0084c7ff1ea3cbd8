"""A later session on the mill: every way of correcting, interleaved, in one mounting of the bar."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dtwin.acquire.thesis_mill import (
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
from dtwin.machines.mill import Correction, SetupErrors
from dtwin.machines.mill_noise import NoiseParameters
from dtwin.machines.mill_parameters import CircularTest
from dtwin.schema import Run
from dtwin.serve.bundle import Bundle
from dtwin.train.evidence import ConditionResult, Evidence, condition_result
from dtwin.train.mill_evidence import (
    TRANSPORT_S,
    ServedCorrection,
    by_direction,
    oracle_correction,
)

NONE, ORACLE = "none", "oracle"
_WARM_UP = 2
# Short jobs with stops between them: the machine stays cooler than after hours of work.
_STOP_S = 900.0
_QUIET: Mapping[str, Any] = {
    "noise": NoiseParameters(rms_um=0.0),
    "setup_errors": SetupErrors(centre_mm=0.0, radius_um=0.0, jitter_us=0.0, trigger_samples=0.0),
}
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Way:
    """One way of correcting.

    Attributes
    ----------
    bundle : Bundle
        What is served.
    change : callable, optional
        What the bench makes of the correction; it arrives as it is without.
    """

    bundle: Bundle
    change: Callable[[Correction], Correction] | None = None


@dataclass(frozen=True)
class LaterSession:
    """What was measured.

    Attributes
    ----------
    runs : dict of str to dict
        By way and feed: runs as ``condition_result`` takes them, with ``raw_um``.
    temperature_c : tuple of float
        Lowest and highest logged temperature.
    """

    runs: Mapping[str, Mapping[float, Sequence[dict[str, Any]]]]
    temperature_c: tuple[float, float]

    def conditions(self, way: str) -> tuple[ConditionResult, ...]:
        """Return before and after of every feed, set-up-corrected, the run as unit.

        Parameters
        ----------
        way : str
            One of the ways.
        """
        out = []
        for feed in FEEDS_MM_MIN:
            runs = {
                "uncompensated": self.runs[NONE][feed],
                "compensated": self.runs[way][feed],
                "oracle": self.runs[ORACLE][feed],
            }
            found = condition_result(PLANE, RADIUS_MM, feed, True, runs)
            out.append(by_direction(found, runs))
        return tuple(out)

    def evidence(self, way: str, bundle: Bundle) -> Evidence:
        """Return the closed-loop evidence for a way, as promotion asks for it.

        Parameters
        ----------
        way : str
            One of the ways.
        bundle : Bundle
            What was served in it.
        """
        delay_s = float(geometry()["correction_delay_s"])
        return Evidence(
            kind="virtual",
            clock="machine clock (correction at 500 Hz, axes at 1 kHz)",
            bundle_sha256=bundle.sha256,
            conditions=self.conditions(way),
            delays={"position_loop_s": delay_s - TRANSPORT_S, "transport_s": TRANSPORT_S},
        )

    def raw_um(self, way: str, feed: float) -> float:
        """Return the mean absolute reading of a way's runs, mounting and all.

        Parameters
        ----------
        way : str
            One of the ways.
        feed : float
            Feed in mm/min.
        """
        return float(np.mean([run["raw_um"] for run in self.runs[way][feed]]))


def later_session(
    ways: Mapping[str, Way], *, seed: int, repeats: int, progress: Progress | None = None
) -> LaterSession:
    """Mount the bar anew on the cold machine, and measure all ways in random order.

    The oracle knows the repeatable error of every single circle, at its temperature, and has the
    guard and the delay of the first way.

    Parameters
    ----------
    ways : mapping of str to Way
        Ways of correcting; ``none`` and ``oracle`` are added.
    seed : int
        Of the session.
    repeats : int
        Of every way, feed and direction.
    progress : callable, optional
        Called with (done, total, what).
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
    found: dict[str, dict[float, list[dict[str, Any]]]] = {
        name: {feed: [] for feed in FEEDS_MM_MIN} for name in names
    }
    for test, name, run in zip(tests, places, runs, strict=True):
        acted = served[test.correction].acted[test.direction] if name in ways else {}
        found[name][test.feed_mm_min].append(_row(test, run, acted))
    seen = temperatures_c(runs)
    return LaterSession(found, (float(seen.min()), float(seen.max())))


def _interleaved(
    names: Sequence[str], seed: int, repeats: int
) -> tuple[list[CircularTest], list[str]]:
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


def _counted(
    corrections: Mapping[str, Correction], progress: Progress | None
) -> Mapping[str, Correction]:
    if progress is None:
        return corrections
    total, done = len(corrections), 0

    def told(name: str, inner: Correction) -> Correction:
        def correct(test: CircularTest, command: Any) -> Any:
            nonlocal done
            done += 1
            progress(done, total, name)
            return inner(test, command)

        return correct

    return {name: told(name, inner) for name, inner in corrections.items()}


def _row(test: CircularTest, run: Run, acted: Mapping[str, int]) -> dict[str, Any]:
    reading = run.samples["deviation_um"]
    return {
        "direction": test.direction,
        "angle_rad": np.radians(run.samples["angle_deg"]) % (2.0 * np.pi),
        "deviation_um": reading,
        "raw_um": float(np.abs(reading).mean()),
        "acted": acted,
    }
