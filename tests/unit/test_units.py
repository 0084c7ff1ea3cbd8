import math

import pytest

from dtwin.units import is_number


@pytest.mark.parametrize("value", [0, -2.5, 1e300])
def test_finite_numbers_are_numbers(value: float) -> None:
    assert is_number(value)


@pytest.mark.parametrize("value", [True, math.nan, -math.inf, 10**400, "1", None])
def test_truth_values_text_and_what_no_float_holds_are_none(value: object) -> None:
    assert not is_number(value)
