"""An amplifier as a node of a CAN bus, by the conventions of CANopen.

Orders go out as PDOs, and an answer belongs to the order whose sequence number it carries; what
can wait is read and written as objects. The host's heartbeat is a part of Ping and sent by nobody
else; each amplifier hears one of its own, so that one that was lost is not fed by those for others.
"""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from drivers import clock
from drivers.backends.can_bus.bus import CanBus, can_bus
from drivers.backends.can_bus.node import NodeWatch
from drivers.backends.can_bus.objects import ObjectClient
from drivers.backends.can_bus.pending import PendingRequests
from drivers.backends.hardware import Worker, make_worker
from drivers.backends.urls.can_bus import CanUrl
from drivers.backends.wire_backend import WireBackend
from drivers.codec.can_bus.frame import CANOPEN, CanFrame, cob_id
from drivers.codec.can_bus.replies import UNASKED, CanReply, plain_reply
from drivers.codec.can_bus.requests import (
    PdoRequest,
    encode_broadcast,
    encode_request,
    wanted_commands,
)
from drivers.codec.can_bus.timing import CanTimes
from drivers.errors import LinkError, LinkTimeout
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Achieved,
    AmplifierEvent,
    Apply,
    Arm,
    Broadcast,
    Commit,
    GetCaps,
    GetFaults,
    Hello,
    LoadEnvelope,
    Nak,
    NakCode,
    Reply,
    Request,
    Stage,
)
from drivers.statistics import WireCounters

_OBJECTS_WAIT = 40  # an object is read in so many answers at most
_START = CANOPEN["nmt"]["start"]
_T = TypeVar("_T")


@dataclass(frozen=True)
class _Joined:
    """The bus while this is on it, the amplifier's objects, and who waits for them."""

    bus: CanBus
    objects: ObjectClient
    worker: Worker


class CanBackend(WireBackend):
    """Carries requests to the node of a CAN bus given by its URL (see `CanUrl`)."""

    def __init__(self, url: str) -> None:
        super().__init__()
        self._url = CanUrl.parse(url)
        self._joined: _Joined | None = None
        self._node = NodeWatch(self._url, answered=self._answered, told=self._told, lost=self._lose)
        self._orders = PendingRequests()
        self._staged: Achieved | None = None  # as it was asked for
        self._channels = PROTOCOL.quantities.channel_count.maximum
        self._loss: str | None = None
        self._is_listening = False

    @property
    def is_unsent(self) -> bool:
        """Whether it is still being listened for another host, before anything is sent."""
        return self._is_listening

    @property
    def bus(self) -> str:
        """The bus, on which every amplifier hears a broadcast."""
        return str(self._url.bus)

    @property
    def wire_times(self) -> CanTimes:
        """Of the bus."""
        return CanTimes(self._url.bus.bitrate, self._url.bus.fd)

    async def open(self) -> None:
        """Join the bus, which is opened by the first of its amplifiers; raises LinkError."""
        if self._joined is not None:
            return
        bus = can_bus(self._url.bus)
        await bus.join(self._url.node, self._lose)
        worker = make_worker(f"era-sdo {self._url.node}")
        objects = ObjectClient(bus.network, self._url.node, worker)
        self._joined = _Joined(bus, objects, worker)
        self._loss = None
        self._counters = WireCounters()
        self._node.join(bus, objects, self._counters)

    async def close(self) -> None:
        """Leave the bus; what still waits for an answer gets LinkError."""
        self._node.stop()
        self._fail(f"{self._url.bus} was closed")
        joined, self._joined = self._joined, None
        if joined is None:
            return
        try:
            await joined.worker.close()
        finally:  # also where this is cancelled
            self._node.leave(joined.bus)
            await joined.bus.leave(self._url.node)

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Send a request and wait for its answer; LinkTimeout, LinkError or FrameError.

        timeout [s]: for all of it, of objects for each of their frames; longer where the bus and an
        amplifier that reacts in time need longer.
        """
        self._opened()
        match request:
            case Hello():
                return await self._hello(timeout)
            case GetCaps():
                capabilities = await self._objects_job(
                    lambda objects: objects.capabilities(timeout=timeout), timeout
                )
                self._channels = capabilities.channels
                return capabilities
            case GetFaults():
                return await self._objects_job(
                    lambda objects: objects.faults(timeout=timeout), timeout
                )
            case LoadEnvelope() as load:
                return await self._objects_job(
                    lambda objects: objects.load_envelope(load, timeout=timeout), timeout
                )
            case _:
                return await self._order(request, timeout)

    async def broadcast(self, request: Broadcast) -> None:
        """Say a commit or a stop to every amplifier of the bus; raises LinkError."""
        self._opened()
        self._send(encode_broadcast(request))

    async def _hello(self, timeout: float) -> Reply:
        heartbeat = round(self._url.heartbeat * 1000)

        def ask(objects: ObjectClient) -> Reply:
            identity = objects.identity(timeout=timeout)
            objects.set_heartbeat(heartbeat, timeout=timeout)
            return identity

        identity = await self._objects_job(ask, timeout)
        self._send([CanFrame(cob_id("nmt"), bytes([_START, self._url.node]))])
        self._node.start()
        return identity

    async def _order(self, order: PdoRequest, timeout: float) -> Reply:
        if isinstance(order, Arm):
            self._is_listening = True
            try:
                await self._node.check_no_other_host()
            finally:
                self._is_listening = False
        sequence = self._orders.next_sequence()
        frames = encode_request(
            order, node=self._url.node, sequence=sequence, fd=bool(self._url.bus.fd)
        )
        if isinstance(order, Apply | Stage):
            for command in order.command_set.commands:
                if command.channel >= self._channels:  # its frame would be another node's
                    return Nak(NakCode.BAD_CHANNEL, command.channel)
        bus = self._url.bus
        on_wire = 2 * self.wire_times.frames(frames)
        try:
            answer = await self._orders.answer_to(
                order,
                sequence=sequence,
                send=lambda: self._send(frames),
                timeout=max(timeout, on_wire + PROTOCOL.reaction),
            )
        except LinkError:
            raise
        except TimeoutError:
            raise LinkTimeout(
                f"no answer from node {self._url.node} on {bus} within {timeout * 1e3:g} ms; check "
                "that the amplifier is switched on and that the bit rates agree"
            ) from None
        reply = plain_reply(answer)
        if reply is not None:
            return reply  # always, where the order is about no set
        return await self._achieved(order, answer, timeout)

    async def _achieved(self, order: PdoRequest, answer: CanReply, timeout: float) -> Achieved:
        """What a set plays: what was asked for if the answer says so, else it is read."""
        wanted = None
        if isinstance(order, Apply | Stage):
            token = order.command_set.token
            wanted = Achieved(token, wanted_commands(order.command_set))
        elif isinstance(order, Commit) and self._staged and self._staged.token == order.token:
            wanted = self._staged
        if wanted is not None and answer.exact:
            achieved = wanted
        else:
            achieved = await self._objects_job(
                lambda objects: objects.achieved(timeout=timeout), timeout
            )
            if wanted is not None:
                achieved = _in_order_of(wanted, achieved)
        if isinstance(order, Apply | Stage):
            self._staged = achieved
        return achieved

    async def _objects_job(self, job: Callable[[ObjectClient], _T], timeout: float) -> _T:
        """Do something with the amplifier's objects, beside the event loop."""
        joined = self._opened()
        objects = joined.objects
        future = joined.worker.submit(lambda: job(objects))
        try:
            async with asyncio.timeout(_OBJECTS_WAIT * timeout):
                result = await asyncio.shield(future)
        except TimeoutError as problem:
            if isinstance(problem, LinkError):
                raise
            objects.abandon()
            future.add_done_callback(_forget)
            raise LinkTimeout(
                f"node {self._url.node} on {self._url.bus} took too long over an object; check "
                "that the bus is not overloaded"
            ) from None
        except asyncio.CancelledError:
            objects.abandon()
            future.add_done_callback(_forget)
            raise
        self._counters.frames_out += 1
        self._counters.frames_in += 1
        return result

    def _send(self, frames: Sequence[CanFrame]) -> None:
        self._opened().bus.send(frames)
        self._last_sent = clock.now()
        self._counters.frames_out += len(frames)

    def _told(self, event: AmplifierEvent) -> None:
        self._counters.events += 1
        self._on_event(event)

    def _answered(self, answer: CanReply) -> None:
        if answer.sequence == UNASKED:
            self._told(answer.event)
            return
        if not self._orders.take(answer):
            self._counters.unexpected_frames += 1

    def _lose(self, what: str) -> None:
        if self._loss is not None or self._joined is None:
            return
        self._node.stop()
        self._fail(what)
        self._on_loss(what)

    def _fail(self, what: str) -> None:
        self._loss = self._loss or what
        if self._joined is not None:
            self._joined.objects.close()
        self._orders.fail(self._loss)

    def _opened(self) -> _Joined:
        if self._joined is None or self._loss is not None:
            raise LinkError(self._loss or f"{self._url.bus} is not open; open the amplifier first")
        return self._joined


def _in_order_of(wanted: Achieved, achieved: Achieved) -> Achieved:
    """The commands in the order in which they were asked for; those of others as they come."""
    places = {command.channel: place for place, command in enumerate(wanted.commands)}
    commands = sorted(
        achieved.commands, key=lambda command: places.get(command.channel, len(places))
    )
    return Achieved(achieved.token, tuple(commands))


def _forget(future: "asyncio.Future[Any]") -> None:
    """Nobody waits for it any more, also not for its error."""
    if not future.cancelled():
        future.exception()
