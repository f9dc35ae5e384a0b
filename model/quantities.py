"""Formatting of quantities, shares, and numbers with their nouns."""

import math
from typing import NamedTuple

_DISPLAY_UNITS = {"m": (1e3, "mm"), "Pa": (1e-9, "GPa"), "N/m": (1e-3, "kN/m"), "kg": (1e3, "g")}

_ROUNDING = 1e-9  # of a percentage: 100 * 0.29 is 28.999999999999996


def in_display_unit(value: float, unit: str, *, digits: int = 3) -> str:
    """Format a value in an SI unit, or without unit, in the usual unit for plates: `17 kN/m`."""
    factor, shown_unit = _DISPLAY_UNITS.get(unit, (1.0, unit))
    text = f"{value * factor:.{digits}g}"
    if "e+" in text:  # a plate of a meter is 1000 mm
        text = f"{value * factor:.0f}"
    return f"{text} {shown_unit}".strip()


class EstimateText(NamedTuple):
    """Texts of a value, its standard error and their unit, as a string `74.02 ± 0.87 GPa`."""

    value: str
    error: str
    unit: str

    def __str__(self) -> str:
        return f"{self.value} ± {self.error} {self.unit}".strip()


def estimate_text(value: float, error: float, unit: str = "", *, sign: str = "") -> EstimateText:
    """Format a value with its standard error to two digits.

    Units: see `in_display_unit`; sign: "+" also shows the sign of values above zero.
    """
    factor, shown_unit = _DISPLAY_UNITS.get(unit, (1.0, unit))
    value *= factor
    error *= factor
    if not (math.isfinite(error) and error > 0):
        return EstimateText(f"{value:{sign}.5g}", f"{error:.2g}", shown_unit)
    _, _, exponent = f"{error:.1e}".partition("e")
    decimals = max(0, 1 - int(exponent))
    return EstimateText(f"{value:{sign}.{decimals}f}", f"{error:.{decimals}f}", shown_unit)


def percent(share: float) -> str:
    """Format a share as `12 %`; below a tenth with two digits, `1.2 %`."""
    if share > 0.1:
        return f"{100 * share:.0f} %"
    return f"{100 * share:.2g} %"


def percent_down(share: float) -> str:
    """Format a share as `79 %`, rounded down, so that a share below a limit never looks equal."""
    return f"{math.floor(100 * share + _ROUNDING)} %"


def counted(number: int, thing: str, *, plural: str | None = None) -> str:
    """Format a number with its noun; plural: for nouns with an irregular plural."""
    if number == 1:
        return f"1 {thing}"
    return f"{number} {plural or f'{thing}s'}"
