"""The project's firmware in place of simulated amplifiers: its samples move the plate of a bench.

`make firmware` builds it from the sources of a checkout; it is not part of the wheel. It runs as
one process for each amplifier.
"""

import asyncio
import contextlib
import fcntl
import os
import re
import sys
from collections import deque
from collections.abc import AsyncIterator, Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from drivers.errors import LinkError
from drivers.protocol.definition import QUANTITIES
from model.arrays import FloatArray
from model.errors import InputError
from model.rig.rig import Rig
from sim.bench.bench import Bench
from sim.plant.fingers import KEPT, Position
from sim.plant.imperfections import Imperfections
from sim.plant.plant import SampledPlant

RATE = 16_000.0
"""Samples per second and channel [Hz]."""

CHANNELS = 4
"""Channels of an amplifier."""

FOLDER = Path(__file__).parents[1] / "out" / "firmware"
"""Where `make firmware` puts its programs."""

_FULL_STROKE = 32767.0  # as a sample
_PIPE_SIZE = 1 << 20  # bytes; eight seconds
_STARTUP_TIMEOUT = 10.0  # s
_WITH_PARENT = (
    "import ctypes, os, signal, sys; "
    "ctypes.CDLL(None).prctl(1, signal.SIGTERM); "  # PR_SET_PDEATHSIG
    "os.getppid() == int(sys.argv[1]) and os.execvp(sys.argv[2], sys.argv[2:])"
)


def find_firmware() -> Path:
    """The built firmware, a program; InputError where there is none."""
    program = FOLDER / "era-firmware"
    if program.exists():
        return program
    if (FOLDER.parents[1] / "firmware").is_dir():
        raise InputError(f"firmware: {program} does not exist; run `make firmware` first")
    raise InputError(
        "firmware: its C sources are not part of this installation; run from a checkout of "
        "era-haptics, after `make firmware`"
    )


def ending_with_parent(command: Sequence[str | Path]) -> list[str | Path]:
    """A command whose process ends with the thread that starts it, also if that is killed.

    On Linux only.
    """
    if sys.platform != "linux":
        return [*command]
    return [sys.executable, "-c", _WITH_PARENT, str(os.getpid()), *command]


class RunningFirmware:
    """A running amplifier: its URL, and its samples as they come."""

    def __init__(self, url: str, pipe: int) -> None:
        self.url = url
        self._pipe = pipe
        self._rest = b""

    def read(self) -> FloatArray:
        """The samples since the last call, (n, channels) in full strokes."""
        with contextlib.suppress(BlockingIOError):
            while piece := os.read(self._pipe, _PIPE_SIZE):
                self._rest += piece
        size = len(self._rest) // (2 * CHANNELS) * 2 * CHANNELS
        whole, self._rest = self._rest[:size], self._rest[size:]
        return np.frombuffer(whole, "<i2").reshape(-1, CHANNELS) / _FULL_STROKE


@contextlib.asynccontextmanager
async def running(program: Path, folder: Path, name: str) -> AsyncIterator[RunningFirmware]:
    """Run the firmware for an amplifier; folder: for its pipe. Raises LinkError."""
    path = folder / f"{name}.samples"
    os.mkfifo(path)
    async with contextlib.AsyncExitStack() as stack:
        pipe = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        stack.callback(os.close, pipe)
        fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE_SIZE)
        process = await asyncio.create_subprocess_exec(
            *ending_with_parent([program, "--serial", "--samples", path]),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.DEVNULL,
        )
        stack.push_async_callback(_terminate, process)
        assert process.stdout is not None  # noqa: S101  a pipe was requested
        try:
            async with asyncio.timeout(_STARTUP_TIMEOUT):
                line = (await process.stdout.readline()).decode()
        except TimeoutError:
            raise LinkError(f"firmware of {name}: not ready in {_STARTUP_TIMEOUT:g} s") from None
        found = re.search(r"/dev/\S+", line)
        if found is None:
            raise LinkError(f"firmware of {name}: no line was opened, got {line.strip()!r}")
        yield RunningFirmware(f"serial://{found[0]}", pipe)


async def _terminate(process: asyncio.subprocess.Process) -> None:
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    await process.wait()


_SILENT = 1e-3  # of full stroke
_LEAST = 0.1  # of a channel's loudest tone; quieter peaks are its side lobes
_PADDING = 8
_APART = 1.0  # Hz; of different tones


def frequencies_in(samples: FloatArray, *, rate: float) -> list[float]:
    """The frequencies [Hz] in samples (n, channels) in full strokes, ascending.

    Peaks of a windowed spectrum at the steps of the wire; rate [Hz].
    """
    found: list[float] = []
    for channel in samples.T:
        if np.abs(channel).max() >= _SILENT:
            size = _PADDING * len(channel)
            spectrum = np.abs(np.fft.rfft(channel * np.hanning(len(channel)), size))
            middle = spectrum[1:-1]
            is_peak = (middle > spectrum[:-2]) & (middle >= spectrum[2:])
            at = np.flatnonzero(is_peak & (middle > _LEAST * spectrum.max())) + 1
            # Each local maximum lies at the top of a parabola through three logarithms.
            below, top, above = (np.log(spectrum[at + offset] + 1e-12) for offset in (-1, 0, 1))
            offsets = (below - above) / (2 * (below - 2 * top + above))
            found += ((at + offsets) * rate / size).tolist()
    step = QUANTITIES["frequency"].step
    tones: list[float] = []
    for frequency in sorted(round(each / step) * step for each in found):
        if not tones or frequency - tones[-1] > _APART:
            tones.append(frequency)
    return tones


_MAX_LAG = 0.06  # s; of the samples' clock


class FirmwareBench(Bench):
    """A simulated rig whose amplifiers are firmware, by name; now [s]: its time.

    Sample times are those of their arrival on a steady clock. Of the channels' errors only the
    gain applies: samples have no phase of their own. Raises InputError for channels that the
    firmware does not have.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        now: float,
        imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
    ) -> None:
        for era, channel in rig.wiring.items():
            if channel.number >= CHANNELS:
                raise InputError(
                    f"channel of {era} must be 0 to {CHANNELS - 1} with firmware, got "
                    f"{channel.number}"
                )
        super().__init__(rig, now=now, sample_rate=RATE, imperfections=imperfections)
        self.firmware: Mapping[str, RunningFirmware] = {}
        self._sampled = SampledPlant(self._plant, rate=RATE)
        self._gains = np.array([imperfections.errors_of(era.name, rig).gain for era in rig.eras])
        self._unused = {name: np.zeros((0, CHANNELS)) for name in rig.amplifiers}
        self._start: float | None = None  # of sample 0 [s]
        self._count = 0
        self._recent: deque[tuple[float, FloatArray]] = deque()  # samples with their first time

    def advance(self, now: float) -> None:
        """Advance by the samples that have come by a time [s]."""
        for name, firmware in self.firmware.items():
            self._unused[name] = np.concatenate([self._unused[name], firmware.read()])
        count = min(map(len, self._unused.values()))
        if count == 0:
            return
        samples = {name: made[:count] for name, made in self._unused.items()}
        self._unused = {name: made[count:] for name, made in self._unused.items()}
        wired = [
            samples[channel.amplifier][:, channel.number]
            for channel in (self.rig.wiring[era.name] for era in self.rig.eras)
        ]
        self._play(np.column_stack(wired), now=now)

    def begin_placing(
        self,
        positions: Mapping[str, Position],
        *,
        now: float,
        observers: Collection[str] = (),
        loads: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        """Replace the fingers at once, as `place_fingers`: the amplifiers are other processes."""
        super().begin_placing(positions, now=now, observers=observers, loads=loads)
        self._sample_plate()
        self._sampled.follow()

    def _play(self, levels: FloatArray, *, now: float) -> None:
        """Move the plate by the next levels (n, eras)."""
        last = self._count + len(levels)
        if self._start is None or abs(now - self._start - last / RATE) > _MAX_LAG:
            self._start = now - last / RATE
        times: FloatArray = self._start + np.arange(self._count + 0.5, last) / RATE
        self._count, self.time = last, float(times[-1])
        bases = levels * self._gains * [era.full_level for era in self.rig.eras]
        shapes = self._listening()
        felt = self._sampled.advance(bases, shapes=np.concatenate(shapes))
        self._pass_on(times, felt, shapes)
        self._recent.append((float(times[0]), levels))
        while self._recent[0][0] < self.time - KEPT:
            self._recent.popleft()

    def _sample(self, end: float) -> None:
        """Let the plate that lends its coordinates go on; the samples' is sampled as they come."""
        self._plant.skip(end)

    def _frequencies(self, since: float, until: float) -> list[float]:
        """The frequencies [Hz] that the samples of a window consist of."""
        pieces = [levels for time, levels in self._recent if since <= time <= until]
        return frequencies_in(np.concatenate(pieces), rate=RATE) if pieces else []
