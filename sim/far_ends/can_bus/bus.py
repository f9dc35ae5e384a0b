"""A CAN bus within this process: a frame of one member is received by all others, at one time.

Each amplifier has faults of its own each way; a damaged frame fails its CRC and is dropped. Not
modelled: arbitration, retransmission, bus-off.
"""

import asyncio
import struct
import zlib
from collections.abc import Callable

from drivers import clock
from drivers.codec.can_bus.canopen import CanFrame
from sim.faults.fault_window import Faults
from sim.transport.frame_time import FrameTime
from sim.transport.line import TwoWayLine

LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Data lengths by length code; above eight bytes CAN FD only."""

Listener = Callable[[CanFrame], None]

_OVERHEAD = 8  # bytes of a frame beside its data, about, with stuffing and gap
_HEAD = struct.Struct("<L")
_FD = 1 << 31


class CanBus:
    """A bus whose members are identified by their listeners.

    bitrate [bit/s]: None for no transmission time.
    """

    def __init__(self, bitrate: int | None = None) -> None:
        self._members: list[Listener] = []
        self._bitrate = bitrate
        self._free_from = 0.0
        self._in_flight: set[asyncio.TimerHandle] = set()
        self.time = FrameTime()

    def join(self, listener: Listener) -> None:
        """Add a member."""
        self._members.append(listener)

    def leave(self, listener: Listener) -> None:
        """Remove a member, if it is one."""
        if listener in self._members:
            self._members.remove(listener)

    def send(self, frame: CanFrame, *, sender: Listener) -> None:
        """Deliver a frame to all but its sender, after the frames that were sent before."""
        if self._bitrate is None:
            self._deliver(frame, sender)
            return

        def arrive() -> None:
            self._in_flight.discard(timer)
            self._deliver(frame, sender)

        bits = 8 * (_OVERHEAD + len(frame.data))
        self._free_from = max(clock.now(), self._free_from) + bits / self._bitrate
        timer = asyncio.get_running_loop().call_at(self._free_from, arrive)
        self._in_flight.add(timer)

    def close(self) -> None:
        """Discard the frames in flight."""
        for timer in self._in_flight:
            timer.cancel()
        self._in_flight.clear()

    def _deliver(self, frame: CanFrame, sender: Listener) -> None:
        with self.time.in_one_frame():
            for member in tuple(self._members):
                if member is not sender:
                    member(frame)


class Stub:
    """The connection of one amplifier; receive: called with each frame."""

    def __init__(self, bus: CanBus, receive: Listener, *, faults: Faults) -> None:
        self._bus = bus
        self._hears = receive
        self._line = TwoWayLine(to_amplifier=self._arrive, to_host=self._leave, faults=faults)
        self._listener = self._hear  # one object, which identifies the member
        bus.join(self._listener)

    def send(self, frame: CanFrame) -> None:
        """Send a frame of the amplifier."""
        self._line.outward.send(_to_bytes(frame))

    def close(self) -> None:
        """Leave the bus and discard frames in flight."""
        self._bus.leave(self._listener)
        self._line.close()

    def _hear(self, frame: CanFrame) -> None:
        self._line.inward.send(_to_bytes(frame))

    def _arrive(self, frame_bytes: bytes) -> None:
        frame = self._checked(frame_bytes)
        if frame is not None:
            self._hears(frame)

    def _leave(self, frame_bytes: bytes) -> None:
        frame = self._checked(frame_bytes)
        if frame is not None:
            self._bus.send(frame, sender=self._listener)

    def _checked(self, frame_bytes: bytes) -> CanFrame | None:
        body, check = frame_bytes[:-4], frame_bytes[-4:]
        if len(body) < _HEAD.size or zlib.crc32(body).to_bytes(4, "little") != check:
            return None
        (head,) = _HEAD.unpack_from(body)
        return CanFrame(head & ~_FD, body[_HEAD.size :], fd=bool(head & _FD))


def _to_bytes(frame: CanFrame) -> bytes:
    body = _HEAD.pack(frame.id | (_FD if frame.fd else 0)) + frame.data
    return body + zlib.crc32(body).to_bytes(4, "little")
