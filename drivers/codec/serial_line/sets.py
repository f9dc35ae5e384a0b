"""Payloads of sets and envelopes on a serial line: pack and unpack.

Unpacking yields plain values in range or raises Malformed.
"""

from functools import lru_cache

from drivers.codec.payload import Cursor, Malformed, Row, pack
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Achieved, NakCode

_Q = PROTOCOL.quantities
_KEEP_PHASE = 0x01
_SKIP_ENDING = 0x02
_ENVELOPES = 0x04  # onset and ending follow the command
_SET = Row(_Q.token, _Q.ramp, _Q.valid_for)
_TONE = Row(_Q.frequency, _Q.level, _Q.phase)
_SLOTS = Row(_Q.envelope_slot, _Q.envelope_slot)
_KNOT = Row(_Q.level, _Q.phase)


def _pack_commands(commands: tuple[DriveCommand, ...]) -> bytes:
    packed = [pack((_Q.channel_count, len(commands)))]
    for command in commands:
        is_shaped = command.onset or command.ending
        flags = _KEEP_PHASE if command.keep_phase else 0
        flags |= _SKIP_ENDING if command.skip_ending else 0
        flags |= _ENVELOPES if is_shaped else 0
        packed += [pack((_Q.channel, command.channel)), bytes([flags])]
        packed.append(_TONE.pack(command.frequency, command.level, command.phase))
        if is_shaped:
            packed.append(_SLOTS.pack(command.onset, command.ending))
    return b"".join(packed)


def _unpack_commands(cursor: Cursor) -> tuple[DriveCommand, ...]:
    commands: list[DriveCommand] = []
    seen: set[int] = set()
    for _ in range(cursor.integer(_Q.channel_count)):
        channel = cursor.integer(_Q.channel)
        flags = cursor.flags(_KEEP_PHASE | _SKIP_ENDING | _ENVELOPES)
        frequency, level, phase = cursor.numbers(_TONE)
        if channel in seen:
            raise Malformed(
                f"channel {channel} occurs twice", code=NakCode.BAD_CHANNEL, channel=channel
            )
        seen.add(channel)
        onset, ending = cursor.integers(_SLOTS) if flags & _ENVELOPES else (0, 0)
        commands.append(
            DriveCommand(
                channel=channel,
                frequency=frequency,
                level=level,
                phase=phase,
                keep_phase=bool(flags & _KEEP_PHASE),
                onset=onset,
                ending=ending,
                skip_ending=bool(flags & _SKIP_ENDING),
            )
        )
    return tuple(commands)


def pack_set(command_set: CommandSet) -> bytes:
    """Pack a set."""
    times = _SET.pack(command_set.token, command_set.ramp, command_set.valid_for)
    return times + _pack_commands(command_set.commands)


def unpack_set(cursor: Cursor) -> CommandSet:
    """Unpack a set, which must pass a guard before it can be encoded."""
    token = cursor.integer(_Q.token)
    ramp, valid_for = cursor.number(_Q.ramp), cursor.number(_Q.valid_for)
    return CommandSet(token, _unpack_commands(cursor), ramp=ramp, valid_for=valid_for)


def pack_envelope(envelope: Envelope) -> bytes:
    """Pack an envelope."""
    head = pack((_Q.envelope_slot, envelope.slot), (_Q.envelope_step, envelope.step))
    head += pack((_Q.envelope_knots, len(envelope.knots)))
    return head + b"".join(_KNOT.pack(knot.level, knot.phase) for knot in envelope.knots)


def unpack_envelope(cursor: Cursor) -> Envelope:
    """Unpack an envelope, which must pass a guard before it can be encoded."""
    slot = cursor.integer(_Q.envelope_slot)
    step = cursor.number(_Q.envelope_step)
    count = cursor.integer(_Q.envelope_knots)
    knots = tuple(Knot(*cursor.numbers(_KNOT)) for _ in range(count))
    return Envelope(slot=slot, step=step, knots=knots)


def pack_achieved(achieved: Achieved) -> bytes:
    """Pack an achieved set."""
    return pack((_Q.token, achieved.token)) + _pack_commands(achieved.commands)


def unpack_achieved(cursor: Cursor) -> Achieved:
    """Unpack an achieved set; ignores what follows it."""
    return Achieved(token=cursor.integer(_Q.token), commands=_commands_in(cursor.rest()))


@lru_cache(maxsize=64)  # replies to a stage, its commit and renewals repeat them
def _commands_in(packed: bytes) -> tuple[DriveCommand, ...]:
    return _unpack_commands(Cursor(packed))
