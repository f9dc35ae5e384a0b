"""The amplifier's side of CANopen: NMT, heartbeat, emergencies, orders and sets, SDO.

Written from protocol.yaml's description, with nothing of the host's code in it, so that the two
check each other. Not modelled: SYNC and heartbeat messages that a real node would miss while it
is busy.
"""

import asyncio
import struct
from collections.abc import Callable
from typing import TypeAlias

from drivers import clock
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
from sim.bench.station import Station
from sim.far_ends.can_bus.objects import (
    CANOPEN,
    IDS,
    ObjectDictionary,
    achieved_domain,
    channel_ids,
)
from sim.far_ends.can_bus.sdo import SdoServer
from sim.far_ends.can_bus.sets import (
    APPLY,
    ARM,
    COMMIT,
    SETS,
    STATUS,
    STOP,
    TORN,
    Order,
    Refused,
    SetBuffer,
    integers_of,
)

_NMT = CANOPEN["nmt"]
_NMT_STATES = CANOPEN["nmt_states"]
_OPERATIONAL, _STOPPED = _NMT_STATES["OPERATIONAL"], _NMT_STATES["STOPPED"]
_PRE_OPERATIONAL = _NMT_STATES["PRE_OPERATIONAL"]
_Q = PROTOCOL.quantities
_QUICK = 0.005  # s; the shortest ramp that is no step
_FD_LENGTHS = (8, 12, 16, 20, 24, 32, 48, 64)
_LOOK = 0.02  # s; how often it is looked whether the supply is back


CallLater: TypeAlias = Callable[[float, Callable[[], None]], asyncio.TimerHandle]


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
        self._buffer = SetBuffer(station.capabilities.channels)
        self._waiting: Order | None = None  # for its SYNC
        self._asked: tuple[int, list[tuple[object, ...]]] = (0, [])  # token, what was asked
        self._fault = Fault.NONE
        self._was_off = False
        self._timers: list[asyncio.TimerHandle] = []
        self._beat: asyncio.TimerHandle | None = None

    def start(self, call_later: CallLater | None = None) -> None:
        """Boot; what comes later is left to the running event loop, unless to somebody else."""
        self._call_later = call_later or asyncio.get_running_loop().call_later
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
        self._beat = self._call_later(delay, self._heartbeat)

    def _heartbeat(self) -> None:
        if self._is_awake() and self._objects.heartbeat:
            self._send(CanFrame(IDS["heartbeat"] + self._node, bytes([self._state])))
        self._next_heartbeat()

    def _look(self) -> None:
        """Notice that the supply has come back."""
        self._is_awake()
        for timer in self._timers:
            timer.cancel()
        self._timers = [self._call_later(_LOOK, self._look)]

    def _is_awake(self) -> bool:
        is_off = self._station.faults.now("reboot", clock.now())
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
            self._buffer.take_slots(data)
        elif fd and cob_id == IDS["command"] + self._node:
            self._buffer.take_blocks(data)
        elif cob_id in self._channel_of and len(data) == 8:
            self._buffer.take(self._channel_of[cob_id], data)

    def _order(self, data: bytes, *, own: bool, fd: bool) -> None:
        token, ramp, duration, what, sequence = struct.unpack_from("<HHHBB", data)
        order = Order(token, ramp, duration, what & 7, what >> 3, sequence, own, fd)
        if own and sequence == 0:
            return
        if fd:
            self._buffer.take_blocks(data[8:])
        if order.action in SETS:
            self._waiting = order
        elif own:
            self._carry_out(order, lambda: self._plain_request(order))
        elif order.action == STOP:
            self._station.broadcast(Stop(_nearest_ramp(ramp)))

    def _sync(self) -> None:
        order, self._waiting = self._waiting, None
        if order is not None and order.own:
            self._carry_out(order, lambda: self._set_request(order))
        elif order is not None and order.action == COMMIT and _Q.token.holds(order.token):
            self._station.broadcast(Commit(order.token))
        elif order is None and self._buffer.sequence is not None:
            # Commands without their order: it was lost, and whoever sent it waits.
            lost = Order(0, 0, 0, APPLY, 0, self._buffer.sequence, own=True, fd=False)
            self._answer(lost, TORN, 255, False, ())
        self._forget_set()

    def _forget_set(self) -> None:
        self._buffer.clear()
        self._waiting = None

    def _carry_out(self, order: Order, make: Callable[[], Request]) -> None:
        try:
            reply = self._station.exchange(make())
        except Refused as refused:
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

    def _plain_request(self, order: Order) -> Request:
        ramp = _nearest_ramp(order.ramp)
        match order.action:
            case 4:  # arm; its token is the number of the host
                if not _Q.watchdog.holds(order.time) or not 1 <= order.token <= 127:
                    raise Refused(NakCode.BAD_VALUE)
                return Arm(order.time / 1000)
            case 5:
                return Disarm(ramp)
            case 6:
                return Stop(ramp)
            case 7:
                return Clear()
            case _:
                return GetStatus()

    def _set_request(self, order: Order) -> Request:
        if not _Q.token.holds(order.token):
            raise Refused(NakCode.BAD_TOKEN)
        if order.action == COMMIT:
            return Commit(order.token)
        wanted = self._buffer.command_set(order)
        self._asked = order.token, [integers_of(command) for command in wanted.commands]
        return Apply(wanted) if order.action == APPLY else Stage(wanted)

    def _is_exact(self, achieved: Achieved) -> bool:
        """Whether a set plays as it was asked for; if not, the host reads what it does."""
        self._objects.achieved = achieved_domain(achieved)
        token, asked = self._asked
        played = sorted(integers_of(command) for command in achieved.commands)
        return token == achieved.token and played == asked

    # what the amplifier says

    def _status_blocks(self, order: Order, reply: Reply) -> tuple[bytes, ...]:
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
        self, order: Order, result: int, channel: int, exact: bool, blocks: tuple[bytes, ...]
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


def _nearest_ramp(ramp: int) -> float:
    """The nearest ramp [s] in range: silence is never refused for its ramp."""
    return min(ramp, _Q.ramp.maximum) / _Q.ramp.per_unit
