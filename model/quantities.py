"""Formatting of quantities and shares."""

_DISPLAY_UNITS = {"m": (1e3, "mm"), "Pa": (1e-9, "GPa"), "N/m": (1e-3, "kN/m"), "kg": (1e3, "g")}


def in_display_unit(value: float, unit: str, *, digits: int = 3) -> str:
    """Format a value of an SI unit, or of none, in the unit usual for plates: `17 kN/m`."""
    factor, shown_unit = _DISPLAY_UNITS.get(unit, (1.0, unit))
    shown = f"{value * factor:.{digits}g}"
    if "e+" in shown:  # a plate of a metre is 1000 mm
        shown = f"{value * factor:.0f}"
    return f"{shown} {shown_unit}".strip()


def percent(share: float) -> str:
    """Format a share as `12 %`; below a tenth with two digits, `1.2 %`."""
    return f"{100 * share:.0f} %" if share > 0.1 else f"{100 * share:.2g} %"
