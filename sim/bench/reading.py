"""A reading of tones at sensors of a bench, by least squares over its window.

The normal equations of all tones and a constant are summed sample by sample, so that tones played
together do not leak into each other; of the samples only the newest are kept.
"""

import math
from collections.abc import Callable, Sequence
from typing import final

import numpy as np

from drivers.protocol.messages import (
    Measure,
    Reading,
    ReadingState,
    SampleBlock,
    SensorReading,
    ToneReading,
)
from model.arrays import FloatArray
from sim.plant.transducer import Transducer, read_accelerations

KEPT_SAMPLES = 16_384  # of each sensor; 1.6 s at 10 kHz
_COUNTS = 32_767  # of a raw sample at the range


@final
class ToneReader:
    """Reads tones at sensors from `start` [s] on, while samples of its window come.

    shapes: returns those at its sensors (s, r); origin [s]: where t begins; token: of what plays.
    on_end: called with it after the last sample.
    """

    def __init__(
        self,
        request: Measure,
        transducers: Sequence[Transducer],
        *,
        shapes: Callable[[], FloatArray],
        start: float,
        origin: float | None,
        token: int,
        sample_rate: float,
        rng: np.random.Generator,
        on_end: Callable[["ToneReader"], None],
    ) -> None:
        self.request = request
        self.end = start + request.window
        self.is_disturbed = False
        self._transducers = tuple(transducers)
        self._shapes = shapes
        self._start = start
        self._offset = 0.0 if origin is None else start - origin
        self._token = token
        self._sample_rate = sample_rate
        self._rng = rng
        self._on_end = on_end
        self._reach = np.array([one.reach for one in transducers])
        unknowns, sensors = 2 * len(request.frequencies) + 1, len(transducers)
        self._normal = np.zeros((unknowns, unknowns))
        self._right = np.zeros((unknowns, sensors))
        self._is_overloaded = np.zeros(sensors, dtype=bool)
        self._kept = np.zeros((KEPT_SAMPLES, sensors), dtype=np.int16)
        self._count = 0

    @property
    def shapes(self) -> FloatArray:
        """Shapes at its sensors."""
        return self._shapes()

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Take samples: times (n,) [s], accelerations (n, s) [m/s²]."""
        inside = (times > self._start) & (times <= self.end)
        readings = read_accelerations(
            self._transducers,
            accelerations[inside],
            sample_rate=self._sample_rate,
            rng=self._rng,
        )
        angles = 2 * math.pi * np.outer(times[inside] - self._start, self.request.frequencies)
        columns = np.hstack([np.sin(angles), np.cos(angles), np.ones((len(angles), 1))])
        self._normal += columns.T @ columns
        self._right += columns.T @ readings
        self._is_overloaded |= (np.abs(readings) >= self._reach).any(axis=0)
        counts = np.round(readings / self._reach * _COUNTS).astype(np.int16)
        last = counts[-KEPT_SAMPLES:]
        self._count += len(counts)
        at = np.arange(self._count - len(last), self._count) % KEPT_SAMPLES
        self._kept[at] = last
        if len(times) and times[-1] + 1 / self._sample_rate > self.end:
            self._on_end(self)

    def reading(self, first: int, now: float) -> Reading:
        """The reading at a time [s], its sensors from one on."""
        request = self.request
        state, left = ReadingState.RUNNING, self.end - now
        sensors: tuple[SensorReading, ...] = ()
        if left <= 0:
            state = ReadingState.DISTURBED if self.is_disturbed else ReadingState.COMPLETE
            left, sensors = 0.0, self._sensors()[first:]
        return Reading(
            request.number,
            state,
            left,
            self._offset,
            self._token,
            len(request.frequencies),
            sensors,
        )

    def samples(self, sensor: int, first: int, *, limit: int) -> SampleBlock | None:
        """At limit so many raw samples from one on, or the oldest kept; None for no such sensor."""
        if not 0 <= sensor < len(self._transducers):
            return None
        first = min(max(first, self._count - KEPT_SAMPLES, 0), self._count)
        numbers = np.arange(first, min(first + limit, self._count))
        samples = self._kept[numbers % KEPT_SAMPLES, sensor]
        return SampleBlock(self.request.number, first, self._count, tuple(samples.tolist()))

    def _sensors(self) -> tuple[SensorReading, ...]:
        frequencies = np.array(self.request.frequencies)
        tones = len(frequencies)
        found, *_ = np.linalg.lstsq(self._normal, self._right, rcond=None)
        phasors = found[:tones] + 1j * found[tones : 2 * tones]
        phasors *= np.exp(-2j * math.pi * frequencies * self._offset)[:, None]
        return tuple(
            SensorReading(
                tuple(ToneReading(abs(a), math.degrees(np.angle(a))) for a in column.tolist()),
                is_overloaded=bool(is_overloaded),
            )
            for column, is_overloaded in zip(phasors.T, self._is_overloaded, strict=True)
        )


def count_step(reach: float) -> float:
    """Reading of one count of a raw sample, for a range."""
    return reach / _COUNTS
