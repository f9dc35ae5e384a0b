"""Sound cards without sound: a JACK server whose output is captured, and a card in memory.

The card in memory is in front of a plate on the desk, with what can be wrong with its wires.
"""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from benchmarks.desk.capture import Capture
from benchmarks.desk_plate.desk_plate import DeskPlate
from era_haptics.lab.measuring.sound_card import SoundCard
from model.arrays import Float32Array, FloatArray
from typed_page import ERA

RATE = 48_000
BLOCK = 128
START = 20.0  # s
HOST = str(Path(__file__).with_name("steady_host.py"))


@dataclass(frozen=True)
class JackServer:
    """A running server; environment: of its clients."""

    process: "subprocess.Popen[bytes]"
    environment: dict[str, str]


@contextlib.contextmanager
def jack_server(
    name: str, *, rate: int = RATE, inputs: int = 2, outputs: int = 2
) -> Iterator[JackServer]:
    """A server of its own; synchronous: a machine that stalls delays samples and loses none."""
    environment = os.environ | {"JACK_DEFAULT_SERVER": name, "JACK_NO_START_SERVER": "1"}
    priority = ["-R", "-P10"] if os.geteuid() == 0 else ["-r"]
    dummy = ["-d", "dummy", "-p", str(BLOCK), "-r", str(rate)]
    dummy += ["-C", str(inputs), "-P", str(outputs)]
    with subprocess.Popen(
        ["jackd", "-n", name, "-S", *priority, *dummy],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment,
    ) as process:
        try:
            yield JackServer(process, environment)
        finally:
            process.terminate()


def capture_on(server: str, name: str, channels: int) -> Capture:
    """A client of a server that captures, as soon as that is up."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JACK_DEFAULT_SERVER", server)
        return Capture(name, channels)


class SoftAmp:
    """A running `era soft-amp`; url: of its first amplifier."""

    def __init__(self, *options: str, environment: dict[str, str], log: Path) -> None:
        self._log = log
        with log.open("wb") as errors:
            self.process = subprocess.Popen(
                [ERA, "soft-amp", *options, "--until-eof"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=environment,
            )
        assert self.process.stdout is not None
        self.url = self.process.stdout.readline().strip()

    @property
    def log(self) -> str:
        """What it has reported."""
        return self._log.read_text()

    @property
    def player(self) -> int:
        """The process that plays."""
        path = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        return int(path.read_text().split()[0])

    def end(self) -> None:
        """End it as the end of its input does."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait(START)
        self.process.stdout.close()


@contextlib.contextmanager
def host(url: str, channels: int) -> Iterator["subprocess.Popen[str]"]:
    """A program that plays 1 kHz at level 0.5 on every channel, each 30 degrees ahead."""
    with subprocess.Popen(
        [sys.executable, HOST, url, str(channels)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "armed\n"
        yield process
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGKILL)


MEMORY_BLOCK = 4800


class DeskCard(SoundCard):
    """Samples of a plate, without time.

    lost: runs in which a block is lost; late: runs in which samples come as late as if a block had
    been lost before; reported: losses that the driver reports in each run; on_outputs,
    on_inputs: order of the cables, by default as they should be; gain: of all inputs;
    drifts: of the clocks of some inputs, relative; factors: of some inputs; loudest: largest sample
    of each output so far; amplified: what amplifiers make of samples (n, eras) in a run.
    """

    def __init__(
        self,
        plate: DeskPlate,
        *,
        rate: float,
        lost: Sequence[int] = (),
        late: Sequence[int] = (),
        reported: int = 0,
        on_outputs: Sequence[int] | None = None,
        on_inputs: Sequence[int] | None = None,
        gain: float = 1.0,
        drifts: Mapping[int, float] = MappingProxyType({}),
        factors: Mapping[int, float] = MappingProxyType({}),
        amplified: Callable[[FloatArray, int], FloatArray] = lambda played, run: played,
    ) -> None:
        self._plate, self.rate, self.name, self.gaps = plate, rate, "memory", reported
        self._lost, self._late, self._gain, self.runs = lost, late, gain, 0
        self._drifts, self._factors, self._amplified = drifts, factors, amplified
        self.loudest = np.zeros(1)
        self._on_outputs = range(plate.outputs) if on_outputs is None else on_outputs
        self._on_inputs = range(plate.inputs) if on_inputs is None else on_inputs

    def run(self, played: FloatArray) -> Float32Array:
        """Advance the plate by so many samples."""
        self.loudest = np.maximum(self.loudest, np.abs(played).max(axis=0))
        amplified = np.column_stack([self._amplified(played[:, :-1], self.runs), played[:, -1]])
        blocks = np.split(
            amplified[:, self._on_outputs], range(MEMORY_BLOCK, len(played), MEMORY_BLOCK)
        )
        heard = np.concatenate([self._plate.advance(block) for block in blocks])
        if self.runs in self._lost:
            middle = round(2 * self.rate)  # a block in the middle is missing, and nothing says so
            heard = np.concatenate([heard[:middle], heard[middle + 128 :], heard[-128:]])
        if self.runs in self._late:
            heard = np.concatenate([np.zeros((128, heard.shape[1])), heard[:-128]])
        self.runs += 1
        samples = np.arange(len(heard), dtype=float)
        for number, drift in self._drifts.items():
            column = heard[:, number - 1]
            heard[:, number - 1] = np.interp(samples * (1 + drift), samples, column)
        for number, factor in self._factors.items():
            heard[:, number - 1] *= factor
        return np.clip(self._gain * heard[:, self._on_inputs], -1, 1).astype(np.float32)

    def close(self) -> None:
        """Nothing is open."""
