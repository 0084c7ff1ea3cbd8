"""MkDocs hook: which effects a set of circles cannot tell apart, computed from the library."""

from __future__ import annotations

from typing import Any

import numpy as np

from dtwin.physics.candidates import applicable
from dtwin.physics.experiment import planned_observations
from dtwin.physics.fit import Alias, find_aliases
from dtwin.physics.library import Library
from dtwin.physics.problem import Term, least_visible, unweighted
from dtwin.plan import expand

PLACE = "<!-- confusion groups -->"
_SETS = (
    ("One circle, counter-clockwise", [100.0], [2000.0], ["CCW"]),
    ("The same circle in both directions", [100.0], [2000.0], ["CCW", "CW"]),
    ("Three feeds, both directions", [100.0], [1000.0, 2000.0, 4000.0], ["CCW", "CW"]),
    ("Three feeds, two radii, both directions", [50.0, 150.0], [1000.0, 2000.0, 4000.0], ["CCW", "CW"]),
)
_REPEATS = 3


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Insert what every set of circles leaves open."""
    return markdown.replace(PLACE, _sections()) if PLACE in markdown else markdown


def _sections() -> str:
    library = Library()
    parts = []
    for title, radii, feeds, directions in _SETS:
        grid = {
            "plane": ["XY"],
            "radius_mm": radii,
            "feed_mm_min": feeds,
            "repeats": _REPEATS,
            "directions": directions,
        }
        plan = expand({"plan": {"name": "set", "machine": "mill"}, "grid": grid}, title)
        runs = plan.n_runs
        # A machine that warms up and is left to cool once: time and temperature part.
        warm = 3.0 * np.sin(np.linspace(0.0, 1.4 * np.pi, runs))
        obs = planned_observations(plan, {"temperature_c": 20.0 + warm})
        tried, _ = applicable(library, obs, [])
        terms = [Term(i, i.effect.start_shape) for i in tried]
        problem = unweighted(obs, [])
        hidden = [
            t.label
            for t in terms
            if not problem.visible(problem.whitened(obs.regressors(t.instance, t.shape)), least=least_visible(t))[
                0
            ].size
        ]
        listed = _lines(find_aliases(obs, terms))
        parts.append(
            f"## {title}\n\n{runs} runs, {len(terms)} effects with their axes. What shares a shape with what:\n\n{listed}\n\n"
            f"Absorbed by the set-up: {', '.join(hidden) or 'nothing'}.\n"
        )
    return "\n".join(parts)


def _lines(aliases: list[Alias]) -> str:
    """Return one line for each effect that another one imitates."""
    alike: dict[str, list[str]] = {}
    for alias in aliases:
        alike.setdefault(alias.first, []).append(alias.second)
    return "\n".join(f"- {first}: {', '.join(rest)}" for first, rest in alike.items()) or "- none"
