"""Messages to registers and back, for a Modbus host.

An exchange writes one block and reads one back, by FC23 in one transaction or by FC16 and FC4 in
two. Its tag, written and read back, matches responses to requests, since RTU frames carry no
number. Identity and capabilities are only read, so that nothing is written to an unknown device.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drivers.codec.modbus import blocks, sensor_blocks
from drivers.codec.modbus.adu import Read as Read
from drivers.codec.modbus.adu import Write as Write
from drivers.codec.modbus.blocks import (
    CHANNEL_SIZE,
    FAULT_SIZE,
    HEAD,
    LIMIT_SIZE,
    MEASURED_SIZE,
    READING_SIZE,
    SENSOR_SIZE,
    TEXT_SIZE,
)
from drivers.command import CommandSet, DriveCommand, Envelope
from drivers.errors import CommandError
from drivers.guard import require_safe
from drivers.protocol.definition import PROTOCOL, WireQuantity
from drivers.protocol.messages import (
    AmplifierState,
    Apply,
    Arm,
    Broadcast,
    Clear,
    Commit,
    Disarm,
    Fault,
    GetBlock,
    GetCaps,
    GetFaults,
    GetMeasured,
    GetReading,
    GetSensors,
    GetStatus,
    Hello,
    LoadEnvelope,
    Measure,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    SetAddress,
    Stage,
    Stop,
)

_MAP = PROTOCOL.modbus
_Q = PROTOCOL.quantities
_CONTROLWORDS: Mapping[str, int] = _MAP["controlwords"]
CHANNELS_MAX = _Q.channel_count.maximum
RECORDS_FIRST = 4  # usually fewer; further ones are read separately


_WITHOUT_STATE = (
    *(Hello, GetCaps, GetFaults, GetMeasured, LoadEnvelope),
    *(GetSensors, Measure, GetReading, GetBlock),
)


@dataclass(frozen=True, slots=True)
class Exchange:
    """A request on this wire: a block to read, and one to write before."""

    read: Read
    write: Write | None = None


def encode_request(
    request: Request, *, tag: int, channels: int = CHANNELS_MAX, records: int = RECORDS_FIRST
) -> Exchange:
    """Encode a request; TypeError if a set in it has not passed a guard.

    tag: 1..65535; channels, records: number of channels and faults to read.
    """
    require_safe(request)
    match request:
        case Hello():
            texts = len(_MAP["input"]["identity"]["texts"])
            return Exchange(_read("identity", beyond=texts * TEXT_SIZE))
        case GetCaps():
            return Exchange(_read("capabilities", beyond=CHANNELS_MAX * LIMIT_SIZE))
        case GetStatus():
            return Exchange(_read("status", beyond=channels), Write(_MAP["look"], (tag,)))
        case GetFaults():
            beyond = min(records, _MAP["fault_count"]) * FAULT_SIZE
            return Exchange(_read("faults", beyond=beyond), Write(_MAP["look"], (tag,)))
        case GetMeasured():
            beyond = channels * MEASURED_SIZE
            return Exchange(_read("measured", beyond=beyond), Write(_MAP["look"], (tag,)))
        case GetSensors() | GetReading() | GetBlock() | Measure():
            return _of_sensors(request, tag)
        case SetAddress():
            raise CommandError("on Modbus an address is set by a broadcast")
        case Ping(session=session):
            held = _Q.held_session.to_wire(session)
            return Exchange(_read("status", beyond=channels), _block("heartbeat", tag, [held]))
        case Arm() | Disarm() | Stop() | Clear():
            return Exchange(
                _read("status", beyond=channels), _block("control", tag, _control(request))
            )
        case Stage(command_set=requested) | Apply(command_set=requested):
            commit = requested.token if isinstance(request, Apply) else 0
            head = [commit, _Q.held_session.to_wire(request.session)]
            write = _block("set", tag, [*head, *_pack_set(requested)])
            return Exchange(_read("achieved", beyond=channels * CHANNEL_SIZE), write)
        case Commit():
            write = _block("set", tag, _pack_commit(request))
            return Exchange(_read("achieved", beyond=channels * CHANNEL_SIZE), write)
        case LoadEnvelope(envelope=envelope):
            kept = _MAP["holding"]["envelope"]
            return Exchange(
                Read(kept["address"], HEAD + len(kept["registers"])),
                _block("envelope", tag, _pack_envelope(envelope)),
            )


def _of_sensors(request: GetSensors | GetReading | GetBlock | Measure, tag: int) -> Exchange:
    """Encode a request for sensors: from which one on, then what is listed from there."""
    match request:
        case GetSensors(first=first):
            beyond = _MAP["sensors_listed"] * SENSOR_SIZE
            read, block = _read("sensors", beyond=beyond), "sensor"
            words = _unsigned((_Q.sensor, first))
        case GetReading(first=first):
            beyond = READING_SIZE
            read, block = _read("reading", beyond=beyond), "sensor"
            words = _unsigned((_Q.sensor, first))
        case GetBlock(sensor=sensor, sample=sample):
            read = _read("samples", beyond=_Q.sample_count.maximum)
            at, block = _Q.sample.to_wire(sample), "sample"
            words = [*_unsigned((_Q.sensor, sensor)), at >> 16, at & 0xFFFF]
        case Measure():
            read, block = _read("reading"), "measure"
            words = _unsigned(
                (_Q.reading, request.number),
                (_Q.window, request.window),
                (_Q.tone_count, len(request.frequencies)),
                *((_Q.frequency, frequency) for frequency in request.frequencies),
            )
    return Exchange(read, _block(block, tag, words))


def encode_broadcast(request: Broadcast) -> Write:
    """Encode a write to all units."""
    if isinstance(request, Commit):
        return _block("set", 0, _pack_commit(request))
    if isinstance(request, SetAddress):
        return _block("address", 0, [_Q.address.to_wire(request.address), *_text(request)])
    return _block("control", 0, _control(request))


def _text(request: SetAddress) -> tuple[int, ...]:
    """The serial number as registers."""
    raw = request.serial_number.encode()[: 2 * TEXT_SIZE].ljust(2 * TEXT_SIZE, b"\0")
    return struct.unpack(f">{TEXT_SIZE}H", raw)


def decode_refusal(registers: Sequence[int], *, tag: int) -> Nak | None:
    """Decode the refusal of the write with this tag; None if it is of another."""
    refusal = blocks.unpack_refusal(registers)
    return refusal[0] if refusal is not None and refusal[1] == tag else None


def refusal_read() -> Read:
    """Return the block with the reason of the last exception."""
    return _read("refusal")


def is_of(registers: Sequence[int], *, tag: int | None) -> bool:
    """Whether a block has this tag (any for None)."""
    return len(registers) >= HEAD and tag in (None, registers[0])


def decode_reply(request: Request, registers: Sequence[int]) -> Reply:
    """Decode the reply to a request from its block; raises FrameError."""
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
        case GetMeasured():
            return blocks.unpack_measured(registers)
        case GetSensors():
            return sensor_blocks.unpack_sensors(registers)
        case Measure() | GetReading():
            return sensor_blocks.unpack_reading(registers)
        case GetBlock():
            return sensor_blocks.unpack_samples(registers)
        case _:
            return blocks.unpack_status(registers)


def reported_state(
    request: Request, registers: Sequence[int]
) -> tuple[AmplifierState, Fault] | None:
    """Decode state and fault if the block has them; raises FrameError."""
    if isinstance(request, _WITHOUT_STATE):
        return None
    return blocks.unpack_state(registers)


def nak_of_exception(code: int) -> Nak | None:
    """Return the refusal of an exception code that stands for one only."""
    codes = [name for name, number in _MAP["exceptions"].items() if number == code]
    return Nak(NakCode[codes[0]]) if len(codes) == 1 else None


def _read(name: str, *, beyond: int = 0) -> Read:
    block = _MAP["input"][name]
    return Read(block["address"], HEAD + len(block["registers"]) + beyond)


def _block(name: str, tag: int, registers: Sequence[int]) -> Write:
    address: int = _MAP["holding"][name]["address"]
    return Write(address, (tag, *registers))


def _control(request: Arm | Disarm | Stop | Clear) -> list[int]:
    """Controlword, watchdog, ramp, session, latch; unused ones are at their minimum."""
    watchdog = request.watchdog if isinstance(request, Arm) else _Q.watchdog.low
    ramp = request.ramp if isinstance(request, Disarm | Stop) else 0.0
    session = request.session if isinstance(request, Arm) else 0
    latch = request.latch if isinstance(request, Clear) else 0
    word = _CONTROLWORDS[type(request).__name__.upper()]
    return [
        word,
        *_unsigned(
            (_Q.watchdog, watchdog),
            (_Q.ramp, ramp),
            (_Q.held_session, session),
            (_Q.latch, latch),
        ),
    ]


def _pack_commit(commit: Commit) -> list[int]:
    return _unsigned((_Q.token, commit.token), (_Q.held_session, commit.session))


def _unsigned(*pairs: tuple[WireQuantity, float]) -> list[int]:
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
