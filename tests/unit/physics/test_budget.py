"""How much each cause makes of an error: against sizes computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.acquire.virtual_mill import _standard_tests
from dtwin.machines.mill import VirtualMill
from dtwin.machines.mill_parameters import MillParameters, NoiseParameters
from dtwin.physics.budget import Budget, budget
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.observations import observe
from dtwin.physics.twin import chosen_terms, twin_of
from dtwin.twins.budget_spread import _repeats_um, spread_as_dict, spread_budget

LIBRARY = Library()
RADII_MM = (50.0, 100.0, 150.0)


def told(mill: MillParameters, effects: list[str]) -> tuple[Budget, float]:
    made = VirtualMill(mill, seed=3, noise=NoiseParameters(rms_um=0.1))
    tests = _standard_tests(3, planes=("XY",))
    obs = observe(made.campaign(), made.measure(tests))
    fitted = fit(obs, chosen_terms(effects, LIBRARY, obs))
    twin = twin_of(fitted, obs, name="t", version=1, action="fit", data={})
    radius = np.array([test.radius_mm for test in tests])
    return budget(twin, obs), float(np.sqrt((radius**2).mean()))


def test_the_rms_of_a_cause_is_that_of_its_ellipse() -> None:
    mill = MillParameters(squareness_um_m={"XY": 60.0}).with_axis("X", scale_ppm=40.0)
    found, radius_mm = told(mill, ["squareness", "scale_mismatch"])
    shares = {share.label: share for share in found.shares}
    # An angle s makes s R sin(2t) / 2 of the radius, a scale s of one axis s R cos(2t) / 2 beside a wrong radius.
    for label, s in (("squareness XY", 60.0), ("scale_mismatch XY", 40.0)):
        expected = 1e-3 * s * radius_mm / 2.0 / np.sqrt(2.0)
        share = shares[label]
        assert share.rms_um[""] == pytest.approx(expected, rel=0.03)
        assert share.rms_um["XY"] == share.rms_um[""]
        assert abs(share.rms_um[""] - expected) < 2.0 * share.uncertainty_um + 0.02 * expected
    assert [s.label for s in found.shares] == ["squareness XY", "scale_mismatch XY"]
    # The two are at right angles: without one the other is left.
    assert shares["squareness XY"].left_um == pytest.approx(shares["scale_mismatch XY"].rms_um[""], rel=0.05)
    assert found.error_um == pytest.approx(np.hypot(*(s.rms_um[""] for s in found.shares)), rel=0.02)
    assert found.unexplained_um < 0.1 * found.error_um
    assert found.unexplained_um < found.left_um < min(share.left_um for share in found.shares)
    assert found.left_largest_um < shares["squareness XY"].largest_um < found.largest_um


def test_what_is_left_is_as_sure_as_it_says() -> None:
    """Runs that differ as a whole, beside noise: the RMS of campaigns made again scatters by what one of them foretells."""
    rng = np.random.default_rng(0)
    made = VirtualMill(MillParameters(squareness_um_m={"XY": 60.0}), seed=3, noise=NoiseParameters(rms_um=0.1))
    obs = observe(made.campaign(), made.measure(_standard_tests(3, planes=("XY",))[:12]))
    fitted = fit(obs, chosen_terms(["squareness"], LIBRARY, obs))
    twin = twin_of(fitted, obs, name="t", version=1, action="fit", data={})
    told = []
    for _ in range(40):
        size = 1.0 + 0.1 * rng.normal(size=obs.run_of.max() + 1)[obs.run_of, None]
        told.append(_repeats_um(again := obs.with_y(size * obs.y_um), again.y_um))
        told.append(again.rms(again.y_um))
    k2, rms = np.array(told).reshape(40, 2).T
    assert np.mean(k2) == pytest.approx(2.0 * rms.std(ddof=1), rel=0.3)
    found, spread = spread_budget(twin, obs)
    (share,) = found.shares
    # One plane is all there is, and without its one cause nothing but noise is left.
    assert spread.parts[share.label]["XY"] == pytest.approx(share.uncertainty_um)
    assert spread.left[share.label] == pytest.approx(spread.left_of_all, rel=0.2)
    assert found == budget(twin, obs)
    assert spread_as_dict(found, spread)["shares"][0]["k2_um"]["left"] == spread.left[share.label]
