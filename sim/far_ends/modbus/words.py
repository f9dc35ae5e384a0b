"""What stands in the registers of a simulated amplifier: messages to 16-bit words and back.

Written apart from the host's side, from protocol.yaml alone.
"""

import struct
from collections.abc import Mapping, Sequence
from typing import Any

from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.protocol.definition import PROTOCOL, Quantity
from drivers.protocol.messages import (
    Achieved,
    Apply,
    Capabilities,
    Commit,
    FaultList,
    Identity,
    LoadEnvelope,
    NakCode,
    Stage,
    Status,
)

MAP: Mapping[str, Any] = PROTOCOL.modbus
_Q = PROTOCOL.quantities
_GROUP: int = MAP["channel_registers"]
_FLAGS: Mapping[str, Mapping[str, int]] = MAP["flags"]
_KNOWN_FLAGS = sum((2 ** flag["bits"] - 1) * 2 ** flag["bit"] for flag in _FLAGS.values())
NO_CHANNEL = 255


class Unfit(Exception):
    """Words that cannot be taken; code and channel are those of the refusal."""

    def __init__(self, code: NakCode, channel: int | None = None) -> None:
        super().__init__(code.name)
        self.code = code
        self.channel = channel


def checksum(words: Sequence[int]) -> int:
    """CRC-16 with polynomial 1021 from FFFF; FFFF stands for 0, which says that there is none."""
    remainder = 0xFFFF
    for byte in struct.pack(f">{len(words)}H", *words):
        remainder = (remainder << 8) & 0xFF00 ^ _CHECK_OF_BYTE[remainder >> 8 ^ byte]
    return remainder or 0xFFFF


def _check_of_byte(byte: int) -> int:
    remainder = byte << 8
    for _ in range(8):
        remainder = (remainder << 1) ^ (0x1021 if remainder & 0x8000 else 0)
    return remainder & 0xFFFF


_CHECK_OF_BYTE = [_check_of_byte(byte) for byte in range(256)]


def value_of(quantity: Quantity, word: int, *, channel: int | None = None) -> float:
    """The value [unit] in a word; raises Unfit where it is out of range."""
    number = word - 0x10000 if quantity.minimum < 0 and word >= 0x8000 else word
    if not quantity.minimum <= number <= quantity.maximum:
        bad_token = quantity is _Q.token
        raise Unfit(NakCode.BAD_TOKEN if bad_token else NakCode.BAD_VALUE, channel)
    return number / quantity.per_unit


def word_of(quantity: Quantity, value: float) -> int:
    """The word of a value [unit], the nearest in range: an answer says what it can."""
    nearest = min(max(round(value * quantity.per_unit), quantity.minimum), quantity.maximum)
    return nearest % 0x10000


def commands_of(words: Sequence[int]) -> tuple[DriveCommand, ...]:
    """What the channels shall play, in groups of four words; one of zeros names none."""
    groups = [words[at : at + _GROUP] for at in range(0, len(words), _GROUP)]
    return tuple(_command(channel, group) for channel, group in enumerate(groups) if any(group))


def _command(channel: int, group: Sequence[int]) -> DriveCommand:
    frequency, level, phase, flags = group
    if flags & ~_KNOWN_FLAGS:
        raise Unfit(NakCode.BAD_VALUE, channel)
    said = {name: flags // 2 ** flag["bit"] % 2 ** flag["bits"] for name, flag in _FLAGS.items()}
    return DriveCommand(
        channel=channel,
        frequency=value_of(_Q.frequency, frequency, channel=channel),
        level=value_of(_Q.level, level, channel=channel),
        phase=value_of(_Q.phase, phase, channel=channel),
        keep_phase=said["keep_phase"] == 1,
        onset=said["onset"],
        ending=said["ending"],
        skip_ending=said["skip_ending"] == 1,
    )


def command_words(command: DriveCommand) -> list[int]:
    """The four words of a channel."""
    said = {
        "keep_phase": int(command.keep_phase),
        "skip_ending": int(command.skip_ending),
        "onset": command.onset,
        "ending": command.ending,
    }
    return [
        word_of(_Q.frequency, command.frequency),
        word_of(_Q.level, command.level),
        word_of(_Q.phase, command.phase),
        sum(said[name] * 2 ** flag["bit"] for name, flag in _FLAGS.items()),
    ]


def status_words(status: Status) -> list[int]:
    """Its registers in their order, then a level for each channel."""
    said = {
        "state": int(status.state),
        "fault": int(status.fault),
        "active_token": status.token,
        "high_voltage": int(status.high_voltage),
        "voltage": word_of(_Q.voltage, status.voltage),
        "temperature": word_of(_Q.temperature, status.temperature),
        "watchdog_left": word_of(_Q.watchdog_left, status.watchdog_left),
        "channel_count": len(status.levels),
    }
    words = [said[name] for name in MAP["input"]["status"]["registers"]]
    return words + [word_of(_Q.level, level) for level in status.levels]


def achieved_words(achieved: Achieved | None, status: Status) -> list[int]:
    """What plays or would, after the condition; token 0 and no channels where there is nothing."""
    said = {
        "state": int(status.state),
        "fault": int(status.fault),
        "token": achieved.token if achieved else 0,
        "channel_count": len(status.levels),
    }
    groups = [[0] * _GROUP for _ in status.levels]
    for command in achieved.commands if achieved else ():
        groups[command.channel] = command_words(command)
    words = [said[name] for name in MAP["input"]["achieved"]["registers"]]
    return words + [word for group in groups for word in group]


def capability_words(can: Capabilities) -> list[int]:
    """Its registers in their order."""
    said = {
        "protocol_version": PROTOCOL.version,
        "channel_count": can.channels,
        "frequency_min": word_of(_Q.frequency, can.frequency_min),
        "frequency_max": word_of(_Q.frequency, can.frequency_max),
        "frequency_step": word_of(_Q.frequency, can.frequency_step),
        "level_max": word_of(_Q.level, can.level_max),
        "level_step": word_of(_Q.level, can.level_step),
        "phase_step": word_of(_Q.phase_step, can.phase_step),
        "ramp_max": word_of(_Q.ramp, can.ramp_max),
        "watchdog_min": word_of(_Q.watchdog, can.watchdog_min),
        "watchdog_max": word_of(_Q.watchdog, can.watchdog_max),
        "envelope_knots": can.envelope_knots,
        "envelope_slots": can.envelope_slots,
        "envelope_step_min": word_of(_Q.envelope_step, can.envelope_step_min),
        "envelope_step_max": word_of(_Q.envelope_step, can.envelope_step_max),
    }
    return [said[name] for name in MAP["input"]["capabilities"]["registers"]]


def identity_words(who: Identity) -> list[int]:
    """The version of the protocol, then the texts."""
    words = [who.protocol_version]
    for name in MAP["input"]["identity"]["texts"]:
        size = 2 * MAP["text_registers"]
        raw = text_bytes(getattr(who, name)).ljust(size, b"\0")
        words += struct.unpack(f">{size // 2}H", raw)
    return words


def text_bytes(text: str) -> bytes:
    """A text in UTF-8, cut to what fits."""
    return text.encode()[: 2 * MAP["text_registers"]].decode(errors="ignore").encode()


def fault_words(faults: FaultList) -> list[int]:
    """How many, then four words each, newest first."""
    newest = faults.faults[: MAP["fault_count"]]
    words = [len(newest)]
    for record in newest:
        channel = NO_CHANNEL if record.channel is None else record.channel
        age = min(round(record.age * _Q.age.per_unit), _Q.age.maximum)
        words += [int(record.fault), channel, age // 0x10000, age % 0x10000]
    return words


def playing(words: Sequence[int]) -> Stage | Apply | Commit:
    """What the words of the set block ask for; raises Unfit."""
    commit, *rest = words
    if not rest:
        return Commit(token=int(value_of(_Q.token, commit)))
    if len(rest) < 3 or (len(rest) - 3) % _GROUP:
        raise Unfit(NakCode.BAD_LENGTH)
    token = int(value_of(_Q.token, rest[0]))
    ramp, valid_for = value_of(_Q.ramp, rest[1]), value_of(_Q.valid_for, rest[2])
    wanted = CommandSet(token, commands_of(rest[3:]), ramp=ramp, valid_for=valid_for)
    if commit not in (0, token):
        raise Unfit(NakCode.BAD_TOKEN)
    return Apply(wanted) if commit else Stage(wanted)


def envelope_load(words: Sequence[int]) -> LoadEnvelope:
    """What the words of the envelope block ask for; raises Unfit."""
    if len(words) < 3 or len(words) != 3 + 2 * words[2]:
        raise Unfit(NakCode.BAD_LENGTH)
    pairs = zip(words[3::2], words[4::2], strict=True)
    knots = tuple(Knot(value_of(_Q.level, a), value_of(_Q.phase, b)) for a, b in pairs)
    slot = int(value_of(_Q.envelope_slot, words[0]))
    return LoadEnvelope(Envelope(slot, value_of(_Q.envelope_step, words[1]), knots))
