"""A client of a JACK server that records, in a process of its own.

    python tests/support/processes/jack_recorder.py SERVER NAME CHANNELS KIND FILE

It prints rate and block once it records. KIND `card` records what the server gives to its sound
card, through the monitor ports of a server that has them; `client` what others play to the inputs.
FILE keeps the count of recorded frames, then the samples. Each line on standard input is a port, to
which it prints the number of connections, or `CLIENT:`, whose outputs it connects to its inputs. It
ends with its input.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from kit.jack_client import jack_client
from model.arrays import Float32Array

AUDIBLE = 1e-6
_HEAD = 8  # bytes
_LONGEST = 600.0  # s
_END = 20.0  # s
_SUPPORT = Path(__file__).parents[1]
_ROOT = _SUPPORT.parents[1]


class Capture:
    """A running recorder with inputs in_1, ...; it waits until the server is up."""

    def __init__(self, server: str, name: str, channels: int, *, is_card: bool = False) -> None:
        self._file = tempfile.NamedTemporaryFile()  # noqa: SIM115  closed below
        kind = "card" if is_card else "client"
        path = os.pathsep.join([str(_ROOT), str(_SUPPORT)])
        self._process = subprocess.Popen(
            [sys.executable, __file__, server, name, str(channels), kind, self._file.name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": path},
        )
        self.rate, self.block = map(int, self._process.stdout.readline().split())
        self._position = np.memmap(self._file, np.uint64, mode="r", shape=(1,))
        shape = (round(_LONGEST * self.rate), channels)
        self._samples = np.memmap(self._file, np.float32, mode="r", offset=_HEAD, shape=shape)

    @property
    def position(self) -> int:
        """Frames recorded so far."""
        return int(self._position[0])

    def samples(self, count: int) -> Float32Array:
        """The last samples (count, channels)."""
        end = self.position
        return np.array(self._samples[end - count : end])

    def is_sounding(self) -> bool:
        """Whether the last block had sound."""
        return self.position > 0 and bool(np.abs(self.samples(self.block)).max() > AUDIBLE)

    def has_sounded_for(self, seconds: float) -> bool:
        """Whether there was sound in each of the last tenths of so many seconds."""
        length = self.rate // 10
        count = round(seconds * 10) * length
        if self.position < count:
            return False
        loudest = np.abs(self.samples(count)).max(axis=1)
        return bool((loudest.reshape(-1, length).max(axis=1) > AUDIBLE).all())

    def end_of_sound(self) -> int:
        """The position after the last sample with sound."""
        loudest = np.abs(self._samples[: self.position]).max(axis=1)
        return int(np.flatnonzero(loudest > AUDIBLE)[-1]) + 1

    def connect(self, client: str) -> None:
        """Connect the outputs of another client to the inputs, in their order."""
        self._ask(f"{client}:")

    def is_played_to(self, port: str) -> bool:
        """Whether a program plays to a port of the server."""
        return self._ask(port) > 0

    def _ask(self, line: str) -> int:
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())

    def close(self) -> None:
        """Leave the server."""
        self._process.stdin.close()
        try:
            self._process.wait(_END)
        except subprocess.TimeoutExpired:  # its server is gone
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._file.close()


def record(server: str, name: str, channels: int, kind: str, path: str) -> None:
    """Record until the end of standard input."""
    client = jack_client(name, server)
    silences = range(channels if kind == "card" else 0)
    inputs = [client.inports.register(f"in_{n + 1}") for n in range(channels)]
    outputs = [client.outports.register(f"silence_{n + 1}") for n in silences]
    frames = round(_LONGEST * client.samplerate)
    os.truncate(path, _HEAD + frames * channels * 4)
    position = np.memmap(path, np.uint64, mode="r+", shape=(1,))
    samples = np.memmap(path, np.float32, mode="r+", offset=_HEAD, shape=(frames, channels))

    def process(count: int) -> None:
        begin = int(position[0])
        for column, port in enumerate(inputs):
            samples[begin : begin + count, column] = port.get_array()
        for port in outputs:
            port.get_array()[:] = 0
        position[0] = begin + count

    client.set_process_callback(process)
    client.activate()
    # A server copies to a monitor only while something is connected to its output.
    for number, (output, own_port) in enumerate(zip(outputs, inputs, strict=False), start=1):
        client.connect(output, f"system:playback_{number}")
        client.connect(f"system:monitor_{number}", own_port)
    _answer(client.samplerate, client.blocksize)
    for line in sys.stdin:
        name = line.strip()
        if name.endswith(":"):
            sources = client.get_ports(f"^{name}", is_audio=True, is_output=True)
            if len(sources) < len(inputs):
                raise ValueError(f"{name} must have {len(inputs)} outputs, got {len(sources)}")
            # A plate has another output after its sensors: the loop-back.
            for source, own_port in zip(sources, inputs, strict=False):
                client.connect(source, own_port)
            _answer(len(sources))
        else:
            _answer(len(client.get_all_connections(name)))
    os._exit(0)  # libjack does not bear to close a client of a server that is gone


def _answer(*numbers: int) -> None:
    sys.stdout.write(" ".join(map(str, numbers)) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    record(sys.argv[1], sys.argv[2], int(sys.argv[3]), sys.argv[4], sys.argv[5])
