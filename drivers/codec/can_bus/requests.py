"""Requests as the frames that carry them on CAN; no I/O.

A request that moves something is an *order*: a PDO that the amplifier answers with a PDO of the
same sequence number (see `answers`). The commands of a set go before their order, one PDO a
channel, under its sequence number, and sets take effect at the SYNC that follows: whole or, where a
frame is missing, not at all. On CAN FD the order and its commands are one frame. What can wait (who
is there, what it can play, faults, envelopes) is read and written as `objects`.
"""

from collections.abc import Mapping
from dataclasses import replace

from drivers.codec.can_bus.frame import CANOPEN, LAYOUTS, CanFrame, cob_id, command_id
from drivers.command import CommandSet, DriveCommand
from drivers.guard import require_safe
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Apply,
    Arm,
    Broadcast,
    Clear,
    Commit,
    Disarm,
    GetStatus,
    Ping,
    Stage,
    Stop,
)

PdoRequest = Apply | Stage | Commit | Arm | Disarm | Stop | Clear | GetStatus | Ping

SEQUENCE_MAX = 255
_Q = PROTOCOL.quantities
_ACTIONS: Mapping[str, int] = CANOPEN["actions"]
_OPERATIONAL: int = CANOPEN["nmt_states"]["OPERATIONAL"]
_FD_BLOCKS = 8
_FD_LENGTHS = (8, 12, 16, 20, 24, 32, 48, 64)
_FILLING = b"\xff"  # a block of these is no command: its level would be out of range

SYNC = CanFrame(cob_id("sync"), b"")


def action_of(order: PdoRequest) -> int:
    """Which action an order asks for; a Ping asks for the status, its heartbeat goes before it."""
    name = type(order).__name__.lower()
    return _ACTIONS.get(name, _ACTIONS["status"])


def host_number(node: int) -> int:
    """The number under which the host sends its heartbeat to one amplifier."""
    return int(CANOPEN["host_base"]) - node


def encode_request(
    order: PdoRequest, *, node: int, sequence: int, fd: bool = False
) -> tuple[CanFrame, ...]:
    """The frames of an order to a node; TypeError for a set that has not passed a guard.

    sequence: 1..255. fd: as CAN FD, which is answered in one frame of the same kind.
    """
    require_safe(order)
    match order:
        case Ping():
            beat = CanFrame(cob_id("heartbeat", host_number(node)), bytes([_OPERATIONAL]))
            return (beat, _order(order, node, sequence, fd=fd))
        case Arm(watchdog=watchdog):
            time = _Q.watchdog.to_wire(watchdog)
            return (_order(order, node, sequence, fd=fd, token=host_number(node), time=time),)
        case Disarm(ramp=ramp) | Stop(ramp=ramp):
            return (_order(order, node, sequence, fd=fd, ramp=_Q.ramp.to_wire(ramp)),)
        case Commit(token=token):
            return (_order(order, node, sequence, fd=fd, token=_Q.token.to_wire(token)), SYNC)
        case Apply(command_set=wanted) | Stage(command_set=wanted):
            head = _order(
                order,
                node,
                sequence,
                fd=fd,
                token=_Q.token.to_wire(wanted.token),
                ramp=_Q.ramp.to_wire(wanted.ramp),
                time=_Q.valid_for.to_wire(wanted.valid_for),
                count=len(wanted.commands),
            )
            shapes = tuple(_slots(wanted.commands, node, sequence))
            together = _in_fd_frames if fd else _in_classic_frames
            return (*shapes, *together(head, wanted.commands, node, sequence), SYNC)
        case _:
            return (_order(order, node, sequence, fd=fd),)


def encode_broadcast(request: Broadcast) -> tuple[CanFrame, ...]:
    """The frames of what every amplifier of the bus shall do; nobody answers."""
    match request:
        case Commit(token=token):
            return (_order(request, 0, 0, token=_Q.token.to_wire(token)), SYNC)
        case Stop(ramp=ramp):
            return (_order(request, 0, 0, ramp=_Q.ramp.to_wire(ramp)),)


def wanted_commands(wanted: CommandSet) -> tuple[DriveCommand, ...]:
    """The commands of a set as they read on the other side of the wire."""
    return tuple(
        replace(
            command,
            frequency=_Q.frequency.quantise(command.frequency),
            level=_Q.level.quantise(command.level),
            phase=_Q.phase.quantise(command.phase),
        )
        for command in wanted.commands
    )


def _order(
    order: PdoRequest,
    node: int,
    sequence: int,
    *,
    fd: bool = False,
    token: int = 0,
    ramp: int = 0,
    time: int = 0,
    count: int = 0,
) -> CanFrame:
    data = LAYOUTS["order"].pack(
        token=token,
        ramp=ramp,
        time=time,
        action=action_of(order),
        count=count,
        sequence=sequence,
    )
    return CanFrame(cob_id("order", node), data, fd=fd)


def _command(command: DriveCommand, sequence: int) -> bytes:
    return LAYOUTS["command"].pack(
        frequency=_Q.frequency.to_wire(command.frequency),
        level=_Q.level.to_wire(command.level),
        phase=_Q.phase.to_wire(command.phase),
        keep_phase=command.keep_phase,
        skip_ending=command.skip_ending,
        shaped=bool(command.onset or command.ending),
        channel=command.channel,
        sequence=sequence,
    )


def _in_classic_frames(
    head: CanFrame, commands: tuple[DriveCommand, ...], node: int, sequence: int
) -> list[CanFrame]:
    frames = [
        CanFrame(command_id(node, command.channel), _command(command, sequence))
        for command in commands
    ]
    return [*frames, head]


def _in_fd_frames(
    head: CanFrame, commands: tuple[DriveCommand, ...], node: int, sequence: int
) -> list[CanFrame]:
    blocks = [_command(command, sequence) for command in commands]
    first, rest = blocks[: _FD_BLOCKS - 1], blocks[_FD_BLOCKS - 1 :]
    frames = [
        CanFrame(cob_id("command", node), _filled(rest[at : at + _FD_BLOCKS]), fd=True)
        for at in range(0, len(rest), _FD_BLOCKS)
    ]
    return [*frames, replace(head, data=_filled([head.data, *first]))]


def _filled(blocks: list[bytes]) -> bytes:
    """Blocks in a length that CAN FD has."""
    data = b"".join(blocks)
    length = next(length for length in _FD_LENGTHS if length >= len(data))
    return data.ljust(length, _FILLING)


def _slots(commands: tuple[DriveCommand, ...], node: int, sequence: int) -> list[CanFrame]:
    """The envelopes that a set refers to: a frame for each four channels with any."""
    each = CANOPEN["channels_per_node"]
    groups: dict[int, dict[str, int]] = {}
    for command in commands:
        if command.onset or command.ending:
            group, place = divmod(command.channel, each)
            slots = groups.setdefault(group, {})
            slots[f"onset_{place}"] = _Q.envelope_slot.to_wire(command.onset)
            slots[f"ending_{place}"] = _Q.envelope_slot.to_wire(command.ending)
    return [
        CanFrame(
            cob_id("slots", node),
            LAYOUTS["slots"].pack(group=group, sequence=sequence, **slots),
        )
        for group, slots in sorted(groups.items())
    ]
