"""Which numbers can be computed with."""

from __future__ import annotations

import warnings

import numpy as np

from dtwin.acquire._readings import usable


def test_single_precision_is_judged_without_a_warning() -> None:
    values = np.array([0.0, 1.5, np.inf, np.nan], dtype=np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert usable(values).tolist() == [True, True, False, False]
    assert usable(np.array([1e99, 1e101])).tolist() == [True, False]
