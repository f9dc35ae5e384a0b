"""The sensors of one simulated amplifier: one at the foot of each ERA that it drives, and others.

They read the acceleration of the plate in time. Tones are fitted by least squares over a window:
the normal equations of all tones and a constant are summed sample by sample, so that tones played
together do not leak into each other.
"""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol, final

import numpy as np

from drivers.protocol.definition import (
    MAX_WORDS,
    NO_CHANNEL,
    QUANTITIES,
    READING_STATES,
    SENSOR_UNITS,
    UNKNOWN_PLACE,
    sensor_reading,
)
from drivers.protocol.records import Refusal, Values
from model.arrays import FloatArray
from sim.amplifier.readings import AmplifierClock
from sim.amplifier.simulated_amplifier import Amplifier
from sim.plant.accelerometer import Accelerometer, positions, readings


class Probe(Protocol):
    """A listener to the plate at fixed points, by their reduced shapes (p, r)."""

    @property
    def shapes(self) -> FloatArray:
        """Shapes at its points."""

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Take samples: times (n,) [s], one at least, accelerations (n, p) [m/s²].

        Calls are contiguous.
        """


class SampledPlate(Protocol):
    """A plate in the time domain, sampled at a rate [Hz] while probes listen to it."""

    sample_rate: float

    @property
    def probes(self) -> list[Probe]:
        """The listeners, which have all samples up to the present time."""

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Reduced shapes (p, r) at points (p, 2) [m]."""


@dataclass(frozen=True)
class Measurement:
    """Tones [Hz] that are measured over a window [s]; number: of the reading."""

    number: int
    window: float
    frequencies: tuple[float, ...]


@final
class ToneReader:
    """Reads tones at sensors of a plate from `start` [s] on, until its window has ended.

    clock: on which phases count; token: of what plays. window_start: the clock at the start.
    """

    def __init__(
        self,
        plate: SampledPlate,
        measurement: Measurement,
        sensors: Sequence[Accelerometer],
        *,
        start: float,
        clock: AmplifierClock,
        token: int,
        rng: np.random.Generator,
    ) -> None:
        self.measurement = measurement
        self.end = start + measurement.window
        self.window_start = clock.reading(start)
        self.token = token
        self.is_disturbed = False
        self._plate = plate
        self._sensors = tuple(sensors)
        self._start = start
        self._clock = clock
        self._rng = rng
        self._reach = np.array([one.reach for one in sensors])
        unknowns, count = 2 * len(measurement.frequencies) + 1, len(sensors)
        self._normal = np.zeros((unknowns, unknowns))
        self._right = np.zeros((unknowns, count))
        self._is_overloaded = np.zeros(count, dtype=bool)

    @property
    def shapes(self) -> FloatArray:
        """Shapes at its sensors."""
        return self._plate.shapes_at(positions(self._sensors))

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Take samples: times (n,) [s], accelerations (n, s) [m/s²]."""
        inside = (times > self._start) & (times <= self.end)
        rate = self._plate.sample_rate
        read = readings(self._sensors, accelerations[inside], sample_rate=rate, rng=self._rng)
        # At one pace: samples come before the amplifier does what changes it.
        clock = self._clock.straight(times[0])
        shown = clock.shown + (times[inside] - clock.time) * clock.pace
        angles = 2 * math.pi * np.outer(shown, self.measurement.frequencies)
        columns = np.hstack([np.sin(angles), np.cos(angles), np.ones((len(angles), 1))])
        self._normal += columns.T @ columns
        self._right += columns.T @ read
        self._is_overloaded |= (np.abs(read) >= self._reach).any(axis=0)
        if times[-1] + 1 / rate > self.end:
            self._plate.probes.remove(self)

    def tones(self) -> list[tuple[bool, list[complex]]]:
        """Of each sensor: whether it was overloaded, and the phasors of its tones."""
        count = len(self.measurement.frequencies)
        found, *_ = np.linalg.lstsq(self._normal, self._right, rcond=None)
        phasors = found[:count] + 1j * found[count : 2 * count]
        return list(zip(self._is_overloaded.tolist(), phasors.T.tolist(), strict=True))


REACH = 2000.0
"""Largest range [m/s²]; the paper's plate stays below with all ERAs at full stroke."""

_Q = QUANTITIES
_MAX_SENSORS = _Q["sensor"].maximum + 1
_SENSOR_WORDS, _HEAD_WORDS = 7, 8  # of a sensor that is listed, of a reading without sensors
_ROUNDING = 1e-6
_BELOW_NYQUIST, _FREQUENCY_MAX = 0.8, 3000.0  # Hz


@final
class Sensing:
    """The sensors of an amplifier that plays on a plate; feet: those at its ERAs."""

    def __init__(
        self, plate: SampledPlate, amplifier: Amplifier, feet: Sequence[Accelerometer], *, seed: int
    ) -> None:
        self._plate = plate
        self._amplifier = amplifier
        self._feet = tuple(feet)
        self._others: tuple[Accelerometer, ...] = ()
        self._rng = np.random.default_rng(seed)
        self.reader: ToneReader | None = None
        """What reads the tones, or has read them last."""

    def place(self, others: Sequence[Accelerometer]) -> None:
        """Replace the sensors that are not at ERAs; more than the protocol counts are left out."""
        self._others = tuple(replace(one, reach=min(one.reach, REACH)) for one in others)

    def handle(self, name: str, values: Values, now: float) -> Values:
        """Reply to GetSensors, Measure or GetReading at a time [s]; raises Refusal."""
        if name == "GetSensors":
            return self._listed(values["first"])
        if name == "Measure":
            return self._measure(values, now)
        return self._reading(values["first"], now)

    def changed(self, moment: float) -> None:
        """Note that what plays changes at a time [s]."""
        if self.reader is not None and moment < self.reader.end:
            self.reader.is_disturbed = True

    def forget(self) -> None:
        """Forget the reading, as without supply."""
        reader, self.reader = self.reader, None
        if reader is not None and reader in self._plate.probes:
            self._plate.probes.remove(reader)

    @property
    def sensors(self) -> tuple[Accelerometer, ...]:
        """All sensors, those at its ERAs first."""
        return (*self._feet, *self._others)[:_MAX_SENSORS]

    @property
    def _frequency_max(self) -> float:
        nyquist = self._plate.sample_rate / 2
        return _Q["frequency"].quantise(min(_BELOW_NYQUIST * nyquist, _FREQUENCY_MAX))

    def _listed(self, first: int) -> Values:
        """Describe the sensors from one on, as many as fit."""
        described = [self._described(sensor) for sensor in self.sensors]
        listed = described[first:][: (MAX_WORDS - 2) // _SENSOR_WORDS]
        return {"all": len(described), "count": len(listed), "sensors": listed}

    def _described(self, sensor: Accelerometer) -> Values:
        return {
            "unit": SENSOR_UNITS["ACCELERATION"],
            "channel": NO_CHANNEL if sensor.channel is None else sensor.channel,
            **{
                "x": _place(sensor.x),
                "y": _place(sensor.y),
                "range": float(np.float32(sensor.reach)),
            },
            "frequency_max": _Q["frequency"].to_wire(self._frequency_max),
        }

    def _measure(self, values: Values, now: float) -> Values:
        """Begin to measure, unless it is the same again: its reply was lost."""
        measurement = Measurement(
            values["reading"],
            _Q["window"].from_wire(values["window"]),
            tuple(_Q["frequency"].from_wire(each) for each in values["frequencies"]),
        )
        if self.reader is None or measurement != self.reader.measurement:
            self._begin(measurement, now)
        return self._reading(_MAX_SENSORS, now)

    def _begin(self, measurement: Measurement, now: float) -> None:
        ascending = sorted(measurement.frequencies)
        if not ascending or ascending[-1] > self._frequency_max:
            limit = self._frequency_max
            raise Refusal(f"frequencies must be at most {limit:g} Hz, and at least one")
        apart = min(after - before for before, after in pairwise([0.0, *ascending]))
        if apart * measurement.window < 1 - _ROUNDING:
            raise Refusal(f"frequencies must be {1 / measurement.window:g} Hz apart, got {apart:g}")
        self.forget()
        self.reader = ToneReader(
            self._plate,
            measurement,
            self.sensors,
            start=now,
            clock=self._amplifier.clock,
            token=self._amplifier.token,
            rng=self._rng,
        )
        self._plate.probes.append(self.reader)

    def _reading(self, first: int, now: float) -> Values:
        """Report the reading at a time [s], its sensors from one on, as many as fit."""
        reader = self.reader
        if reader is None:
            numbers = ("reading", "state", "window_left", "window_start", "token", "tones", "count")
            return {**dict.fromkeys(numbers, 0), "sensors": []}
        state, left, listed = "RUNNING", reader.end - now, 0
        tones = len(reader.measurement.frequencies)
        words: list[int] = []
        if left <= 0:
            state, left = "DISTURBED" if reader.is_disturbed else "COMPLETE", 0.0
            record = sensor_reading(tones)
            found = reader.tones()[first:][: (MAX_WORDS - _HEAD_WORDS) // (1 + 3 * tones)]
            listed = len(found)
            for is_overloaded, phasors in found:
                rows = [
                    {
                        "amplitude": abs(each),
                        "phase": _Q["phase"].to_wire(math.degrees(cmath.phase(each))),
                    }
                    for each in phasors
                ]
                record.append(words, {"flags": int(is_overloaded), "tones": rows})
        return {
            **{"reading": reader.measurement.number, "state": READING_STATES[state]},
            "window_left": _Q["window_left"].to_wire(left),
            **{"window_start": reader.window_start, "token": reader.token},
            **{"tones": tones, "count": listed, "sensors": words},
        }


def _place(at: float) -> int:
    """A coordinate [m] as the protocol states it."""
    last = _Q["place"].from_wire(UNKNOWN_PLACE - 1)
    return _Q["place"].to_wire(at) if at <= last else UNKNOWN_PLACE
