"""Name the effect that a twin lacks, or say that it cannot be named.

The order: runs that are not like their repeats, logged channels, the set of effects of the library
that explains most for what it costs, each tested beside all the others, their laws, and at last the
scaling law of what nothing explains. Where something is left, the search is made again beside laws without
a name. What was found stays, whatever is left beside it. The unit of
replication is always the run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from dtwin.physics import localise
from dtwin.physics._doubts import (
    LACK_OF_FIT,
    SPOKEN_OF,
    Tests,
    beside_places,
    doubted,
    follows_unknown,
    halves_of_lobes,
    hidden_by,
    is_dwarfed,
    standing_alone,
    without_dwarfed,
)
from dtwin.physics._grading import laws_of
from dtwin.physics._law_search import search_laws
from dtwin.physics._local_laws import laws_in_words, material_laws
from dtwin.physics._material import IMMATERIAL
from dtwin.physics._measured_once import as_if_repeated
from dtwin.physics._moved_setups import beside_moves
from dtwin.physics._nameless import local, nameless, simpler_law
from dtwin.physics._outliers import odd_of_two, odd_runs
from dtwin.physics._parity import Curve, curves_left, joined
from dtwin.physics._score import HIGHEST_HARMONIC
from dtwin.physics._screen import Channel, is_foreign, screen_channels, with_foreign
from dtwin.physics._search import Search, search_effects
from dtwin.physics._spread import spread_of, unsteady
from dtwin.physics._suspects import closest, members, sized, suspect, suspects
from dtwin.physics._trust import sum_um, trusted
from dtwin.physics._wording import many_runs, unexplained, unresolved_part
from dtwin.physics.candidates import Candidates, applicable
from dtwin.physics.diagnosis import Diagnosis, Verdict
from dtwin.physics.effect import Effect
from dtwin.physics.learned import can_learn
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, Term, set_up, unweighted, weighted_like
from dtwin.progress import tell
from dtwin.units import shown_number

_FIT_IS_DOUBTFUL = 0.05
# What was found must explain this share, or what is left must be this small beside the floor.
_EXPLAINED = 0.93
# What is found at one speed is what the curve looks like only, and is said so.
_EXPLAINED_AT_ONE_SPEED = 0.85
# Along an axis all effects of one parity move with the two conditions alike: what is left speaks against none of several.
_EXPLAINED_ALONG, _SEVERAL = 0.5, 4
_LEFT = 0.3
_LITTLE = 0.2
# So much of everything, as RMS, is something unknown, and not how far the library's laws are off.
_UNKNOWN = 0.3
# What is seen only beside laws without a name, and is less than this of the noise floor, may be what they leave.
_BESIDE_LAWS = 0.5

_NOTHING: tuple[Verdict, ...] = ("nothing_missing", "variance_effect")


def diagnose(obs: Observations, known: Sequence[Term], library: Mapping[str, Effect], *, seed: int = 0) -> Diagnosis:
    """Find out what a twin lacks.

    Args:
        known: Effects of the twin, without set-up terms.
        library: Effects that may be missing.
    """
    once = partial(_diagnosed, known=known, library=library, seed=seed)
    return beside_moves(obs, known, library, once(obs), once)


def _diagnosed(obs: Observations, known: Sequence[Term], library: Mapping[str, Effect], seed: int) -> Diagnosis:
    """Find out what a twin lacks, each set-up at one place."""
    tried, untestable = applicable(library, obs, known)
    tell(f"{obs.campaign.name}: {len(tried)} effects of the library, each alone")
    within = [Term(i, i.effect.start_shape) for i in tried if i.effect.within_condition]
    problem = set_up(obs, known, within)
    dropped = odd_runs(problem) or odd_of_two(problem, tried, lambda others: set_up(others, known, within))
    outliers = tuple(dict.fromkeys(obs.runs[i].run_id for i in dropped))
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
    noise = problem.noise
    if noise is None:
        return _once(blank, obs, known, library, seed)
    blank = replace(
        blank, noise_floor_um=noise.floor_um, floor_kind="repeats", spread=spread_of(obs, residual, library)
    )
    channels = screen_channels(problem, seed)
    beside = partial(with_foreign, channels=channels, library=library)
    problem = beside(problem)
    candidates = Candidates(obs, tried)
    searched = partial(_searched, candidates=candidates, beside=beside, seed=seed, shown_by_channel=bool(channels))
    concluded = partial(_concluded, blank, problem, candidates, known, channels, library, seed)
    first = searched(problem, known)
    answer = concluded(first, first)
    places = local(problem, candidates) if obs.there_and_back and answer.verdict not in _NOTHING else []
    if places:
        beside_them = [*known, *places]
        beside_laws = searched(beside(weighted_like(obs, beside_them, noise)), beside_them)
        other = concluded(beside_laws, first, places)
        return other if other.found else concluded(first, first, places, none=True)
    left = answer.unresolved
    much = left is not None and left.share >= _UNKNOWN**2
    if much:
        plain = unweighted(obs, known)
        curves = curves_left(answer, first, plain, candidates)
        beside_curves = [searched(problem, known, curve=curve) for curve in curves]
        if beside_curves:
            others = [concluded(other, first) for other in beside_curves]
            return joined(answer, others, [first, *beside_curves], plain, candidates)
    if not answer.found or not _has_laws(obs):
        return answer
    believed = frozenset(group[0].label for group in answer.found)
    tops = [f.top.term for f in first.found]
    simpler, rest = simpler_law(problem, candidates, tops)
    unknown = simpler
    if simpler:
        believed &= {term.label for term in rest}
    elif much:
        unknown = nameless(problem, candidates, [term for term in tops if term.label in believed])
    if not unknown:
        return answer
    beside_them = [*known, *unknown]
    beside_laws = searched(beside(weighted_like(obs, beside_them, noise)), beside_them)
    other = concluded(beside_laws, first, unknown, believed)
    if other.found:
        return other
    # One law without a name that leaves nothing is better than effects that leave much, and are not seen beside it.
    explains_all = len(unknown) == 1 and not beside_laws.found and beside_laws.lack_of_fit[0] > _FIT_IS_DOUBTFUL
    return concluded(first, first, none=True) if simpler or explains_all else answer


def _has_laws(obs: Observations) -> bool:
    """Tell whether what is unknown can be told by how it scales: circles at several speeds."""
    return can_learn(obs.grid.kind) and obs.several_speeds


def _searched(
    problem: Problem,
    known: Sequence[Term],
    candidates: Candidates,
    beside: Callable[[Problem], Problem],
    seed: int,
    shown_by_channel: bool,
    curve: Curve = lambda problem: problem,
) -> Search:
    """Search for what is missing beside what is known; once more where laws that were taken to be exact are not.

    ``curve``: takes out of a problem what is told by itself.
    """
    again = partial(
        search_effects,
        curve(problem),
        curve(unweighted(problem.obs, known)),
        candidates,
        known,
        beside=lambda reweighted: curve(beside(reweighted)),
        seed=seed,
        shown_by_channel=shown_by_channel,
    )
    first_search = again()
    if first_search.if_inexact is not None and doubted(first_search, 0.0, _tests(first_search)):
        # What is small may then be how far others are off.
        other = again(before=first_search)
        if _doubted_um(other) <= _doubted_um(first_search):
            return other
    return first_search


def _doubted_um(search: Search) -> float:
    """Return the size of what is found and doubted, RMS."""
    obs = search.plain.obs
    return localise.systematic_rms_um(obs, sum_um(doubted(search, 0.0, _tests(search)), obs))


def _once(
    blank: Diagnosis, obs: Observations, known: Sequence[Term], library: Mapping[str, Effect], seed: int
) -> Diagnosis:
    """Say what runs that were measured once look like; nothing of it is confirmed."""
    said = "no condition was repeated: the noise floor is not known"
    copied = as_if_repeated(obs, known, seed)
    if copied is None:
        return replace(blank, headline=said)
    copies, floor_um = copied
    diagnosis = _diagnosed(copies, known, library, seed)
    groups = tuple(tuple(replace(s, grade="shape-consistent") for s in group) for group in diagnosis.found)
    said += f", it is at least {shown_number(floor_um, 2)} µm (harmonics above {HIGHEST_HARMONIC})"
    names = "; ".join(" or ".join(s.label for s in group) for group in groups)
    return replace(
        blank,
        headline=f"{said}; it looks like {names}" if names else said,
        suspects=diagnosis.suspects,
        found=groups,
        unresolved=diagnosis.unresolved,
        invisible=diagnosis.invisible,
        floor_kind="within_run",
        noise_floor_um=floor_um,
    )


def _concluded(
    blank: Diagnosis,
    problem: Problem,
    candidates: Candidates,
    known: Sequence[Term],
    channels: Sequence[Channel],
    library: Mapping[str, Effect],
    seed: int,
    search: Search,
    first: Search,
    unknown: Sequence[Term] = (),
    believed: frozenset[str] = frozenset(),
    none: bool = False,
) -> Diagnosis:
    """Judge what a search found.

    ``problem``: whitened campaign with what the twin knows.
    ``unknown``: laws without a name that the search was made beside; they are a part of what is not resolved.
    ``believed``: labels that are believed without these laws; ``none``: nothing is believed.
    ``first``: the search beside nothing but what the twin knows.
    """
    obs = problem.obs
    bare = unweighted(obs, known)
    tests = _tests(search)
    words = localise.headline(obs, localise.in_angle(bare))
    few = f"tested, but {many_runs(obs)} do not tell what moves between them"
    blank = replace(
        blank,
        lack_of_fit_p=first.lack_of_fit[0],
        channels=tuple(channels),
        invisible=first.first.invisible,
        untestable={**blank.untestable, **dict.fromkeys(search.untold, few)},
    )
    foreign = tuple(c.name for c in channels if is_foreign(c.name, library))
    if not search.found:
        return _nothing_found(blank, search, candidates, known, channels, words)
    moving = screen_channels(search.last, seed) if channels else ()
    # A channel of the library's own that still moves with what is left has not been explained.
    late_um = (
        blank.noise_floor_um * max((c.share for c in moving if not is_foreign(c.name, library)), default=0.0) ** 0.5
    )
    much = _much_left(search, blank.noise_floor_um)
    doubts = doubted(search, late_um, tests)
    doubts += [f for f in halves_of_lobes(search, bare, candidates) if f not in doubts]
    doubts += hidden_by(doubts, search, tests)
    least_um = _BESIDE_LAWS * blank.noise_floor_um if unknown else 0.0
    if places := list(unknown) if obs.there_and_back else []:
        doubts += [f for f in beside_places(search, first) if f not in doubts]
    kept = [
        f
        for f in trusted(search, doubts, much)
        if (much or not is_dwarfed(f, search))
        and (f.label in believed or f.size_um >= least_um)
        and not follows_unknown(f, tests, search)
    ]
    kept = [] if none else standing_alone(kept, search, unweighted(obs, [*known, *unknown]), candidates)
    if obs.grid.in_plane and (len(kept) < len(search.found) or search.lack_of_fit[1] <= LACK_OF_FIT):
        kept = without_dwarfed(kept, bare, candidates)
    others = [f for f in search.found if f not in kept]
    told = unknown or much or others or _worth_telling(search, blank.noise_floor_um)
    terms = [f.top.term for f in kept]
    left = localise.in_angle(candidates.given(bare, [*terms, *places]))
    search = replace(search, first=first.first, systematic_um=(first.systematic_um[0], search.systematic_um[1]))
    fit_p = first.lack_of_fit[0] if others or unknown else search.lack_of_fit[1]
    places = material_laws(places, bare, terms, candidates, IMMATERIAL * blank.noise_floor_um)
    blank = replace(blank, places=tuple(_as_place(law) for law in places))
    beside_um, where = laws_in_words(places, bare, terms, candidates) if places else (0.0, "")
    unresolved = unresolved_part(search, left, fit_p, beside_um, where) if told else None
    laws = tuple(search_laws(candidates.given(problem, terms))) if told else ()
    # What was found and not believed is shown with the tests that say why.
    withdrawn = [
        replace(suspect(f.top, bare, search, candidates, f.gain), laws=tuple(tests[f.label][f.label])) for f in others
    ]
    likely = [members(f, tests[f.label], search, candidates, known) for f in kept]
    groups = sized(obs, [*known, *unknown], kept, likely)
    blank = replace(
        blank, suspects=suspects(search, candidates, known, groups, withdrawn), unresolved=unresolved, laws=laws
    )
    if not kept:
        return replace(
            blank,
            verdict="unknown_effect",
            headline=unexplained(where or words, channels, search, known),
            closest=closest(search, candidates) if search.untold else search.found[0].label,
        )
    single = all(len(group) == 1 for group in groups)
    verdict: Verdict = "missing_effect" if len(groups[0]) == 1 else "ambiguous"
    names = "; ".join(" or ".join(s.label for s in group) for group in groups)
    said = f"{names} {'is' if len(groups) == 1 else 'are'} missing" if single else names
    said += f": {words}"
    if unresolved is not None:
        said += f"; besides, {shown_number(unresolved.systematic_rms_um, 2)} µm is not resolved" + f": {where}" * bool(
            where
        )
    if foreign:
        said += f"; besides, something moves with {', '.join(foreign)}"
    return replace(blank, verdict=verdict, headline=said, found=groups)


def _as_place(law: Term) -> dict[str, Any]:
    return {"effect": law.instance.effect.name, "axis": law.instance.axis, "shape": dict(law.shape)}


def _tests(search: Search) -> Tests:
    return {f.label: laws_of(f, len(search.found)) for f in search.found}


def _nothing_found(
    blank: Diagnosis,
    search: Search,
    candidates: Candidates,
    known: Sequence[Term],
    channels: Sequence[Channel],
    words: str,
) -> Diagnosis:
    fit_p, left_um = search.lack_of_fit[0], search.systematic_um[0]
    shown, obs = suspects(search, candidates, known, ()), search.plain.obs
    moves = "".join(f"; {said}" for said in [unsteady(obs, localise.in_angle(search.plain))] if said)
    if left_um < IMMATERIAL * blank.noise_floor_um and not channels:
        said = f"what repeats agree on ({shown_number(left_um, 2)} µm) is small beside the noise floor"
        return replace(blank, verdict=_quiet(blank), headline=said + moves, suspects=shown)
    laws = tuple(search_laws(search.last)) if fit_p <= _FIT_IS_DOUBTFUL else ()
    if fit_p > LACK_OF_FIT and not laws and not channels:
        said = "residual is at the noise floor"
        if blank.spread:
            said += f"; its spread depends on {', '.join(blank.spread.depends_on)}"
        return replace(blank, verdict=_quiet(blank), headline=said + moves, suspects=shown)
    return replace(
        blank,
        verdict="unknown_effect",
        suspects=shown,
        laws=laws,
        unresolved=unresolved_part(search, localise.in_angle(search.plain), search.lack_of_fit[1]),
        headline=unexplained(words, channels, search, known),
        closest=closest(search, candidates),
    )


def _much_left(search: Search, floor_um: float) -> bool:
    """Tell whether what was found leaves structure: certainly some, or probably much."""
    p_value, left_um = search.lack_of_fit[-1], search.systematic_um[-1]
    certain = p_value <= LACK_OF_FIT and left_um > _LITTLE * floor_um
    probable = p_value <= _FIT_IS_DOUBTFUL and left_um > _LEFT * floor_um
    obs = search.plain.obs
    several = obs.there_and_back and len(search.found) >= _SEVERAL
    along = _EXPLAINED_ALONG if several else _EXPLAINED_AT_ONE_SPEED
    enough = _EXPLAINED if obs.several_speeds else along
    return (certain or probable) and search.explained < enough


def _worth_telling(search: Search, floor_um: float) -> bool:
    """Tell whether what is left is certain, and large enough to be spoken of."""
    first_um, left_um = search.systematic_um
    return search.lack_of_fit[-1] <= LACK_OF_FIT and left_um > max(_LITTLE * floor_um, SPOKEN_OF * first_um)


def _quiet(blank: Diagnosis) -> Verdict:
    return "variance_effect" if blank.spread else "nothing_missing"
