"""Fits side by side: as many as the processors that are free, and none goes on when the caller has ended."""

from __future__ import annotations

import time
from concurrent.futures import CancelledError, ProcessPoolExecutor
from multiprocessing import get_context
from threading import Event, Lock

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from dtwin.processes import processors
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
    # Whatever the environment says.
    with threadpool_limits(2, "blas"):
        assert set(_blas_threads()) == {2}
        with side_by_side(2) as (pool, _):
            assert set(pool.submit(_blas_threads).result()) == {1}


def test_a_process_of_a_pool_fits_one_model_at_a_time() -> None:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        assert pool.submit(_most_at_once).result() == 1
    assert _most_at_once() == processors()


def _blas_threads() -> list[int]:
    return [part["num_threads"] for part in threadpool_info() if part["user_api"] == "blas"]


def _most_at_once() -> int:
    """Return how many of twice as many fits as there are processors are under way at a time."""
    under_way, most, lock = 0, 0, Lock()

    def fit() -> None:
        nonlocal under_way, most
        with lock:
            under_way += 1
            most = max(most, under_way)
        time.sleep(0.05)
        with lock:
            under_way -= 1

    with side_by_side() as (pool, _):
        for _ in range(2 * processors()):
            pool.submit(fit)
    return most
