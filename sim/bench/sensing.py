"""The sensors of one simulated amplifier: one at the foot of each ERA that it drives, and others.

They read the acceleration of the plate in time. Not modelled: delay of the sensors.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol, final

import numpy as np

from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    GetBlock,
    GetReading,
    GetSensors,
    Measure,
    Nak,
    NakCode,
    Reading,
    ReadingState,
    Reply,
    SampleBlock,
    Sensor,
    SensorList,
    SensorUnit,
)
from model.arrays import FloatArray
from sim.amplifier.amplifier import SensorRequest
from sim.bench.reading import ToneReader, count_step

REACH = 2000.0
"""Largest range [m/s²]; the paper's plate stays below with all ERAs at full stroke."""

_Q = PROTOCOL.quantities
_ROUNDING = 1e-6
_BELOW_NYQUIST, _FREQUENCY_MAX = 0.8, 3000.0  # Hz


@dataclass(frozen=True)
class PlateSensor:
    """A sensor at x, y [m]; channel: whose ERA it sits at. Characteristics as a `Transducer`."""

    x: float
    y: float
    channel: int | None = None
    noise_density: float = 0.0
    reach: float = REACH
    resolution: float = 0.0
    scale: float = 1.0


class SensedPlate(Protocol):
    """The plate that sensors are on."""

    sample_rate: float

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Reduced shapes (p, r) at points (p, 2) [m]."""
        ...

    def listen_to_plate(self, reader: ToneReader) -> None:
        """Pass samples on to a reader from now on."""
        ...

    def forget_reader(self, reader: ToneReader) -> None:
        """Pass no more samples on to a reader."""
        ...


class Played(Protocol):
    """What an amplifier plays."""

    @property
    def token(self) -> int:
        """Token of the set played last since arming; 0: none."""

    @property
    def committed_at(self) -> float:
        """Time of its commit [s]."""


@final
class Sensing:
    """The sensors of an amplifier that plays on a plate; feet: those at its ERAs."""

    def __init__(
        self, plate: SensedPlate, played: Played, feet: Sequence[PlateSensor], *, seed: int
    ) -> None:
        self._plate = plate
        self._played = played
        self._feet = tuple(feet)
        self._others: tuple[PlateSensor, ...] = ()
        self._rng = np.random.default_rng(seed)
        self._reader: ToneReader | None = None

    def place(self, others: Sequence[PlateSensor]) -> None:
        """Replace the sensors that are not at ERAs; more than the protocol counts are left out."""
        self._others = tuple(replace(one, reach=min(one.reach, REACH)) for one in others)

    def handle(self, request: SensorRequest, now: float) -> Reply:
        """Reply to a request at a time [s]."""
        match request:
            case GetSensors(first=first):
                each = [self._described(sensor) for sensor in self._sensors]
                return SensorList(len(each), tuple(each[first:]))
            case Measure():
                return self._measure(request, now)
            case GetReading(first=first):
                return self._reading(first, now)
            case GetBlock():
                return self._block(request)

    def changed(self, moment: float) -> None:
        """Note that what plays changes at a time [s]."""
        if self._reader is not None and moment < self._reader.end:
            self._reader.is_disturbed = True

    def forget(self) -> None:
        """Forget the reading, as without supply."""
        reader, self._reader = self._reader, None
        if reader is not None:
            self._plate.forget_reader(reader)

    @property
    def _sensors(self) -> tuple[PlateSensor, ...]:
        return (*self._feet, *self._others)[: _Q.sensor_count.maximum]

    @property
    def _frequency_max(self) -> float:
        nyquist = self._plate.sample_rate / 2
        return _Q.frequency.quantise(min(_BELOW_NYQUIST * nyquist, _FREQUENCY_MAX))

    @property
    def _raw_rate(self) -> int:
        """Sampling rate of raw samples [Hz]; 0 for one that the protocol cannot state."""
        rate = self._plate.sample_rate
        return int(rate) if rate.is_integer() and rate <= _Q.sample_rate.maximum else 0

    def _described(self, sensor: PlateSensor) -> Sensor:
        return Sensor(
            SensorUnit.ACCELERATION,
            sensor.channel,
            _place(sensor.x),
            _place(sensor.y),
            range=_binary32(sensor.reach),
            frequency_max=self._frequency_max,
            sample_rate=self._raw_rate,
            count_step=_binary32(count_step(sensor.reach)) if self._raw_rate else 0.0,
        )

    def _measure(self, request: Measure, now: float) -> Reply:
        if self._reader is not None and request == self._reader.request:
            return self._reading(_Q.sensor.maximum + 1, now)  # its reply was lost
        ascending = sorted(request.frequencies)
        if not ascending:
            return Nak(NakCode.BAD_VALUE)
        apart = min(after - before for before, after in pairwise([0.0, *ascending]))
        if apart * request.window < 1 - _ROUNDING or ascending[-1] > self._frequency_max:
            return Nak(NakCode.BAD_VALUE)
        self.forget()
        sensors = self._sensors
        points = np.array([[one.x, one.y] for one in sensors])
        token = self._played.token
        self._reader = ToneReader(
            request,
            sensors,
            shapes=lambda: self._plate.shapes_at(points),
            start=now,
            origin=self._played.committed_at if token else None,
            token=token,
            sample_rate=self._plate.sample_rate,
            rng=self._rng,
            on_end=self._plate.forget_reader,
        )
        self._plate.listen_to_plate(self._reader)
        return self._reading(0, now)

    def _reading(self, first: int, now: float) -> Reading:
        if self._reader is None:
            return Reading(0, ReadingState.NONE)
        return self._reader.reading(first, now)

    def _block(self, request: GetBlock) -> Reply:
        if not self._raw_rate or request.sensor >= len(self._sensors):
            return Nak(NakCode.BAD_VALUE)
        if self._reader is None:
            return SampleBlock(0, 0, 0, ())
        block = self._reader.samples(request.sensor, request.sample, limit=_Q.sample_count.maximum)
        return Nak(NakCode.BAD_VALUE) if block is None else block


def _place(at: float) -> float | None:
    """A coordinate [m] as the protocol states it; None beyond its range."""
    return _Q.place.quantise(at) if at < _Q.place.high else None


def _binary32(value: float) -> float:
    return float(np.float32(value))
