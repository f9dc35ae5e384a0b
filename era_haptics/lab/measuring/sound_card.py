"""Sound card that plays and records simultaneously.

The sound card plays one array from memory and records into another through a callback in C. Python
is not in the audio path, and lost blocks are counted.
"""

import ctypes
import time
from typing import Any

import numpy as np

from drivers.errors import LinkError
from model.arrays import Float32Array, FloatArray
from model.errors import InputError
from sim.soft_amp.engine import callback_address
from sim.soft_amp.output import (
    forget_lost_device,
    is_stream_active,
    portaudio_device,
    portaudio_stream,
    sounddevice,
)

MAX_PORTS = 64
_BLOCK = 512  # frames; late samples are worse than a delay, which is measured
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
    )


class DeviceLost(LinkError):
    """A device that is gone, or takes no samples, in the middle of a run."""


class SoundCard:
    """Open device with its first outputs and inputs.

    limit: largest sample allowed, since nothing downstream checks it. The stream runs until
    `close`, so that its delay stays constant.
    """

    name: str
    """Of the device."""
    rate: float
    """Samples per second [Hz]."""

    def __init__(self, *, outputs: int, inputs: int, limit: float) -> None:
        for what, count in (("outputs", outputs), ("inputs", inputs)):
            if count > MAX_PORTS:
                raise InputError(f"{what} must be at most {MAX_PORTS}, got {count}")
        self.transfer = _Transfer(outputs=outputs, inputs=inputs)
        self._limit = limit * (1 + 1e-6)  # of rounding
        self._stream: Any = None
        self.gaps = 0
        """Gaps in the sound of the last run."""

    @property
    def transfer_address(self) -> int:
        """Address of the data for the callbacks."""
        return ctypes.addressof(self.transfer)

    def run(self, played: FloatArray) -> Float32Array:
        """Play samples (n, outputs), and return those recorded meanwhile (n, inputs).

        `gaps` counts gaps in the sound. Raises DeviceLost, ValueError for samples beyond the
        limit.
        """
        transfer = self.transfer
        gaps_at_start = transfer.gaps
        recorded = self.start(played)
        position = 0
        moved_at = time.monotonic()
        try:
            while position < len(recorded):
                time.sleep(_POLL)
                if transfer.position != position:
                    position = transfer.position
                    moved_at = time.monotonic()
                elif not self._is_playing():
                    self._abandon()
                    raise DeviceLost(f"{self.name}: the device was lost")
                elif time.monotonic() - moved_at > _STALLED:
                    raise DeviceLost(f"{self.name}: took no sample within {_STALLED:g} s")
        finally:
            if position < len(recorded):
                self.close()  # the callback still has the memory
        self.gaps = transfer.gaps - gaps_at_start
        return recorded

    def start(self, played: FloatArray) -> Float32Array:
        """Start playing samples (n, outputs); return the array (n, inputs) that is being recorded.

        Raises ValueError for samples beyond the limit.
        """
        transfer = self.transfer
        out = np.ascontiguousarray(played, dtype=np.float32)
        if not (np.abs(out) <= self._limit).all():  # also rejects NaN
            raise ValueError(f"samples must be at most {self._limit:g}, got {np.abs(out).max():g}")
        recorded = np.zeros((len(out), transfer.inputs), dtype=np.float32)
        self._memory = out, recorded  # kept, since the callback uses it
        transfer.play = out.ctypes.data
        transfer.record = recorded.ctypes.data
        transfer.frames = len(out)
        transfer.position = 0
        transfer.is_running = 1
        return recorded

    def _is_playing(self) -> bool:
        return self._stream is None or is_stream_active(self._stream)

    def _abandon(self) -> None:
        """Leave a lost device to the end of the process."""
        self._stream = None
        forget_lost_device()

    def close(self) -> None:
        """Stop immediately and release the device."""
        if self._stream is not None:
            self._stream.close(ignore_errors=True)
            self._stream = None


def open_card(device: str, *, outputs: int, inputs: int, limit: float) -> SoundCard:
    """Open a PortAudio device by name or number.

    The stream runs in both directions on one device, because two devices would have two clocks.
    limit: largest sample, relative to full scale. Raises InputError for an unsuitable device,
    LinkError for a busy or removed device.
    """
    card = SoundCard(outputs=outputs, inputs=inputs, limit=limit)
    properties = portaudio_device(device, outputs=outputs, inputs=inputs)
    card.name = properties["name"]
    card.rate = float(properties["default_samplerate"])
    try:
        card._stream = portaudio_stream(
            properties["index"],
            callback_address("transfer_portaudio"),
            card.transfer_address,
            outputs=outputs,
            inputs=inputs,
            samplerate=card.rate,
            blocksize=_BLOCK,
            latency="high",
        )
    except sounddevice().PortAudioError as problem:
        raise LinkError(
            f"--device {card.name}: cannot be opened: {problem.args[0]}; end the program that "
            "uses it"
        ) from None
    return card
