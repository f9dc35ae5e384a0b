"""A JACK client that keeps every sample it gets, by a callback in C, and when each block came."""

import time

import numpy as np

from drivers.errors import LinkError
from era_haptics.lab.measuring.sound_card import SoundCard, activate
from model.arrays import Float32Array
from sim.soft_amp.jack import JackClient

AUDIBLE = 1e-6
_START = 20.0  # s


class Capture(SoundCard):
    """So many inputs in_1, ... of a client of JACK_DEFAULT_SERVER; longest [s] that it captures.

    It waits until the server is up. While that lives no other server can be used in this process.
    """

    def __init__(self, name: str, channels: int, *, longest: float = 600.0) -> None:
        super().__init__(outputs=0, inputs=channels, limit=0)
        self._client = open_client(name)
        self.rate, self.block = float(self._client.rate), self._client.block
        activate(self, self._client, outputs=0, inputs=channels)
        frames = round(longest * self.rate)
        self._times = np.zeros(frames // self.block + 1, dtype=np.int64)  # us
        self._transfer.arrivals = self._times.ctypes.data
        self._samples = self.start(np.zeros((frames, 0)))

    def samples(self, count: int) -> Float32Array:
        """The last samples (count, channels)."""
        return self._samples[self.position - count : self.position]

    def is_sounding(self) -> bool:
        """Whether the last block had sound."""
        return self.position > 0 and bool(np.abs(self.samples(self.block)).max() > AUDIBLE)

    def last_sound(self) -> float:
        """When the last block with sound came (monotonic, s)."""
        return 1e-6 * float(self._times[(self.end_of_sound() - 1) // self.block])

    def end_of_sound(self) -> int:
        """The position after the last sample with sound."""
        return int(self._loud(0)[-1]) + 1

    def first_sound(self, since: int) -> float:
        """When the first sample with sound from a position on was played (monotonic, s)."""
        first = int(self._loud(since)[0])
        return 1e-6 * float(self._times[first // self.block]) + first % self.block / self.rate

    def is_played_to(self, port: str) -> bool:
        """Whether a program plays to a port of the server."""
        return bool(self._client.connected_to(port))

    def close(self) -> None:
        """Leave the server."""
        self._client.close()

    def _loud(self, since: int) -> "np.ndarray[tuple[int], np.dtype[np.intp]]":
        loud = np.abs(self._samples[since : self.position]).max(axis=1) > AUDIBLE
        return np.flatnonzero(loud) + since


def open_client(name: str) -> JackClient:
    """A client, as soon as the server is up."""
    end = time.monotonic() + _START
    while True:
        try:
            return JackClient(name)
        except LinkError:
            if time.monotonic() > end:
                raise
            time.sleep(0.02)
