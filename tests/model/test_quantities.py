"""Formatting of quantities and shares."""

import pytest

from model.quantities import in_display_unit, percent


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
