"""A campaign with one row for each condition has the products of the whole one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_five_runs import LIBRARY, campaign

from dtwin.physics._condensed import condensed
from dtwin.physics._dictionary import dictionary_for
from dtwin.physics._material import weighed
from dtwin.physics.candidates import Candidates, applicable
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, Term, set_up


def whole(obs: Observations) -> tuple[Problem, Candidates, list[Term]]:
    instances, _ = applicable(LIBRARY, obs, [])
    candidates = Candidates(obs, instances)
    terms = [Term(i, i.effect.start_shape) for i in instances]
    # What moves with time is known, so that the basis differs between repeats.
    known = next(term for term in terms if term.instance.effect.name == "thermal_drift")
    problem = candidates.given(set_up(obs, [], []), [known])
    return problem, candidates, terms


@pytest.mark.parametrize("places_differ", [False, True])
def test_products_and_what_is_left_are_those_of_all_rows(places_differ: bool) -> None:
    rng = np.random.default_rng(3)
    obs = campaign(0.5 * np.ones((1, 1, 1)), rng)
    if places_differ:
        mask = obs.mask.copy()
        mask[0, :5] = False
        obs = replace(obs, mask=mask)
    problem, candidates, terms = whole(obs)
    few = condensed(problem, candidates)
    assert (len(few.root) < obs.n_rows) != places_differ

    long = np.concatenate([candidates.whitened(problem, t) for t in terms], axis=1)
    short = np.concatenate([few.columns(t) for t in terms], axis=1)
    size = np.sqrt((long**2).sum(axis=0))
    assert (size > 0.0).sum() >= 10
    size[size == 0.0] = 1.0
    np.testing.assert_allclose(
        (short / size).T @ (short / size), (long / size).T @ (long / size), atol=1e-9, err_msg="columns"
    )
    np.testing.assert_allclose(
        (short / size).T @ few.y, (long / size).T @ problem.y, atol=1e-9 * np.sqrt(len(problem.y))
    )
    assert few.residual @ few.residual == pytest.approx((problem.residual**2).sum(), rel=1e-10)
    fitted = short[:, :3] @ np.ones(3)
    np.testing.assert_allclose(
        few.expanded(fitted[:, None])[:, 0], long[:, :3] @ np.ones(3), atol=1e-9 * size[:3].max()
    )


def test_a_dictionary_of_terms_fits_what_differs_between_repeats() -> None:
    obs = campaign(0.5 * np.ones((1, 1, 1)), np.random.default_rng(4))
    instances, _ = applicable(LIBRARY, obs, [])
    terms = [Term(i, i.effect.start_shape) for i in instances if i.effect.name in ("thermal_drift", "thermal_shift")]
    problem = set_up(obs, [], [])
    dictionary = dictionary_for(problem, terms)
    fitted = dictionary.fitted(dictionary.add(terms))
    candidates = Candidates(obs, instances)
    columns = np.concatenate([candidates.whitened(problem, t) for t in terms], axis=1)
    columns = columns - problem.basis @ (problem.basis.T @ columns)
    left = problem.residual.ravel()
    np.testing.assert_allclose(
        fitted, columns @ np.linalg.lstsq(columns, left, rcond=None)[0], atol=1e-6 * np.abs(left).max()
    )
    assert np.linalg.norm(fitted) > 0.05 * np.linalg.norm(left)


def test_of_effects_that_what_is_known_explains_none_is_material() -> None:
    obs = campaign(0.5 * np.ones((1, 1, 1)), np.random.default_rng(4))
    instances, _ = applicable(LIBRARY, obs, [])
    known = next(Term(i, i.effect.start_shape) for i in instances if i.effect.name == "backlash")
    problem = set_up(obs, [known], [])
    assert weighed([known], [known], Candidates(obs, instances), problem)(False) == ([], {})
