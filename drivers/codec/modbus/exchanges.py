"""Messages to registers and back, for the host's side of Modbus.

An exchange is one block written and one read back, by FC23 in one transaction or by FC16 and FC4 in
two; its tag, written with the one and read with the other, says what answers what, since an RTU
frame carries no number. Identity and capabilities are only read, so that nothing is written to a
device before it is known. Nothing here knows of frames.
"""

import binascii
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drivers.codec.modbus import blocks
from drivers.codec.modbus.blocks import CHANNEL_SIZE, FAULT_SIZE, HEAD, TEXT_SIZE
from drivers.command import CommandSet, DriveCommand, Envelope
from drivers.guard import require_safe
from drivers.protocol.definition import PROTOCOL, Quantity
from drivers.protocol.messages import (
    AmplifierState,
    Apply,
    Arm,
    Broadcast,
    Clear,
    Commit,
    Disarm,
    Fault,
    GetCaps,
    GetFaults,
    GetStatus,
    Hello,
    LoadEnvelope,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    Stage,
    Stop,
)

_MAP = PROTOCOL.modbus
_Q = PROTOCOL.quantities
_CONTROLWORDS: Mapping[str, int] = _MAP["controlwords"]
CHANNELS_MAX = _Q.channel_count.maximum
RECORDS_FIRST = 4  # mostly there are fewer; where there are more they are asked for


@dataclass(frozen=True, slots=True)
class Write:
    """Registers for consecutive addresses from here on."""

    address: int
    registers: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Read:
    """So many registers from this address on."""

    address: int
    count: int


@dataclass(frozen=True, slots=True)
class Exchange:
    """What a request is on this wire: a block that is read, and one that is written before."""

    read: Read
    write: Write | None = None


def encode_request(
    request: Request, *, tag: int, channels: int = CHANNELS_MAX, records: int = RECORDS_FIRST
) -> Exchange:
    """The exchange of a request; TypeError if a set in it has not passed a guard.

    tag: 1..65535; channels: how many of them are read; records: how many faults.
    """
    require_safe(request)
    match request:
        case Hello():
            texts = len(_MAP["input"]["identity"]["texts"])
            return Exchange(_read("identity", beyond=texts * TEXT_SIZE))
        case GetCaps():
            return Exchange(_read("capabilities"))
        case GetStatus():
            return Exchange(_read("status", beyond=channels), Write(_MAP["look"], (tag,)))
        case GetFaults():
            beyond = min(records, _MAP["fault_count"]) * FAULT_SIZE
            return Exchange(_read("faults", beyond=beyond), Write(_MAP["look"], (tag,)))
        case Ping():
            return Exchange(_read("status", beyond=channels), Write(_MAP["heartbeat"], (tag,)))
        case Arm() | Disarm() | Stop() | Clear():
            return Exchange(
                _read("status", beyond=channels), _block("control", tag, _order(request))
            )
        case Stage(command_set=wanted) | Apply(command_set=wanted):
            commit = wanted.token if isinstance(request, Apply) else 0
            write = _block("set", tag, [commit, *_pack_set(wanted)])
            return Exchange(_read("achieved", beyond=channels * CHANNEL_SIZE), write)
        case Commit(token=token):
            write = _block("set", tag, [_Q.token.to_wire(token)])
            return Exchange(_read("achieved", beyond=channels * CHANNEL_SIZE), write)
        case LoadEnvelope(envelope=envelope):
            kept = _MAP["holding"]["envelope"]
            return Exchange(
                Read(kept["address"], HEAD + len(kept["registers"])),
                _block("envelope", tag, _pack_envelope(envelope)),
            )


def encode_broadcast(request: Broadcast) -> Write:
    """What is written to all units; a commit is one register."""
    if isinstance(request, Commit):
        address = _MAP["holding"]["set"]["address"] + HEAD
        return Write(address, (_Q.token.to_wire(request.token),))
    return _block("control", 0, _order(request))


def decode_refusal(registers: Sequence[int], *, tag: int) -> Nak | None:
    """The refusal of the write that carried this tag; None where it is that of another."""
    refusal = blocks.unpack_refusal(registers)
    return refusal[0] if refusal is not None and refusal[1] == tag else None


def refusal_read() -> Read:
    """Where the amplifier says why it answered with an exception."""
    return _read("refusal")


def is_of(registers: Sequence[int], *, tag: int | None) -> bool:
    """Whether a block that was read belongs to this tag; None: whether it is sound at all."""
    if len(registers) < HEAD or (tag is not None and registers[0] != tag):
        return False
    return registers[1] in (0, check_of(registers[HEAD:]))


def check_of(registers: Sequence[int]) -> int:
    """CRC-16 (polynomial 1021, from FFFF) of registers, high byte first; FFFF where that is 0."""
    return binascii.crc_hqx(struct.pack(f">{len(registers)}H", *registers), 0xFFFF) or 0xFFFF


def decode_reply(request: Request, registers: Sequence[int]) -> Reply:
    """The reply in the block that the exchange of this request has read; raises FrameError."""
    match request:
        case Hello():
            return blocks.unpack_identity(registers)
        case GetCaps():
            return blocks.unpack_capabilities(registers)
        case GetFaults():
            return blocks.unpack_faults(registers)
        case Stage() | Apply() | Commit():
            return blocks.unpack_achieved(registers)
        case LoadEnvelope():
            return blocks.unpack_loaded(registers)
        case _:
            return blocks.unpack_status(registers)


def condition(request: Request, registers: Sequence[int]) -> tuple[AmplifierState, Fault] | None:
    """State and fault where the block that was read tells them; raises FrameError."""
    if isinstance(request, Hello | GetCaps | GetFaults | LoadEnvelope):
        return None
    return blocks.unpack_condition(registers)


def nak_of_exception(code: int) -> Nak | None:
    """The refusal that an exception stands for where only one does."""
    codes = [name for name, number in _MAP["exceptions"].items() if number == code]
    return Nak(NakCode[codes[0]]) if len(codes) == 1 else None


def _read(name: str, *, beyond: int = 0) -> Read:
    block = _MAP["input"][name]
    return Read(block["address"], HEAD + len(block["registers"]) + beyond)


def _block(name: str, tag: int, registers: Sequence[int]) -> Write:
    address: int = _MAP["holding"][name]["address"]
    return Write(address, (tag, check_of(registers), *registers))


def _order(request: Arm | Disarm | Stop | Clear) -> list[int]:
    """Controlword, watchdog and ramp; those that do not belong to it are at their least."""
    watchdog = request.watchdog if isinstance(request, Arm) else _Q.watchdog.low
    ramp = request.ramp if isinstance(request, Disarm | Stop) else 0.0
    word = _CONTROLWORDS[type(request).__name__.upper()]
    return [word, _Q.watchdog.to_wire(watchdog), _Q.ramp.to_wire(ramp)]


def _unsigned(*pairs: tuple[Quantity, float]) -> list[int]:
    return [quantity.to_wire(value) & 0xFFFF for quantity, value in pairs]


def _pack_set(command_set: CommandSet) -> list[int]:
    by_channel = {command.channel: command for command in command_set.commands}
    registers = _unsigned(
        (_Q.token, command_set.token),
        (_Q.ramp, command_set.ramp),
        (_Q.valid_for, command_set.valid_for),
    )
    for channel in range(max(by_channel, default=-1) + 1):
        command = by_channel.get(channel)
        registers += [0] * CHANNEL_SIZE if command is None else _pack_channel(command)
    return registers


def _pack_channel(command: DriveCommand) -> list[int]:
    _Q.channel.to_wire(command.channel)
    shape = _unsigned((_Q.envelope_slot, command.onset), (_Q.envelope_slot, command.ending))
    values = {
        "keep_phase": int(command.keep_phase),
        "skip_ending": int(command.skip_ending),
        "onset": shape[0],
        "ending": shape[1],
    }
    flags = sum(value << _MAP["flags"][name]["bit"] for name, value in values.items())
    return [
        *_unsigned(
            (_Q.frequency, command.frequency),
            (_Q.level, command.level),
            (_Q.phase, command.phase),
        ),
        flags,
    ]


def _pack_envelope(envelope: Envelope) -> list[int]:
    registers = _unsigned(
        (_Q.envelope_slot, envelope.slot),
        (_Q.envelope_step, envelope.step),
        (_Q.envelope_knots, len(envelope.knots)),
    )
    for knot in envelope.knots:
        registers += _unsigned((_Q.level, knot.level), (_Q.phase, knot.phase))
    return registers
