"""Time-critical requests as CAN frames; no I/O.

A request is an *order* PDO, and its reply a PDO with the same sequence number (see `replies`). The
commands of a set are one PDO per channel with the same sequence number. It takes effect with the
last of its frames, in whatever order an adapter transmits them. On CAN FD the order and its
commands are one frame. Identity, capabilities, faults and envelopes are SDO transfers (`objects`).
"""

from collections.abc import Mapping
from dataclasses import replace

from drivers.codec.can_bus.frame import CANOPEN, LAYOUTS, CanFrame, cob_id, command_id
from drivers.command import CommandSet, DriveCommand
from drivers.errors import CommandError
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
    SetAddress,
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
_FILLING = b"\xff"  # filler; its level is out of range


def action_of(request: PdoRequest) -> int:
    """Return the action code of a request; a Ping is a heartbeat and the action status."""
    name = type(request).__name__.lower()
    return _ACTIONS.get(name, _ACTIONS["status"])


def host_number(node: int) -> int:
    """Return the node number of the host's heartbeat to one amplifier."""
    return int(CANOPEN["host_base"]) - node


def encode_request(
    request: PdoRequest, *, node: int, sequence: int, fd: bool = False
) -> tuple[CanFrame, ...]:
    """Encode a request to a node; TypeError for a set that has not passed a guard.

    sequence: 1..255. fd: as CAN FD; the reply then is one CAN FD frame.
    """
    require_safe(request)
    order = _order(request, node, sequence, fd=fd)
    match request:
        case Ping():
            beat = CanFrame(cob_id("heartbeat", host_number(node)), bytes([_OPERATIONAL]))
            return (beat, order)
        case Apply(command_set=requested) | Stage(command_set=requested):
            together = _in_fd_frames if fd else _in_classic_frames
            shapes = _slots(requested.commands, node, sequence)
            return (*shapes, *together(order, requested.commands, node, sequence))
        case _:
            return (order,)


def encode_broadcast(request: Broadcast) -> tuple[CanFrame, ...]:
    """Encode a request to every amplifier of the bus; there are no replies.

    CommandError for SetAddress: an address is set by an object.
    """
    if isinstance(request, SetAddress):
        raise CommandError("on CAN an address is set by an object")
    return (_order(request, 0, 0),)


def requested_commands(requested: CommandSet) -> tuple[DriveCommand, ...]:
    """Return the commands of a set, quantised as on the wire."""
    return tuple(
        replace(
            command,
            frequency=_Q.frequency.quantise(command.frequency),
            level=_Q.level.quantise(command.level),
            phase=_Q.phase.quantise(command.phase),
        )
        for command in requested.commands
    )


def _order(request: PdoRequest, node: int, sequence: int, *, fd: bool = False) -> CanFrame:
    """Encode the order PDO of a request."""
    fields: dict[str, int] = {}
    match request:
        case Arm(watchdog=watchdog):
            fields = {"token": host_number(node), "time": _Q.watchdog.to_wire(watchdog)}
        case Disarm(ramp=ramp) | Stop(ramp=ramp):
            fields = {"ramp": _Q.ramp.to_wire(ramp)}
        case Clear(latch=latch):
            fields = {"token": _Q.latch.to_wire(latch)}
        case Commit(token=token):
            fields = {"token": _Q.token.to_wire(token)}
        case Apply(command_set=requested) | Stage(command_set=requested):
            fields = {
                "token": _Q.token.to_wire(requested.token),
                "ramp": _Q.ramp.to_wire(requested.ramp),
                "time": _Q.valid_for.to_wire(requested.valid_for),
                "count": len(requested.commands),
            }
    data = LAYOUTS["order"].pack(action=action_of(request), sequence=sequence, **fields)
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
    """Join blocks and fill up to a CAN FD length."""
    data = b"".join(blocks)
    length = next(length for length in _FD_LENGTHS if length >= len(data))
    return data.ljust(length, _FILLING)


def _slots(commands: tuple[DriveCommand, ...], node: int, sequence: int) -> list[CanFrame]:
    """Encode the envelope slots of a set: a frame per four channels with any."""
    each = CANOPEN["channels_per_node"]
    groups: dict[int, dict[str, int]] = {}
    for command in commands:
        if command.onset or command.ending:
            group, index = divmod(command.channel, each)
            slots = groups.setdefault(group, {})
            slots[f"onset_{index}"] = _Q.envelope_slot.to_wire(command.onset)
            slots[f"ending_{index}"] = _Q.envelope_slot.to_wire(command.ending)
    return [
        CanFrame(
            cob_id("slots", node),
            LAYOUTS["slots"].pack(group=group, sequence=sequence, **slots),
        )
        for group, slots in sorted(groups.items())
    ]
