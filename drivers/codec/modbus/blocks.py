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


def _fields(
    names: Collection[str], registers: Sequence[int]
) -> tuple[dict[str, int], Sequence[int]]:
    """Split off the named registers after the head."""
    end = HEAD + len(names)
    return dict(zip(names, registers[HEAD:end], strict=True)), registers[end:]


def _integer(name: str, register: int) -> int:
    quantity = _QUANTITIES[name]
    value = register - (1 << 16) if quantity.wire == "i16" and register >> 15 else register
    if not quantity.holds(value):
        raise FrameError(f"{name} must be {quantity.minimum} to {quantity.maximum}, got {value}")
    return value


def _number(name: str, register: int) -> float:
    return _QUANTITIES[name].from_wire(_integer(name, register))


def _channel_count(register: int, *, read: int) -> int:
    channels = _integer("channel_count", register)
    if channels > read:
        raise FrameError(f"channel count must be at most {read}, got {channels}")
    return channels


def _one_of(kind: type[_EnumT], register: int) -> _EnumT:
    try:
        return kind(register)
    except ValueError:
        raise FrameError(f"unknown {kind.__name__} {register}") from None


def _channel(register: int) -> int | None:
    return None if register == _NO_CHANNEL else _integer("channel", register)


def unpack_identity(registers: Sequence[int]) -> Identity:
    """Decode an identity."""
    block = _MAP["input"]["identity"]
    found, rest = _fields(block["registers"], registers)
    texts = {
        name: read_text(_raw(rest[number * TEXT_SIZE : (number + 1) * TEXT_SIZE]), name)
        for number, name in enumerate(block["texts"])
    }
    return Identity(versions=versions_of(_integer("versions", found["versions"])), **texts)


def _raw(registers: Sequence[int]) -> bytes:
    return struct.pack(f">{len(registers)}H", *registers).rstrip(b"\0")


def unpack_capabilities(registers: Sequence[int]) -> Capabilities:
    """Decode capabilities."""
    found, rest = _fields(_MAP["input"]["capabilities"]["registers"], registers)
    whole: dict[str, Any] = {
        name: _integer(name, found.pop(name))
        for name in ("envelope_knots", "envelope_slots", "voices")
    }
    channels = _channel_count(found.pop("channel_count"), read=len(rest) // LIMIT_SIZE)
    features = Feature(found.pop("features"))
    limits = tuple(
        ChannelLimits(
            frequency_min=_number("frequency_min", lowest),
            frequency_max=_number("frequency_max", highest),
            level_max=_number("level_max", level),
        )
        for lowest, highest, level in list(_groups(rest, LIMIT_SIZE))[:channels]
    )
    numbers: dict[str, Any] = {name: _number(name, register) for name, register in found.items()}
    return Capabilities(
        channels=channels, channel_limits=limits, features=features, **numbers, **whole
    )


def unpack_status(registers: Sequence[int]) -> Status:
    """Decode a status."""
    found, levels = _fields(_MAP["input"]["status"]["registers"], registers)
    channels = _channel_count(found["channel_count"], read=len(levels))
    return Status(
        state=_one_of(AmplifierState, found["state"]),
        fault=_one_of(Fault, found["fault"]),
        token=_integer("active_token", found["active_token"]),
        temperature=_number("temperature", found["temperature"]),
        watchdog_left=_number("watchdog_left", found["watchdog_left"]),
        levels=tuple(_number("level", register) for register in levels[:channels]),
        voltage=_number("voltage", found["voltage"]),
        latch=_integer("latch", found["latch"]),
        **flags_of(found["flags"]),
    )


def _groups(registers: Sequence[int], size: int) -> Iterable[Sequence[int]]:
    return (registers[at : at + size] for at in range(0, len(registers) - size + 1, size))


def unpack_achieved(registers: Sequence[int]) -> Achieved:
    """Decode an achieved set, in the order of its channels."""
    found, rest = _fields(_MAP["input"]["achieved"]["registers"], registers)
    _channel_count(found["channel_count"], read=len(rest) // CHANNEL_SIZE)
    commands = tuple(
        _command(channel, group)
        for channel, group in enumerate(_groups(rest, CHANNEL_SIZE))
        if any(group)
    )
    return Achieved(token=_integer("token", found["token"]), commands=commands)


def _command(channel: int, group: Sequence[int]) -> DriveCommand:
    frequency, level, phase, flags = group
    shape = {
        name: flags >> index["bit"] & (1 << index["bits"]) - 1
        for name, index in _MAP["flags"].items()
    }
    return DriveCommand(
        channel=channel,
        frequency=_number("frequency", frequency),
        level=_number("level", level),
        phase=_number("phase", phase),
        keep_phase=bool(shape["keep_phase"]),
        onset=shape["onset"],
        ending=shape["ending"],
        skip_ending=bool(shape["skip_ending"]),
    )


def unpack_faults(registers: Sequence[int]) -> FaultList:
    """Decode the faults that were read; see `unpack_fault_count`."""
    found, rest = _fields(_MAP["input"]["faults"]["registers"], registers)
    count = _integer("fault_count", found["fault_count"])
    records = list(_groups(rest, FAULT_SIZE))[:count]
    return FaultList(
        tuple(
            FaultRecord(
                fault=_one_of(Fault, fault),
                channel=_channel(channel),
                age=_Q.age.from_wire(high << 16 | low),
            )
            for fault, channel, high, low in records
        )
    )


def unpack_measured(registers: Sequence[int]) -> Measured:
    """Decode measurements."""
    found, rest = _fields(_MAP["input"]["measured"]["registers"], registers)
    channels = _channel_count(found["channel_count"], read=len(rest) // MEASURED_SIZE)
    volts, amperes = _Q.channel_voltage, _Q.channel_current
    return Measured(
        tuple(
            Measurement(volts.from_wire(voltage), amperes.from_wire(current))
            for voltage, current in list(_groups(rest, MEASURED_SIZE))[:channels]
        )
    )


def unpack_fault_count(registers: Sequence[int]) -> int:
    """Decode the number of faults."""
    found, _ = _fields(_MAP["input"]["faults"]["registers"], registers)
    return _integer("fault_count", found["fault_count"])


def unpack_loaded(registers: Sequence[int]) -> Loaded:
    """Decode the confirmation of a loaded envelope."""
    found, _ = _fields(_MAP["holding"]["envelope"]["registers"], registers)
    return Loaded(
        slot=_integer("slot", found["slot"]),
        knots=_integer("envelope_knots", found["envelope_knots"]),
    )


def unpack_refusal(registers: Sequence[int]) -> tuple[Nak, int] | None:
    """Decode the last refusal and its tag, or None."""
    found, _ = _fields(_MAP["input"]["refusal"]["registers"], registers)
    if not found["nak"]:
        return None
    return Nak(_one_of(NakCode, found["nak"]), _channel(found["channel"])), found["refused_tag"]


def unpack_state(registers: Sequence[int]) -> tuple[AmplifierState, Fault]:
    """Decode state and fault, with which a status and an achieved set begin."""
    found, _ = _fields(("state", "fault"), registers)
    return _one_of(AmplifierState, found["state"]), _one_of(Fault, found["fault"])
