"""The thesis's tracking figures: its own arithmetic, and closed forms of the chain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from studies.tracking_figures import BLOCK_RATE_HZ, BLOCK_SAMPLES, PUBLISHED, Pass, published_figures, reduce_passes

FEEDS = (2000.0, 4000.0, 5000.0)
BLOCK_S = (BLOCK_SAMPLES - 1) / BLOCK_RATE_HZ
# Mean over a block of x = a t^2 / 2, in um for each mg.
UM_PER_MG = 9.80665e3 * BLOCK_S**2 / 6.0


def one(feed: float, direction: str, repeat: int, bar_um: float, pull_mg: float) -> Pass:
    """Return a pass whose acceleration is constant and points outwards all the way."""
    angle = np.linspace(0.2, 6.0, 16)
    outward = np.stack([-np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    blocks = 1e-3 * pull_mg * np.repeat(outward[:, :, None], BLOCK_SAMPLES, axis=2)
    bar = np.full(16, bar_um)
    return Pass(feed, direction, repeat, angle, bar, np.zeros(16), blocks, slice(4, 12))


def passes(gaps: dict[float, float], pulls: dict[float, float]) -> list[Pass]:
    return [one(f, d, r, gaps[f] + 0.1 * (r - 2), pulls[f]) for f in FEEDS for d in ("CCW", "CW") for r in (1, 2, 3)]


def test_the_published_per_cents_follow_from_the_published_means() -> None:
    told = published_figures()
    assert told["mean_of_per_cents"] == pytest.approx(41.3, abs=0.05)
    bar, acc, enc = (np.array(PUBLISHED[k]) for k in ("ball_bar", "accelerometer", "encoder"))
    np.testing.assert_allclose(100.0 * (acc - enc) / (bar - enc), PUBLISHED["reduction_pct"], atol=0.5)
    assert told["per_cent_of_sums"] == pytest.approx(100.0 * 49.4 / 125.0, abs=0.1)
    # By hand for F2000: gap 16.9, mean of the others 27.025: 40.1 %.
    others = ((125.0 - g) / 4.0 for g in (16.9, 22.6, 26.0, 34.6, 24.9))
    by_hand = [100 * (1 - abs(g - o) / g) for g, o in zip((16.9, 22.6, 26.0, 34.6, 24.9), others, strict=True)]
    assert by_hand[0] == pytest.approx(40.1, abs=0.05)
    assert told["constant_of_other_feeds_pct"] == pytest.approx(np.mean(by_hand), abs=0.1)


def test_a_block_of_constant_acceleration_moves_by_a_t_squared_over_six() -> None:
    made = one(5000.0, "CCW", 1, 0.0, 2.0)
    np.testing.assert_allclose(made.corrected_um(0.0), 2.0 * UM_PER_MG, rtol=2e-3)
    # Above its power, the threshold takes the line away.
    np.testing.assert_allclose(made.corrected_um(1e3), 0.0, atol=1e-12)


def test_a_displacement_that_is_the_gap_closes_it_and_a_control_cannot() -> None:
    gaps = {2000.0: 10.0, 4000.0: -20.0, 5000.0: 40.0}
    pulls = {f: g / UM_PER_MG for f, g in gaps.items()}
    found = reduce_passes(passes(gaps, pulls))
    assert found.reduction_pct == pytest.approx(100.0, abs=1.0)
    constant, other = found.controls.values()
    assert constant < 0.0
    assert other < 0.0
    for feed in found.feeds:
        # Repeats differ by 0.1 um: -0.1, 0, 0.1.
        assert feed["ball_bar_floor_um"] == pytest.approx(0.1)
        assert feed["runs"] == 6


def test_going_past_the_bar_is_not_a_success() -> None:
    gaps = {f: 10.0 for f in FEEDS}
    doubled = passes(gaps, {f: 0.0 for f in FEEDS})
    doubled = [replace(p, encoder_um=p.encoder_um + 0.0, bar_um=-p.bar_um) for p in doubled]
    pulled = [replace(p, blocks_g=one(p.feed_mm_min, "CCW", 1, 0.0, 10.0 / UM_PER_MG).blocks_g) for p in doubled]
    found = reduce_passes(pulled)
    # The swarm's best is to switch the wrong way off.
    assert found.reduction_pct == pytest.approx(0.0, abs=1e-6)


def test_what_a_mounting_explains_does_not_count_along_the_path() -> None:
    made = passes({f: 10.0 for f in FEEDS}, {f: 0.0 for f in FEEDS})
    eccentric = [replace(p, bar_um=p.bar_um + 70.0 * np.cos(p.angle_rad - 1.0)) for p in made]
    path = reduce_passes(eccentric).along_the_path
    assert path["gap_um"] == pytest.approx(0.0, abs=1e-9)
    assert path["left_um"] == pytest.approx(0.0, abs=1e-9)
