"""Name the effect that a twin lacks, or say that it cannot be named.

The order: runs that are not like their repeats, logged channels, every effect of the library one
by one until nothing significant is left, the laws of what was found, and at last the scaling law
of what nothing explains. The unit of replication is always the run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from dtwin.physics import localise
from dtwin.physics.candidates import Candidate, Candidates, applicable
from dtwin.physics.cross_validation import left_out_gain
from dtwin.physics.diagnosis import Diagnosis, Grade, Suspect, Verdict
from dtwin.physics.effect import Effect
from dtwin.physics.law_search import search_laws
from dtwin.physics.laws import LawTest, law_tests
from dtwin.physics.observations import Observations
from dtwin.physics.outliers import odd_runs
from dtwin.physics.problem import Problem, Term, set_up, unweighted
from dtwin.physics.screen import Channel, screen_channels
from dtwin.physics.search import IMMATERIAL, Search, search
from dtwin.physics.spread import spread_of
from dtwin.schema import Floats

LACK_OF_FIT = 0.003
_FIT_IS_DOUBTFUL = 0.05
# What was found must explain this share, or what is left must be this small beside the floor.
_EXPLAINED = 0.93
_LEFT = 0.3
_LITTLE = 0.2
_SHOWN = 8


def diagnose(
    obs: Observations,
    known: Sequence[Term],
    library: Mapping[str, Effect],
    *,
    seed: int = 0,
) -> Diagnosis:
    """Find out what a twin lacks.

    Parameters
    ----------
    obs : Observations
        The runs.
    known : sequence of Term
        Effects of the twin, without set-up terms.
    library : mapping of str to Effect
        Effects that may be missing.
    seed : int
        Seed of permutations.
    """
    tried, untestable = applicable(library, obs, known)
    within = [Term(i, i.effect.start_shape) for i in tried if i.effect.within_condition]
    problem = set_up(obs, known, within)
    dropped = odd_runs(problem)
    outliers = tuple(obs.runs[i].run_id for i in dropped)
    if dropped:
        obs = obs.without(dropped)
        problem = set_up(obs, known, within)
    residual = localise.residual_um(obs, known)
    blank = Diagnosis(
        verdict="need_repeats",
        headline="",
        residual_rms_um=obs.rms(residual),
        systematic_rms_um=localise.systematic_rms_um(obs, residual),
        noise_floor_um=float("nan"),
        floor_kind="none",
        lack_of_fit_p=float("nan"),
        where=localise.worst_places(obs, residual),
        untestable=untestable,
        outlier_runs=outliers,
    )
    if problem.noise is None:
        return replace(blank, headline="no condition was repeated: the noise floor is not known")
    blank = replace(
        blank,
        noise_floor_um=problem.noise.floor_um,
        floor_kind="repeats",
        spread=spread_of(obs, residual, library),
    )
    channels = screen_channels(problem, seed)
    problem = _with_foreign(problem, channels, library)
    candidates = Candidates(obs, tried)
    plain = unweighted(obs, known)
    found = search(problem, plain, candidates, seed=seed, shown_by_channel=bool(channels))
    moving = tuple(c.name for c in screen_channels(found.last, seed)) if channels else ()
    return _concluded(blank, found, candidates, known, channels, moving, residual, library)


def _concluded(
    blank: Diagnosis,
    found: Search,
    candidates: Candidates,
    known: Sequence[Term],
    channels: Sequence[Channel],
    moving: Sequence[str],
    residual: Floats,
    library: Mapping[str, Effect],
) -> Diagnosis:
    obs = found.last.obs
    words = localise.headline(obs, residual)
    fit_p = found.lack_of_fit[0]
    blank = replace(blank, lack_of_fit_p=fit_p, channels=tuple(channels), invisible=found.invisible)
    foreign = tuple(c for c in channels if _is_foreign(c.name, library))
    left_um = found.systematic_um[0]
    if not found.steps:
        if left_um < IMMATERIAL * blank.noise_floor_um and not channels:
            shown = _suspects(found, candidates, known, (), {})
            said = f"what repeats agree on ({left_um:.2g} um) is small beside the noise floor"
            return replace(blank, verdict=_quiet(blank), headline=said, suspects=shown)
        laws = tuple(search_laws(found.last)) if fit_p <= _FIT_IS_DOUBTFUL else ()
        shown = _suspects(found, candidates, known, (), {})
        unexplained = [c.name for c in channels]
        if fit_p > LACK_OF_FIT and not laws and not unexplained:
            said = "residual is at the noise floor"
            if blank.spread:
                said += f"; its spread depends on {', '.join(blank.spread.depends_on)}"
            return replace(blank, verdict=_quiet(blank), headline=said, suspects=shown)
        return replace(
            blank, verdict="unknown_effect", headline=_unexplained(words, unexplained),
            suspects=shown, laws=laws, closest=_closest(found.tested),
        )  # fmt: skip
    step = found.steps[0]
    tests = {c.term.label: _laws_of(found, candidates, c) for c in step.group[:_SHOWN]}
    group = [c for c in step.group if not _broken(tests.get(c.term.label, []))]
    shown = _suspects(found, candidates, known, group, tests)
    # A channel of the library's own that still moves with what is left has not been explained.
    wrong_law = not group or any(not _is_foreign(name, library) for name in moving)
    if wrong_law or _much_left(found, blank.noise_floor_um):
        return replace(
            blank,
            verdict="unknown_effect",
            headline=_unexplained(words, [c.name for c in channels]),
            suspects=tuple(replace(s, in_group=False) for s in shown),
            laws=tuple(search_laws(step.problem)),
            closest=step.top.term.label,
        )
    verdict: Verdict = "missing_effect" if len(group) == 1 else "ambiguous"
    names = " or ".join(c.term.label for c in group)
    said = f"{names} is missing: {words}" if len(group) == 1 else f"{names}: {words}"
    if foreign:
        said += f"; besides, something moves with {', '.join(c.name for c in foreign)}"
    return replace(blank, verdict=verdict, headline=said, suspects=shown)


def _unexplained(words: str, moving: Sequence[str]) -> str:
    said = f"no known effect explains it: {words}"
    return f"{said}; it moves with {', '.join(moving)}" if moving else said


def _much_left(found: Search, floor_um: float) -> bool:
    """Tell whether what was found leaves structure: certainly some, or probably much."""
    p_value, left_um = found.lack_of_fit[-1], found.systematic_um[-1]
    certain = p_value <= LACK_OF_FIT and left_um > _LITTLE * floor_um
    probable = p_value <= _FIT_IS_DOUBTFUL and left_um > _LEFT * floor_um
    return (certain or probable) and found.explained < _EXPLAINED


def _quiet(blank: Diagnosis) -> Verdict:
    return "variance_effect" if blank.spread else "nothing_missing"


def _laws_of(found: Search, candidates: Candidates, candidate: Candidate) -> list[LawTest]:
    """Test the law of a candidate with all later effects taken out."""
    first = found.steps[0]
    problem = first.problem
    for step in found.steps[1:]:
        term = step.top.term
        visible = candidates.visible(problem, term)
        problem = problem.extended(visible, candidates.whitened(problem, term))
    visible = candidates.visible(problem, candidate.term)
    if not visible.shape[1]:
        return []
    return law_tests(problem, candidates, replace(candidate, visible=visible), first.level)


def _broken(tests: Sequence[LawTest]) -> bool:
    return any(test.broken for test in tests)


def _grade(candidate: Candidate, tests: Sequence[LawTest], group: Sequence[Candidate]) -> Grade:
    """Grade a name: its law counts as confirmed when every variable of it was tested."""
    law = candidate.term.instance.effect.law
    wanted = {"feed"} if law.feed is not None else set()
    wanted |= {"direction"} if law.direction != "mixed" else set()
    by_variable = {test.variable: test for test in tests}
    enough = (
        law.feed is not None
        and not _broken(tests)
        and all(name in by_variable and by_variable[name].confirmed for name in wanted)
        and ("radius" not in by_variable or by_variable["radius"].confirmed)
    )
    return "law-confirmed" if enough and len(group) == 1 else "shape-consistent"


def _suspects(
    found: Search,
    candidates: Candidates,
    known: Sequence[Term],
    group: Sequence[Candidate],
    tests: Mapping[str, Sequence[LawTest]],
) -> tuple[Suspect, ...]:
    step = found.steps[0] if found.steps else None
    tested = step.tested if step else found.tested
    p_values = step.p_values if step else found.p_values
    problem = step.problem if step else found.last
    members = [c.term.label for c in group]
    rivals = {c.term.label for c in step.group} if step else set()
    rest = sorted((c for c in tested if c.term.label not in members), key=lambda c: -c.score.gain)
    total = max(found.systematic_um[0] ** 2 * float(problem.obs.mask.sum()), 1e-300)
    plain = unweighted(problem.obs, known)
    out = []
    for candidate in [*group, *rest][:_SHOWN]:
        label = candidate.term.label
        effect = candidate.term.instance.effect
        whitened = candidates.whitened(plain, candidate.term)
        visible = candidates.visible(plain, candidate.term)
        after = plain.extended(visible, whitened)
        gain = (step.gains if step else {}).get(label)
        if gain is None:
            gain = left_out_gain(problem, candidates.whitened(problem, candidate.term))
        own = tests.get(label, ())
        inside = label in members
        out.append(
            Suspect(
                effect=effect.name,
                axis=candidate.term.instance.axis,
                rms_after_um=problem.obs.rms(localise.in_angle(after)),
                cv_gain=gain,
                p_value=p_values[label],
                in_group=inside,
                grade=_grade(candidate, own, group) if inside else None,
                confounded_with=tuple(sorted(rivals - {label})) if label in rivals else (),
                laws=tuple(own),
                share=min(1.0, float(((visible.T @ plain.residual.ravel()) ** 2).sum()) / total),
                remedy=effect.remedy,
            )
        )
    return tuple(out)


def _with_foreign(
    problem: Problem, channels: Sequence[Channel], library: Mapping[str, Effect]
) -> Problem:
    """Take out what moves with a channel that no effect knows, so that it is not noise."""
    obs = problem.obs
    theta = obs.grid.phase_rad
    waves = [np.ones(obs.n_bins)] + [f(h * theta) for h in range(1, 5) for f in (np.cos, np.sin)]
    for channel in channels:
        if not _is_foreign(channel.name, library):
            continue
        values = obs.centred_columns[channel.name]
        columns = np.stack([values * wave for wave in waves], axis=2) * obs.mask[:, :, None]
        whitened = problem.whitened(columns)
        visible, _ = problem.visible(whitened)
        problem = problem.extended(visible, whitened)
    return problem


def _is_foreign(name: str, library: Mapping[str, Effect]) -> bool:
    return name != "time_h" and all(name not in effect.needs for effect in library.values())


def _closest(tested: Sequence[Candidate]) -> str | None:
    if not tested:
        return None
    best = max(tested, key=lambda c: c.score.gain)
    return best.term.label if best.score.gain > 0.0 else None
