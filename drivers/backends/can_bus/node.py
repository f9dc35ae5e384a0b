"""Receiver of one CAN node: replies, events, and supervision of its heartbeat."""

import asyncio
import contextlib
import math
from collections.abc import Callable
from typing import TypeVar

from canopen.emcy import EmcyConsumer, EmcyError
from canopen.nmt import NmtMaster

from drivers import clock
from drivers.backends.can_bus.bus import CanBus
from drivers.backends.can_bus.objects import ObjectClient
from drivers.codec.can_bus.frame import CANOPEN, CanFrame, cob_id
from drivers.codec.can_bus.replies import CanReply, CanReplyReader, decode_emergency
from drivers.codec.can_bus.requests import host_number
from drivers.errors import FrameError, LinkError
from drivers.protocol.messages import AmplifierEvent
from drivers.statistics import WireCounters
from drivers.urls.can_bus import CanUrl

MAX_MISSED_NODE_HEARTBEATS = 3  # of the amplifier, until it is lost
_LATE = 0.005  # s; delay of timers, so that a loss is detected by the third heartbeat
_SHORTEST = 1e-4  # s; shortest pause
_HOST_HEARTBEAT = CANOPEN["heartbeat_ms"] / 1000  # s; interval of every host while armed
_OPERATIONAL = CANOPEN["nmt_states"]["OPERATIONAL"]
_BOOT_UP = CANOPEN["nmt_states"]["BOOT_UP"]
_T = TypeVar("_T")


class NodeWatch:
    """Receives the frames of a node, in the reader thread; callbacks run in the event loop."""

    def __init__(
        self,
        url: CanUrl,
        *,
        on_reply: Callable[[CanReply], None],
        on_event: Callable[[AmplifierEvent], None],
        on_loss: Callable[[str], None],
    ) -> None:
        self._url = url
        self._on_reply, self._on_event, self._on_loss = on_reply, on_event, on_loss
        self._loop: asyncio.AbstractEventLoop | None = None
        self._counters = WireCounters()
        self._reply_reader = CanReplyReader(url.node)
        self._emergencies = EmcyConsumer()
        self._subscribed: list[tuple[int, Callable[..., None]]] = []
        self.tolerance = 0.0  # s, beyond three heartbeats: the watchdog of one that may play
        self._is_watched = False
        self._was_operational = False
        self._joined = 0.0
        self._heard = 0.0  # last heartbeat of the node
        self._host_heard = -math.inf  # last heartbeat of another host
        self._next_check: asyncio.TimerHandle | None = None
        self._check_due = 0.0

    def join(self, bus: CanBus, objects: ObjectClient, counters: WireCounters) -> None:
        """Subscribe on a bus, with callbacks in the running event loop."""
        self._loop = asyncio.get_running_loop()
        self._counters = counters
        self._reply_reader = CanReplyReader(self._url.node)
        self._joined = clock.now()
        self._host_heard = -math.inf
        node, nmt = self._url.node, NmtMaster(self._url.node)
        self._emergencies = EmcyConsumer()
        nmt.add_heartbeat_callback(self._heartbeat)
        self._emergencies.add_callback(self._emergency)
        self._subscribed = [
            (cob_id("sdo_answer", node), objects.feed),
            (cob_id("heartbeat", node), nmt.on_heartbeat),
            (cob_id("heartbeat", host_number(node)), self._other_host),
            (cob_id("emergency", node), self._emergencies.on_emcy),
            *((can_id, self._reply_frame) for can_id in self._reply_reader.ids),
        ]
        for can_id, callback in self._subscribed:
            bus.network.subscribe(can_id, callback)

    def leave(self, bus: CanBus) -> None:
        """Unsubscribe."""
        self.stop()
        for can_id, callback in self._subscribed:
            with contextlib.suppress(KeyError, ValueError):
                bus.network.unsubscribe(can_id, callback)
        self._subscribed.clear()

    @property
    def is_started(self) -> bool:
        """Whether the node was set operational, and is supervised."""
        return self._is_watched

    def start(self) -> None:
        """Start to supervise heartbeat and NMT state."""
        self.tolerance = 0.0
        self._heard = self._check_due = clock.now()
        self._was_operational = False
        if not self._is_watched:
            self._is_watched = True
            self._check_heartbeat()

    def stop(self) -> None:
        """Stop the supervision."""
        self._is_watched = False
        if self._next_check is not None:
            self._next_check.cancel()
            self._next_check = None

    async def check_no_other_host(self) -> None:
        """Listen for another host before arming; LinkError if there is one."""
        await asyncio.sleep(max(0.0, self._joined + 1.2 * _HOST_HEARTBEAT - clock.now()))
        if clock.now() - self._host_heard < MAX_MISSED_NODE_HEARTBEATS * _HOST_HEARTBEAT:
            raise LinkError(
                f"another program drives node {self._url.node} on {self._url.bus}; end that one"
            )

    def _reply_frame(self, can_id: int, data: bytearray, timestamp: float) -> None:
        self._counters.frames_in += 1
        try:
            can_reply = self._reply_reader.feed(CanFrame(can_id, bytes(data)))
        except FrameError:
            self._counters.invalid_frames += 1
            return
        if can_reply is not None:
            self._post(self._on_reply, can_reply)

    def _emergency(self, error: EmcyError) -> None:
        self._emergencies.reset()  # it keeps them all
        data = error.code.to_bytes(2, "little") + bytes([error.register]) + error.data
        try:
            self._post(self._on_event, decode_emergency(data))
        except FrameError:
            self._counters.invalid_frames += 1

    def _heartbeat(self, state: int) -> None:
        self._heard = clock.now()
        if not self._is_watched:
            return
        if state == _BOOT_UP:
            cause = "has restarted, or another node with its number has"
        elif self._was_operational and state != _OPERATIONAL:
            cause = "was taken out of operation by another master"
        else:
            self._was_operational = self._was_operational or state == _OPERATIONAL
            return
        self._post(
            self._on_loss,
            f"node {self._url.node} on {self._url.bus} {cause}: open and arm it again",
        )

    def _other_host(self, can_id: int, data: bytearray, timestamp: float) -> None:
        self._host_heard = clock.now()
        self._counters.unexpected_frames += 1

    def _post(self, callback: Callable[[_T], None], argument: _T) -> None:
        """Call back in the event loop."""
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # of a closed loop
                self._loop.call_soon_threadsafe(callback, argument)

    def _check_heartbeat(self) -> None:
        """Check the age of the last heartbeat.

        If this process was delayed, heartbeats may have arrived but not been read yet.
        """
        now = clock.now()
        silent = now - self._heard
        limit = MAX_MISSED_NODE_HEARTBEATS * self._url.heartbeat - _LATE + self.tolerance
        was_delayed = now - self._check_due > self._url.heartbeat / 2
        if silent < limit or was_delayed:
            # A remainder by rounding must not lead to an immediate check.
            pause = max(limit - silent, _SHORTEST) if silent < limit else self._url.heartbeat
            self._check_due = now + pause
            self._next_check = asyncio.get_running_loop().call_later(pause, self._check_heartbeat)
            return
        self._on_loss(
            f"node {self._url.node} on {self._url.bus}: no heartbeat for {silent * 1e3:.0f} ms; "
            "check its supply and the cable, then open the amplifier again"
        )
