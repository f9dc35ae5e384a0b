"""A bench whose plate is moved by the samples of running firmware."""

from collections import deque
from collections.abc import Collection, Mapping
from types import MappingProxyType

import numpy as np

from drivers.protocol.table import QUANTITIES
from model.arrays import FloatArray
from model.errors import InputError
from model.rig.rig import Rig
from sim.bench.bench import Bench
from sim.firmware.programs import CHANNELS, RATE, RunningFirmware
from sim.plant.fingers import KEPT, Position
from sim.plant.imperfections import Imperfections
from sim.plant.sampled import SampledPlant

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
            found += _peaks(channel, rate=rate)
    step = QUANTITIES["frequency"].step
    tones: list[float] = []
    for frequency in sorted(round(each / step) * step for each in found):
        if not tones or frequency - tones[-1] > _APART:
            tones.append(frequency)
    return tones


def _peaks(channel: FloatArray, *, rate: float) -> list[float]:
    """Local maxima of the spectrum of a channel (n,), by a parabola through three logarithms."""
    size = _PADDING * len(channel)
    spectrum = np.abs(np.fft.rfft(channel * np.hanning(len(channel)), size))
    middle = spectrum[1:-1]
    is_peak = (middle > spectrum[:-2]) & (middle >= spectrum[2:])
    at = np.flatnonzero(is_peak & (middle > _LEAST * spectrum.max())) + 1
    below, top, above = (np.log(spectrum[at + offset] + 1e-12) for offset in (-1, 0, 1))
    offsets = (below - above) / (2 * (below - 2 * top + above))
    return ((at + offsets) * rate / size).tolist()  # type: ignore[no-any-return]


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
        self._count, self._time = last, float(times[-1])
        bases = levels * self._gains * [era.stroke for era in self.rig.eras]
        shapes = [self._fingers.layout.shapes, *(probe.shapes for probe in self._probes)]
        felt = self._sampled.advance(bases, shapes=np.concatenate(shapes))
        parts = np.split(felt, np.cumsum([len(each) for each in shapes])[:-1], axis=1)
        self._fingers.record(times, parts[0])
        for probe, part in zip(self._probes, parts[1:], strict=True):
            probe.record(times, part)
        self._recent.append((float(times[0]), levels))
        while self._recent[0][0] < self._time - KEPT:
            self._recent.popleft()

    def _sample(self, end: float) -> None:
        """Let the plate that lends its coordinates go on; the samples' is sampled as they come."""
        self._plant.skip(end)

    def _frequencies(self, since: float, until: float) -> list[float]:
        """The frequencies [Hz] that the samples of a window consist of."""
        pieces = [levels for time, levels in self._recent if since <= time <= until]
        return frequencies_in(np.concatenate(pieces), rate=RATE) if pieces else []
