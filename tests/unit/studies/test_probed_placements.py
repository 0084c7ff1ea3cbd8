"""Where a probed block lies: known geometry is found again, and the rules flag what they should."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dtwin.errors import InputError
from studies.machines.probed_block import Block, probe
from studies.placement_campaign import SETTINGS
from studies.probed_placements import COUNTS, NOT_SQUARE, SETUP_SLIP, TRAVEL_LIMIT, locate

CENTRE_MM = np.array([0.137, -0.211, 0.043])


def readings(turned_deg: float = 0.4, temperature_c: float = 34.5, centre_mm: np.ndarray = CENTRE_MM) -> np.ndarray:
    block = Block(centre_mm, np.radians(turned_deg), temperature_c)
    return probe(block, 0.0, np.random.default_rng(1))


@pytest.mark.parametrize("turned_deg", [-3.0, 0.0, 0.4, 5.0])
def test_a_block_that_is_shifted_turned_and_warm_is_found(turned_deg: float) -> None:
    placed = locate(readings(turned_deg), 34.5, 0.0, SETTINGS)
    np.testing.assert_allclose(placed.error_um, 1e3 * CENTRE_MM, atol=1e-6)
    assert placed.turned_deg == pytest.approx(turned_deg)
    assert placed.flag == COUNTS


def test_without_its_temperature_the_block_seems_to_have_moved_by_half_its_growth() -> None:
    warm = readings(0.0, 34.5)
    cold_believed = locate(warm, 20.0, 0.0, SETTINGS).error_um - 1e3 * CENTRE_MM
    rise = 14.5 * 11.5e-6 * 1e3
    np.testing.assert_allclose(cold_believed, [10.0 * rise, 17.5 * rise, 10.0 * rise], rtol=1e-6)


def test_a_correction_along_the_axes_instead_of_the_normals_would_be_seen() -> None:
    turned = readings(3.0, 20.0, np.zeros(3))
    along_axis_um = 1e3 * (turned[:2].mean() - SETTINGS.half_x_mm - SETTINGS.ball_radius_mm)
    assert abs(along_axis_um) > 10.0
    assert np.abs(locate(turned, 20.0, 0.0, SETTINGS).error_um).max() < 1e-6


def test_each_rule_flags_by_name() -> None:
    far = readings(centre_mm=np.array([4.0, -4.0, 0.0]))
    assert locate(far, 34.5, 0.0, SETTINGS).flag == TRAVEL_LIMIT
    assert locate(readings(), 34.5, 31.0, SETTINGS).flag == SETUP_SLIP
    chipped = readings()
    chipped[1] += 0.1
    assert locate(chipped, 34.5, 0.0, SETTINGS).flag == NOT_SQUARE
    wide = replace(SETTINGS, search_mm=5.0)
    assert locate(readings(), 34.5, 0.0, wide).flag == COUNTS


def test_readings_that_are_no_readings_are_refused() -> None:
    for wrong in (np.zeros(4), np.array([1.0, 2.0, np.nan, 0.0, 0.0])):
        with pytest.raises(InputError, match="five finite"):
            locate(wrong, 20.0, 0.0, SETTINGS)
