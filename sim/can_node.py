"""The amplifier's side of CANopen: NMT, heartbeat, emergencies, orders and sets, SDO.

Written from protocol.yaml's description, with nothing of the host's code in it, so that the two
check each other. Not modelled: SYNC and heartbeat messages that a real node would miss while it
is busy.
"""

import asyncio
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from drivers.command import CommandSet, DriveCommand
from drivers.protocol.can_frame import CanFrame
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Achieved,
    Apply,
    Arm,
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
    Request,
    Stage,
    State,
    Status,
    Stop,
)
from sim.can_objects import CANOPEN, IDS, ObjectDictionary, achieved_domain, channel_ids
from sim.can_sdo import SdoServer
from sim.station import Station

STATUS, APPLY, STAGE, COMMIT, ARM, DISARM, STOP, CLEAR = range(8)
_SETS = (APPLY, STAGE, COMMIT)
_TORN = 15
_NMT = CANOPEN["nmt"]
_NMT_STATES = CANOPEN["nmt_states"]
_OPERATIONAL, _STOPPED = _NMT_STATES["OPERATIONAL"], _NMT_STATES["STOPPED"]
_PRE_OPERATIONAL = _NMT_STATES["PRE_OPERATIONAL"]
_Q = PROTOCOL.quantities
_QUICK = 0.005  # s; the shortest ramp that is no step
_FD_LENGTHS = (8, 12, 16, 20, 24, 32, 48, 64)
_LOOK = 0.02  # s; how often it is looked whether the supply is back


@dataclass(frozen=True, slots=True)
class _Order:
    """An order frame as it came; own: not said to all."""

    token: int
    ramp: int
    time: int
    action: int
    count: int
    sequence: int
    own: bool
    fd: bool


class _Command(NamedTuple):
    """A channel's command as it came, integers as on the wire."""

    frequency: int
    level: int
    phase: int
    flags: int
    sequence: int


class _Refused(Exception):
    """An order that says nonsense, or a set with a frame missing."""

    def __init__(self, code: int, channel: int = 255) -> None:
        super().__init__(code, channel)
        self.code = code
        self.channel = channel


class CanNode:
    """An amplifier as node `node` of a bus; send puts a frame of its own on the bus."""

    def __init__(self, station: Station, node: int, *, send: Callable[[CanFrame], None]) -> None:
        self._station = station
        self._node = node
        self._send = send
        self._state = _PRE_OPERATIONAL
        self._channel_of = channel_ids(node, station.capabilities.channels)
        self._objects = ObjectDictionary(station, node, pdo_written=self._pdo)
        self._sdo = SdoServer(
            read=self._objects.read,
            write=self._objects.write,
            send=lambda data: send(CanFrame(IDS["sdo_answer"] + node, data)),
        )
        self._commands: dict[int, _Command] = {}
        self._slots: dict[int, tuple[int, int]] = {}  # by channel: word of both slots, sequence
        self._waiting: _Order | None = None  # for its SYNC
        self._asked: tuple[int, list[tuple[object, ...]]] = (0, [])  # token, what was asked
        self._fault = Fault.NONE
        self._was_off = False
        self._timers: list[asyncio.TimerHandle] = []
        self._beat: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Boot, in the running event loop."""
        self._station.listen(self._tell)
        self._boot()
        self._look()

    def close(self) -> None:
        """No more heartbeats."""
        for timer in self._timers:
            timer.cancel()
        if self._beat is not None:
            self._beat.cancel()

    def receive(self, frame: CanFrame) -> None:
        """Take a frame from the bus."""
        if not self._is_awake():
            return
        if frame.id == IDS["nmt"]:
            self._nmt_command(frame.data)
        elif frame.id == IDS["sdo_request"] + self._node and self._state != _STOPPED:
            self._sdo.receive(frame.data)
        elif frame.id == IDS["heartbeat"] + self._objects.host and self._objects.host:
            self._station.exchange(Ping())
        elif frame.id == IDS["sync"] and len(frame.data) <= 1:
            self._sync()
        else:
            self._pdo(frame.id, frame.data, fd=frame.fd)

    # what the network says

    def _nmt_command(self, data: bytes) -> None:
        if len(data) != 2 or data[1] not in (0, self._node):
            return
        if data[0] == _NMT["start"]:
            self._state = _OPERATIONAL
        elif data[0] == _NMT["stop"]:
            self._leave_operation(_STOPPED)
        elif data[0] == _NMT["pre_operational"]:
            self._leave_operation(_PRE_OPERATIONAL)
        elif data[0] == _NMT["reset_communication"]:
            self._leave_operation(_PRE_OPERATIONAL)
            self._boot()
        elif data[0] == _NMT["reset_node"]:
            self._station.restart()
            self._boot()

    def _leave_operation(self, state: int) -> None:
        """Nothing is heard of the host then, so nothing may play."""
        if self._station.status().state is State.OPERATION_ENABLED:
            self._station.exchange(Stop(_QUICK))
        self._state = state
        self._forget_set()

    def _boot(self) -> None:
        self._objects.reset()
        self._sdo.reset()
        self._forget_set()
        self._state = _PRE_OPERATIONAL
        self._send(CanFrame(IDS["heartbeat"] + self._node, b"\x00"))
        if self._beat is not None:
            self._beat.cancel()
        self._next_heartbeat()

    def _next_heartbeat(self) -> None:
        period = self._objects.heartbeat
        delay = period / 1000 if period else _LOOK  # 0: none, until another is written
        self._beat = asyncio.get_running_loop().call_later(delay, self._heartbeat)

    def _heartbeat(self) -> None:
        if self._is_awake() and self._objects.heartbeat:
            self._send(CanFrame(IDS["heartbeat"] + self._node, bytes([self._state])))
        self._next_heartbeat()

    def _look(self) -> None:
        """Notice that the supply has come back."""
        self._is_awake()
        for timer in self._timers:
            timer.cancel()
        self._timers = [asyncio.get_running_loop().call_later(_LOOK, self._look)]

    def _is_awake(self) -> bool:
        is_off = self._station.faults.now("reboot", time.monotonic())
        if self._was_off and not is_off:
            self._was_off = False
            self._boot()
        self._was_off = is_off
        return self._station.is_answering

    # orders and sets

    def _pdo(self, cob_id: int, data: bytes, *, fd: bool = False) -> None:
        if self._state != _OPERATIONAL or len(data) < 8:
            return
        if cob_id == IDS["order"] + self._node:
            self._order(data, own=True, fd=fd)
        elif cob_id == IDS["order"]:
            self._order(data, own=False, fd=False)
        elif cob_id == IDS["slots"] + self._node and len(data) == 8:
            self._take_slots(data)
        elif fd and cob_id == IDS["command"] + self._node:
            self._take_blocks(data)
        elif cob_id in self._channel_of and len(data) == 8:
            command = _Command(*struct.unpack("<HHhBB", data))
            # Its channel is named twice, by the identifier and in the flags.
            self._commands[self._channel_of[cob_id]] = command

    def _order(self, data: bytes, *, own: bool, fd: bool) -> None:
        token, ramp, duration, what, sequence = struct.unpack_from("<HHHBB", data)
        order = _Order(token, ramp, duration, what & 7, what >> 3, sequence, own, fd)
        if own and sequence == 0:
            return
        if fd:
            self._take_blocks(data[8:])
        if order.action in _SETS:
            self._waiting = order
        elif own:
            self._carry_out(order, lambda: self._plain_request(order))
        elif order.action == STOP and _Q.ramp.holds(ramp):
            self._station.broadcast(Stop(ramp / 1000))

    def _sync(self) -> None:
        order, self._waiting = self._waiting, None
        if order is not None and order.own:
            self._carry_out(order, lambda: self._set_request(order))
        elif order is not None and order.action == COMMIT and _Q.token.holds(order.token):
            self._station.broadcast(Commit(order.token))
        elif order is None and self._commands:
            # Commands without their order: it was lost, and whoever sent it waits.
            sequence = next(iter(self._commands.values())).sequence
            self._answer(_Order(0, 0, 0, APPLY, 0, sequence, True, False), _TORN, 255, False, ())
        self._forget_set()

    def _forget_set(self) -> None:
        self._commands.clear()
        self._slots.clear()
        self._waiting = None

    def _carry_out(self, order: _Order, make: Callable[[], Request]) -> None:
        try:
            reply = self._station.exchange(make())
        except _Refused as refused:
            self._answer(order, refused.code, refused.channel, False, ())
            return
        if reply is None:
            return
        if isinstance(reply, Nak):
            channel = 255 if reply.channel is None else reply.channel
            self._answer(order, reply.code, channel, False, ())
        elif isinstance(reply, Achieved):
            self._answer(order, 0, 255, self._is_exact(reply), ())
        else:
            if order.action == ARM:
                self._objects.host, self._objects.watchdog = order.token, order.time
            self._answer(order, 0, 255, False, self._status_blocks(order, reply))

    def _plain_request(self, order: _Order) -> Request:
        ramp = order.ramp / 1000
        if order.action in (DISARM, STOP) and not _Q.ramp.holds(order.ramp):
            raise _Refused(NakCode.BAD_VALUE)
        match order.action:
            case 4:  # arm; its token is the number of the host
                if not _Q.watchdog.holds(order.time) or not 1 <= order.token <= 127:
                    raise _Refused(NakCode.BAD_VALUE)
                return Arm(order.time / 1000)
            case 5:
                return Disarm(ramp)
            case 6:
                return Stop(ramp)
            case 7:
                return Clear()
            case _:
                return GetStatus()

    def _set_request(self, order: _Order) -> Request:
        if not _Q.token.holds(order.token):
            raise _Refused(NakCode.BAD_TOKEN)
        if order.action == COMMIT:
            return Commit(order.token)
        if not (_Q.ramp.holds(order.ramp) and _Q.valid_for.holds(order.time)):
            raise _Refused(NakCode.BAD_VALUE)
        own = {
            channel: command
            for channel, command in self._commands.items()
            if command.sequence == order.sequence
        }
        if len(own) != order.count:
            raise _Refused(_TORN)
        commands = tuple(
            self._drive_command(channel, command, order.sequence)
            for channel, command in sorted(own.items())
        )
        self._asked = order.token, [_integers(command) for command in commands]
        wanted = CommandSet(order.token, commands, order.ramp / 1000, order.time / 1000)
        return Apply(wanted) if order.action == APPLY else Stage(wanted)

    def _drive_command(self, channel: int, command: _Command, sequence: int) -> DriveCommand:
        if command.flags >> 4 != channel or channel >= self._station.capabilities.channels:
            raise _Refused(NakCode.BAD_CHANNEL, command.flags >> 4)
        if command.flags & 0b1000 or not (
            _Q.level.holds(command.level) and _Q.phase.holds(command.phase)
        ):
            raise _Refused(NakCode.BAD_VALUE, channel)
        slots = 0
        if command.flags & 4:
            slots, of = self._slots.get(channel, (0, -1))
            if of != sequence:
                raise _Refused(_TORN)
        return DriveCommand(
            channel=channel,
            frequency=command.frequency / 100,
            level=command.level / 10_000,
            phase=command.phase / 100,
            keep_phase=bool(command.flags & 1),
            onset=slots & 0x3F,
            ending=slots >> 6,
            skip_ending=bool(command.flags & 2),
        )

    def _take_blocks(self, data: bytes) -> None:
        """Commands in a row, as CAN FD carries them; eight bytes FF fill up."""
        for begin in range(0, len(data) - 7, 8):
            block = data[begin : begin + 8]
            if block != b"\xff" * 8:
                command = _Command(*struct.unpack("<HHhBB", block))
                self._commands[command.flags >> 4] = command

    def _take_slots(self, data: bytes) -> None:
        word = int.from_bytes(data[:6], "little")
        for place in range(4):
            self._slots[4 * (data[6] & 3) + place] = (word >> 12 * place & 0xFFF, data[7])

    def _is_exact(self, achieved: Achieved) -> bool:
        """Whether a set plays as it was asked for; if not, the host reads what it does."""
        self._objects.achieved = achieved_domain(achieved)
        token, asked = self._asked
        played = sorted(_integers(command) for command in achieved.commands)
        return token == achieved.token and played == asked

    # what the amplifier says

    def _status_blocks(self, order: _Order, reply: Reply) -> tuple[bytes, ...]:
        status = reply if isinstance(reply, Status) else self._station.status()
        levels = [_Q.level.to_wire(min(level, 1.0)) for level in status.levels]
        blocks = [
            struct.pack(
                "<BBhHBx",
                order.sequence,
                status.high_voltage,
                _Q.temperature.to_wire(min(max(status.temperature, -100), 200)),
                _Q.voltage.to_wire(status.voltage),
                len(levels),
            )
        ]
        for begin in range(0, len(levels), 4):
            word = sum(level << 14 * place for place, level in enumerate(levels[begin : begin + 4]))
            blocks.append(word.to_bytes(7, "little") + bytes([order.sequence]))
        return tuple(blocks)

    def _answer(
        self, order: _Order, result: int, channel: int, exact: bool, blocks: tuple[bytes, ...]
    ) -> None:
        """Answer in the kind of frame in which it was asked; the answer itself comes last."""
        status = self._station.status()
        answer = struct.pack(
            "<BBBBHH",
            order.sequence,
            order.action | exact << 3 | result << 4,
            status.state | status.fault << 4,
            channel,
            status.token,
            min(max(round(status.watchdog_left * 1000), 0), _Q.watchdog_left.maximum),
        )
        self._objects.blocks["answer"] = answer
        if blocks:
            self._objects.blocks["condition"] = blocks[0]
        for group, block in enumerate(blocks[1:]):
            self._objects.blocks[f"levels {group}"] = block
        if order.fd:
            data = b"".join((answer, *blocks))
            length = next(length for length in _FD_LENGTHS if length >= len(data))
            frame = CanFrame(IDS["answer"] + self._node, data.ljust(length, b"\xff"), fd=True)
            self._send(frame)
            return
        for group, block in enumerate(blocks[1:]):
            self._send(CanFrame(IDS["levels"] + self._node + group, block))
        if blocks:
            self._send(CanFrame(IDS["condition"] + self._node, blocks[0]))
        self._send(CanFrame(IDS["answer"] + self._node, answer))

    def _tell(self, event: Event) -> None:
        """A change of state or fault: an emergency for faults, an answer to nobody for others."""
        concerns_fault = event.fault is not Fault.NONE or self._fault is not Fault.NONE
        self._fault = event.fault
        if not self._station.is_answering or self._state == _STOPPED:
            return
        channel = 255 if event.channel is None else event.channel
        if concerns_fault:
            said = CANOPEN["emergencies"][event.fault.name]
            head = (said["code"], said["error_register"], event.state | event.fault << 4)
            data = struct.pack("<HBBB3x", *head, channel)
            self._send(CanFrame(IDS["emergency"] + self._node, data))
        elif self._state == _OPERATIONAL:
            data = struct.pack("<BBBBHH", 0, STATUS, event.state, channel, 0, 0)
            self._send(CanFrame(IDS["answer"] + self._node, data))


def _integers(command: DriveCommand) -> tuple[object, ...]:
    """A command as it reads on the wire."""
    return (
        command.channel,
        _Q.frequency.to_wire(command.frequency),
        _Q.level.to_wire(command.level),
        _Q.phase.to_wire(command.phase),
        command.keep_phase,
        command.onset,
        command.ending,
        command.skip_ending,
    )
