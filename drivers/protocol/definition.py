"""The protocol's numbers as typed values, loaded once from protocol.yaml."""

import random
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from drivers.protocol.quantity import WireQuantity as WireQuantity
from drivers.protocol.tokens import is_newer_token as is_newer_token
from drivers.protocol.tokens import token_after as token_after


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
