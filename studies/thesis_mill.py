"""The mill of `dtwin demo mill`: circles like those of the source thesis, on a mill that warms up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dtwin.acquire.virtual_mill import PERIOD_S
from dtwin.machines.mill import SetupErrors, VirtualMill
from dtwin.machines.mill_parameters import CircularTest, HeatParameters, MillParameters, NoiseParameters
from dtwin.schema import Direction, Floats, Plane, Run

MACHINE = "told-right-mill"
PLANE: Plane = "XY"
RADIUS_MM = 50.0
FEEDS_MM_MIN = (100.0, 250.0, 500.0)
DIRECTIONS: tuple[Direction, Direction] = ("CCW", "CW")
RUNS_OF_A_FEED = 4
CAMPAIGN_RADII_MM = (50.0, 100.0)
CAMPAIGN_REPEATS = 3
_COOL_DOWN_S = 5400.0
_COOL_DOWN_AFTER = 5
# Centred with a dial gauge, as an operator of an ultra-precision machine does.
_MOUNTED = SetupErrors(centre_mm=0.02, radius_um=2.0)


def thesis_mill(seed: int, **settings: Any) -> VirtualMill:
    """Return a mill whose X axis grows with its temperature, and whose scale was set at one.

    ``seed``: of mountings, sampling and noise: one for each session.
    ``**settings``: further attributes of ``VirtualMill``.
    """
    parameters = MillParameters(
        squareness_um_m={PLANE: 30.0},
        heat=HeatParameters(rise_c=6.0, feed_mm_min=500.0, feed_share=0.4, time_constant_min=25.0),
    ).with_axis("X", scale_ppm=-50.0, growth_um_m_k=20.0)
    defaults: dict[str, Any] = {"noise": NoiseParameters(rms_um=0.2), "setup_errors": _MOUNTED}
    return VirtualMill(parameters, seed=seed, **(defaults | settings))


def geometry() -> dict[str, Any]:
    """Return what a campaign says of this machine."""
    # An offset is not fed forward: it arrives through the position loop.
    gain_1_s = thesis_mill(0).parameters.x.position_gain_1_s
    return {"type": "mill", "virtual": True, "correction_delay_s": 1.0 / gain_1_s + PERIOD_S}


def circle(
    direction: Direction, feed_mm_min: float, repeat: int, setup: str, correction: str = "", pause_s: float = 0.0
) -> CircularTest:
    """Return one circle of the thesis's test.

    ``direction``, ``feed_mm_min``, ``repeat``, ``setup``, ``correction``, ``pause_s``: as in ``CircularTest``.
    """
    return CircularTest(PLANE, direction, RADIUS_MM, feed_mm_min, repeat, setup, pause_s, correction=correction)


def measure_warm(mill: VirtualMill, tests: Sequence[CircularTest], warm_up: int) -> list[Run]:
    """Measure circles after others that only warm the machine.

    ``mill``: the machine, cold.
    ``tests``: what is kept.
    ``warm_up``: circles of 100 mm at the fastest feed before them.
    """
    return mill.measure([*_warming(warm_up, tests[0].setup), *tests])[warm_up:]


def session_of_the_thesis(seed: int, *, warm_up: int) -> list[Run]:
    """Measure one mounting of the bar: four runs of each feed, both directions, in order.

    ``seed``: of the session.
    ``warm_up``: circles before it.
    """
    tests = [
        circle(direction, feed, repeat, "learned")
        for feed in FEEDS_MM_MIN
        for repeat in range(1, RUNS_OF_A_FEED + 1)
        for direction in DIRECTIONS
    ]
    return measure_warm(thesis_mill(seed), tests, warm_up)


def designed_campaign(seed: int) -> list[Run]:
    """Measure two radii and all feeds in random order, with a cool-down in each mounting.

    It begins warm and stops in the middle of every mounting: what follows temperature turns back,
    what follows time goes on.

    ``seed``: of the session and of the order.
    """
    rng = np.random.default_rng([seed, 17])
    tests: list[CircularTest] = []
    for radius in CAMPAIGN_RADII_MM:
        pairs = [(f, r) for r in range(1, CAMPAIGN_REPEATS + 1) for f in FEEDS_MM_MIN]
        for place, number in enumerate(rng.permutation(len(pairs))):
            feed, repeat = pairs[number]
            for direction in DIRECTIONS:
                stop = place == _COOL_DOWN_AFTER and direction == DIRECTIONS[0]
                tests.append(
                    CircularTest(
                        PLANE, direction, radius, feed, repeat, f"r{radius:g}", pause_s=_COOL_DOWN_S if stop else 0.0
                    )
                )
    return measure_warm(thesis_mill(seed), tests, 20)


def temperatures_c(runs: Sequence[Run]) -> Floats:
    """Return the logged temperature of every run, shape (n,)."""
    return np.array([run.meta.covariates["temperature_c"] for run in runs])


def _warming(count: int, setup: str) -> list[CircularTest]:
    return [CircularTest(PLANE, "CCW", 100.0, FEEDS_MM_MIN[-1], k + 1, setup) for k in range(count)]
