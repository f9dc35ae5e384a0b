"""Register contents of a simulated amplifier: messages to 16-bit words and back.

Written from protocol.yaml, without code of the host's side.
"""

import struct
from collections.abc import Mapping, Sequence
from typing import Any

from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.protocol.definition import PROTOCOL, WireQuantity
from drivers.protocol.messages import (
    Achieved,
    Apply,
    Capabilities,
    Commit,
    FaultList,
    Identity,
    LoadEnvelope,
    Measured,
    NakCode,
    SetAddress,
    Stage,
    Status,
)

MAP: Mapping[str, Any] = PROTOCOL.modbus
_Q = PROTOCOL.quantities
_GROUP: int = MAP["channel_registers"]
_FLAGS: Mapping[str, Mapping[str, int]] = MAP["flags"]
_KNOWN_FLAGS = sum((2 ** flag["bits"] - 1) * 2 ** flag["bit"] for flag in _FLAGS.values())
NO_CHANNEL = 255


class RefusedWrite(Exception):
    """A write that is refused with this code and channel."""

    def __init__(self, code: NakCode, channel: int | None = None) -> None:
        super().__init__(code.name)
        self.code = code
        self.channel = channel


def value_of(quantity: WireQuantity, word: int, *, channel: int | None = None) -> float:
    """The value [unit] in a word; raises RefusedWrite where it is out of range."""
    number = word - 0x10000 if quantity.minimum < 0 and word >= 0x8000 else word
    if not quantity.minimum <= number <= quantity.maximum:
        bad_token = quantity is _Q.token
        raise RefusedWrite(NakCode.BAD_TOKEN if bad_token else NakCode.BAD_VALUE, channel)
    return number / quantity.per_unit


def word_of(quantity: WireQuantity, value: float) -> int:
    """The word of a value [unit], clipped to the range."""
    nearest = min(max(round(value * quantity.per_unit), quantity.minimum), quantity.maximum)
    return nearest % 0x10000


def commands_of(words: Sequence[int]) -> tuple[DriveCommand, ...]:
    """Commands of channels in groups of four words; a group of zeros names no channel."""
    groups = [words[at : at + _GROUP] for at in range(0, len(words), _GROUP)]
    return tuple(_command(channel, group) for channel, group in enumerate(groups) if any(group))


def _command(channel: int, group: Sequence[int]) -> DriveCommand:
    frequency, level, phase, flags = group
    if flags & ~_KNOWN_FLAGS:
        raise RefusedWrite(NakCode.BAD_VALUE, channel)
    fields = {name: flags // 2 ** flag["bit"] % 2 ** flag["bits"] for name, flag in _FLAGS.items()}
    return DriveCommand(
        channel=channel,
        frequency=value_of(_Q.frequency, frequency, channel=channel),
        level=value_of(_Q.level, level, channel=channel),
        phase=value_of(_Q.phase, phase, channel=channel),
        keep_phase=fields["keep_phase"] == 1,
        onset=fields["onset"],
        ending=fields["ending"],
        skip_ending=fields["skip_ending"] == 1,
    )


def command_words(command: DriveCommand) -> list[int]:
    """The four words of a channel."""
    fields = {
        "keep_phase": int(command.keep_phase),
        "skip_ending": int(command.skip_ending),
        "onset": command.onset,
        "ending": command.ending,
    }
    return [
        word_of(_Q.frequency, command.frequency),
        word_of(_Q.level, command.level),
        word_of(_Q.phase, command.phase),
        sum(fields[name] * 2 ** flag["bit"] for name, flag in _FLAGS.items()),
    ]


def status_words(status: Status) -> list[int]:
    """The registers of a status, then a level per channel."""
    fields = {
        "state": int(status.state),
        "fault": int(status.fault),
        "active_token": status.token,
        "flags": status.high_voltage + 2 * status.interlock_open,
        "voltage": word_of(_Q.voltage, status.voltage),
        "temperature": word_of(_Q.temperature, status.temperature),
        "watchdog_left": word_of(_Q.watchdog_left, status.watchdog_left),
        "latch": status.latch,
        "channel_count": len(status.levels),
    }
    words = [fields[name] for name in MAP["input"]["status"]["registers"]]
    return words + [word_of(_Q.level, level) for level in status.levels]


def achieved_words(achieved: Achieved | None, status: Status) -> list[int]:
    """The registers of the achieved set; token 0 and no channels for none."""
    fields = {
        "state": int(status.state),
        "fault": int(status.fault),
        "token": achieved.token if achieved else 0,
        "channel_count": len(status.levels),
    }
    groups = [[0] * _GROUP for _ in status.levels]
    for command in achieved.commands if achieved else ():
        groups[command.channel] = command_words(command)
    words = [fields[name] for name in MAP["input"]["achieved"]["registers"]]
    return words + [word for group in groups for word in group]


def capability_words(capabilities: Capabilities) -> list[int]:
    """The registers of capabilities."""
    fields = {
        "channel_count": capabilities.channels,
        "frequency_min": word_of(_Q.frequency, capabilities.frequency_min),
        "frequency_max": word_of(_Q.frequency, capabilities.frequency_max),
        "frequency_step": word_of(_Q.frequency, capabilities.frequency_step),
        "level_max": word_of(_Q.level, capabilities.level_max),
        "level_step": word_of(_Q.level, capabilities.level_step),
        "phase_step": word_of(_Q.phase_step, capabilities.phase_step),
        "ramp_max": word_of(_Q.ramp, capabilities.ramp_max),
        "watchdog_min": word_of(_Q.watchdog, capabilities.watchdog_min),
        "watchdog_max": word_of(_Q.watchdog, capabilities.watchdog_max),
        "envelope_knots": capabilities.envelope_knots,
        "envelope_slots": capabilities.envelope_slots,
        "envelope_step_min": word_of(_Q.envelope_step, capabilities.envelope_step_min),
        "envelope_step_max": word_of(_Q.envelope_step, capabilities.envelope_step_max),
        "features": int(capabilities.features),
        "voices": capabilities.voices,
    }
    words = [fields[name] for name in MAP["input"]["capabilities"]["registers"]]
    for each in capabilities.limits_of_channels:
        words += [
            word_of(_Q.frequency, each.frequency_min),
            word_of(_Q.frequency, each.frequency_max),
        ]
        words.append(word_of(_Q.level, each.level_max))
    return words


def measured_words(measured: Measured) -> list[int]:
    """The number of channels, then voltage and current of each; none where nothing is measured."""
    words = [len(measured.channels)]
    for one in measured.channels:
        words += [
            word_of(_Q.channel_voltage, one.voltage),
            word_of(_Q.channel_current, one.current),
        ]
    return words


def identity_words(identity: Identity) -> list[int]:
    """The versions that are spoken, then the texts."""
    words = [sum(2**version for version in identity.versions)]
    for name in MAP["input"]["identity"]["texts"]:
        size = 2 * MAP["text_registers"]
        raw = text_bytes(getattr(identity, name)).ljust(size, b"\0")
        words += struct.unpack(f">{size // 2}H", raw)
    return words


def text_bytes(text: str) -> bytes:
    """A text in UTF-8, truncated to its registers."""
    return text.encode()[: 2 * MAP["text_registers"]].decode(errors="ignore").encode()


def fault_words(faults: FaultList) -> list[int]:
    """The number of faults, then four words each, newest first."""
    newest = faults.faults[: MAP["fault_count"]]
    words = [len(newest)]
    for record in newest:
        channel = NO_CHANNEL if record.channel is None else record.channel
        age = min(round(record.age * _Q.age.per_unit), _Q.age.maximum)
        words += [int(record.fault), channel, age // 0x10000, age % 0x10000]
    return words


def decode_set(words: Sequence[int]) -> Stage | Apply | Commit:
    """Decode the set block; raises RefusedWrite."""
    if len(words) < 2:
        raise RefusedWrite(NakCode.BAD_LENGTH)
    commit, session, *rest = words
    if not rest:
        return Commit(int(value_of(_Q.token, commit)), session)
    if len(rest) < 3 or (len(rest) - 3) % _GROUP:
        raise RefusedWrite(NakCode.BAD_LENGTH)
    token = int(value_of(_Q.token, rest[0]))
    ramp, valid_for = value_of(_Q.ramp, rest[1]), value_of(_Q.valid_for, rest[2])
    wanted = CommandSet(token, commands_of(rest[3:]), ramp=ramp, valid_for=valid_for)
    if commit not in (0, token):
        raise RefusedWrite(NakCode.BAD_TOKEN)
    return Apply(wanted, session) if commit else Stage(wanted, session)


def decode_address(words: Sequence[int]) -> SetAddress:
    """Decode the address block; raises RefusedWrite."""
    if len(words) != 1 + MAP["text_registers"]:
        raise RefusedWrite(NakCode.BAD_LENGTH)
    raw = struct.pack(f">{len(words) - 1}H", *words[1:]).rstrip(b"\0")
    return SetAddress(int(value_of(_Q.address, words[0])), raw.decode(errors="replace"))


def decode_envelope(words: Sequence[int]) -> LoadEnvelope:
    """Decode the envelope block; raises RefusedWrite."""
    if len(words) < 3 or len(words) != 3 + 2 * words[2]:
        raise RefusedWrite(NakCode.BAD_LENGTH)
    pairs = zip(words[3::2], words[4::2], strict=True)
    knots = tuple(Knot(value_of(_Q.level, a), value_of(_Q.phase, b)) for a, b in pairs)
    slot = int(value_of(_Q.envelope_slot, words[0]))
    return LoadEnvelope(Envelope(slot, value_of(_Q.envelope_step, words[1]), knots))
