"""Formatting of quantities and shares."""

import math

import pytest

from model.quantities import in_display_unit, percent, with_error


@pytest.mark.parametrize(
    ("value", "unit", "digits", "expected"),
    [
        (70e9, "Pa", 3, "70 GPa"),
        (19041.2, "N/m", 5, "19.041 kN/m"),
        (0.0015, "m", 3, "1.5 mm"),
        (0.012006, "kg", 2, "12 g"),
        (4.8489, "N s/m", 3, "4.85 N s/m"),
        (0.01302, "", 2, "0.013"),
        (1.2, "m", 3, "1200 mm"),
        (0.9996, "m", 3, "1000 mm"),
        (117e3, "N/m", 2, "117 kN/m"),
    ],
)
def test_in_display_unit_scales_to_giga_kilo_or_milli(
    value: float, unit: str, digits: int, expected: str
) -> None:
    """Giga, kilo and milli where plates have them; any other unit as it is, and none without."""
    assert in_display_unit(value, unit, digits=digits) == expected


@pytest.mark.parametrize(
    ("share", "expected"),
    [(1.43, "143 %"), (0.124, "12 %"), (0.0999, "10 %"), (0.0123, "1.2 %"), (0.0, "0 %")],
)
def test_percent_has_two_significant_digits(share: float, expected: str) -> None:
    """Whole per cents from ten on, below with two digits."""
    assert percent(share) == expected


@pytest.mark.parametrize(
    ("value", "error", "unit", "expected"),
    [
        (74.0241e9, 0.8712e9, "Pa", "74.02 ± 0.87 GPa"),
        (0.0130284, 2.72e-5, "", "0.013028 ± 0.000027"),
        (0.0119941, 0.000996, "kg", "12.0 ± 1.0 g"),
        (1231.4, 217.0, "Hz", "1231 ± 217 Hz"),
        (1.25, math.inf, "", "1.25 ± inf"),
        (1.0, 0.0, "m", "1000 ± 0 mm"),
    ],
)
def test_with_error_shows_no_digit_below_two_of_the_error(
    value: float, error: float, unit: str, expected: str
) -> None:
    """Value and error have the same decimals, in the unit of plates."""
    assert with_error(value, error, unit) == expected
    assert with_error(value, error, unit, sign="+") == f"+{expected}"
