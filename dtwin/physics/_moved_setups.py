"""Set-ups whose centre moved between runs at one feed and runs at another, though they have one name."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dtwin.physics import localise
from dtwin.physics.diagnosis import Diagnosis, Unresolved
from dtwin.physics.effect import Effect, Instance
from dtwin.physics.fit import fit
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.units import shown_number

# A move is so many times the noise floor, and with centres of their own less than this share of the mean square is left.
_FLOORS, _LESS = 5.0, 0.5
# What is a smaller share of the largest move is none.
_PART = 0.1
# The last of what a set-up has on a circle.
_CENTRE = 2


@dataclass(frozen=True)
class _Move:
    """How far the centre of a set-up, by its number, is at runs of another feed from where it is at runs of one feed; and k = 2 of it."""

    setup: int
    name: str
    um: float
    unsure_um: float
    feeds_mm_min: tuple[float, float]

    def __str__(self) -> str:
        """Return it in words."""
        first, second = (shown_number(feed) for feed in self.feeds_mm_min)
        return f"as if set-up {self.name} had moved by {shown_number(self.um, 2)} µm between its runs at {first} and {second} mm/min"


def beside_moves(
    obs: Observations,
    known: Sequence[Term],
    library: Mapping[str, Effect],
    diagnosis: Diagnosis,
    again: Callable[[Observations], Diagnosis],
) -> Diagnosis:
    """Return what is found where the runs of each feed have a centre of their own, if set-ups moved between feeds; else what was found.

    ``diagnosis``: where each set-up has one centre; ``again``: returns the diagnosis of other runs.
    """
    if not obs.grid.in_plane or diagnosis.unresolved is None:
        return diagnosis
    moved = _moves(obs, _with_found(known, diagnosis, library), range(len(obs.setups)), diagnosis.noise_floor_um)
    if not moved:
        return diagnosis
    own = {move.setup for move in moved}
    other = again(_by_feed(obs, own))
    terms = _with_found(known, other, library)
    moved = [move for move in _moves(obs, terms, own, diagnosis.noise_floor_um) if move.um > move.unsure_um]
    left_um = 0.0 if other.unresolved is None else other.unresolved.systematic_rms_um
    if not moved or left_um**2 > _LESS * diagnosis.unresolved.systematic_rms_um**2:
        return diagnosis
    left = localise.residual_um(obs, terms)
    words = "; ".join(str(move) for move in moved) + "; give runs after a move a set-up of another name"
    rms_um = localise.systematic_rms_um(obs, left)
    share = min(1.0, (rms_um / max(diagnosis.systematic_rms_um, 1e-9)) ** 2)
    unresolved = Unresolved(rms_um, share, diagnosis.unresolved.p_value, words, localise.worst_places(obs, left))
    return replace(
        other,
        verdict=other.verdict if other.found else "unknown_effect",
        headline=f"{other.headline}; {words}" if other.found else words,
        unresolved=unresolved,
        residual_rms_um=diagnosis.residual_rms_um,
        systematic_rms_um=diagnosis.systematic_rms_um,
        lack_of_fit_p=diagnosis.lack_of_fit_p,
        where=diagnosis.where,
    )


def _with_found(known: Sequence[Term], diagnosis: Diagnosis, library: Mapping[str, Effect]) -> list[Term]:
    tops = [group[0] for group in diagnosis.found]
    return [*known, *(Term(Instance(library[top.effect], top.axis), top.shape) for top in tops)]


def _by_feed(obs: Observations, setups: Collection[int]) -> Observations:
    """Return the same runs; of some set-ups, runs at each feed have one of their own."""
    feeds = [obs.conditions[c].feed_mm_min for c in obs.condition_of]
    keys = [
        (int(s), feed if int(s) in setups else None, obs.setups[s]) for s, feed in zip(obs.setup_of, feeds, strict=True)
    ]
    number = {key: n for n, key in enumerate(dict.fromkeys(keys))}
    names = tuple(name if feed is None else f"{name} F{feed:g}" for _, feed, name in number)
    return replace(obs, setups=names, setup_of=np.array([number[key] for key in keys]))


def _moves(obs: Observations, terms: Sequence[Term], setups: Collection[int], floor_um: float) -> list[_Move]:
    """Return how far some set-ups moved most between feeds, the largest first; beside effects."""
    by_feed = _by_feed(obs, setups)
    centres = fit(by_feed, terms, refine=False).setups
    names = by_feed.grid.setup_names[-_CENTRE:]
    moved = []
    for setup in setups:
        rows = np.flatnonzero(obs.setup_of == setup)
        feed_of = {int(by_feed.setup_of[row]): obs.conditions[obs.condition_of[row]].feed_mm_min for row in rows}
        pairs = [(a, b) for a in feed_of for b in feed_of if feed_of[a] < feed_of[b]]
        for a, b in pairs:
            apart_um = float(np.hypot(*(centres[b][name] - centres[a][name] for name in names)))
            unsure_um = float(np.hypot(*(np.hypot(*centres[n]["uncertainty_um"][-_CENTRE:]) for n in (a, b))))
            if apart_um > _FLOORS * floor_um:
                moved.append(_Move(setup, obs.runs[int(rows[0])].setup, apart_um, unsure_um, (feed_of[a], feed_of[b])))
    moved.sort(key=lambda move: -move.um)
    largest = {move.setup: move for move in reversed(moved)}.values()
    return [move for move in moved if move in largest and move.um > _PART * moved[0].um]
