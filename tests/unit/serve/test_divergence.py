"""The divergence alarm speaks when a correction grows on itself, and not otherwise."""

from __future__ import annotations

import pytest

from dtwin.serve.divergence import DivergenceWatch


@pytest.mark.parametrize(
    ("left", "told"),
    [
        ([2.7, 0.7, 0.01, 0.0, 0.02, 0.01], ""),
        ([2.7, 0.01, 0.02, 0.03, 0.04, 0.045], ""),
        ([2.7, 0.5, 0.6, 0.7, 0.8], "grown 3 windows"),
        ([2.7, 0.1, 0.2, 0.3, 0.4], ""),
        ([2.7, 0.5, 0.6, 0.55, 0.7, 0.8], ""),
        ([2.7, 0.5, 3.5, 0.1], "makes it worse: 3.50"),
        ([2.7, float("nan")], "makes it worse"),
    ],
)
def test_windows_inside_the_box(left: list[float], told: str) -> None:
    watch = DivergenceWatch()
    for value in left:
        watch.window(value)
    assert (told in watch.alarm) if told else not watch.alarm


def test_motion_that_is_thrown_out_of_the_box_twice() -> None:
    watch = DivergenceWatch()
    watch.window(2.7)
    assert not watch.window(2.5, inside=False)
    # At the edge of the noise nothing much is left: no alarm.
    assert not watch.window(0.04, inside=False)
    assert "thrown the motion out" in watch.window(2.6, inside=False)
    # It stays.
    assert watch.window(0.0)
