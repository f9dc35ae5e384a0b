"""A sound card that plays from memory and records into it at the same time, by a callback in C.

Python is not in the path of the sound: one array is played, another is filled, and what is lost
meanwhile is counted.
"""

import ctypes
import time
from abc import ABC, abstractmethod

import numpy as np

from drivers.errors import LinkError
from model.arrays import Float32Array, FloatArray
from model.errors import InputError
from sim.soft_amp.engine import address_of
from sim.soft_amp.jack import IS_INPUT, IS_OUTPUT, JackClient, jack_name, libjack
from sim.soft_amp.output import portaudio_device, portaudio_stream, sounddevice

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
        ("has_next", ctypes.c_uint32),
        ("next_frame", ctypes.c_uint32),
        ("ports", ctypes.c_void_p),
        ("arrivals", ctypes.c_void_p),
        ("blocks", ctypes.c_uint64),
    )


class Ports(ctypes.Structure):
    """`struct transfer_ports`: ports of a JACK client, and addresses of functions of libjack."""

    _fields_ = (
        ("client", ctypes.c_void_p),
        ("outputs", ctypes.c_void_p * MAX_PORTS),
        ("inputs", ctypes.c_void_p * MAX_PORTS),
        ("buffer", ctypes.c_void_p),
        ("frame_time", ctypes.c_void_p),
    )


class DeviceLost(LinkError):
    """A device that is gone, or takes no samples, in the middle of a run."""


class SoundCard(ABC):
    """An open device with some outputs and inputs, the first ones that it has.

    name: of the device; rate [Hz]; limit: no sample played is larger, since nothing behind this
    checks it. Its stream runs until `close`, so that the delay through it stays the same.
    """

    name: str
    rate: float

    def __init__(self, *, outputs: int, inputs: int, limit: float) -> None:
        for what, count in (("outputs", outputs), ("inputs", inputs)):
            if count > MAX_PORTS:
                raise InputError(f"{what} must be at most {MAX_PORTS}, got {count}")
        self._transfer = _Transfer(outputs=outputs, inputs=inputs)
        self._limit = limit * (1 + 1e-6)  # of rounding
        self.gaps = 0

    def given(self, ports: Ports | None = None) -> int:
        """The address of what the callbacks are to be given; ports: those of JACK."""
        self._ports = ports  # kept, since the callbacks use it
        self._transfer.ports = None if ports is None else ctypes.addressof(ports)
        return ctypes.addressof(self._transfer)

    def run(self, played: FloatArray) -> Float32Array:
        """Play samples (n, outputs), and return those recorded meanwhile (n, inputs).

        `gaps` counts holes in the sound. Raises DeviceLost, ValueError for samples beyond the
        limit.
        """
        transfer = self._transfer
        before = transfer.gaps
        found = self.begin(played)
        done, since = 0, time.monotonic()
        try:
            while done < len(found):
                time.sleep(_POLL)
                if transfer.position != done:
                    done, since = transfer.position, time.monotonic()
                elif transfer.is_lost or time.monotonic() - since > _STALLED:
                    raise DeviceLost(f"{self.name}: the device was lost, or takes no samples")
        finally:
            if done < len(found):
                self.close()  # the callback still has the memory
        self.gaps = transfer.gaps - before
        return found

    def begin(self, played: FloatArray) -> Float32Array:
        """Play samples (n, outputs); return at once what is recorded meanwhile (n, inputs).

        Raises ValueError for samples beyond the limit.
        """
        transfer = self._transfer
        out = np.ascontiguousarray(played, dtype=np.float32)
        if not (np.abs(out) <= self._limit).all():  # neither is what is no number
            raise ValueError(f"samples must be at most {self._limit:g}, got {np.abs(out).max():g}")
        found = np.zeros((len(out), transfer.inputs), dtype=np.float32)
        self._memory = out, found  # kept, since the callback uses it
        transfer.play, transfer.record = out.ctypes.data, found.ctypes.data
        transfer.frames, transfer.position, transfer.blocks = len(out), 0, 0
        transfer.is_running = 1
        return found

    @property
    def position(self) -> int:
        """Frames that were played and recorded since `begin`."""
        return int(self._transfer.position)

    @abstractmethod
    def close(self) -> None:
        """Stop, and leave the device."""


CLIENT = "era-measure"


def activate(
    card: SoundCard, client: JackClient, *, outputs: int, inputs: int
) -> tuple[list[int], list[int]]:
    """Let a client's new ports out_1, ... and in_1, ... be those of a card; returns them."""
    out = client.register((f"out_{n + 1}" for n in range(outputs)), IS_OUTPUT)
    into = client.register((f"in_{n + 1}" for n in range(inputs)), IS_INPUT)
    library = libjack()
    ports = Ports(client=client.pointer)
    ports.outputs[: len(out)], ports.inputs[: len(into)] = out, into
    ports.buffer = ctypes.cast(library.jack_port_get_buffer, ctypes.c_void_p)
    ports.frame_time = ctypes.cast(library.jack_last_frame_time, ctypes.c_void_p)
    given = card.given(ports)
    for name, set_callback in (
        ("transfer_jack_process", library.jack_set_process_callback),
        ("transfer_jack_shutdown", library.jack_on_shutdown),
    ):
        set_callback(client.pointer, address_of(name), given)
    client.activate()
    return out, into


class JackCard(SoundCard):
    """Ports of its own, each connected to the next one of a client; "": of the hardware."""

    def __init__(self, other: str, *, outputs: int, inputs: int, limit: float) -> None:
        super().__init__(outputs=outputs, inputs=inputs, limit=limit)
        self.name = jack_name(other)
        self._client = JackClient(CLIENT)
        try:
            self.rate = float(self._client.rate)
            takers = self._client.first_ports(other, IS_INPUT, outputs)
            givers = self._client.first_ports(other, IS_OUTPUT, inputs)
            out, into = activate(self, self._client, outputs=outputs, inputs=inputs)
            for port, taker in zip(out, takers, strict=True):
                self._client.connect(port, taker)
            for giver, port in zip(givers, into, strict=True):
                self._client.connect(giver, port)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Leave the server."""
        self._client.close()


_BLOCK = 512  # frames; late samples are worse than a delay, which is measured


class PortAudioCard(SoundCard):
    """One stream in both directions, of one device: two devices would have two clocks."""

    def __init__(self, device: str, *, outputs: int, inputs: int, limit: float) -> None:
        super().__init__(outputs=outputs, inputs=inputs, limit=limit)
        found = portaudio_device(device, outputs=outputs, inputs=inputs)
        self.name, self.rate = found["name"], float(found["default_samplerate"])
        try:
            self._stream = portaudio_stream(
                found["index"],
                address_of("transfer_portaudio"),
                self.given(),
                outputs=outputs,
                inputs=inputs,
                samplerate=self.rate,
                blocksize=_BLOCK,
                latency="high",
            )
        except sounddevice().PortAudioError as problem:
            raise LinkError(
                f"--device {self.name}: cannot be opened: {problem.args[0]}; end the program that "
                "uses it"
            ) from None

    def close(self) -> None:
        """Stop at once, and close the device."""
        self._stream.close(ignore_errors=True)


def open_card(device: str, *, outputs: int, inputs: int, limit: float) -> SoundCard:
    """Open `jack`, `jack:CLIENT`, or a device of PortAudio by its name or number.

    limit: of the samples played, in full scale. Raises InputError for a device that does not suit;
    LinkError where it is busy or gone.
    """
    kind, _, name = device.partition(":")
    if kind == "jack":
        return JackCard(name, outputs=outputs, inputs=inputs, limit=limit)
    return PortAudioCard(device, outputs=outputs, inputs=inputs, limit=limit)
