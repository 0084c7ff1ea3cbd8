"""Sizes that fits share: as one least squares of all readings has them, and who contradicts whom."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.physics.agreed import Quantity, Sizes, agreed, contradicting
from dtwin.schema import Floats

SCALE, LOST = (Quantity(name, "X", "size", "um", name) for name in ("scale", "lost"))
DAYS = ["2026-01-01", "2026-02-01", "2026-03-01"]


def alone(columns: Floats, read: Floats, of: tuple[Quantity | None, ...], noise: float) -> Sizes:
    inverse = np.linalg.inv(columns.T @ columns)
    return Sizes(of, inverse @ columns.T @ read, noise**2 * inverse, np.full(len(of), 1e3))


def measured(seed: int, scale: float, lost: float, noise: float = 0.5) -> Sizes:
    """Return what a test of 40 readings says of both, beside a zero of its own."""
    rng = np.random.default_rng(seed)
    columns = np.column_stack([np.ones(40), rng.normal(size=40), rng.normal(size=40)])
    read = columns @ [rng.normal(), scale, lost] + rng.normal(0.0, noise, 40)
    return alone(columns, read, (None, SCALE, LOST), noise)


def test_agreeing_fits_are_one_least_squares_of_all_readings() -> None:
    rng = np.random.default_rng(1)
    first = np.column_stack([np.ones(30), rng.normal(size=(30, 2))])
    # The second test sees one of them only, beside two numbers of its own.
    second = np.column_stack([rng.normal(size=(20, 2)), rng.normal(size=20)])
    reads = first @ [1.0, 3.0, -2.0] + rng.normal(size=30), second @ [5.0, 7.0, 3.0] + rng.normal(size=20)
    both = agreed([alone(first, reads[0], (None, SCALE, LOST), 1.0), alone(second, reads[1], (None, None, SCALE), 1.0)])
    whole = np.zeros((50, 5))
    whole[:30, :3], whole[30:, 3:], whole[30:, 1] = first, second[:, :2], second[:, 2]
    value = np.linalg.lstsq(whole, np.concatenate(reads), rcond=None)[0]
    spread = np.sqrt(np.diag(np.linalg.inv(whole.T @ whole)))
    assert both[0].value == pytest.approx(value[:3])
    assert both[1].value == pytest.approx(value[[3, 4, 1]])
    assert both[0].standard == pytest.approx(spread[:3])
    assert both[1].standard == pytest.approx(spread[[3, 4, 1]])


def test_what_a_fit_does_not_tell_takes_the_value_of_the_others() -> None:
    # Only the sum of both is told: along their difference anything may be.
    blind = Sizes(
        (SCALE, LOST),
        np.array([2.0, 2.0]),
        0.01 * np.eye(2) + 1e6 * np.array([[1.0, -1.0], [-1.0, 1.0]]),
        np.full(2, 20.0),
    )
    made = agreed([blind, measured(3, 3.0, 1.0)])
    assert made[0].value == pytest.approx(made[1].value[1:])
    assert made[0].value == pytest.approx([3.0, 1.0], abs=0.3)


def test_the_newest_that_differs_is_named_with_its_day_and_keeps_a_value_of_its_own() -> None:
    sizes = [measured(n, 3.0, 1.0 + 2.0 * (n == 2)) for n in range(3)]
    groups, (told,) = contradicting(sizes, [[(f"test-{n}", day)] for n, day in enumerate(DAYS)])
    assert (told.effect, told.campaigns, told.others) == ("lost", ("test-2",), ("test-0", "test-1"))
    assert (told.since, told.what) == ("2026-03-01", "change or mistake")
    assert told.difference == pytest.approx(2.0, abs=told.k2)
    apart = agreed(sizes, groups)
    assert apart[0].value[2] == pytest.approx(apart[1].value[2])
    assert apart[2].value[2] == pytest.approx(3.0, abs=0.4)
    assert apart[2].value[1] == pytest.approx(apart[0].value[1])


def test_a_lasting_change_is_no_mistake_and_tests_that_agree_contradict_nobody() -> None:
    changed = [measured(n, 3.0, 1.0 + 2.0 * (n > 0)) for n in range(3)]
    begun = [[(f"test-{n}", day)] for n, day in enumerate(DAYS)]
    _, (told,) = contradicting(changed, begun)
    assert (told.since, told.what) == ("2026-02-01", "change")
    quiet = [contradicting([measured(10 * k + n, 3.0, 1.0) for n in range(3)], begun)[1] for k in range(60)]
    assert sum(map(bool, quiet)) <= 3
