import math

import pytest

from dtwin.errors import InputError
from dtwin.units import is_number, require_units, shown_number, shown_setting, shown_unit


@pytest.mark.parametrize("value", [0, -2.5, 1e300])
def test_finite_numbers_are_numbers(value: float) -> None:
    assert is_number(value)


@pytest.mark.parametrize("value", [True, math.nan, -math.inf, 10**400, "1", None])
def test_truth_values_text_and_what_no_float_holds_are_none(value: object) -> None:
    assert not is_number(value)


@pytest.mark.parametrize(
    ("unit", "shown"),
    [("um/(m/s2)", "µm/(m/s²)"), ("ms2", "ms²"), ("urad", "µrad"), ("um/m", "µm/m"), ("ppm", "ppm"), ("1", "1")],
)
def test_units_are_shown_with_their_signs(unit: str, shown: str) -> None:
    assert shown_unit(unit) == shown


@pytest.mark.parametrize(
    ("value", "digits", "shown"),
    [
        (183.4, 2, "180"),
        (98_765.4, 3, "98800"),
        (0.00123, 2, "0.0012"),
        (-0.0, 3, "0"),
        (-12.34, 3, "-12.3"),
        (2.5e-7, 2, "2.5e-07"),
        (float("nan"), 3, "nan"),
    ],
)
def test_numbers_for_people_are_rounded_and_have_no_exponent(value: float, digits: int, shown: str) -> None:
    assert shown_number(value, digits) == shown
    if value > 0.0:
        assert shown_number(value, digits, sign="+") == f"+{shown}"


def test_settings_are_words_with_their_units() -> None:
    told = [("axis", "Z"), ("frequency_hz", "5"), ("z_bandwidth_hz", "50"), ("amplitude_um", "2")]
    shown = [shown_setting(name, value) for name, value in told]
    assert shown == ["axis Z", "frequency 5 Hz", "z bandwidth 50 Hz", "amplitude 2 µm"]


@pytest.mark.parametrize("name", ["temperature_x\n[gcode_macro P]\n_c", "a\u2028b_um", "a\x1b[2J_um", "\u202ea_um"])
def test_a_name_that_would_be_lines_or_signs_of_its_own_is_refused(name: str) -> None:
    with pytest.raises(InputError, match="cannot be printed") as refused:
        require_units(["t_s", name], "day-1.parquet")
    assert "\n" not in str(refused.value.got)
    assert require_units(["t_s", "temperature_Spindel vorn_c"], "x")["t_s"] == "s"
