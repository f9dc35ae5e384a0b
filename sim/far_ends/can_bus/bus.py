"""A CAN bus within this process: what one of its members sends, all others hear.

Each amplifier hangs on it by a line of its own each way, which takes time and has faults. A frame
that was damaged on the way fails the check of its CRC, as on a real bus, and is not seen. Not
modelled: arbitration, the repetition of a damaged frame by its sender, bus-off.
"""

import struct
import zlib
from collections.abc import Callable

from drivers.codec.can_bus.frame import CanFrame
from sim.faults.fault_window import Faults
from sim.transport.line import TwoWayLine

LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""How many bytes a frame may have, by its length code; those up to eight without CAN FD."""

Listener = Callable[[CanFrame], None]

_HEAD = struct.Struct("<L")
_FD = 1 << 31


class CanBus:
    """Members are known by what they are called with."""

    def __init__(self) -> None:
        self._members: list[Listener] = []

    def join(self, listener: Listener) -> None:
        """Hear what the others send from now on."""
        self._members.append(listener)

    def leave(self, listener: Listener) -> None:
        """Hear nothing any more; safe for one that has left."""
        if listener in self._members:
            self._members.remove(listener)

    def send(self, frame: CanFrame, *, sender: Listener) -> None:
        """Let all but the sender hear a frame."""
        for member in tuple(self._members):
            if member is not sender:
                member(frame)


class Stub:
    """What connects one amplifier with the bus; hears is called with each frame that arrives.

    bitrate [bit/s]: frames take as long as at this speed, None for no time.
    """

    def __init__(
        self, bus: CanBus, hears: Listener, *, faults: Faults, bitrate: int | None = None
    ) -> None:
        self._bus = bus
        self._hears = hears
        self.damaged = 0
        # A telegram has eight bytes beside the data: about what frame, stuffing and gap cost.
        self._line = TwoWayLine(
            to_amplifier=self._arrive,
            to_host=self._leave,
            faults=faults,
            bits_per_second=bitrate,
            bits_per_byte=8,
        )
        self._listener = self._hear  # one object, by which the bus knows it
        bus.join(self._listener)

    def send(self, frame: CanFrame) -> None:
        """Send a frame of the amplifier's."""
        self._line.outward.send(_telegram(frame))

    def close(self) -> None:
        """Leave the bus; what is on the way is lost."""
        self._bus.leave(self._listener)
        self._line.close()

    def _hear(self, frame: CanFrame) -> None:
        self._line.inward.send(_telegram(frame))

    def _arrive(self, telegram: bytes) -> None:
        frame = self._checked(telegram)
        if frame is not None:
            self._hears(frame)

    def _leave(self, telegram: bytes) -> None:
        frame = self._checked(telegram)
        if frame is not None:
            self._bus.send(frame, sender=self._listener)

    def _checked(self, telegram: bytes) -> CanFrame | None:
        body, check = telegram[:-4], telegram[-4:]
        if len(body) < _HEAD.size or zlib.crc32(body).to_bytes(4, "little") != check:
            self.damaged += 1
            return None
        (head,) = _HEAD.unpack_from(body)
        return CanFrame(head & ~_FD, body[_HEAD.size :], fd=bool(head & _FD))


def _telegram(frame: CanFrame) -> bytes:
    body = _HEAD.pack(frame.id | (_FD if frame.fd else 0)) + frame.data
    return body + zlib.crc32(body).to_bytes(4, "little")
