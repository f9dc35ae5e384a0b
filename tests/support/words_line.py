"""A serial line of protocol 3 in virtual time: hosts' lines and simulated amplifiers on it."""

import asyncio
from collections.abc import Callable

from drivers.codec.serial_line.frame import FrameReader
from drivers.host.amplifier import Amplifier as Host
from drivers.host.line import Line
from drivers.host.serial_wire import SerialWire
from registry.limits import GuardLimits
from sim.amplifier.contract import Amplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers

LIMITS = GuardLimits(20.0, 1000.0, 1.0)

Alter = Callable[[bytes], list[tuple[float, bytes]]]
"""What becomes of bytes on their way: delays [s] and bytes, none for lost ones."""


def unaltered(data: bytes) -> list[tuple[float, bytes]]:
    """Bytes as they are, after 0.2 ms."""
    return [(0.0002, data)]


class MemoryLine:
    """Simulated amplifiers at addresses 1, 2, ... of a line, and the host's amplifiers on it.

    inward, outward: what becomes of bytes for the amplifiers, and for the host; sent: the frames of
    the host, with their times.
    """

    is_blocked = False

    def __init__(self, *names: str, channels: int = 2, baud: int = 921_600) -> None:
        self.loop = asyncio.get_running_loop()
        self.far = {each: Amplifier(each, channels=channels) for each in names}
        self.inward: Alter = unaltered
        self.outward: Alter = unaltered
        self.sent: list[tuple[float, str]] = []
        self._reader = FrameReader()
        self._end = SerialAmplifiers(
            dict(enumerate(self.far.values(), 1)), lambda data: self._send(data, self.outward)
        )
        self.line = Line(SerialWire(baud, sequence=0), self, "line")
        self.hosts = {
            each: Host(self.line, address, LIMITS, name=each)
            for address, each in enumerate(names, 1)
        }

    def write(self, data: bytes) -> None:
        """Send bytes of the host."""
        for frame in self._reader.feed(data):
            self.sent.append((self.loop.time(), f"{frame.address}:{frame.type}"))
        for delay, altered in self.inward(data):
            self.loop.call_later(delay, self._arrived, altered)

    def poll(self) -> None:
        """All that has come was handed over."""

    def _arrived(self, data: bytes) -> None:
        self._end.receive(data, self.loop.time())

    def _send(self, data: bytes, alter: Alter) -> None:
        for delay, altered in alter(data):
            self.loop.call_later(delay, self.line.received, altered)

    def levels(self, name: str) -> list[float]:
        """What the channels of an amplifier play now."""
        far = self.far[name]
        far.tick(self.loop.time())
        return [
            round(far.playback.level(channel, self.loop.time()), 6)
            for channel in range(far.playback.channels)
        ]
