"""A plate as a client of a JACK server: its inputs are an interface's outputs, and the reverse."""

import ctypes
import threading

import numpy as np
from numpy.typing import NDArray

from benchmarks.desk_plate.desk_plate import BLOCK_MULTIPLE, DeskPlate
from drivers.errors import LinkError
from model.errors import InputError
from sim.soft_amp.jack import IS_INPUT, IS_OUTPUT, JackClient, libjack

_PROCESS = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_uint32, ctypes.c_void_p)
_SHUTDOWN = ctypes.CFUNCTYPE(None, ctypes.c_void_p)


class JackPlate:
    """Ports in_1.. and out_1.. of a client; each block is advanced in the server's callback.

    Raises LinkError; InputError for a server whose blocks do not suit.
    """

    def __init__(self, client: JackClient, plate: DeskPlate) -> None:
        if client.block % BLOCK_MULTIPLE:
            raise InputError(
                f"blocks of the JACK server must be a multiple of {BLOCK_MULTIPLE} frames, got "
                f"{client.block}; start it with -p 128"
            )
        self._client, self._plate = client, plate
        self._problem: Exception | None = None
        self._ended = threading.Event()
        self._in = client.register((f"in_{n + 1}" for n in range(plate.outputs)), IS_INPUT)
        self._out = client.register((f"out_{n + 1}" for n in range(plate.inputs)), IS_OUTPUT)
        self._callbacks = _PROCESS(self._advance), _SHUTDOWN(self._lose)  # kept: libjack calls them
        called, lost = (ctypes.cast(each, ctypes.c_void_p) for each in self._callbacks)
        libjack().jack_set_process_callback(client.pointer, called, None)
        libjack().jack_on_shutdown(client.pointer, lost, None)

    def start(self) -> None:
        """Begin to vibrate; raises LinkError."""
        self._client.activate()

    def wait(self, timeout: float) -> None:
        """Wait for a time [s]; raises what ended the plate."""
        if self._ended.wait(timeout) and self._problem is not None:
            raise self._problem

    def _lose(self, _ignored: object) -> None:
        self._problem = LinkError("jack: the server has ended; start it, and this again")
        self._ended.set()

    def _advance(self, frames: int, _ignored: object) -> int:
        if self._problem is not None:
            return 0
        try:
            played = np.stack([_samples(port, frames) for port in self._in], axis=1)
            heard = self._plate.advance(played.astype(float))
            for port, samples in zip(self._out, heard.T, strict=True):
                _samples(port, frames)[:] = samples
        except Exception as problem:  # the server's thread has nobody to raise it to
            self._problem = problem
            self._ended.set()
        return 0


def _samples(port: int, frames: int) -> NDArray[np.float32]:
    """The samples (frames,) of a port, in place; within a callback only."""
    address = libjack().jack_port_get_buffer(port, frames)
    pointer = ctypes.cast(address, ctypes.POINTER(ctypes.c_float))
    return np.ctypeslib.as_array(pointer, (frames,))
