"""The steps of a campaign on a machine: programs in order, with and without a correction."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dtwin.acquire.programs import gcode, urscript
from dtwin.errors import InputError
from dtwin.plan import Plan, PlannedTest
from dtwin.train.closed_loop import FEWEST_REPEATS, FEWEST_RUNS


@dataclass(frozen=True)
class Step:
    """One program that an operator runs once.

    ``programs``: text of the program in each language, by file name.
    ``correction``: ``Bundle.model_sha256`` of the model that must be served meanwhile, empty for none.
    """

    run_id: str
    title: str
    programs: Mapping[str, str]
    stated: Mapping[str, Any]
    correction: str = ""
    serve: str = ""

    @property
    def wanted(self) -> str:
        """With or without what."""
        return f"under {self.correction[:12]}" if self.correction else "without a correction"

    @property
    def ask_for_correction(self) -> str:
        """What the operator has to do before it."""
        if self.correction:
            return f"with the correction: start it now: {self.serve}"
        return "without the correction: end dtwin serve now (Ctrl-C there)"


def circle_steps(plan: Plan) -> tuple[Step, ...]:
    """Return the tests of a plan of circles, one step each."""
    return tuple(_step(plan, test) for test in plan.tests)


def by_turns(plan: Plan, correction: str, serve: str) -> tuple[Step, ...]:
    """Return the tests of a plan, each once without and once with a correction, by turns.

    The order within each pair is drawn from the plan's seed.

    ``correction``, ``serve``: as for :class:`Step`.
    """
    counts = Counter((t.plane, t.radius_mm, t.feed_mm_min) for t in plan.tests)
    least = min(counts.values())
    if least < FEWEST_REPEATS or least * len(plan.directions) < FEWEST_RUNS:
        raise InputError(
            "the plan repeats too little for evidence",
            code="campaign.few",
            where=plan.name,
            got=f"{least} repeats in {len(plan.directions)} directions",
            allowed=f"{FEWEST_REPEATS} repeats or more, and {FEWEST_RUNS} runs of a condition each way",
            hint="repeats under [grid] of the plan",
        )
    rng = np.random.default_rng([plan.seed, 59])
    steps: list[Step] = []
    for step in circle_steps(plan):
        pair = [
            replace(step, run_id=f"{step.run_id}-without", title=f"{step.title}, without"),
            replace(
                step,
                run_id=f"{step.run_id}-with",
                title=f"{step.title}, with the correction",
                correction=correction,
                serve=serve,
            ),
        ]
        steps += [pair[i] for i in rng.permutation(2)]
    return tuple(steps)


def _step(plan: Plan, test: PlannedTest) -> Step:
    return Step(
        run_id=test.test_id,
        title=f"{test.plane} R{test.radius_mm:g} F{test.feed_mm_min:g}, repeat {test.repeat}, set-up {test.setup}",
        programs={
            f"{test.test_id}.nc": gcode(test, plan.directions),
            f"{test.test_id}.script": urscript(test, plan.directions),
        },
        stated={
            "plane": test.plane,
            "radius_mm": test.radius_mm,
            "feed_mm_min": test.feed_mm_min,
            "repeat": test.repeat,
            "setup": test.setup,
        },
    )
