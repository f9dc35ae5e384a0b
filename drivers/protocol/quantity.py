"""A kind of number on the wire: its steps, unit and range."""

import math
from dataclasses import dataclass
from functools import cached_property

from drivers.errors import CommandError

# Sums of floats may exceed a range by rounding: a thousandth of a step is allowed.
_TOLERANCE = 1e-3


@dataclass(frozen=True)
class WireQuantity:
    """A kind of number on the wire: an integer of `per_unit` steps per unit, within a range.

    wire: u16, u32 or i16; minimum, maximum: as integers; wraps: an angle, modulo 360.
    """

    name: str
    wire: str
    per_unit: int
    unit: str
    minimum: int
    maximum: int
    wraps: bool = False

    @cached_property
    def step(self) -> float:
        """Resolution on the wire, in the unit."""
        return 1 / self.per_unit

    @property
    def low(self) -> float:
        """Smallest value, in the unit."""
        return self.minimum / self.per_unit

    @property
    def high(self) -> float:
        """Largest value, in the unit."""
        return self.maximum / self.per_unit

    def to_wire(self, value: float) -> int:
        """Encode a value [unit] as an integer, rounded to the nearest step.

        Raises CommandError for NaN, infinities and values out of range; nothing is clipped.
        """
        scaled = value * self.per_unit
        if self.minimum <= scaled <= self.maximum:
            return round(scaled)
        if not math.isfinite(value):
            raise CommandError(f"{self.name} must be a finite number, got {value}")
        if self.wraps:
            span = self.maximum - self.minimum + 1
            return (round(scaled) - self.minimum) % span + self.minimum
        if not self.minimum - _TOLERANCE <= scaled <= self.maximum + _TOLERANCE:
            unit = f" {self.unit}" if self.unit else ""
            raise CommandError(
                f"{self.name} must be {self.low:g} to {self.high:g}{unit}, got {value:g}{unit}"
            )
        return round(scaled)

    def from_wire(self, integer: int) -> float:
        """Decode an integer to a value [unit]."""
        return integer / self.per_unit

    def quantise(self, value: float) -> float:
        """Return the value [unit] that arrives when this one is sent."""
        return self.to_wire(value) / self.per_unit
