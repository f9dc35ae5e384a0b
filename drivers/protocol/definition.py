"""The protocol's numbers as typed values, loaded once from protocol.yaml."""

import math
import random
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from drivers.errors import CommandError

_STRUCT_CODES = {"u8": "B", "u16": "H", "u32": "I", "i16": "h"}

# Sums of floats may exceed a range by rounding: a thousandth of a step is allowed.
_TOLERANCE = 1e-3


@dataclass(frozen=True)
class WireQuantity:
    """A kind of number on the wire: an integer of `per_unit` steps per unit, within a range.

    wire: u8, u16, u32 or i16; minimum, maximum: as integers; wraps: an angle, modulo 360.
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
        """Format character of `struct`."""
        return _STRUCT_CODES[self.wire]

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
        """Decode an integer in range (see `holds`) to a value [unit]."""
        return integer / self.per_unit

    def holds(self, integer: int) -> bool:
        """Whether an integer from the wire is in range."""
        return self.minimum <= integer <= self.maximum

    def quantise(self, value: float) -> float:
        """Return the value [unit] that arrives when this one is sent."""
        return self.to_wire(value) / self.per_unit


@dataclass(frozen=True)
class Quantities:
    """Every quantity of the protocol, by name."""

    frequency: WireQuantity
    level: WireQuantity
    phase: WireQuantity
    phase_step: WireQuantity
    ramp: WireQuantity
    valid_for: WireQuantity
    watchdog: WireQuantity
    watchdog_left: WireQuantity
    token: WireQuantity
    active_token: WireQuantity
    address: WireQuantity
    channel: WireQuantity
    channel_count: WireQuantity
    fault_count: WireQuantity
    envelope_knots: WireQuantity
    envelope_slots: WireQuantity
    envelope_slot: WireQuantity
    envelope_step: WireQuantity
    temperature: WireQuantity
    voltage: WireQuantity
    channel_voltage: WireQuantity
    channel_current: WireQuantity
    age: WireQuantity
    versions: WireQuantity
    features: WireQuantity
    voices: WireQuantity
    session: WireQuantity
    held_session: WireQuantity
    latch: WireQuantity
    sensor: WireQuantity
    sensor_count: WireQuantity
    place: WireQuantity
    sample_rate: WireQuantity
    reading: WireQuantity
    held_reading: WireQuantity
    window: WireQuantity
    window_left: WireQuantity
    window_start: WireQuantity
    tone_count: WireQuantity
    sample: WireQuantity
    sample_count: WireQuantity


@dataclass(frozen=True)
class SerialDefaults:
    """Defaults and bounds of the serial wire."""

    baud: int
    address: int
    address_max: int
    broadcast: int
    payload_max: int


@dataclass(frozen=True)
class Protocol:
    """The numbers on which host and amplifier agree.

    vendor_numbers: the first type, fault and refusal that are the vendor's; reaction [s]: longest
    time until a reply begins; staged_life [s]: of a set that is not committed; features,
    status_flags: bits by name; overload: bit of the flags of a sensor; modbus,
    canopen: the sections of these names in the file.
    """

    version: int
    vendor_numbers: int
    reaction: float
    staged_life: float
    serial: SerialDefaults
    types: Mapping[str, int]
    states: Mapping[str, int]
    faults: Mapping[str, int]
    features: Mapping[str, int]
    status_flags: Mapping[str, int]
    sensor_units: Mapping[str, int]
    reading_states: Mapping[str, int]
    overload: int
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
        vendor_numbers=raw["vendor_numbers"],
        reaction=raw["reaction"],
        staged_life=raw["staged_life"],
        serial=SerialDefaults(**raw["serial"]),
        types=raw["types"],
        states=raw["states"],
        faults=raw["faults"],
        features=raw["features"],
        status_flags=raw["status_flags"],
        sensor_units=raw["sensor_units"],
        reading_states=raw["reading_states"],
        overload=raw["overload"],
        naks=raw["naks"],
        quantities=Quantities(
            **{
                field.name: WireQuantity(name=field.name, **listed[field.name])
                for field in fields(Quantities)
            }
        ),
        modbus=raw["modbus"],
        canopen=raw["canopen"],
    )


PROTOCOL = _load()


def token_after(token: int) -> int:
    """Return the token after this one (0 before the first): 1..65535, then 1 again."""
    return token % PROTOCOL.quantities.token.maximum + 1


def is_newer_token(token: int, than: int) -> bool:
    """Whether a token follows another by less than half of 2^16 (RFC 1982); any follows 0, none."""
    return than == 0 or 0 < (token - than) % (1 << 16) < 1 << 15


def is_newer_latch(latch: int, than: int) -> bool:
    """Whether a latch follows another by at most 127, of 1 to 255 in turn; any follows 0, none."""
    return latch > 0 and (than == 0 or 0 < (latch - than) % PROTOCOL.quantities.latch.maximum < 128)


def random_token() -> int:
    """Return a random initial token, so that tokens of an earlier host are not repeated."""
    return _random(PROTOCOL.quantities.token)


def random_session() -> int:
    """Return a random session, so that no other host has it, nor an earlier one."""
    return _random(PROTOCOL.quantities.session)


def random_reading() -> int:
    """Return a random number of a reading, so that it is not taken for another host's."""
    return _random(PROTOCOL.quantities.reading)


def _random(quantity: WireQuantity) -> int:
    return random.randint(quantity.minimum, quantity.maximum)  # noqa: S311  not a secret
