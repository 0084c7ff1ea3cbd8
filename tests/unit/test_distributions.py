"""Tails and quantiles are those of scipy.stats, at the edges too."""

from __future__ import annotations

import math

import pytest
from scipy import stats

from dtwin.distributions import chi2_tail, f_quantile, f_tail, t_quantile, t_tail

DOF = (1.0, 2.5, 9.0, 400.0)
VALUES = (0.0, 0.3, 4.0, 60.0, math.inf)


@pytest.mark.parametrize("dof", DOF)
def test_they_agree_with_scipy_stats(dof: float) -> None:
    for p in (1e-6, 0.025, 0.5, 0.975):
        assert t_quantile(p, dof) == pytest.approx(stats.t.ppf(p, dof), rel=1e-9, abs=1e-12)
        assert f_quantile(p, (2.0, dof)) == pytest.approx(stats.f.isf(p, 2.0, dof), rel=1e-6)
    for value in VALUES:
        assert t_tail(value, dof) == pytest.approx(stats.t.sf(value, dof), rel=1e-9)
        assert t_tail(-value, dof) == pytest.approx(stats.t.sf(-value, dof), rel=1e-9)
        assert f_tail(value, (3.0, dof)) == pytest.approx(stats.f.sf(value, 3.0, dof), rel=1e-9)
        assert chi2_tail(value, dof) == pytest.approx(stats.chi2.sf(value, dof), rel=1e-9)


@pytest.mark.parametrize("noncentrality", [0.1, 7.0, 900.0])
def test_the_power_of_a_test_agrees_with_scipy_stats(noncentrality: float) -> None:
    for limit in (0.5, 4.0, 30.0):
        expected = stats.ncf.sf(limit, 1.0, 12.0, noncentrality)
        assert f_tail(limit, (1.0, 12.0), noncentrality) == pytest.approx(expected, abs=1e-9)


def test_what_lies_below_zero_leaves_everything_above() -> None:
    assert f_tail(-0.2, (2.0, 8.0)) == 1.0
    assert math.isnan(f_tail(math.nan, (2.0, 8.0)))
