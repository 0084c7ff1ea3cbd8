"""Faults in the words of the shop: sizes with k = 2, and a picture of each signature."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from defusedxml.ElementTree import fromstring

from dtwin.kinds.volumetric.motions import FAMILIES
from dtwin.physics.fit import Estimate
from dtwin.physics.library import Library
from dtwin.report.faults import _size_of, found_faults, grouped, in_titles, sizes_of, undecided_lines
from dtwin.report.plots import polar_rings
from dtwin.report.signatures import signature_svg
from dtwin.report.text import WIDE, listed, table
from dtwin.report.twins import found_table

LIBRARY = Library()


def test_sentences_for_people_have_titles_in_place_of_names_for_commands() -> None:
    assert in_titles("tells scale_mismatch X from friction Y; friction with thermal_drift", LIBRARY) == (
        "tells Scale mismatch X from Friction Y; friction with Drift"
    )
    assert in_titles("add lead_error:X, backlash:X", LIBRARY) == "add Lead error X, Backlash X"


def estimate(name: str, value: float, uncertainty: float, unit: str = "um", *, told: bool = True) -> Estimate:
    return Estimate("e", "X", name, unit, value, uncertainty, told)


@pytest.mark.parametrize(
    ("estimates", "said"),
    [
        ([estimate("height", 3.1234, 0.2345)], "3.12 ± 0.23 µm"),
        ([estimate("height", -1234.5, 18.0)], "-1234 ± 18 µm"),
        ([estimate("height", 3.1, float("nan"))], "3.1 µm"),
        ([estimate("height", 3.1, 0.2, told=False)], "its size is not told by these runs"),
        ([estimate("cosine", 3.0, 0.1), estimate("sine", 4.0, 0.1)], "5.00 ± 0.10 µm"),
        (
            [
                estimate("compliance", 2.0, 0.1, "um/(m/s2)"),
                estimate("cosine_1", 3.0, 0.1),
                estimate("sine_1", -4.0, 0.1),
            ],
            "compliance 2.00 ± 0.10 µm/(m/s²); amplitude 5.00 ± 0.10 µm",
        ),
        ([estimate("shift_x", 1.0, 0.5), estimate("shift_y", 2.0, 0.5, told=False)], "1.00 ± 0.50 µm"),
        ([estimate("lag", 1.0, 0.5), estimate("extra", 2.0, 0.25)], "lag 1.00 ± 0.50 µm; extra 2.00 ± 0.25 µm"),
    ],
)
def test_a_size_is_rounded_to_its_uncertainty(estimates: list[Estimate], said: str) -> None:
    assert _size_of(estimates) == said


def test_many_names_and_sizes_do_not_make_a_page_wide() -> None:
    names = [f"effect_{n} X" for n in range(14)]
    assert listed(names) == "effect_0 X, effect_1 X, effect_2 X and 11 more"
    assert listed(names[:4], " or ") == "effect_0 X or effect_1 X or effect_2 X or 1 more"
    assert listed(names[:3], "; ") == "effect_0 X; effect_1 X; effect_2 X"
    (line,) = undecided_lines({"undecided": [["friction X", *names]]})
    assert line == f"these runs do not tell friction X from {listed(names)}: its size is that of it alone"
    sizes = [f"second axis order {n} at 100 mm -2.24 ± 0.55 µm" for n in (3, 4, 5)]
    told = table(("found", "size"), [("guideway_shape X", "; ".join(sizes)), ("a; b", 1.0)], WIDE).splitlines()
    assert max(map(len, told)) < 80
    assert told[2:] == [
        f"guideway_shape X  {sizes[0]};",
        f"                  {sizes[1]};",
        f"                  {sizes[2]}",
        "a; b              1",
    ]


def test_the_uncertainty_of_an_amplitude_covers_it() -> None:
    rng = np.random.default_rng(4)
    drawn = np.array([3.0, 4.0]) + rng.normal(0.0, 0.2, (400, 2))
    told = [_size_of([estimate("cosine", c, 0.4), estimate("sine", s, 0.4)]) for c, s in drawn]
    inside = [abs(float(a) - 5.0) <= float(u) for a, u in (re.findall(r"[\d.]+", t) for t in told)]
    assert 0.92 <= np.mean(inside) <= 0.98


def test_a_signature_is_drawn_for_both_directions() -> None:
    picture = fromstring(signature_svg(LIBRARY["backlash"], "Y"))
    curves = picture.findall("polygon")
    assert len(curves) == 2
    radii = [
        np.hypot(*(np.array(re.findall(r"[\d.]+", c.get("points")), float).reshape(-1, 2) - 150.0).T) for c in curves
    ]
    # The play of Y shows where Y reverses, at 90 and 270 degrees, and turns over with the direction.
    quarter = len(radii[0]) // 4
    for radius in radii:
        step = np.abs(np.diff(radius))
        assert abs(int(np.argmax(step)) % (2 * quarter) - quarter) <= 2
    away = np.abs(np.arange(len(radii[0])) % (2 * quarter) - quarter) > 2
    assert np.abs(radii[0] + radii[1] - 200.0)[away].max() < 0.3
    # What no circle shows is drawn along an axis, and a spread in repeats that differ where the axis creeps.
    assert all(signature_svg(effect) for effect in LIBRARY.values())
    # A page of all of them in small needs no more points than pixels.
    assert all(len(signature_svg(effect, width=48)) < 5000 for effect in LIBRARY.values())
    jerks = [
        np.hypot(*(np.array(re.findall(r"[\d.]+", c.get("points")), float).reshape(-1, 2) - 150.0).T)
        for c in fromstring(signature_svg(LIBRARY["stick_slip"], "Y")).findall("polygon")
    ]
    spread = np.std(jerks, axis=0)
    assert len(jerks) == 3
    assert spread[170:190].mean() > 20.0 * max(spread[350:370].mean(), 0.05)
    worn = fromstring(signature_svg(LIBRARY["worn_screw"])).findall("polyline")
    heights = [np.array(re.findall(r"[\d.]+", c.get("points")), float).reshape(-1, 2)[:, 1] for c in worn]
    assert np.allclose(heights[0] + heights[1], 300.0, atol=0.2)


@pytest.mark.parametrize("names", [("cosine_2", "sine_2"), ("half_wave_2", "half_wave_5")])
def test_waves_and_half_waves_have_one_size(names: tuple[str, str]) -> None:
    parts = [
        Estimate("pitch_error", "X", name, "um", value, 0.2, identifiable=True)
        for name, value in zip(names, (3.0, -4.0), strict=True)
    ]
    assert sizes_of(parts) == [("amplitude", 5.0, pytest.approx(0.2), "um")]


def test_the_size_of_a_group_is_that_of_its_first_alone() -> None:
    size = {"name": "scale", "value": 45.7, "uncertainty": 0.6, "unit": "um/m", "identifiable": True}
    common = {"size_um": 1.0, "cv_gain": 0.9, "grade": "", "tested": [], "untested": [], "sizes": [size]}
    scale, inertia = (
        {"effect": e, "axis": a, **common} for e, a in (("scale_mismatch", "XY"), ("inertial_compliance", ""))
    )
    rows = found_table({"found": [[scale, inertia], [scale]]}).rows
    assert [row[2] for row in rows] == ["scale 45.70 ± 0.60 µm/m, if it is the first alone", "scale 45.70 ± 0.60 µm/m"]


def test_every_effect_that_dtwin_ships_belongs_to_a_group_of_the_shop() -> None:
    groups = dict(grouped([*Library().values(), *FAMILIES.values()]))
    assert list(groups) == ["geometry", "drive", "dynamics", "heat", "instrument"]
    mine = replace(Library()["backlash"], name="cable_chain", group="")
    assert grouped([mine]) == [("your own", [mine])]
    ((spread,),) = found_faults({"variance": {"depends_on": ["feed", "stick_slip X"]}}, LIBRARY)
    assert (spread.title, spread.group, "svg" in spread.picture) == ("Stick-slip, X", "drive", True)


def test_rings_of_a_polar_plot_are_round_numbers_of_micrometres() -> None:
    division, rings = polar_rings(100.0, 3000.0)
    assert division == 5.0
    assert rings["ticktext"] == ["-10", "-5", "0", "+5", "+10"]
    assert rings["tickvals"] == pytest.approx([70.0, 85.0, 100.0, 115.0, 130.0])
