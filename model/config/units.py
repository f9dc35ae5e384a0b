"""Values with a unit, as people write them: `12 in`, `1.5 mm`, `70 GPa`, or an SI number."""

import math
import re
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from typing import TYPE_CHECKING

from model.errors import InputError

if TYPE_CHECKING:
    import pint


@dataclass(frozen=True)
class Dimension:
    """A kind of value: its name with article, its SI unit, and an example to write."""

    name: str
    unit: str
    example: str


LENGTH = Dimension("a length", "m", "1.5 mm")
MODULUS = Dimension("a modulus", "Pa", "70 GPa")
DENSITY = Dimension("a density", "kg/m^3", "2700 kg/m^3")
STIFFNESS = Dimension("a stiffness", "N/m", "17 kN/m")
DAMPING = Dimension("a damping", "N s/m", "2 N s/m")
MASS = Dimension("a mass", "kg", "5 g")
FREQUENCY = Dimension("a frequency", "Hz", "250 Hz")
TIME = Dimension("a time", "s", "50 ms")
SPEED = Dimension("a speed", "m/s", "5 cm/s")
RATE = Dimension("a rate", "1/s", "50 Hz")
SLEW = Dimension("a rise of the level", "1/s", "2 %/ms")
RATIO = Dimension("a plain number", "", "0.05 or 5 %")

# A number is split from its unit here, so that nothing is ever evaluated and every text is short:
# pint on its own would work out `9**9**9 m`.
_LONGEST = 40
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,2})?"
_FACTOR = r"[A-Za-zµμΩ%]+(?:(?:\^|\*\*)-?\d|[²³])?"
_UNIT = rf"{_FACTOR}(?:(?:\s*[*/·]\s*|\s+){_FACTOR}){{0,4}}"
_QUANTITY = re.compile(rf"\s*({_NUMBER})\s*({_UNIT})?\s*", re.ASCII)


def quantity(value: object, dimension: Dimension) -> float:
    """The value in the dimension's SI unit; a bare number is one already.

    `12 in` is exactly 0.3048. Raises InputError for another dimension, an unknown unit, what is no
    number, and NaN or infinity.
    """
    if isinstance(value, str):
        result = _parse(value, dimension)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        result = _to_float(value, dimension)
    else:
        raise _refusal(value, dimension, f"is not {dimension.name}")
    if not math.isfinite(result):
        raise _refusal(value, dimension, "is not a finite number")
    return result


def _parse(text: str, dimension: Dimension) -> float:
    """The value of a text `NUMBER [UNIT]`."""
    match = _QUANTITY.fullmatch(text) if len(text) <= _LONGEST else None
    if match is None:
        raise _refusal(text, dimension, "is no number with a unit")
    number, unit = match.groups()
    if unit is None:
        return _to_float(number, dimension)
    return _to_float(Decimal(number) * _factor(text, unit, dimension), dimension)


def _factor(text: str, unit: str, dimension: Dimension) -> Decimal:
    """How many SI units of the dimension one of these units is, exactly where it is exact.

    The base units must be the same ones, not just of the same dimension: revolutions per minute
    and rad/s have the dimension of Hz, but are not that many Hz.
    """
    import pint

    registry = _registry()
    try:
        factor, base = registry.get_base_units(registry.parse_units(unit.replace("·", "*")))
        _, expected = registry.get_base_units(registry.parse_units(dimension.unit))
    except pint.UndefinedUnitError as error:
        raise _refusal(text, dimension, f"has the unknown unit {unit}") from error
    except (pint.PintError, ArithmeticError, AttributeError, TypeError, ValueError) as error:
        raise _refusal(text, dimension, f"has a unit that cannot be read: {unit}") from error
    if base != expected:
        raise _refusal(text, dimension, f"is not {dimension.name}")
    return Decimal(str(factor))


@cache
def _registry() -> "pint.UnitRegistry[Decimal]":
    """Pint's units, with factors as decimals: 12 in is then 0.3048 m and not 0.30479999999999996.

    Made when the first unit is met, for it takes a tenth of a second.
    """
    import pint

    return pint.UnitRegistry(non_int_type=Decimal)


def _to_float(value: float | str | Decimal, dimension: Dimension) -> float:
    """The nearest double; an integer that is too large for one is refused."""
    try:
        return float(value)
    except OverflowError as error:
        raise _refusal(value, dimension, "is not a finite number") from error


def _refusal(value: object, dimension: Dimension, why: str) -> InputError:
    """The error for a value, with what should stand in its place."""
    text = shown(value)
    text = text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
    bare = f"a bare number in {dimension.unit}" if dimension.unit else "a bare number"
    return InputError(f"{text} {why}; write {bare}, or for example {dimension.example}")


def shown(value: object) -> str:
    """A value of a file as it stands there, not as Python writes it."""
    if value is None:
        return "nothing"
    return str(value).lower() if isinstance(value, bool) else repr(value)
