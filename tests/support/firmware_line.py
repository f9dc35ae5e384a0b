"""The firmware on a line, on the clock of a virtual loop: nothing takes real time."""

import asyncio
from collections.abc import Callable
from pathlib import Path

from drivers.codec.can_bus.adapter_text import SLCAN, TextReader
from drivers.codec.can_bus.segments import pack_frames, unpack_frames
from moved_firmware import CAN, MODBUS, SERIAL, TCP, MovedFirmware

LINES = {"serial": SERIAL, "rtu": MODBUS, "tcp": TCP, "can": CAN}
"""The kinds of wires, with the firmware's line of each."""

_WAY = 0.0002  # s
_TURN = 0.001  # s; between two turns of its loop


class FirmwarePort:
    """One amplifier of firmware at address 1 behind a port of a kind of wire.

    folder: of its library.
    """

    is_blocked = False

    def __init__(self, kind: str, folder: Path) -> None:
        self.firmware = MovedFirmware(folder)
        self.take: Callable[[bytes], None] = len
        """Takes what arrives at the host."""
        self._loop = asyncio.get_running_loop()
        self._began = self._loop.time()
        self._line = LINES[kind]
        self._reader = TextReader(SLCAN)
        self.firmware.receive(CAN, b"O\r")
        self.firmware.sent(CAN)
        self._turn()

    def write(self, data: bytes) -> None:
        """Send bytes of the host."""
        if self._line == CAN:
            data = b"".join(SLCAN.encode(frame) for frame in unpack_frames(data))
        self._loop.call_later(_WAY, self._arrived, data)

    def poll(self) -> None:
        """All that has come was handed over."""

    def _arrived(self, data: bytes) -> None:
        self._follow()
        self.firmware.receive(self._line, data)
        self._fetch()

    def _turn(self) -> None:
        self._follow()
        self._fetch()
        self._loop.call_later(_TURN, self._turn)

    def _follow(self) -> None:
        self.firmware.move(self._loop.time() - self._began)

    def _fetch(self) -> None:
        """Hand over what it has sent, after its way."""
        data = self.firmware.sent(self._line)
        if self._line == CAN:
            data = pack_frames(self._reader.feed(data))
        if data:
            self._loop.call_later(_WAY, lambda: self.take(data))
