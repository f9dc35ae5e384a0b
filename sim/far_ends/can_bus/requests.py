"""Requests and sets sent to an operational CANopen node, and its replies.

A request is executed on arrival, a set with the last of its frames. Written from protocol.yaml and
docs/reference/wire-can.md, without code of the host's side.
"""

import asyncio
import struct
from collections.abc import Callable, Sequence
from typing import TypeAlias

from drivers.codec.can_bus.canopen import CanFrame
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
from sim.far_ends.can_bus.objects import (
    CANOPEN,
    IDS,
    ObjectDictionary,
    channel_ids,
    flags_of,
    sent_ids,
)
from sim.far_ends.can_bus.set_buffer import (
    INCOMPLETE_SET,
    NO_CHANNEL,
    SETS,
    Action,
    RefusedRequest,
    RequestFrame,
    SetBuffer,
    achieved_domain,
    integers_of,
)

_Q = PROTOCOL.quantities
_INCOMPLETE_LIFE: float = CANOPEN["incomplete_life"]

CallLater: TypeAlias = Callable[[float, Callable[[], None]], asyncio.TimerHandle]


class RequestHandler:
    """Executes the requests to a node; send: puts a frame on the bus."""

    def __init__(
        self,
        device: SimulatedDevice,
        node: int,
        *,
        objects: ObjectDictionary,
        send: Callable[[CanFrame], None],
        call_later: CallLater,
    ) -> None:
        self._device = device
        self._node = node
        self._objects = objects
        self._send = send
        self._call_later = call_later
        channels = device.capabilities.channels
        self._channel_of = channel_ids(node, channels)
        self._sent_ids = sent_ids(node, channels)
        self._buffer = SetBuffer(channels)
        self._expiry: tuple[int, asyncio.TimerHandle] | None = None  # of which sequence number
        self._asked: tuple[int, list[tuple[object, ...]]] = (0, [])  # token and commands

    def take(self, cob_id: int, data: bytes, *, fd: bool = False) -> None:
        """Receive a PDO; ignored unless it is for this node."""
        if len(data) < 8:
            return
        if cob_id == IDS["order"] + self._node:
            self._request(data, fd=fd)
        elif cob_id == IDS["order"]:
            self._broadcast(data)
        elif cob_id == IDS["slots"] + self._node and len(data) == 8:
            self._buffer.take_slots(data)
        elif fd and cob_id == IDS["command"] + self._node:
            self._buffer.take_blocks(data)
        elif cob_id in self._channel_of and len(data) == 8:
            self._buffer.take(self._channel_of[cob_id], data)
        self._check_set()

    def forget(self) -> None:
        """Discard the frames of an incomplete set."""
        self._buffer.clear()
        self._check_set()

    def _check_set(self) -> None:
        """Execute the set if it is complete; a new one expires after a while."""
        if self._buffer.is_complete and (request := self._buffer.request):
            self._carry_out(request, lambda: self._set_request(request))
            self._buffer.clear()
        sequence = self._buffer.sequence
        if self._expiry is not None and self._expiry[0] != sequence:
            self._expiry[1].cancel()
            self._expiry = None
        if self._expiry is None and sequence is not None:
            self._expiry = sequence, self._call_later(_INCOMPLETE_LIFE, self._expire)

    def _expire(self) -> None:
        request = self._buffer.request
        self.forget()
        if request is not None and self._device.is_answering:
            self._answer(request, result=INCOMPLETE_SET)

    def _request(self, data: bytes, *, fd: bool) -> None:
        request = _request_frame(data, fd=fd)
        if request.sequence == 0:
            return
        if request.action in SETS:
            self._buffer.take_request(request)
            self._buffer.take_blocks(data[8:])
        else:
            self._buffer.clear_before(request.sequence)
            self._carry_out(request, lambda: self._plain_request(request))

    def _broadcast(self, data: bytes) -> None:
        request = _request_frame(data, fd=False)
        if request.sequence == 0 and request.action is Action.STOP:
            self._device.broadcast(Stop(_nearest_ramp(request.ramp)))
        elif (
            request.sequence == 0
            and request.action is Action.COMMIT
            and _Q.token.holds(request.token)
        ):
            self._device.broadcast(Commit(request.token))

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
            case Action.COMMIT:
                return Commit(_token(request))
            case _:
                return GetStatus()

    def _set_request(self, request: RequestFrame) -> Request:
        _token(request)
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


def _request_frame(data: bytes, *, fd: bool) -> RequestFrame:
    token, ramp, duration, what, sequence = struct.unpack_from("<HHHBB", data)
    return RequestFrame(token, ramp, duration, Action(what & 7), what >> 3, sequence, fd)


def _token(request: RequestFrame) -> int:
    """The token of a set; raises RefusedRequest."""
    if not _Q.token.holds(request.token):
        raise RefusedRequest(NakCode.BAD_TOKEN)
    return request.token


def _nearest_ramp(ramp: int) -> float:
    """The nearest ramp [s] in range: silencing is never refused for its ramp."""
    return min(ramp, _Q.ramp.maximum) / _Q.ramp.per_unit
