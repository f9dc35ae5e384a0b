"""Requests as the frames that carry them on CAN, and replies from frames; no I/O.

A request that moves something is an *order*: a PDO that the amplifier answers with a PDO of the
same sequence number. The commands of a set go before their order, one PDO a channel, under its
sequence number, and sets take effect at the SYNC that follows: whole or, where a frame is missing,
not at all. On CAN FD the order and its commands are one frame. What can wait (who is there, what
it can play, faults, envelopes) is read and written as objects: see `canopen_objects`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from drivers.command import CommandSet, DriveCommand
from drivers.errors import FrameError
from drivers.guard import SafeCommand
from drivers.protocol.can_frame import BLOCK, CANOPEN, LAYOUTS, CanFrame, cob_id, command_id
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Apply,
    Arm,
    Broadcast,
    Clear,
    Commit,
    Disarm,
    Event,
    Fault,
    GetStatus,
    Nak,
    NakCode,
    Ping,
    Reply,
    Stage,
    State,
    Status,
    Stop,
)

Order = Apply | Stage | Commit | Arm | Disarm | Stop | Clear | GetStatus | Ping

UNASKED = 0  # the sequence number of what an amplifier says by itself
SEQUENCE_MAX = 255
_Q = PROTOCOL.quantities
_ACTIONS: Mapping[str, int] = CANOPEN["actions"]
_TORN: int = CANOPEN["torn"]
_NO_CHANNEL: int = CANOPEN["no_channel"]
_OPERATIONAL: int = CANOPEN["nmt_states"]["OPERATIONAL"]
_FD_BLOCKS = 8
_FD_LENGTHS = (8, 12, 16, 20, 24, 32, 48, 64)
_FILLING = b"\xff"  # a block of these is no command: its level would be out of range
_STATES = {state.value: state for state in State}
_FAULTS = {fault.value: fault for fault in Fault}
_NAKS = {code.value: code for code in NakCode}

SYNC = CanFrame(cob_id("sync"), b"")


def action_of(order: Order) -> int:
    """Which action an order asks for; a Ping asks for the status, its heartbeat goes before it."""
    name = type(order).__name__.lower()
    return _ACTIONS.get(name, _ACTIONS["status"])


def host_number(node: int) -> int:
    """The number under which the host sends its heartbeat to one amplifier."""
    return int(CANOPEN["host_base"]) - node


def encode_order(
    order: Order, *, node: int, sequence: int, fd: bool = False
) -> tuple[CanFrame, ...]:
    """The frames of an order to a node; TypeError for a set that has not passed a guard.

    sequence: 1..255.
    """
    match order:
        case Ping():
            beat = CanFrame(cob_id("heartbeat", host_number(node)), bytes([_OPERATIONAL]))
            return (beat, _order(order, node, sequence))
        case Arm(watchdog=watchdog):
            time = _Q.watchdog.to_wire(watchdog)
            return (_order(order, node, sequence, token=host_number(node), time=time),)
        case Disarm(ramp=ramp) | Stop(ramp=ramp):
            return (_order(order, node, sequence, ramp=_Q.ramp.to_wire(ramp)),)
        case Commit(token=token):
            return (_order(order, node, sequence, token=_Q.token.to_wire(token)), SYNC)
        case Apply(command_set=wanted) | Stage(command_set=wanted):
            if type(wanted) is not SafeCommand:
                raise TypeError(
                    f"only a SafeCommand goes on the wire, not a {type(wanted).__name__}: "
                    "let Guard.check make one"
                )
            head = _order(
                order,
                node,
                sequence,
                token=_Q.token.to_wire(wanted.token),
                ramp=_Q.ramp.to_wire(wanted.ramp),
                time=_Q.valid_for.to_wire(wanted.valid_for),
                count=len(wanted.commands),
            )
            shapes = tuple(_slots(wanted.commands, node, sequence))
            together = _in_fd_frames if fd else _in_classic_frames
            return (*shapes, *together(head, wanted.commands, node, sequence), SYNC)
        case _:
            return (_order(order, node, sequence),)


def encode_broadcast(request: Broadcast) -> tuple[CanFrame, ...]:
    """The frames of what every amplifier of the bus shall do; nobody answers."""
    match request:
        case Commit(token=token):
            order = _order(request, 0, UNASKED, token=_Q.token.to_wire(token))
            return (order, SYNC)
        case Stop(ramp=ramp):
            return (_order(request, 0, UNASKED, ramp=_Q.ramp.to_wire(ramp)),)


def wanted_commands(wanted: CommandSet) -> tuple[DriveCommand, ...]:
    """The commands of a set as they read on the other side of the wire."""
    return tuple(
        DriveCommand(
            channel=command.channel,
            frequency=_Q.frequency.quantise(command.frequency),
            level=_Q.level.quantise(command.level),
            phase=_Q.phase.quantise(command.phase),
            keep_phase=command.keep_phase,
            onset=command.onset,
            ending=command.ending,
            skip_ending=command.skip_ending,
        )
        for command in wanted.commands
    )


def _order(
    order: Order,
    node: int,
    sequence: int,
    *,
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
    return CanFrame(cob_id("order", node), data)


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
    return [*frames, CanFrame(head.id, _filled([head.data, *first]), fd=True)]


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


@dataclass(frozen=True, slots=True)
class Answer:
    """What an amplifier says to an order, or, with sequence 0, by itself.

    refusal: None where it was carried out; exact: a set plays to the last step as it was asked for.
    status is there in the answers to all orders but those about sets, unless they were refused.
    """

    sequence: int
    action: int
    state: State
    fault: Fault
    token: int
    exact: bool
    refusal: Nak | None
    channel: int | None
    status: Status | None

    @property
    def event(self) -> Event:
        """What it tells where nobody asked."""
        return Event(self.state, self.fault, self.channel)


@dataclass
class AnswerReader:
    """Puts the frames of one amplifier's answers together.

    An answer in several frames is whole when the last, the answer itself, has come with the
    sequence number of the others; what is not is dropped.
    """

    node: int
    _condition: dict[str, int] = field(default_factory=dict)
    _levels: dict[int, dict[str, int]] = field(default_factory=dict)

    @property
    def ids(self) -> tuple[int, ...]:
        """The identifiers of the frames that belong here."""
        each = CANOPEN["channels_per_node"]
        groups = range(_Q.channel_count.maximum // each)
        return (
            cob_id("answer", self.node),
            cob_id("condition", self.node),
            *(cob_id("levels", self.node + group) for group in groups),
        )

    def feed(self, frame: CanFrame) -> Answer | None:
        """Take a frame with one of `ids`; an Answer once it is whole, else None.

        Raises FrameError for a frame that makes no sense.
        """
        if frame.id == cob_id("answer", self.node):
            return self._answer(frame.data)
        if frame.id == cob_id("condition", self.node):
            self._condition = _unpack("condition", frame.data)
        else:
            group = frame.id - cob_id("levels", self.node)
            self._levels[group] = _unpack("levels", frame.data)
        return None

    def _answer(self, data: bytes) -> Answer | None:
        if len(data) > BLOCK:  # CAN FD: condition and levels follow in the same frame
            self._condition = _unpack("condition", data[BLOCK : 2 * BLOCK])
            count = min(self._condition["channel_count"], _Q.channel_count.maximum)
            for group in range(-(-count // CANOPEN["channels_per_node"])):
                begin = (2 + group) * BLOCK
                self._levels[group] = _unpack("levels", data[begin : begin + BLOCK])
        values = _unpack("answer", data[:BLOCK])
        sequence, action, result = values["sequence"], values["action"], values["result"]
        if values["state"] not in _STATES or values["fault"] not in _FAULTS:
            raise FrameError(f"an answer names state {values['state']}, fault {values['fault']}")
        if result not in (0, _TORN) and result not in _NAKS:
            raise FrameError(f"an answer has the result {result}")
        channel = values["channel"]
        if channel != _NO_CHANNEL and not _Q.channel.holds(channel):
            raise FrameError(f"an answer names channel {channel}")
        about_set = action in (_ACTIONS["apply"], _ACTIONS["stage"], _ACTIONS["commit"])
        status = None
        if sequence != UNASKED and not result and not about_set:
            status = self._status(values)
            if status is None:
                return None
        blamed = None if channel == _NO_CHANNEL else channel
        return Answer(
            sequence=sequence,
            action=action,
            state=_STATES[values["state"]],
            fault=_FAULTS[values["fault"]],
            token=values["active_token"],
            exact=bool(values["exact"]),
            refusal=_refusal(result, blamed),
            channel=blamed,
            status=status,
        )

    def _status(self, answer: dict[str, int]) -> Status | None:
        """The status that came with an answer; None where a frame of it is missing."""
        condition = self._condition
        each = CANOPEN["channels_per_node"]
        if condition.get("sequence") != answer["sequence"]:
            return None
        count = condition["channel_count"]
        groups = [self._levels.get(group, {}) for group in range(-(-count // each))]
        if any(group.get("sequence") != answer["sequence"] for group in groups):
            return None
        levels = [group[f"level_{place}"] for group in groups for place in range(each)][:count]
        if not (
            _Q.channel_count.holds(count)
            and all(_Q.level.holds(level) for level in levels)
            and _Q.temperature.holds(condition["temperature"])
            and _Q.watchdog_left.holds(answer["watchdog_left"])
        ):
            raise FrameError("a status has numbers out of range")
        return Status(
            state=_STATES[answer["state"]],
            fault=_FAULTS[answer["fault"]],
            token=answer["active_token"],
            high_voltage=bool(condition["high_voltage"]),
            temperature=_Q.temperature.from_wire(condition["temperature"]),
            watchdog_left=_Q.watchdog_left.from_wire(answer["watchdog_left"]),
            levels=tuple(_Q.level.from_wire(level) for level in levels),
            voltage=_Q.voltage.from_wire(condition["voltage"]),
        )


def decode_emergency(data: bytes) -> Event:
    """The event in an EMCY message; raises FrameError."""
    values = _unpack("emergency", data)
    channel = values["channel"]
    if (
        values["state"] not in _STATES
        or values["fault"] not in _FAULTS
        or not (channel == _NO_CHANNEL or _Q.channel.holds(channel))
    ):
        raise FrameError(f"an emergency that makes no sense: {data.hex(' ')}")
    return Event(
        _STATES[values["state"]],
        _FAULTS[values["fault"]],
        None if channel == _NO_CHANNEL else channel,
    )


def is_about_set(order: Order) -> bool:
    """Whether the reply to an order is what a set achieves."""
    return isinstance(order, Apply | Stage | Commit)


def plain_reply(answer: Answer) -> Reply | None:
    """The reply that an answer holds by itself; None where it is about a set that was taken."""
    return answer.refusal or answer.status


def _refusal(result: int, channel: int | None) -> Nak | None:
    if result == 0:
        return None
    # A frame of the set was lost: the amplifier has done nothing, and can be asked again.
    return Nak(NakCode.BUSY if result == _TORN else _NAKS[result], channel)


def _unpack(layout: str, data: bytes) -> dict[str, int]:
    values = LAYOUTS[layout].unpack(data)
    if values is None:
        raise FrameError(f"a frame that is no {layout}: {data.hex(' ')}")
    return values
