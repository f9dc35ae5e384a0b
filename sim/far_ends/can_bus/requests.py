"""Requests and sets sent to an operational CANopen node, and its replies.

A request is executed on arrival, a set at the SYNC that follows it; a new request discards whatever
still waits for a SYNC. Written from protocol.yaml, without code of the host's side.
"""

import struct
from collections.abc import Callable, Sequence

from drivers.codec.can_bus.frame import CanFrame
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Achieved,
    AmplifierState,
    Apply,
    Arm,
    Clear,
    Commit,
    Disarm,
    GetStatus,
    Nak,
    NakCode,
    Reply,
    Request,
    Stage,
    Status,
    Stop,
)
from sim.bench.simulated_device import SimulatedDevice
from sim.far_ends.can_bus.bus import LENGTHS
from sim.far_ends.can_bus.objects import IDS, ObjectDictionary, channel_ids, flags_of, sent_ids
from sim.far_ends.can_bus.set_buffer import (
    INCOMPLETE_SET,
    NO_CHANNEL,
    SETS,
    TO_ALL,
    Action,
    RefusedRequest,
    RequestFrame,
    SetBuffer,
    achieved_domain,
    integers_of,
)

_Q = PROTOCOL.quantities


class RequestHandler:
    """Executes the requests to a node; send: puts a frame on the bus."""

    def __init__(
        self,
        device: SimulatedDevice,
        node: int,
        *,
        objects: ObjectDictionary,
        send: Callable[[CanFrame], None],
    ) -> None:
        self._device = device
        self._node = node
        self._objects = objects
        self._send = send
        channels = device.capabilities.channels
        self._channel_of = channel_ids(node, channels)
        self._sent_ids = sent_ids(node, channels)
        self._buffer = SetBuffer(channels)
        self._waiting: RequestFrame | None = None  # for SYNC
        self._asked: tuple[int, list[tuple[object, ...]]] = (0, [])  # token and commands

    def take(self, cob_id: int, data: bytes, *, fd: bool = False) -> None:
        """Receive a PDO; ignored unless it is for this node."""
        if len(data) < 8:
            return
        if cob_id == IDS["order"] + self._node:
            self._request(data, own=True, fd=fd)
        elif cob_id == IDS["order"]:
            self._request(data, own=False, fd=False)
        elif cob_id == IDS["slots"] + self._node and len(data) == 8:
            self._buffer.take_slots(data)
        elif fd and cob_id == IDS["command"] + self._node:
            self._buffer.take_blocks(data)
        elif cob_id in self._channel_of and len(data) == 8:
            self._buffer.take(self._channel_of[cob_id], data)

    def sync(self) -> None:
        """Execute the set that waits for SYNC, if any."""
        request, self._waiting = self._waiting, None
        if request is not None and request.own:
            self._carry_out(request, lambda: self._set_request(request))
        elif request is not None and _Q.token.holds(request.token):
            self._device.broadcast(Commit(request.token))
        elif request is None and self._buffer.sequence is not None:
            # Commands whose request was lost: reply, since the host waits.
            lost = RequestFrame(0, 0, 0, Action.APPLY, 0, self._buffer.sequence, own=True, fd=False)
            self._answer(lost, result=INCOMPLETE_SET)
        self.forget()

    def forget(self) -> None:
        """Discard what was received since the last SYNC."""
        self._buffer.clear()
        self._waiting = None

    def _request(self, data: bytes, *, own: bool, fd: bool) -> None:
        token, ramp, duration, what, sequence = struct.unpack_from("<HHHBB", data)
        request = RequestFrame(
            token, ramp, duration, Action(what & 7), what >> 3, sequence, own, fd
        )
        is_dropped = sequence == 0 if own else request.action not in TO_ALL
        if is_dropped:
            return
        self._waiting = None
        self._buffer.clear_others(sequence)
        if fd:
            self._buffer.take_blocks(data[8:])
        if request.action in SETS:
            self._waiting = request
        elif own:
            self._carry_out(request, lambda: self._plain_request(request))
        else:
            self._device.broadcast(Stop(_nearest_ramp(ramp)))

    def _carry_out(self, request: RequestFrame, make: Callable[[], Request]) -> None:
        try:
            reply = self._device.exchange(make())
        except RefusedRequest as refused:
            self._answer(request, result=refused.code, channel=refused.channel)
            return
        if reply is None:
            return
        if isinstance(reply, Nak):
            channel = NO_CHANNEL if reply.channel is None else reply.channel
            self._answer(request, result=reply.code, channel=channel)
        elif isinstance(reply, Achieved):
            self._answer(request, exact=self._is_exact(reply))
        else:
            if request.action is Action.ARM:
                self._objects.host, self._objects.watchdog = request.token, request.time
            self._answer(request, condition=self._status_blocks(request, reply))

    def _plain_request(self, request: RequestFrame) -> Request:
        ramp = _nearest_ramp(request.ramp)
        match request.action:
            case Action.ARM:  # the token is the node of the host
                if not _Q.watchdog.holds(request.time) or not 1 <= request.token <= 127:
                    raise RefusedRequest(NakCode.BAD_VALUE)
                is_held = self._device.status().state is AmplifierState.OPERATION_ENABLED
                if is_held and request.token != self._objects.host:
                    raise RefusedRequest(NakCode.WRONG_SESSION)
                return Arm(request.time / 1000)
            case Action.DISARM:
                return Disarm(ramp)
            case Action.STOP:
                return Stop(ramp)
            case Action.CLEAR:
                return Clear(request.token)
            case _:
                return GetStatus()

    def _set_request(self, request: RequestFrame) -> Request:
        if not _Q.token.holds(request.token):
            raise RefusedRequest(NakCode.BAD_TOKEN)
        if request.action is Action.COMMIT:
            return Commit(request.token)
        wanted = self._buffer.command_set(request)
        self._asked = request.token, [integers_of(command) for command in wanted.commands]
        return Apply(wanted) if request.action is Action.APPLY else Stage(wanted)

    def _is_exact(self, achieved: Achieved) -> bool:
        """Whether a set plays as commanded; else the host reads `achieved`."""
        self._objects.achieved = achieved_domain(achieved)
        token, asked = self._asked
        played = sorted(integers_of(command) for command in achieved.commands)
        return token == achieved.token and played == asked

    def _status_blocks(self, request: RequestFrame, reply: Reply) -> list[bytes]:
        """The status, then levels of four channels each."""
        status = reply if isinstance(reply, Status) else self._device.status()
        levels = [_Q.level.to_wire(min(level, 1.0)) for level in status.levels]
        blocks = [
            struct.pack(
                "<BBhHBB",
                request.sequence,
                flags_of(status),
                _Q.temperature.to_wire(min(max(status.temperature, -100), 200)),
                _Q.voltage.to_wire(status.voltage),
                len(levels),
                status.latch,
            )
        ]
        for begin in range(0, len(levels), 4):
            word = sum(level << 14 * place for place, level in enumerate(levels[begin : begin + 4]))
            blocks.append(word.to_bytes(7, "little") + bytes([request.sequence]))
        return blocks

    def _answer(
        self,
        request: RequestFrame,
        *,
        result: int = 0,
        channel: int = NO_CHANNEL,
        exact: bool = False,
        condition: Sequence[bytes] = (),
    ) -> None:
        """Reply in classic or FD frames, as requested; the reply itself comes last."""
        status = self._device.status()
        answer = struct.pack(
            "<BBBBHH",
            request.sequence,
            request.action | exact << 3 | result << 4,
            status.state | status.fault << 4,
            channel,
            status.token,
            min(max(round(status.watchdog_left * 1000), 0), _Q.watchdog_left.maximum),
        )
        blocks = [answer, *condition]
        sent = dict(zip(self._sent_ids, blocks, strict=False))  # the status may be left out
        self._objects.blocks.update(sent)
        if request.fd:
            data = b"".join(blocks)
            length = next(length for length in LENGTHS if length >= len(data))
            frame = CanFrame(IDS["answer"] + self._node, data.ljust(length, b"\xff"), fd=True)
            self._send(frame)
            return
        for cob_id, block in reversed(sent.items()):
            self._send(CanFrame(cob_id, block))


def _nearest_ramp(ramp: int) -> float:
    """The nearest ramp [s] in range: silencing is never refused for its ramp."""
    return min(ramp, _Q.ramp.maximum) / _Q.ramp.per_unit
