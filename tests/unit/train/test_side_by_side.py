"""Fits side by side: as many as asked for, and none goes on when the caller has ended."""

from __future__ import annotations

import time
from concurrent.futures import CancelledError
from threading import Event

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from dtwin.progress import Progress
from dtwin.train.side_by_side import side_by_side


def test_fits_that_run_and_fits_that_wait_end_with_the_caller() -> None:
    begun = Event()
    ended: list[str] = []
    others: list[str] = []

    def fit(step: Progress) -> None:
        begun.set()
        try:
            while True:
                step(0, 1, "")
                time.sleep(0.001)
        except CancelledError:
            ended.append("in its middle")
            raise

    def interrupted() -> None:
        with side_by_side(1) as (pool, step):
            pool.submit(fit, step)
            pool.submit(others.append, "begun")
            assert begun.wait(10.0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert ended == ["in its middle"]
    assert others == []


def test_linear_algebra_takes_one_thread_in_each() -> None:
    np.ones((2, 2)) @ np.ones((2, 2))
    with side_by_side(2) as (pool, _):
        threads = [part["num_threads"] for part in pool.submit(threadpool_info).result()]
    assert threads
    assert set(threads) == {1}
