"""A plate as a client of a JACK server: its inputs are an interface's outputs, and the reverse."""

import threading

import numpy as np

from benchmarks.desk_plate.desk_plate import BLOCK_MULTIPLE, DeskPlate
from drivers.errors import LinkError
from model.errors import InputError
from sim.libjack import IS_INPUT, IS_OUTPUT, JackClient


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
        client.process(self._advance, lost=self._lose)

    def start(self) -> None:
        """Begin to vibrate; raises LinkError."""
        self._client.activate()

    def wait(self, timeout: float) -> None:
        """Wait for a time [s]; raises what ended the plate."""
        if self._ended.wait(timeout) and self._problem is not None:
            raise self._problem

    def _lose(self) -> None:
        self._problem = LinkError("jack: the server has ended; start it, and this again")
        self._ended.set()

    def _advance(self, frames: int) -> None:
        if self._problem is not None:
            return
        try:
            played = np.stack([self._client.samples(port, frames) for port in self._in], axis=1)
            heard = self._plate.advance(played.astype(float))
            for port, samples in zip(self._out, heard.T, strict=True):
                self._client.samples(port, frames)[:] = samples
        except Exception as problem:  # the server's thread has nobody to raise it to
            self._problem = problem
            self._ended.set()
