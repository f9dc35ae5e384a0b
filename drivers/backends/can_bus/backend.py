"""Backend for an amplifier on a CAN bus, by the conventions of CANopen.

Time-critical requests are PDOs, matched to their replies by sequence number; the others are SDO
transfers. Only Ping sends the host's heartbeat; each amplifier has one of its own, so that a lost
amplifier is not fed by the heartbeats of others.
"""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from drivers import clock
from drivers.backends.can_bus.bus import CanBus, can_bus
from drivers.backends.can_bus.node import NodeWatch
from drivers.backends.can_bus.objects import ObjectClient
from drivers.backends.can_bus.pending import PendingRequests
from drivers.backends.wire_backend import WireBackend
from drivers.codec.can_bus.frame import CANOPEN, CanFrame, cob_id
from drivers.codec.can_bus.replies import UNSOLICITED, CanReply, plain_reply
from drivers.codec.can_bus.requests import (
    PdoRequest,
    encode_broadcast,
    encode_request,
    requested_commands,
)
from drivers.codec.can_bus.timing import CanTimes
from drivers.errors import CommandError, LinkError, LinkTimeout
from drivers.hardware import Worker, make_worker
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Achieved,
    AmplifierEvent,
    Apply,
    Arm,
    Broadcast,
    Commit,
    GetBlock,
    GetCaps,
    GetFaults,
    GetMeasured,
    GetReading,
    GetSensors,
    Hello,
    LoadEnvelope,
    Measure,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    SetAddress,
    Stage,
    Stop,
)
from drivers.statistics import WireCounters
from drivers.urls.can_bus import CanUrl

_BROADCAST_TIMEOUT = 0.03  # s; for room in the transmit queue
_ADDRESS_TIMEOUT = 0.5  # s; for an SDO reply to a new address, while nothing plays
_MAX_SDO_RESPONSES = 40  # of one job
_FRAMES_APART = 8  # from a heartbeat to its order: that long the bus may be busy
_START = CANOPEN["nmt"]["start"]
_RESET_COMMUNICATION = CANOPEN["nmt"]["reset_communication"]
_T = TypeVar("_T")


@dataclass(frozen=True)
class _Joined:
    """The joined bus, the amplifier's objects, and the worker for SDO transfers."""

    bus: CanBus
    objects: ObjectClient
    worker: Worker


class CanBackend(WireBackend):
    """Carries requests to the node of a CAN bus given by its URL (see `CanUrl`)."""

    def __init__(self, url: str) -> None:
        super().__init__()
        self._url = CanUrl.parse(url)
        self._joined: _Joined | None = None
        self._node = NodeWatch(
            self._url, on_reply=self._received, on_event=self._notify, on_loss=self._lose
        )
        self._pending = PendingRequests()
        self._start = CanFrame(cob_id("nmt"), bytes([_START, self._url.node]))
        self._staged: Achieved | None = None  # as requested
        self._channels = PROTOCOL.quantities.channel_count.maximum

    @property
    def carries_sessions(self) -> bool:
        """No: the session is the number of the host."""
        return False

    @property
    def bus(self) -> str:
        """The bus: a broadcast reaches every amplifier on it."""
        return str(self._url.bus)

    @property
    def wire_times(self) -> CanTimes:
        """Durations on the bus."""
        return CanTimes(self._url.bus.bitrate, self._url.bus.fd)

    async def open(self) -> None:
        """Join the bus, which its first amplifier opens; raises LinkError."""
        if self._joined is not None:
            return
        bus = can_bus(self._url.bus)
        await bus.join(self._url.node, self._lose)
        worker = make_worker(f"era-sdo {self._url.node}")
        self._counters = WireCounters()
        objects = ObjectClient(bus.network, self._url.node, worker, self._counters)
        self._joined = _Joined(bus, objects, worker)
        self._loss = None
        self._node.join(bus, objects, self._counters)

    async def close(self) -> None:
        """Leave the bus; pending requests raise LinkError."""
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
        """Send a request and wait for its reply; LinkTimeout, LinkError or FrameError.

        timeout [s]: of the whole exchange, in SDO transfers of each frame; extended on slow buses.
        """
        self._opened(request)
        match request:
            case Hello():
                return await self._hello(request, timeout)
            case GetCaps():
                capabilities = await self._objects_job(ObjectClient.capabilities, request, timeout)
                self._channels = capabilities.channels
                return capabilities
            case GetFaults():
                return await self._objects_job(ObjectClient.faults, request, timeout)
            case SetAddress():
                raise CommandError("on CAN an address is set by a broadcast")
            case GetMeasured():
                measure = partial(ObjectClient.measured, channels=self._channels)
                return await self._objects_job(measure, request, timeout)
            case GetSensors():
                return await self._objects_job(
                    partial(ObjectClient.sensors, request=request), request, timeout
                )
            case Measure():
                return await self._objects_job(
                    partial(ObjectClient.measure, request=request), request, timeout
                )
            case GetReading():
                return await self._objects_job(
                    partial(ObjectClient.reading, request=request), request, timeout
                )
            case GetBlock():
                return await self._objects_job(
                    partial(ObjectClient.samples, request=request), request, timeout
                )
            case LoadEnvelope():
                load = partial(ObjectClient.load_envelope, request=request)
                return await self._objects_job(load, request, timeout)
            case _:
                return await self._exchange_pdo(request, timeout)

    async def broadcast(self, request: Broadcast) -> None:
        """Send a commit or a stop to every amplifier of the bus; raises LinkError.

        SetAddress is for its own node alone: two of one number cannot be told apart.
        """
        if isinstance(request, SetAddress):
            give = partial(ObjectClient.set_address, request=request)
            await self._objects_job(give, request, _ADDRESS_TIMEOUT)
            reset = CanFrame(cob_id("nmt"), bytes([_RESET_COMMUNICATION, self._url.node]))
            await self._send([reset], request, _BROADCAST_TIMEOUT)
            return
        await self._send(encode_broadcast(request), request, _BROADCAST_TIMEOUT)

    async def _hello(self, request: Hello, timeout: float) -> Reply:
        heartbeat = round(self._url.heartbeat * 1000)

        def identify(objects: ObjectClient, *, timeout: float) -> Reply:
            identity = objects.identity(timeout=timeout)
            objects.set_heartbeat(heartbeat, timeout=timeout)
            return identity

        identity = await self._objects_job(identify, request, timeout)
        await self._send([self._start], request, timeout)
        self._node.start()
        return identity

    async def _exchange_pdo(self, request: PdoRequest, timeout: float) -> Reply:
        if isinstance(request, Arm):
            await self._node.check_no_other_host()
            self._node.tolerance = request.watchdog
        sequence = self._pending.next_sequence()
        frames = encode_request(
            request, node=self._url.node, sequence=sequence, fd=bool(self._url.bus.fd)
        )
        if isinstance(request, Apply | Stage):
            for command in request.command_set.commands:
                if command.channel >= self._channels:  # its COB-ID belongs to another node
                    return Nak(NakCode.BAD_CHANNEL, command.channel)
        if isinstance(request, Stop) and not self._node.is_started:
            frames = (self._start, *frames)  # a node that is not operational ignores the rest
        bus = self._url.bus
        timeout = max(timeout, 2 * self.wire_times.frames(frames) + PROTOCOL.reaction)
        deadline = clock.now() + timeout
        if isinstance(request, Ping):
            # An adapter that transmits by priority would send the status order before it.
            beat, *frames_left = frames
            await self._send([beat], request, timeout)
            await asyncio.sleep(_FRAMES_APART * self.wire_times.frames([beat]))
            frames = tuple(frames_left)
        await self._send(frames, request, timeout)
        try:
            can_reply = await self._pending.reply_to(
                request, sequence=sequence, timeout=deadline - clock.now()
            )
        except LinkError:
            raise
        except TimeoutError:
            raise LinkTimeout(
                f"no reply from node {self._url.node} on {bus} within {timeout * 1e3:g} ms; check "
                "that the amplifier is switched on and that the bit rates agree"
            ) from None
        reply = plain_reply(can_reply)
        if reply is not None:
            return reply  # always, unless the request carries a set
        return await self._achieved(request, can_reply, timeout)

    async def _achieved(self, request: PdoRequest, can_reply: CanReply, timeout: float) -> Achieved:
        """Return what a set plays: the requested set if the reply is exact, else read it."""
        requested = None
        if isinstance(request, Apply | Stage):
            token = request.command_set.token
            requested = Achieved(token, requested_commands(request.command_set))
        elif isinstance(request, Commit) and self._staged and self._staged.token == request.token:
            requested = self._staged
        if requested is not None and can_reply.exact:
            achieved = requested
        else:
            achieved = await self._objects_job(ObjectClient.achieved, request, timeout)
            if requested is not None:
                achieved = _in_order_of(requested, achieved)
        if isinstance(request, Stage):
            self._staged = achieved
        return achieved

    async def _objects_job(self, job: Callable[..., _T], request: Request, timeout: float) -> _T:
        """Run an SDO job, with the object client and timeout [s], outside the event loop."""
        joined = self._opened(request)
        objects = joined.objects
        future = joined.worker.submit(lambda: job(objects, timeout=timeout))
        try:
            async with asyncio.timeout(_MAX_SDO_RESPONSES * timeout):
                result = await asyncio.shield(future)
        except TimeoutError as error:
            if isinstance(error, LinkError):
                raise
            objects.abandon()
            future.add_done_callback(_forget)
            raise LinkTimeout(
                f"node {self._url.node} on {self._url.bus}: SDO transfer timed out; check "
                "that the bus is not overloaded"
            ) from None
        except asyncio.CancelledError:
            objects.abandon()
            future.add_done_callback(_forget)
            raise
        self._counters.frames_out += 1
        self._counters.frames_in += 1
        return result

    async def _send(self, frames: Sequence[CanFrame], request: Request, timeout: float) -> None:
        is_stop = isinstance(request, Stop)
        await self._opened(request).bus.send(frames, timeout=timeout, is_stop=is_stop)
        self._last_sent_at = clock.now()
        self._counters.frames_out += len(frames)

    def _notify(self, event: AmplifierEvent) -> None:
        self._counters.events += 1
        self._on_event(event)

    def _received(self, can_reply: CanReply) -> None:
        if can_reply.sequence == UNSOLICITED:
            self._notify(can_reply.event)
            return
        if not self._pending.resolve(can_reply):
            self._counters.unexpected_frames += 1

    def _lose(self, cause: str) -> None:
        if self._loss is not None or self._joined is None:
            return
        self._node.stop()
        self._fail(cause)
        self._on_loss(cause)

    def _fail(self, cause: str) -> None:
        self._loss = self._loss or cause
        if self._joined is not None:
            self._joined.objects.close()
        self._pending.fail(self._loss)

    def _opened(self, request: Request) -> _Joined:
        return self._require(self._joined, str(self._url.bus), request)


def _in_order_of(requested: Achieved, achieved: Achieved) -> Achieved:
    """Sort the achieved commands into the requested order."""
    order = {command.channel: number for number, command in enumerate(requested.commands)}
    commands = sorted(achieved.commands, key=lambda command: order.get(command.channel, len(order)))
    return Achieved(achieved.token, tuple(commands))


def _forget(future: "asyncio.Future[Any]") -> None:
    """Mark the exception of an abandoned future as retrieved."""
    if not future.cancelled():
        future.exception()
