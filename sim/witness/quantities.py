"""Quantities of docs/reference/wire-protocol.md: step and bounds, copied from its table."""

from typing import NamedTuple


class Quantity(NamedTuple):
    """A quantity on a wire."""

    step: float
    low: int
    high: int


FREQUENCY = Quantity(0.01, 0, 65535)  # Hz
LEVEL = Quantity(0.0001, 0, 10000)
PHASE = Quantity(0.01, -18000, 17999)  # degrees
RAMP = Quantity(0.001, 0, 1000)  # s
VALID_FOR = Quantity(0.001, 0, 60000)  # s
WATCHDOG = Quantity(0.001, 100, 2000)  # s
WATCHDOG_LEFT = Quantity(0.001, 0, 2000)  # s
TOKEN = Quantity(1, 1, 65535)
ACTIVE_TOKEN = Quantity(1, 0, 65535)
CHANNEL = Quantity(1, 0, 15)
CHANNEL_COUNT = Quantity(1, 0, 16)
KNOTS = Quantity(1, 0, 32)
SLOT = Quantity(1, 0, 63)
STEP = Quantity(0.0001, 0, 1000)  # s
TEMPERATURE = Quantity(0.1, -1000, 2000)  # °C
STATE = Quantity(1, 0, 7)
FAULT = Quantity(1, 0, 6)


class OutOfRange(ValueError):
    """An integer out of range."""


def value(quantity: Quantity, integer: int, name: str) -> float:
    """Scale an integer to its unit; raises OutOfRange."""
    if not quantity.low <= integer <= quantity.high:
        raise OutOfRange(f"{name} must be {quantity.low} to {quantity.high}, got {integer}")
    return integer * quantity.step


def whole(quantity: Quantity, integer: int, name: str) -> int:
    """Check an integer; raises OutOfRange."""
    value(quantity, integer, name)
    return integer


def signed(word: int) -> int:
    """A word of 16 bits in two's complement."""
    return word - 0x10000 if word & 0x8000 else word
