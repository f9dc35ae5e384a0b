"""Values with a unit, such as `12 in` or `70 GPa`, and bare numbers in SI units."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cache
from typing import TYPE_CHECKING, Any

from model.errors import InputError

if TYPE_CHECKING:
    import pint


@dataclass(frozen=True)
class Dimension:
    """A kind of value, such as a length.

    Units with their own zero, such as degC, are rejected unless the SI unit has one, too.
    """

    name: str
    """Name with article."""

    unit: str
    """SI unit; a bare number in degC counts from 0 degC."""

    example: str
    """Example for messages."""

    factors: Mapping[str, str] = field(default_factory=dict, compare=False)
    """Factors of common units, because loading pint doubles the time in which a command starts."""

    def key(self, name: str) -> str:
        """Return the JSON key of a value, with its unit: `stiffness_n_m`."""
        unit = self.unit.lower().replace(" ", "").replace("/", "_").replace("^", "")
        return f"{name}_{unit}".removesuffix("_")


LENGTH = Dimension(
    "a length",
    "m",
    "1.5 mm",
    {"m": "1", "cm": "0.01", "mm": "0.001", "um": "0.000001", "in": "0.0254"},
)

MODULUS = Dimension("a modulus", "Pa", "70 GPa", {"Pa": "1", "MPa": "1000000", "GPa": "1000000000"})

DENSITY = Dimension("a density", "kg/m^3", "2700 kg/m^3", {"kg/m^3": "1"})

STIFFNESS = Dimension("a stiffness", "N/m", "17 kN/m", {"N/m": "1", "kN/m": "1000", "N/mm": "1000"})

LINE_STIFFNESS = Dimension("a stiffness per length", "N/m^2", "5 kN/m^2")

DAMPING = Dimension("a damping", "N s/m", "2 N s/m", {"N s/m": "1"})

MASS = Dimension("a mass", "kg", "5 g", {"kg": "1", "g": "0.001"})

FORCE_FACTOR = Dimension("a force factor", "N/A", "3.6 N/A", {"N/A": "1", "T m": "1"})

RESISTANCE = Dimension("a resistance", "ohm", "4 ohm", {"ohm": "1"})

INDUCTANCE = Dimension("an inductance", "H", "0.1 mH", {"H": "1", "mH": "0.001"})

POWER = Dimension("a power", "W", "3 W", {"W": "1", "mW": "0.001"})

VOLTAGE = Dimension("a voltage", "V", "5 V", {"V": "1", "mV": "0.001"})

LINE_MASS = Dimension("a mass per length", "kg/m", "0.05 kg/m", {"kg/m": "1", "g/m": "0.001"})

FREQUENCY = Dimension("a frequency", "Hz", "250 Hz", {"Hz": "1", "kHz": "1000"})

TIME = Dimension("a time", "s", "50 ms", {"s": "1", "ms": "0.001"})

SPEED = Dimension("a speed", "m/s", "5 cm/s", {"m/s": "1", "cm/s": "0.01", "mm/s": "0.001"})

ANGLE = Dimension(
    "an angle", "rad", "15 deg", {"rad": "1", "deg": "0.01745329251994329576923690768"}
)

RATE = Dimension("a rate", "1/s", "50 Hz", {"Hz": "1", "%/ms": "10"})

SLEW = Dimension("a rise of the level", "1/s", "2 %/ms", RATE.factors)

TEMPERATURE = Dimension("a temperature", "degC", "23 °C or 296 K", {"degC": "1", "°C": "1"})

LEVEL = Dimension("a level", "dB", "14 dB", {"dB": "1"})

RATIO = Dimension("a plain number", "", "0.05 or 5 %", {"%": "0.01"})

# The number is split from its unit here and texts are short, so that nothing is evaluated: pint
# by itself would compute `9**9**9 m`.
_MAX_LENGTH = 40

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,2})?"

_FACTOR = r"[A-Za-zµμΩ%°]+(?:(?:\^|\*\*)-?\d|[²³])?"

_UNIT = rf"{_FACTOR}(?:(?:\s*[*/·]\s*|\s+){_FACTOR}){{0,4}}"

_QUANTITY = re.compile(rf"\s*({_NUMBER})\s*({_UNIT})?\s*", re.ASCII)


def quantity(value: object, dimension: Dimension) -> float:
    """Return a value in the SI unit of its dimension; a bare number is in this unit.

    `12 in` is exactly 0.3048. Raises InputError for another dimension, an unknown unit, a value
    that is not a number, and NaN or infinity.
    """
    if isinstance(value, str):
        # Word processors write other blanks, and a minus sign of their own.
        result = _parse(" ".join(value.split()).replace("\N{MINUS SIGN}", "-"), dimension)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        result = _to_float(value, dimension)
    else:
        raise _refusal(value, dimension, f"is not {dimension.name}")
    if not math.isfinite(result):
        raise _refusal(value, dimension, "is not a finite number")
    return result


def _parse(text: str, dimension: Dimension) -> float:
    """Return the value of a text `NUMBER [UNIT]`."""
    match = _QUANTITY.fullmatch(text) if len(text) <= _MAX_LENGTH else None
    if match is None:
        raise _refusal(text, dimension, "is not a number with a unit")
    number, unit = match.groups()
    if unit is None:
        return _to_float(number, dimension)
    common = dimension.factors.get(unit)
    factor, zero = (Decimal(common), 0) if common else unit_scale(text, unit, dimension)
    return _to_float(Decimal(number) * factor + zero, dimension)


def unit_scale(text: str, unit: str, dimension: Dimension) -> tuple[Decimal, Decimal]:
    """Return the factor from a unit to the SI unit of a dimension, and its zero in the SI unit.

    The base units must be the same, not just the dimension: revolutions per minute and rad/s have
    the dimension of Hz. A unit with another zero than the SI unit, such as degC and K, is rejected
    unless the SI unit has its own zero. A logarithmic unit, which has no factor, is always
    rejected.
    """
    import pint

    registry = _registry()
    try:
        parsed_unit = registry.parse_units(unit.replace("·", "*"))
        si_unit = registry.parse_units(dimension.unit.replace("·", "*"))
        factor, base = registry.get_base_units(parsed_unit)
        _, expected = registry.get_base_units(si_unit)
        zero, si_zero = _zero_of(registry, parsed_unit), _zero_of(registry, si_unit)
    except pint.UndefinedUnitError as error:
        raise _refusal(text, dimension, f"has an unknown unit, {unit}") from error
    except TypeError as error:  # of Decimal, for a logarithm
        raise _refusal(text, dimension, f"is not {dimension.name}") from error
    except (pint.PintError, ArithmeticError, AttributeError, ValueError) as error:
        raise _refusal(text, dimension, f"has an invalid unit, {unit}") from error
    if base != expected or (zero and not si_zero):
        raise _refusal(text, dimension, f"is not {dimension.name}")
    return Decimal(str(factor)), zero - si_zero


def _zero_of(registry: "pint.UnitRegistry[Decimal]", unit: Any) -> Decimal:
    """Return the zero of a unit in base units."""
    return Decimal(str(registry.Quantity(Decimal(0), unit).to_base_units().magnitude))


@cache
def _registry() -> "pint.UnitRegistry[Decimal]":
    """Pint's units with decimal factors, so that 12 in is 0.3048 m and not 0.30479999999999996.

    Made for the first unit that is not common, since it takes a tenth of a second.
    """
    import pint

    return pint.UnitRegistry(non_int_type=Decimal)


def _to_float(value: float | str | Decimal, dimension: Dimension) -> float:
    """Return the nearest double; raises InputError for an integer that is too large."""
    try:
        return float(value)
    except OverflowError as error:
        raise _refusal(value, dimension, "is not a finite number") from error


def _refusal(value: object, dimension: Dimension, why: str) -> InputError:
    """Return the error for a value, with a remedy."""
    text = as_written(value)
    text = text if len(text) <= _MAX_LENGTH else f"{text[:_MAX_LENGTH]}..."
    bare = f"a bare number in {dimension.unit}" if dimension.unit else "a bare number"
    return InputError(f"{text} {why}; write {bare}, or for example {dimension.example}")


def as_written(value: object) -> str:
    """Return a value as text in a file."""
    if value is None:
        return "nothing"
    return str(value).lower() if isinstance(value, bool) else repr(value)


def in_meters(x: float, y: float, *, length: float, width: float) -> str:
    """Return the remedy for a position that would be on the plate in cm or mm, else "".

    length, width [m]: of the plate. Coordinates below 1 are not taken for another unit.
    """
    for unit, count in (("cm", 100), ("mm", 1000)):
        sides = ((x, length), (y, width))
        if all(at == 0 or 1 <= at <= count * side for at, side in sides):
            return (
                f"; positions are in meters: for {x:g} {unit}, {y:g} {unit} write "
                f"{x / count:g},{y / count:g}"
            )
    return ""
