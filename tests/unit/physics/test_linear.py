"""ISO 230-2 figures against values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.physics.linear import linear_figures


def test_figures_of_a_case_worked_out_by_hand() -> None:
    # Two positions, two runs: means 1 and 5 forward, -1 and 2 backward.
    forward = np.array([[0.0, 2.0], [4.0, 6.0]])
    backward = np.array([[-1.0, -1.0], [0.0, 4.0]])
    found = linear_figures(forward, backward)
    s_forward, s_backward = np.sqrt(2.0), np.sqrt(8.0)
    assert found.reversal_um == pytest.approx(3.0)
    assert found.mean_reversal_um == pytest.approx(2.5)
    assert found.systematic_forward_um == pytest.approx(4.0)
    assert found.systematic_backward_um == pytest.approx(3.0)
    assert found.systematic_um == pytest.approx(6.0)
    assert found.mean_deviation_um == pytest.approx(3.5)
    assert found.repeatability_forward_um == pytest.approx(4 * s_forward)
    assert found.repeatability_backward_um == pytest.approx(4 * s_backward)
    assert found.repeatability_um == pytest.approx(2 * s_forward + 2 * s_backward + 3.0)
    # Highest: 2 + 2 s_b = 7.657 backward, 5 + 2 s_f = 7.828 forward; lowest: 2 - 2 s_b.
    assert found.accuracy_um == pytest.approx(5 + 2 * s_forward - (2 - 2 * s_backward))
    assert found.accuracy_forward_um == pytest.approx(4.0 + 4 * s_forward)


def test_a_perfect_axis_has_nothing() -> None:
    found = linear_figures(np.zeros((11, 5)), np.zeros((11, 5)))
    assert set(vars(found).values()) == {0.0}


@pytest.mark.parametrize(
    ("forward", "backward"),
    [
        (np.zeros((5, 1)), np.zeros((5, 1))),
        (np.zeros((5, 3)), np.zeros((4, 3))),
        (np.zeros(5), np.zeros(5)),
        (np.full((5, 3), np.nan), np.zeros((5, 3))),
    ],
)
def test_what_is_no_test_is_refused(forward: np.ndarray, backward: np.ndarray) -> None:
    with pytest.raises(InputError):
        linear_figures(forward, backward)
