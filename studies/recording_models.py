"""Models of one recording: chosen and judged by the pass that they were not fitted to."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.physics.effect import Effect, Instance
from dtwin.physics.library import instances
from dtwin.physics.problem import Term
from dtwin.physics.state import State, has_joints
from dtwin.schema import Floats
from dtwin.statistics import rms
from studies.recording_effects import ARC_DIP, STOP_RINGING
from studies.recording_passes import Aligned
from studies.recording_search import Search

_PITCHES_MM = tuple(float(p) for p in np.geomspace(4.0, 60.0, 40))
_ORDERS = tuple(float(o) for o in np.arange(10.0, 421.0, 5.0))
_SMALLEST_GAIN = 0.01
_MOST_TERMS = 24
_RANK = 1e-6
_BLOCK = 50


@dataclass(frozen=True)
class Passes:
    """Both passes of every repeated stretch, all runs one after the other.

    ``y_um``, (n,): deviation in the first and in the second pass.
    """

    aligned: tuple[Aligned, ...]
    y_um: tuple[Floats, Floats]

    def columns(self, term: Term) -> tuple[Floats, Floats]:
        """Return an effect in the first and in the second pass, each of shape (n, k)."""
        effect, axis = term.instance.effect, term.instance.axis
        return self.both([effect.columns(a.state, axis, term.shape) for a in self.aligned])

    def both(self, whole: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Return rows of the first and of the second pass from rows of whole runs.

        ``whole``, (samples, ...): one array for each run.
        """
        pairs = [
            (values[s.first : s.end], values[s.second])
            for a, values in zip(self.aligned, whole, strict=True)
            for s in a.stretches
        ]
        return np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])


@dataclass(frozen=True)
class Rung:
    """A step of the model.

    ``parameters``: linear parameters of the model so far, set-up included.
    ``fit_um``, ``held_out_um``: RMS on the pass that was fitted, and on the other; mean square of both ways round.
    """

    term: Term
    parameters: int
    fit_um: float
    held_out_um: float


def passes_of(aligned: Sequence[Aligned]) -> Passes:
    """Return both passes of what the runs repeat."""
    whole = [a.run.samples["deviation_um"] for a in aligned]
    return Passes(tuple(aligned), Passes(tuple(aligned), (np.empty(0),) * 2).both(whole))


def setup_terms(library: Mapping[str, Effect], state: State) -> list[Term]:
    """Return centre and radius, which belong to the mounting of the bar."""
    return [
        Term(instance, {})
        for name in ("radius_offset", "centre_offset")
        for instance in instances(library[name], [state.plane], state.axes, joints=False)
    ]


def candidate_terms(library: Mapping[str, Effect], state: State, *, joints: bool, clock: bool) -> Iterator[Term]:
    """Return every effect at every shape that may be tried.

    ``state``: any run: tells axes and what was logged.
    ``clock``: with effects of the time since a stop.
    """
    own = [e for e in library.values() if e.per != "joint" or joints]
    for effect in [*own, *((STOP_RINGING, ARC_DIP) if clock else ())]:
        if effect.setup or state.kind not in effect.kinds or effect.on_spread:
            continue
        if effect.within_condition or not set(effect.needs) <= set(state.columns):
            continue
        places = (
            [Instance(effect)]
            if effect is ARC_DIP
            else instances(effect, [state.plane], state.axes, joints=has_joints(state.geometry))
        )
        grids = [_grid(effect, n) for n in range(len(effect.shapes))]
        names = [s.name for s in effect.shapes]
        for place in places:
            for values in itertools.product(*grids):
                yield Term(place, dict(zip(names, values, strict=True)))


def judge(y: tuple[Floats, Floats], columns: tuple[Floats, Floats]) -> tuple[float, float]:
    """Return RMS on the pass fitted and on the other pass, both ways round, in um.

    ``y``, ``columns``, (n,): first and second pass.
    """
    inside, outside = 0.0, 0.0
    for one, other in ((0, 1), (1, 0)):
        x = np.linalg.lstsq(columns[one], y[one], rcond=_RANK)[0]
        inside += float(((y[one] - columns[one] @ x) ** 2).mean()) / 2.0
        outside += float(((y[other] - columns[other] @ x) ** 2).mean()) / 2.0
    return float(np.sqrt(inside)), float(np.sqrt(outside))


def left_by_the_other(y: tuple[Floats, Floats], columns: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """Return what is left of each pass by the model fitted to the other, each of shape (n,)."""
    by_second = np.linalg.lstsq(columns[1], y[1], rcond=_RANK)[0]
    by_first = np.linalg.lstsq(columns[0], y[0], rcond=_RANK)[0]
    return y[0] - columns[0] @ by_second, y[1] - columns[1] @ by_first


def grow(passes: Passes, base: Sequence[Term], candidates: Sequence[Term]) -> list[Rung]:
    """Add one effect after the other, each the one that helps most on the other pass.

    ``base``: always in the model.
    Until nothing takes away a hundredth of the error on the pass not fitted.
    """
    pool = [(term, passes.columns(term)) for term in candidates]
    pool = [(t, c) for t, c in pool if all(np.abs(part).max() > 0.0 for part in c)]
    model = stack([passes.columns(term) for term in base])
    search = Search(passes.y_um, [columns for _, columns in pool])
    search.add(model)
    best_um = judge(passes.y_um, model)[1]
    rungs: list[Rung] = []
    free = np.ones(len(pool), dtype=bool)
    while len(rungs) < _MOST_TERMS and free.any():
        left_um = np.where(free, search.left_um(), np.inf)
        number = int(np.argmin(left_um))
        if left_um[number] > (1.0 - _SMALLEST_GAIN) * best_um:
            break
        term, columns = pool[number]
        model = stack([model, columns])
        search.add(columns)
        inside, best_um = judge(passes.y_um, model)
        rungs.append(Rung(term, int(np.linalg.matrix_rank(model[0], 1e-6)), inside, best_um))
        free &= [t is not term and (t.label != term.label or bool(t.instance.effect.shapes)) for t, _ in pool]
    return rungs


def best_of(passes: Passes, base: Sequence[Term], candidates: Sequence[Term]) -> tuple[Term, float] | None:
    """Return the one effect that helps most on the other pass, and the RMS it leaves in um.

    ``base``, ``candidates``: what is in the model, and what may be added.
    """
    pool = [(term, passes.columns(term)) for term in candidates]
    if not pool:
        return None
    search = Search(passes.y_um, [columns for _, columns in pool])
    search.add(stack([passes.columns(term) for term in base]))
    left_um = search.left_um()
    number = int(np.argmin(left_um))
    return pool[number][0], float(left_um[number])


def unseen_path_um(passes: Passes, columns: tuple[Floats, Floats]) -> float:
    """Return the RMS on parts of the path that no pass of the fit has seen, in um.

    One block in five is left out of the first pass and foretold in the second, and so round.

    ``columns``, (n, k): model in both passes.
    """
    fold = (np.arange(passes.y_um[0].size) // _BLOCK) % 5
    total = 0.0
    for left_out in range(5):
        out = fold == left_out
        for one, other in ((0, 1), (1, 0)):
            x = np.linalg.lstsq(columns[one][~out], passes.y_um[one][~out], rcond=_RANK)[0]
            total += float(((passes.y_um[other][out] - columns[other][out] @ x) ** 2).sum())
    return float(np.sqrt(total / (2 * fold.size)))


def harmonic_columns(passes: Passes, parameters: int, *, by_direction: bool) -> tuple[Floats, Floats]:
    """Return the lowest harmonics of the aligned angle, as many columns as asked for.

    ``by_direction``: each direction has harmonics of its own.
    """
    whole = []
    groups = len(passes.aligned) if by_direction else 1
    for number, aligned in enumerate(passes.aligned):
        theta = aligned.state.angle_rad
        waves = [np.ones_like(theta)]
        for order in range(1, parameters // (2 * groups) + 2):
            waves += [np.cos(order * theta), np.sin(order * theta)]
        block = np.zeros((theta.size, parameters))
        mine = range(number if by_direction else 0, parameters, groups)
        for wave, column in zip(waves, mine, strict=False):
            block[:, column] = wave
        whole.append(block)
    return passes.both(whole)


def look_up_um(passes: Passes) -> float:
    """Return the RMS that remains when one pass foretells the other, in um."""
    offsets = passes.y_um[1] - passes.y_um[0]
    return rms(offsets)


def stack(parts: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """Return columns side by side, for both passes."""
    return np.hstack([p[0] for p in parts]), np.hstack([p[1] for p in parts])


def _grid(effect: Effect, number: int) -> tuple[float, ...]:
    shape = effect.shapes[number]
    if effect.per == "joint" and shape.name == "order":
        return tuple(sorted({*shape.grid, *_ORDERS}))
    return shape.grid or _PITCHES_MM
