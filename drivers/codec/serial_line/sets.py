"""Payloads of sets and envelopes on a serial line: pack and unpack.

Unpacking yields plain values in range or raises Malformed.
"""

from collections import OrderedDict
from operator import truediv

from drivers.codec.payload import Cursor, Malformed, Row, pack
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.protocol.definition import PROTOCOL, WireQuantity
from drivers.protocol.messages import Achieved, NakCode

_Q = PROTOCOL.quantities
_KEEP_PHASE = 0x01
_SKIP_ENDING = 0x02
_ENVELOPES = 0x04  # onset and ending follow the command
_SET = Row(_Q.token, _Q.ramp, _Q.valid_for)
_FLAGS = WireQuantity("flags", "u8", 1, "", 0, _KEEP_PHASE | _SKIP_ENDING | _ENVELOPES)
_COMMAND = Row(_Q.channel, _FLAGS, _Q.frequency, _Q.level, _Q.phase)
_PER_UNIT = (_Q.frequency.per_unit, _Q.level.per_unit, _Q.phase.per_unit)
_SLOTS = Row(_Q.envelope_slot, _Q.envelope_slot)
_KNOT = Row(_Q.level, _Q.phase)


def _pack_commands(commands: tuple[DriveCommand, ...]) -> tuple[bytes, bool]:
    """Pack commands; returns the bytes, and whether these mean exactly the same."""
    pieces = [pack((_Q.channel_count, len(commands)))]
    are_exact = True
    for command in commands:
        is_shaped = command.onset or command.ending
        flags = _KEEP_PHASE if command.keep_phase else 0
        flags |= _SKIP_ENDING if command.skip_ending else 0
        flags |= _ENVELOPES if is_shaped else 0
        tone = (command.frequency, command.level, command.phase)
        encoded = _COMMAND.to_wire((command.channel, flags, *tone))
        are_exact = are_exact and tone == tuple(map(truediv, encoded[2:], _PER_UNIT))
        pieces.append(_COMMAND.pack_integers(*encoded))
        if is_shaped:
            pieces.append(_SLOTS.pack(command.onset, command.ending))
    return b"".join(pieces), are_exact


def _unpack_commands(cursor: Cursor) -> tuple[DriveCommand, ...]:
    commands: list[DriveCommand] = []
    seen: set[int] = set()
    per_hertz, per_stroke, per_degree = _PER_UNIT
    for _ in range(cursor.integer(_Q.channel_count)):
        channel, flags, frequency, level, phase = cursor.integers(_COMMAND)
        if channel in seen:
            raise Malformed(
                f"channel {channel} occurs twice", code=NakCode.BAD_CHANNEL, channel=channel
            )
        seen.add(channel)
        onset, ending = cursor.integers(_SLOTS) if flags & _ENVELOPES else (0, 0)
        commands.append(
            DriveCommand(
                channel=channel,
                frequency=frequency / per_hertz,
                level=level / per_stroke,
                phase=phase / per_degree,
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
    packed, are_exact = _pack_commands(command_set.commands)
    if are_exact:
        _keep(packed, command_set.commands)
    return times + packed


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
    packed, _ = _pack_commands(achieved.commands)
    return pack((_Q.token, achieved.token)) + packed


def unpack_achieved(cursor: Cursor) -> Achieved:
    """Unpack an achieved set; ignores what follows it."""
    return Achieved(token=cursor.integer(_Q.token), commands=_commands_in(cursor.rest()))


def _commands_in(packed: bytes) -> tuple[DriveCommand, ...]:
    commands = _known.get(packed)
    if commands is None:
        commands = _unpack_commands(Cursor(packed))
        _keep(packed, commands)
    return commands


# By their bytes. Replies to a stage, its commit and renewals mostly repeat what was sent.
_known: OrderedDict[bytes, tuple[DriveCommand, ...]] = OrderedDict()
_MAX_KNOWN = 64


def _keep(packed: bytes, commands: tuple[DriveCommand, ...]) -> None:
    """Keep the commands that these bytes mean, in place of the oldest."""
    _known[packed] = commands
    if len(_known) > _MAX_KNOWN:
        _known.popitem(last=False)
