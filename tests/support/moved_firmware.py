"""The firmware in this process, on a clock that its caller moves: nothing of it takes real time."""

import ctypes
from pathlib import Path

import numpy as np

from model.arrays import FloatArray

RATE = 16000
"""Samples per second and channel."""

SERIAL, MODBUS, CAN, TCP = range(4)
"""Its lines; TCP: Modbus over TCP, whose replies come from MODBUS."""

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
