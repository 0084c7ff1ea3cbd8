"""Stand-ins for arrays: complex numbers, points of a known path, and what is not told."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dtwin.serve.builder import GraphBuilder
from dtwin.train.traced import NotTold, NotTraceable, Traced, TracedAlong


def response(rate: Any, size: Any) -> Any:
    """Return a second-order response as effects write it, and its parts in one number."""
    s = 1j * rate
    denominator = s**2 + 0.3 * s * size + np.square(s - 2.0) - (4.0 - 1j) / (s + 1.0)
    return size * s * np.exp(1j * np.array([0.4])) / denominator


def test_complex_arithmetic_is_that_of_numpy() -> None:
    builder = GraphBuilder()
    rate, size = (Traced([builder.input(name)]) for name in ("rate", "size"))
    told = response(rate, size)
    graph = builder.graph({"re": told.real.columns[0], "im": told.imag.columns[0]})
    for r, a in np.random.default_rng(1).uniform(0.3, 4.0, (20, 2)):
        found, _ = graph.evaluate({"rate": r, "size": a}, {})
        wanted = complex(response(np.array([r]), np.array([a]))[0])
        assert complex(found["re"], found["im"]) == pytest.approx(wanted, rel=1e-12)


def test_what_no_operator_carries_is_refused() -> None:
    rate = Traced([GraphBuilder().input("rate")])
    turning = 1j * rate
    for attempt in (
        lambda: np.exp(turning),
        lambda: turning**0.5,
        lambda: np.add.reduce(turning),
        lambda: 2.0 + NotTold("the weather"),
        lambda: rate * NotTold("the weather"),
        lambda: np.where(NotTold("the weather"), 1.0, 2.0),
    ):
        with pytest.raises(NotTraceable):
            attempt()


def test_what_is_asked_of_a_whole_path_is_a_number() -> None:
    builder = GraphBuilder()
    x = TracedAlong(builder.input("x"), np.array([3.0, -1.0, 3.0, 2.0]))
    assert (x.min(), x.max(), np.ptp(x)) == (-1.0, 3.0, 4.0)
    assert np.unique(x).tolist() == [-1.0, 2.0, 3.0]
    share = (x - x.min()) / np.ptp(x)
    graph = builder.graph({"share": share.columns[0]})
    assert graph.evaluate({"x": 1.0}, {})[0] == {"share": 0.5}
    with pytest.raises(NotTraceable):
        np.mean(x)
