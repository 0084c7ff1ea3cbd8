"""Tails and quantiles are those of scipy.stats, at the edges too; Holm by hand."""

from __future__ import annotations

import math

import pytest
from scipy import stats

from dtwin.statistics import chi2_tail, f_quantile, f_tail, holm, rms, t_quantile, t_tail

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


def test_holm_counts_the_tests_that_are_left_and_never_falls_behind() -> None:
    # 0.01 * 3, 0.02 * 2, then 0.03 * 1 would be smaller than the one before it.
    assert holm([0.03, 0.01, 0.02]).tolist() == pytest.approx([0.04, 0.03, 0.04])
    assert holm([0.5, 0.6]).tolist() == [1.0, 1.0]
    # Three tests that are one are not corrected; no test at all is none.
    assert holm([0.02, 0.02, 0.02], tests=1.0).tolist() == pytest.approx([0.02] * 3)
    assert holm([]).size == 0


def test_the_root_of_the_mean_square_keeps_the_unit_and_is_nan_of_nothing() -> None:
    assert rms([[3.0, -4.0], [0.0, 0.0]]) == 2.5
    assert math.isnan(rms([]))
