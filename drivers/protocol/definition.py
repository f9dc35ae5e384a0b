"""The protocol's numbers as typed values, loaded once from protocol.yaml."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from drivers.errors import CommandError

_STRUCT_CODES = {"u8": "B", "u16": "H", "u32": "I", "i16": "h"}

# Sums of floats may miss the end of a range by rounding; a thousandth of a step is no overstepping.
_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Quantity:
    """One kind of number on the wire: an integer of `per_unit` steps to the unit, within a range.

    wire: u8, u16, u32 or i16; minimum, maximum: as integers; wraps: an angle, taken modulo a turn.
    """

    name: str
    wire: str
    per_unit: int
    unit: str
    minimum: int
    maximum: int
    wraps: bool = False

    @cached_property
    def struct_code(self) -> str:
        """Its character in the format strings of `struct`."""
        return _STRUCT_CODES[self.wire]

    @property
    def step(self) -> float:
        """The smallest difference that the wire can tell, in the unit."""
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
        """The integer for a value [unit], rounded to the nearest step.

        Raises CommandError for NaN, infinities and values out of range: nothing is clipped.
        """
        scaled = value * self.per_unit
        if self.minimum <= scaled <= self.maximum:
            return round(scaled)
        if not math.isfinite(value):
            raise CommandError(f"{self.name} is {value}, which is not a number that can be sent")
        if self.wraps:
            span = self.maximum - self.minimum + 1
            return (round(scaled) - self.minimum) % span + self.minimum
        if not self.minimum - _TOLERANCE <= scaled <= self.maximum + _TOLERANCE:
            unit = f" {self.unit}" if self.unit else ""
            raise CommandError(
                f"{self.name} is {value:g}{unit}; it must lie between {self.low:g} and "
                f"{self.high:g}{unit}"
            )
        return round(scaled)

    def from_wire(self, integer: int) -> float:
        """The value [unit] of an integer, which must be in range (see `holds`)."""
        return integer / self.per_unit

    def holds(self, integer: int) -> bool:
        """Whether an integer from the wire is in range."""
        return self.minimum <= integer <= self.maximum

    def quantise(self, value: float) -> float:
        """The value [unit] that the far end reads when this one is sent."""
        return self.from_wire(self.to_wire(value))


@dataclass(frozen=True)
class Quantities:
    """Every quantity of the protocol by its name."""

    frequency: Quantity
    level: Quantity
    phase: Quantity
    phase_step: Quantity
    ramp: Quantity
    valid_for: Quantity
    watchdog: Quantity
    watchdog_left: Quantity
    token: Quantity
    active_token: Quantity
    channel: Quantity
    channel_count: Quantity
    fault_count: Quantity
    envelope_knots: Quantity
    envelope_slots: Quantity
    envelope_slot: Quantity
    envelope_step: Quantity
    temperature: Quantity
    voltage: Quantity
    age: Quantity
    protocol_version: Quantity


@dataclass(frozen=True)
class SerialLine:
    """Defaults and bounds of the serial wire."""

    baud: int
    address: int
    address_max: int
    broadcast: int
    payload_max: int


@dataclass(frozen=True)
class Protocol:
    """Everything that host and amplifier must agree on, in numbers.

    reaction [s]: a reply has begun by then; modbus, canopen: the sections of these names as they
    stand in the file.
    """

    version: int
    reaction: float
    serial: SerialLine
    types: Mapping[str, int]
    states: Mapping[str, int]
    faults: Mapping[str, int]
    naks: Mapping[str, int]
    quantities: Quantities
    modbus: Mapping[str, Any]
    canopen: Mapping[str, Any]


def _load() -> Protocol:
    text = Path(__file__).with_name("protocol.yaml").read_text(encoding="utf-8")
    raw: dict[str, Any] = YAML(typ="safe", pure=True).load(text)
    listed = raw["quantities"]
    return Protocol(
        version=raw["version"],
        reaction=raw["reaction"],
        serial=SerialLine(**raw["serial"]),
        types=raw["types"],
        states=raw["states"],
        faults=raw["faults"],
        naks=raw["naks"],
        quantities=Quantities(
            **{
                field.name: Quantity(name=field.name, **listed[field.name])
                for field in fields(Quantities)
            }
        ),
        modbus=raw["modbus"],
        canopen=raw["canopen"],
    )


PROTOCOL = _load()


def token_after(token: int) -> int:
    """The token that follows one, or 0 for the first: 1..65535, then from 1 again."""
    return token % PROTOCOL.quantities.token.maximum + 1
