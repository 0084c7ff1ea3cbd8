"""Formulas as effects: text that can be read back, and nothing but formulas."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dtwin.errors import InputError
from dtwin.train.formula import parse_formula
from dtwin.train.residual_formula import _INPUTS, formula_effect


def expressions() -> st.SearchStrategy[str]:
    leaf = st.sampled_from(_INPUTS) | st.floats(-9, 9).map(lambda x: f"({x!r})")
    return st.recursive(
        leaf,
        lambda inner: (
            st.tuples(inner, st.sampled_from("+-*"), inner).map(lambda p: f"({p[0]} {p[1]} {p[2]})")
            | inner.map(lambda a: f"sin({a})")
            | inner.map(lambda a: f"(-{a})")
            | inner.map(lambda a: f"square({a})")
        ),
        max_leaves=8,
    )


@given(expressions(), st.integers(0, 2**32 - 1))
def test_text_says_what_the_formula_says(text: str, seed: int) -> None:
    values = {n: np.random.default_rng(seed).uniform(-1, 1, 5) for n in _INPUTS}
    formula, constants = parse_formula(text, _INPUTS)
    again, others = parse_formula(formula.text(constants), _INPUTS)
    np.testing.assert_array_equal(again.values(values, others), formula.values(values, constants))


@pytest.mark.parametrize("text", ["__import__('os')", "t", "c1.real", "lambda: 1", "c1 if r else 2"])
def test_only_formulas_become_effects(text: str) -> None:
    with pytest.raises(InputError, match="not a formula"):
        formula_effect("learned_formula_00000000", text)
