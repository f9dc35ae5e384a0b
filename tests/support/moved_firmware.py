"""The firmware in this process, on a clock that its caller moves: nothing of it takes real time."""

import ctypes
from collections.abc import Callable
from pathlib import Path

import numpy as np

from drivers import clock
from drivers.codec.can_bus.adapter_text import SLCAN, TextReader
from drivers.codec.can_bus.segments import pack_frames, unpack_frames
from model.arrays import FloatArray

RATE = 16000
"""Samples per second and channel."""

SERIAL, MODBUS, CAN, TCP = range(4)
"""Its lines; TCP: Modbus over TCP, whose replies come from MODBUS."""
LINES = {"serial": SERIAL, "rtu": MODBUS, "tcp": TCP, "can": CAN}
"""The kinds of wires, with the line of each."""

_FULL = 32767  # of a sample
_RING = 8192  # bytes
_SAMPLES = 1 << 21


class MovedFirmware:
    """The library `era-moved.so` in a folder: one amplifier, whose clock begins at 0.

    channels: with which it was built.
    """

    def __init__(self, folder: Path, *, channels: int = 4) -> None:
        self._library = ctypes.CDLL(str(folder / "era-moved.so"))
        self._library.moved_to.argtypes = [ctypes.c_uint64]
        self._library.moved_stall.argtypes = [ctypes.c_uint64, ctypes.c_bool]
        self._sent = ctypes.create_string_buffer(_RING)
        self._made = np.empty(_SAMPLES, np.int16)
        self._channels = channels
        self._library.moved_begin()

    def move(self, time: float) -> None:
        """Move its clock to a time [s]."""
        self._library.moved_to(round(time * 1e6))

    def stall(self, time: float, *, is_converter_still: bool) -> None:
        """Let its loop stand still until a time [s], and its converter take nothing meanwhile."""
        self._library.moved_stall(round(time * 1e6), is_converter_still)

    def receive(self, line: int, data: bytes) -> None:
        """Take bytes that arrive on a line now."""
        if line == TCP:
            self._library.moved_receive_tcp(data, len(data))
        else:
            self._library.moved_receive(line, data, len(data))

    def sent(self, line: int) -> bytes:
        """Return what it has sent on a line since the last call."""
        length = self._library.moved_sent(MODBUS if line == TCP else line, self._sent)
        return self._sent.raw[:length]

    def samples(self) -> FloatArray:
        """Return the samples since the last call, (n, channels) in full levels."""
        pointer = self._made.ctypes.data_as(ctypes.c_void_p)
        length = self._library.moved_samples(pointer)
        return self._made[:length].reshape(-1, self._channels) / _FULL

    def set_interlock(self, *, is_open: bool) -> None:
        """Open or close its interlock."""
        self._library.moved_interlock(is_open)


class FirmwareEnd:
    """Firmware at address 1, the far end of a kind of wire; folder: its library."""

    def __init__(self, kind: str, folder: Path, send: Callable[[bytes], None]) -> None:
        self._firmware = MovedFirmware(folder)
        self._began = clock.now()
        self._line, self._send = LINES[kind], send
        self._reader = TextReader(SLCAN)
        self._firmware.receive(CAN, b"O\r")
        self._firmware.sent(CAN)

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at a time [s]."""
        if self._line == CAN:
            data = b"".join(map(SLCAN.encode, unpack_frames(data)))
        self._firmware.move(now - self._began)
        self._firmware.receive(self._line, data)
        self.tick(now)

    def tick(self, now: float) -> None:
        """Move its clock, and send what it has to say."""
        self._firmware.move(now - self._began)
        data = self._firmware.sent(self._line)
        if self._line == CAN:
            data = pack_frames(self._reader.feed(data))
        if data:
            self._send(data)
