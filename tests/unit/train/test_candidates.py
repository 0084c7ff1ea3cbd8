"""Comparison models: sound inputs, and what is said of those that do harm."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.train.comparison_models import RECIPES, Recipe, fitted
from dtwin.train.results import Candidate, Scores, r2_text, worse_in_sample


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda r: r.name)
def test_an_input_that_only_rounding_moves_does_no_harm_elsewhere(recipe: Recipe) -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(400, 3))
    x[:, 0] = 66.7 + 1e-6 * rng.normal(size=400)
    target = 20.0 * x[:, 1] + rng.normal(size=400)
    group = np.repeat(np.arange(8), 50)
    model = fitted(recipe, 1, x, target, np.array([100.0, 3.0, 3.0]), group)
    assert model.used.tolist() == [False, True, True]
    elsewhere = x + np.array([33.3, 50.0, 0.0])
    limit = 2.0 * np.abs(target).max()
    assert np.abs(model.predict(elsewhere)).max() < limit
    assert np.std(target - model.predict(x)) < np.std(target)


def candidate(name: str, train_rms_um: float) -> Candidate:
    return Candidate(name, "linear", False, 1, {"run": Scores("run", 0.0, 1, 1, 1, "", 2, 2)}, train_rms_um)


def test_a_baseline_that_is_worse_than_nothing_where_it_was_fitted_is_told() -> None:
    (told,) = worse_in_sample([candidate("zero", 48.0), candidate("a", 47.0), candidate("b", 324.0)])
    assert told.startswith("b is worse than no correction on the rows that it was fitted to (324 against 48 µm)")
    assert len(worse_in_sample([candidate("zero", 48.0), candidate("c", float("nan"))])) == 1
    assert worse_in_sample([candidate("b", 324.0)]) == []


def test_a_large_error_is_no_number_but_a_sentence() -> None:
    assert r2_text(-2e14, 1e9, 48.0) == "worse than no correction"
    assert r2_text(-3.0, 40.0, 48.0) == "-3.000"
    assert r2_text(0.0, 48.0, 48.0) == "0.000"
    assert r2_text(-1.0, 90.0, None) == "-1.000"
