"""Register blocks of an amplifier, decoded for a Modbus host.

Decoding yields a message with every value in range or raises FrameError.
"""

import struct
from collections.abc import Collection, Iterable, Sequence
from enum import IntEnum
from typing import Any, TypeVar

from drivers.codec.payload import flags_of, read_text, versions_of
from drivers.command import DriveCommand
from drivers.errors import FrameError
from drivers.protocol.definition import PROTOCOL, WireQuantity
from drivers.protocol.messages import (
    Achieved,
    AmplifierState,
    Capabilities,
    ChannelLimits,
    Fault,
    FaultList,
    FaultRecord,
    Feature,
    Identity,
    Loaded,
    Measured,
    Measurement,
    Nak,
    NakCode,
    Status,
)

_MAP = PROTOCOL.modbus
_Q = PROTOCOL.quantities
HEAD = len(_MAP["head"])  # registers at the start of every block
CHANNEL_SIZE: int = _MAP["channel_registers"]
LIMIT_SIZE: int = _MAP["limit_registers"]
MEASURED_SIZE: int = _MAP["measured_registers"]
SENSOR_SIZE: int = _MAP["sensor_registers"]
READING_SIZE: int = _MAP["reading_registers"]
FAULT_SIZE: int = _MAP["fault_registers"]
TEXT_SIZE: int = _MAP["text_registers"]
_NO_CHANNEL = 255

# By register, from protocol.yaml; registers of channels and faults have their quantities' names.
_QUANTITIES: dict[str, WireQuantity] = vars(_Q) | {
    register: vars(_Q)[kind]
    for block in (*_MAP["input"].values(), *_MAP["holding"].values())
    for register, kind in block["registers"].items()
    if kind in vars(_Q)
}

_EnumT = TypeVar("_EnumT", bound=IntEnum)


def fields_of(
    names: Collection[str], registers: Sequence[int]
) -> tuple[dict[str, int], Sequence[int]]:
    """Split off the named registers after the head."""
    end = HEAD + len(names)
    return dict(zip(names, registers[HEAD:end], strict=True)), registers[end:]


def integer_of(name: str, register: int) -> int:
    """Decode the integer of a register by its name; FrameError out of range."""
    quantity = _QUANTITIES[name]
    value = register - (1 << 16) if quantity.wire == "i16" and register >> 15 else register
    if not quantity.holds(value):
        raise FrameError(f"{name} must be {quantity.minimum} to {quantity.maximum}, got {value}")
    return value


def number_of(name: str, register: int) -> float:
    """Decode the value of a register by its name, in its unit."""
    return _QUANTITIES[name].from_wire(integer_of(name, register))


def _channel_count(register: int, *, read: int) -> int:
    channels = integer_of("channel_count", register)
    if channels > read:
        raise FrameError(f"channel count must be at most {read}, got {channels}")
    return channels


def one_of(kind: type[_EnumT], register: int) -> _EnumT:
    """Decode a member of an enumeration."""
    try:
        return kind(register)
    except ValueError:
        raise FrameError(f"unknown {kind.__name__} {register}") from None


def channel_of(register: int) -> int | None:
    """Decode a channel, None for 255."""
    return None if register == _NO_CHANNEL else integer_of("channel", register)


def unpack_identity(registers: Sequence[int]) -> Identity:
    """Decode an identity."""
    block = _MAP["input"]["identity"]
    found, rest = fields_of(block["registers"], registers)
    texts = {
        name: read_text(_raw(rest[number * TEXT_SIZE : (number + 1) * TEXT_SIZE]), name)
        for number, name in enumerate(block["texts"])
    }
    return Identity(versions=versions_of(integer_of("versions", found["versions"])), **texts)


def _raw(registers: Sequence[int]) -> bytes:
    return struct.pack(f">{len(registers)}H", *registers).rstrip(b"\0")


def unpack_capabilities(registers: Sequence[int]) -> Capabilities:
    """Decode capabilities."""
    found, rest = fields_of(_MAP["input"]["capabilities"]["registers"], registers)
    whole: dict[str, Any] = {
        name: integer_of(name, found.pop(name))
        for name in ("envelope_knots", "envelope_slots", "voices")
    }
    channels = _channel_count(found.pop("channel_count"), read=len(rest) // LIMIT_SIZE)
    features = Feature(found.pop("features"))
    limits = tuple(
        ChannelLimits(
            frequency_min=number_of("frequency_min", lowest),
            frequency_max=number_of("frequency_max", highest),
            level_max=number_of("level_max", level),
        )
        for lowest, highest, level in list(groups_of(rest, LIMIT_SIZE))[:channels]
    )
    numbers: dict[str, Any] = {name: number_of(name, register) for name, register in found.items()}
    return Capabilities(
        channels=channels, channel_limits=limits, features=features, **numbers, **whole
    )


def unpack_status(registers: Sequence[int]) -> Status:
    """Decode a status."""
    found, levels = fields_of(_MAP["input"]["status"]["registers"], registers)
    channels = _channel_count(found["channel_count"], read=len(levels))
    return Status(
        state=one_of(AmplifierState, found["state"]),
        fault=one_of(Fault, found["fault"]),
        token=integer_of("active_token", found["active_token"]),
        temperature=number_of("temperature", found["temperature"]),
        watchdog_left=number_of("watchdog_left", found["watchdog_left"]),
        levels=tuple(number_of("level", register) for register in levels[:channels]),
        voltage=number_of("voltage", found["voltage"]),
        latch=integer_of("latch", found["latch"]),
        **flags_of(found["flags"]),
    )


def groups_of(registers: Sequence[int], size: int) -> Iterable[Sequence[int]]:
    """Split registers into groups of a size; what is left over is ignored."""
    return (registers[at : at + size] for at in range(0, len(registers) - size + 1, size))


def unpack_achieved(registers: Sequence[int]) -> Achieved:
    """Decode an achieved set, in the order of its channels."""
    found, rest = fields_of(_MAP["input"]["achieved"]["registers"], registers)
    _channel_count(found["channel_count"], read=len(rest) // CHANNEL_SIZE)
    commands = tuple(
        _command(channel, group)
        for channel, group in enumerate(groups_of(rest, CHANNEL_SIZE))
        if any(group)
    )
    return Achieved(token=integer_of("token", found["token"]), commands=commands)


def _command(channel: int, group: Sequence[int]) -> DriveCommand:
    frequency, level, phase, flags = group
    shape = {
        name: flags >> index["bit"] & (1 << index["bits"]) - 1
        for name, index in _MAP["flags"].items()
    }
    return DriveCommand(
        channel=channel,
        frequency=number_of("frequency", frequency),
        level=number_of("level", level),
        phase=number_of("phase", phase),
        keep_phase=bool(shape["keep_phase"]),
        onset=shape["onset"],
        ending=shape["ending"],
        skip_ending=bool(shape["skip_ending"]),
    )


def unpack_faults(registers: Sequence[int]) -> FaultList:
    """Decode the faults that were read; see `unpack_fault_count`."""
    found, rest = fields_of(_MAP["input"]["faults"]["registers"], registers)
    count = integer_of("fault_count", found["fault_count"])
    records = list(groups_of(rest, FAULT_SIZE))[:count]
    return FaultList(
        tuple(
            FaultRecord(
                fault=one_of(Fault, fault),
                channel=channel_of(channel),
                age=_Q.age.from_wire(high << 16 | low),
            )
            for fault, channel, high, low in records
        )
    )


def unpack_measured(registers: Sequence[int]) -> Measured:
    """Decode measurements."""
    found, rest = fields_of(_MAP["input"]["measured"]["registers"], registers)
    channels = _channel_count(found["channel_count"], read=len(rest) // MEASURED_SIZE)
    volts, amperes = _Q.channel_voltage, _Q.channel_current
    return Measured(
        tuple(
            Measurement(volts.from_wire(voltage), amperes.from_wire(current))
            for voltage, current in list(groups_of(rest, MEASURED_SIZE))[:channels]
        )
    )


def unpack_fault_count(registers: Sequence[int]) -> int:
    """Decode the number of faults."""
    found, _ = fields_of(_MAP["input"]["faults"]["registers"], registers)
    return integer_of("fault_count", found["fault_count"])


def unpack_loaded(registers: Sequence[int]) -> Loaded:
    """Decode the confirmation of a loaded envelope."""
    found, _ = fields_of(_MAP["holding"]["envelope"]["registers"], registers)
    return Loaded(
        slot=integer_of("slot", found["slot"]),
        knots=integer_of("envelope_knots", found["envelope_knots"]),
    )


def unpack_refusal(registers: Sequence[int]) -> tuple[Nak, int] | None:
    """Decode the last refusal and its tag, or None."""
    found, _ = fields_of(_MAP["input"]["refusal"]["registers"], registers)
    if not found["nak"]:
        return None
    return Nak(one_of(NakCode, found["nak"]), channel_of(found["channel"])), found["refused_tag"]


def unpack_state(registers: Sequence[int]) -> tuple[AmplifierState, Fault]:
    """Decode state and fault, with which a status and an achieved set begin."""
    found, _ = fields_of(("state", "fault"), registers)
    return one_of(AmplifierState, found["state"]), one_of(Fault, found["fault"])
