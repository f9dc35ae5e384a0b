"""A sound card that plays from memory and records into it at the same time, by a callback in C.

Python is not in the path of the sound: one array is played, another is filled, and what is lost
meanwhile is counted.
"""

import ctypes
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cache

import numpy as np

from drivers.errors import LinkError
from model.arrays import Float32Array, FloatArray
from model.errors import InputError
from sim.soft_amp.library import library

MAX_PORTS = 64
_POLL = 0.02  # s
_STALLED = 10.0  # s without a sample; `jackd -S` may be slow on a loaded machine


class _Transfer(ctypes.Structure):
    """`struct transfer` of firmware/ports/sound/transfer.h."""

    _fields_ = (
        ("play", ctypes.c_void_p),
        ("record", ctypes.c_void_p),
        ("frames", ctypes.c_uint64),
        ("position", ctypes.c_uint64),
        ("outputs", ctypes.c_uint32),
        ("inputs", ctypes.c_uint32),
        ("is_running", ctypes.c_uint32),
        ("gaps", ctypes.c_uint32),
        ("is_lost", ctypes.c_uint32),
    )
    position: int
    is_running: int
    gaps: int
    is_lost: int


class Ports(ctypes.Structure):
    """`struct transfer_ports`: ports of a JACK client, and addresses of functions of libjack."""

    _fields_ = (
        ("client", ctypes.c_void_p),
        ("outputs", ctypes.c_void_p * MAX_PORTS),
        ("inputs", ctypes.c_void_p * MAX_PORTS),
        ("buffer", ctypes.c_void_p),
        ("frame_time", ctypes.c_void_p),
    )


@cache
def _callbacks() -> ctypes.CDLL:
    return ctypes.CDLL(str(library()))


class SoundCard(ABC):
    """An open device with some outputs and inputs, the first ones that it has.

    name: of the device; rate [Hz]. Its stream runs until `close`, so that the delay through it
    stays the same; one card at a time in a process.
    """

    name: str
    rate: float

    def __init__(self, *, outputs: int, inputs: int) -> None:
        for what, count in (("outputs", outputs), ("inputs", inputs)):
            if count > MAX_PORTS:
                raise InputError(f"{what} must be at most {MAX_PORTS}, got {count}")
        self._transfer = _Transfer(outputs=outputs, inputs=inputs)
        self.gaps = 0

    def use(self, ports: Ports | None = None) -> None:
        """Set what the callbacks move."""
        _callbacks().transfer_use(
            ctypes.byref(self._transfer), None if ports is None else ctypes.byref(ports)
        )

    @staticmethod
    def address(name: str) -> int:
        """The address of a callback."""
        found = ctypes.cast(getattr(_callbacks(), name), ctypes.c_void_p).value
        assert found is not None  # noqa: S101  of a function
        return found

    def run(
        self, played: FloatArray, *, progress: Callable[[int], None] = lambda _frames: None
    ) -> Float32Array:
        """Play samples (n, outputs), and return those recorded meanwhile (n, inputs).

        progress: called with the frames done. `gaps` counts holes in the sound. Raises LinkError
        for a device that is gone or takes no samples.
        """
        transfer = self._transfer
        out = np.ascontiguousarray(played, dtype=np.float32)
        found = np.zeros((len(out), transfer.inputs), dtype=np.float32)
        transfer.play, transfer.record = out.ctypes.data, found.ctypes.data
        transfer.frames, transfer.position = len(out), 0
        before = transfer.gaps
        transfer.is_running = 1
        done, since = 0, time.monotonic()
        try:
            while done < len(out):
                time.sleep(_POLL)
                if transfer.position != done:
                    done, since = transfer.position, time.monotonic()
                    progress(done)
                elif transfer.is_lost or time.monotonic() - since > _STALLED:
                    raise LinkError(f"{self.name}: the device was lost, or takes no samples")
        finally:
            if done < len(out):
                self.close()  # the callback still has the memory
        self.gaps = transfer.gaps - before
        return found

    @abstractmethod
    def close(self) -> None:
        """Stop, and leave the device."""


def open_card(device: str, *, outputs: int, inputs: int) -> SoundCard:
    """Open `jack`, `jack:CLIENT`, or a device of PortAudio by its name or number.

    Raises InputError for one that does not suit; LinkError where it is busy or gone.
    """
    kind, _, name = device.partition(":")
    if kind == "jack":
        from sim.measuring.jack_card import JackCard

        return JackCard(name, outputs=outputs, inputs=inputs)
    from sim.measuring.portaudio_card import PortAudioCard

    return PortAudioCard(device, outputs=outputs, inputs=inputs)
