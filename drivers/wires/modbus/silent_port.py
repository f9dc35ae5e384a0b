"""The port of Modbus RTU, which keeps the line silent before each frame."""

import asyncio
import contextlib
from collections.abc import Callable
from typing import final

from drivers.errors import LinkError
from drivers.wires.address import PortAbove
from drivers.wires.modbus.frames import RTU_MAX

_TO_ALL = b"\0"


@final
class SilentPort(PortAbove):
    """A port that sends a frame once the line was silent for a time [s]; implements `Port`.

    byte_time [s]; on_data: called with what is received. A frame waits at most for the longest
    other one, so that noise does not keep a stop waiting, but always for one of its own.
    Of those that wait a newer one replaces the older: its request was given up. Broadcasts stay,
    which have no reply to wait for.
    """

    def __init__(self, silence: float, byte_time: float, on_data: Callable[[bytes], None]) -> None:
        self._silence, self._byte_time, self._on_data = silence, byte_time, on_data
        self._loop = asyncio.get_running_loop()
        self._free_from = self._loop.time() + silence
        self._sent_until = 0.0  # s; the end of the last frame of its own, and silence
        self._waiting: list[tuple[float, bytes]] = []  # until when [s] at most, frame
        self._timer: asyncio.TimerHandle | None = None

    def write(self, data: bytes) -> None:
        """Send a frame as soon as the line was silent; raises LinkError."""
        latest = self._loop.time() + RTU_MAX * self._byte_time + self._silence
        kept = [each for each in self._waiting if each[1].startswith(_TO_ALL)]
        self._waiting = [*kept, (latest, data)]
        self._send()

    def close(self) -> None:
        """Close it; what waits is not sent."""
        self._waiting.clear()
        super().close()

    def received(self, data: bytes) -> None:
        """Take what was received, and count it as noise on the line."""
        self._free_from = max(self._free_from, self._loop.time() + self._silence)
        self._on_data(data)

    def _send(self) -> None:
        """Send what may go now; the timer sends the rest."""
        while self._waiting:
            latest, frame = self._waiting[0]
            due = max(self._sent_until, min(self._free_from, latest))
            now = self._loop.time()
            if now < due:
                if self._timer is None:
                    self._timer = self._loop.call_at(due, self._due)
                return
            del self._waiting[0]
            self._sent_until = now + len(frame) * self._byte_time + self._silence
            self._free_from = max(self._free_from, self._sent_until)
            self.below.write(frame)

    def _due(self) -> None:
        self._timer = None
        with contextlib.suppress(LinkError):  # the loss of the port is reported by itself
            self._send()
