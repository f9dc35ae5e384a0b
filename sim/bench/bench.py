"""The simulated rig: amplifiers, sensors and fingers on one plate in the time domain.

Time is passed in; only `keep_time` reads a clock. Channels drive the ERAs by the rig's wiring,
level 1 being the full stroke, with the imperfections given.

The plate is solved anew where the motion of a base changes, and a host changes the rate of an
amplifier's clock with every Ping. So the plate continues with a straight clock for each amplifier
until that differs by `WRONG` from the amplifier's own.

Sensors read the acceleration of the plate at the foot of each ERA, and at other points. Tones are
fitted by least squares over a window: the normal equations of all tones and a constant are summed
sample by sample, so that tones played together do not leak into each other.
"""

import asyncio
import cmath
import math
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import pairwise
from types import MappingProxyType
from typing import Protocol, TypeAlias, final

import numpy as np

from drivers.playing import Voice
from drivers.protocol.definition import (
    CLOCK_TURN,
    MAX_WORDS,
    NO_CHANNEL,
    QUANTITIES,
    READING_STATES,
    SENSOR_UNITS,
    UNKNOWN_PLACE,
    sensor_reading,
)
from drivers.protocol.records import Refusal, Values
from model.arrays import FloatArray, Point
from model.fem import Mesh
from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import (
    FingertipLoad,
    PointLoad,
    Source,
    check_loads,
    footprints_of,
    with_patches,
)
from model.structure.plate import Plate
from model.transients.base_motion import Motion
from registry import limits, threads
from sim.amplifier.readings import AmplifierClock, StraightClock
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.plant import imperfections
from sim.plant.fingers import (
    HISTORY_DURATION,
    Accelerometer,
    FeltVibration,
    FingerRecord,
    PlateFingers,
    measure_vibration,
    positions,
    readings,
)
from sim.plant.imperfections import Imperfections, PlateErrors, motion_of, realised
from sim.plant.plant import PLANT_SAMPLE_RATE, FingerPlacement, LoadedPlate, Plant

WRONG = 0.5e-6
"""Most by which a clock of the plate is wrong [s]: 0.1 degrees of 500 Hz, when it is replaced."""

_SOON = 0.05  # s; of a clock that is wrong then: a rate that is no correction of the last
_ALIKE = 10e-6  # of a pace; rates that a host chooses by readings that are not exact
_DRIFT = 0.1e-6  # s; by which the warm-up of a crystal may change it unseen


class StraightClocks:
    """Straight clocks in place of those of amplifiers by name, which hold at a time [s]."""

    def __init__(self, clocks: Mapping[str, AmplifierClock], *, time: float) -> None:
        self._clocks = clocks
        self.straight = {name: clock.straight(time) for name, clock in clocks.items()}
        """Those that hold now, by name."""
        self._due = dict.fromkeys(clocks, time)
        self._changes = dict.fromkeys(clocks, 0)
        self.renew(time)

    @property
    def next_due(self) -> float:
        """When one of them has to be looked at [s]."""
        return min(self._due.values())

    def renew(self, time: float) -> list[str]:
        """Replace those that do not hold from a time [s] on; return their names."""
        renewed = []
        for name, clock in self._clocks.items():
            if time < self._due[name] and self._changes[name] == clock.changes:
                continue
            self._changes[name] = clock.changes
            now = clock.straight(time)
            lasts = _lasts(self.straight[name], now)
            if lasts < _SOON:
                known = self.straight[name]
                # The mean pace since another clock was right, where that is alike.
                mean = known.pace + _behind(known, now) / max(now.time - known.time, _SOON)
                self.straight[name] = (
                    now._replace(pace=mean) if abs(mean - now.pace) < _ALIKE else now
                )
                lasts = _lasts(self.straight[name], now)
                renewed.append(name)
            self._due[name] = time + min(lasts / 2, clock.steady(time, _DRIFT))
        return renewed


def _lasts(known: StraightClock, now: StraightClock) -> float:
    """Return for how long [s] a clock is right enough, negative if it is wrong."""
    drift, left = abs(now.pace - known.pace), WRONG - abs(_behind(known, now))
    return left / drift if drift else math.copysign(math.inf, left)


def _behind(known: StraightClock, now: StraightClock) -> float:
    """Return by how much a clock is behind that of now [s]."""
    return math.remainder(now.shown - known.at(now.time), CLOCK_TURN)


class Probe(Protocol):
    """A listener to the plate at fixed points, by their reduced shapes (p, r)."""

    @property
    def shapes(self) -> FloatArray:
        """Shapes at its points."""

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Take samples: times (n,) [s], one at least, accelerations (n, p) [m/s²].

        Calls are contiguous.
        """


@dataclass(frozen=True)
class ToneMeasurement:
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
        plate: "Bench",
        measurement: ToneMeasurement,
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
    """The sensors of an amplifier that plays on a plate, at the feet of its ERAs and elsewhere."""

    def __init__(
        self, plate: "Bench", name: str, amplifier: SimulatedAmplifier, *, seed: int
    ) -> None:
        self._plate = plate
        self._name = name
        self._amplifier = amplifier
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
            described = [
                {
                    "unit": SENSOR_UNITS["ACCELERATION"],
                    "channel": NO_CHANNEL if sensor.channel is None else sensor.channel,
                    "x": _place(sensor.x),
                    "y": _place(sensor.y),
                    "range": float(np.float32(sensor.reach)),
                    "frequency_max": _Q["frequency"].to_wire(self._frequency_max),
                }
                for sensor in self._sensors_of(self._plate.rig)
            ]
            listed = described[values["first"] :][: (MAX_WORDS - 2) // _SENSOR_WORDS]
            return {"all": len(described), "count": len(listed), "sensors": listed}
        if name == "Measure":
            measurement = ToneMeasurement(
                values["reading"],
                _Q["window"].from_wire(values["window"]),
                tuple(_Q["frequency"].from_wire(each) for each in values["frequencies"]),
            )
            # The same again is a repeated request, whose reply was lost.
            if self.reader is None or measurement != self.reader.measurement:
                self._begin(measurement, now)
            return self._reading(_MAX_SENSORS, now)
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

    def _sensors_of(self, rig: Rig) -> tuple[Accelerometer, ...]:
        """All sensors, those at its ERAs first, where a rig has these."""
        return (*_feet(rig, self._name), *self._others)[:_MAX_SENSORS]

    @property
    def _frequency_max(self) -> float:
        nyquist = self._plate.sample_rate / 2
        return _Q["frequency"].quantise(min(_BELOW_NYQUIST * nyquist, _FREQUENCY_MAX))

    def _begin(self, measurement: ToneMeasurement, now: float) -> None:
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
            self._sensors_of(self._plate.real),
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
            "reading": reader.measurement.number,
            "state": READING_STATES[state],
            "window_left": _Q["window_left"].to_wire(left),
            "window_start": reader.window_start,
            "token": reader.token,
            "tones": tones,
            "count": listed,
            "sensors": words,
        }


def _place(at: float) -> int:
    """A coordinate [m] as the protocol states it."""
    last = _Q["place"].from_wire(UNKNOWN_PLACE - 1)
    return _Q["place"].to_wire(at) if at <= last else UNKNOWN_PLACE


_TICK = 0.01  # s; of `keep_time`
_MAX_BEHIND = 0.1  # s; of the plate behind the amplifiers, once time goes on
_MAX_STEP = 1.0  # s; sampled at once
_MAX_SHAPES = 16  # sets of points

Voices: TypeAlias = tuple[Voice, ...]
"""What a channel plays."""


class Bench:
    """A simulated rig at rest at time now [s]; sample_rate [Hz]: of sensors and fingers.

    Fingers load the plate as the rig's fingertip. probes: listeners beside them; imperfections: in
    what the bench differs from the rig. Raises
    InputError for unknown channels.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        now: float,
        sample_rate: float = PLANT_SAMPLE_RATE,
        imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
    ) -> None:
        imperfections.check(rig)
        self.rig = rig
        self.sample_rate = sample_rate
        self.imperfections = imperfections
        self.real = imperfections.plate.realised(rig)
        """The rig with the errors of plate and ERAs: what moves, and where feet stand."""
        self._probes: list[Probe] = []
        self.time = now
        """The present time [s]."""
        # Behind the amplifiers, and advanced in few large steps: nothing acts back on them.
        self._plant = _plant_of(self.real, now)
        self._sampled_until = now  # up to when [s] fingers and probes have samples
        self._fingers = PlateFingers(self._plant.reduced)
        self._is_sampling = False
        # Fingers that are not on the plate in time yet; the newest, and those that load the plate.
        self._placements: deque[FingerPlacement] = deque()
        self.positions: Mapping[str, Point] = {}
        self._contacts: Mapping[str, FingertipLoad] = {}
        self.observers: frozenset[str] = frozenset()  # fingers without weight
        self.loads: Mapping[str, float] = {}  # by finger, relative to the rig's fingertip
        self.amplifiers: Mapping[str, SimulatedAmplifier] = {
            name: SimulatedAmplifier(
                name,
                channels=_channel_count(rig, name),
                is_output=name in rig.outputs,
                clock=AmplifierClock(imperfections.crystal_of(name), since=now),
            )
            for name in rig.amplifiers
        }
        clocks = {name: amplifier.clock for name, amplifier in self.amplifiers.items()}
        self._clocks = StraightClocks(clocks, time=now)
        self._sensing = [
            Sensing(self, name, amplifier, seed=number)
            for number, (name, amplifier) in enumerate(self.amplifiers.items())
        ]
        for amplifier, sensing in zip(self.amplifiers.values(), self._sensing, strict=True):
            amplifier.attach(sensing)
        # By ERA: what its channel plays, and what moves its base, later by the amplifier's delay.
        self._wired = [rig.wiring[era.name] for era in rig.eras]
        self._commanded: list[Voices] = [()] * len(rig.eras)
        self._applied_outputs: list[Voices] = [()] * len(rig.eras)
        self._delays = [imperfections.delays.get(one.amplifier, 0.0) for one in self._wired]
        self._errors = [imperfections.errors_of(era.name, rig) for era in rig.eras]
        self._shapes_at = lru_cache(_MAX_SHAPES)(
            lambda points: self._plant.reduced.at(np.frombuffer(points).reshape(-1, 2))
        )
        # Voices that moved the base of an ERA, with the time of their end [s].
        self._played: deque[tuple[int, Voices, float]] = deque()

    @property
    def fingers(self) -> PlateFingers:
        """The fingers, with what they have felt up to the present time."""
        self._sample_plate()
        return self._fingers

    @property
    def probes(self) -> list[Probe]:
        """The listeners beside the fingers, which have all samples up to the present time."""
        self._sample_plate()
        return self._probes

    def advance(self, now: float) -> None:
        """Advance to a time [s]; each event happens at its own time."""
        self._advance(now)
        if self.time - self._sampled_until >= _MAX_BEHIND:
            self._sample_what_is_solved()

    def _advance(self, now: float) -> None:
        """Advance the amplifiers to a time [s], and the plate with them if probes listen."""
        if now - self.time > HISTORY_DURATION and not self._probes:  # older samples are not kept
            self._sample_plate()
            self._advance_amplifiers(now - HISTORY_DURATION)
            self._sampled_until = self.time
            self._plant.skip(self.time)
        while now - self.time > _MAX_STEP:
            self._advance_amplifiers(self.time + _MAX_STEP)
            self._sample_plate()
        self._advance_amplifiers(now)
        behind = self.time - self._sampled_until
        if self._probes or behind > HISTORY_DURATION:
            self._sample_plate()
        elif behind > _MAX_STEP:
            self._sample_what_is_solved()

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Reduced shapes (p, r) at points (p, 2) [m].

        Valid until fingers that load the plate change.
        """
        return self._shapes_at(points.tobytes())

    def exchange(self, amplifier: str, name: str, values: Values, *, now: float) -> Values:
        """Return the values of an amplifier's reply to a request at a time [s]; raises Refusal."""
        if now > self.time:
            self._advance(now)
        try:
            return self.amplifiers[amplifier].handle(name, values, self.time)
        finally:
            self._update_plant()

    def place_fingers(
        self,
        positions: Mapping[str, Point],
        *,
        now: float,
        observers: Collection[str] = (),
        loads: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        """Replace the fingers by those at these positions [m]; InputError changes nothing.

        observers: fingers without weight; loads: of the others relative to the rig's fingertip, 1
        where left out.
        """
        self.begin_placing(positions, now=now, observers=observers, loads=loads)
        self._sample_plate()

    def begin_placing(
        self,
        positions: Mapping[str, Point],
        *,
        now: float,
        observers: Collection[str] = (),
        loads: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        """Replace the fingers as `place_fingers`, with the plate under them still to be solved.

        The amplifiers go on; the plate waits at this time until `unsolved` is solved or read.
        """
        self._fingers.check(positions)
        check_loads(loads.values(), highest=limits.MAX_HAND_LOAD)
        self.advance(now)
        self.observers = frozenset(observers) & positions.keys()
        self.loads = {name: load for name, load in loads.items() if name in positions}
        self.positions = dict(positions)
        before, self._contacts = self._contacts, self._contacts_at(positions)
        solve = None
        if self._contacts != before:
            solution = self._plant.solution(self._contacts, time=self.time)
            solve = partial(_tabulated, solution, self.sample_rate)
        placement = FingerPlacement(self.time, positions, self._contacts, solve)
        if len(self._placements) > 1 and placement.supersedes(*list(self._placements)[-2:]):
            self._placements.pop()
        self._placements.append(placement)

    @property
    def unsolved(self) -> FingerPlacement | None:
        """The first of the fingers that are to be placed whose plate is not solved, if any."""
        return next((one for one in self._placements if not one.is_solved), None)

    def change_plate(self, errors: PlateErrors, *, now: float) -> None:
        """Replace plate and ERAs by those of these errors, at rest; what plays drives them on.

        Raises InputError for ERAs that do not support the plate, which changes nothing.
        """
        self.advance(now)
        self._sample_plate()
        real = errors.realised(self.rig)
        plant = _plant_of(real, self.time)
        plant.set_contacts(self._plant.contacts)
        for index, playing in enumerate(self._applied_outputs):
            plant.set_input(index, self._motion(index, playing, self._clock_of(index)))
        self.imperfections = replace(self.imperfections, plate=errors)
        self.real, self._plant = real, plant
        self._shapes_at.cache_clear()
        self._fingers.place(self._fingers.layout.positions, reduced=plant.reduced)
        for sensing in self._sensing:
            sensing.changed(self.time)

    def place_sensors(self, sensors: Sequence[Accelerometer]) -> None:
        """Replace the sensors of the first amplifier beside those at its ERAs."""
        self._sensing[0].place(sensors)

    def records(self, since: float, until: float) -> tuple[dict[str, FingerRecord], list[float]]:
        """The record of each finger in a window of the last ten seconds [s], by id.

        Also the frequencies [Hz] driven in it, ascending.
        """
        self._sample_plate(until)
        present = [(index, output, math.inf) for index, output in enumerate(self._applied_outputs)]
        driven = {
            tone.frequency
            for index, output, end in [*self._played, *present]
            for tone in output
            if tone.transition.start + self._delays[index] < until
            and min(end, tone.silent_from + self._delays[index]) > since
        }
        return self._fingers.felt(since, until), sorted(driven)

    def felt(self, since: float, until: float) -> dict[str, FeltVibration]:
        """Vibration at each finger in such a window, by id."""
        records, frequencies = self.records(since, until)
        return {name: measure_vibration(record, frequencies) for name, record in records.items()}

    def _advance_amplifiers(self, to_time: float) -> None:
        amplifiers = self.amplifiers.values()
        while True:
            events = [amplifier.next_event for amplifier in amplifiers]
            moment = min([to_time, self._clocks.next_due, *events])
            self.time = max(self.time, moment)
            for amplifier, event in zip(amplifiers, events, strict=True):
                if event <= moment or amplifier.is_derated:
                    amplifier.tick(moment)
            self._update_plant()
            if moment >= to_time:
                return

    def _contacts_at(self, positions: Mapping[str, Point]) -> Mapping[str, FingertipLoad]:
        """The fingers that load the plate, and the patches of hands."""
        fingertip, size = self.rig.fingertip, (self.rig.plate.length, self.rig.plate.width)
        if fingertip is None:
            return {}
        found = dict[str, FingertipLoad]()
        for name, at in positions.items():
            if name not in self.observers:
                places, loads = with_patches([at], [self.loads.get(name, 1.0)], size)
                for number, (place, load) in enumerate(zip(places, loads, strict=True)):
                    patch = f"{name} patch {number}" if number else name
                    tip = self.imperfections.load_of(name, fingertip.under(load))
                    found[patch] = FingertipLoad(*place, tip)
        return found

    def _sample_plate(self, until: float = math.inf, *, solves: bool = True) -> None:
        """Advance the plate to a time [s] or the present one.

        solves: fingers that are unsolved by then; otherwise to the first of them.
        """
        end = min(until, self.time)
        while self._placements and self._placements[0].time <= end and not self._is_sampling:
            if not (solves or self._placements[0].is_solved):
                end = self._placements[0].time
                break
            self._place(self._placements.popleft())
        self._sample_until(end)

    def _sample_what_is_solved(self) -> None:
        """Advance the plate by a second at most, to a finger that is unsolved."""
        self._sample_plate(self._sampled_until + _MAX_STEP, solves=False)

    def _place(self, placement: FingerPlacement) -> None:
        """Advance the plate to the time of a placement, and put its fingers on it."""
        self._sample_until(placement.time)
        before = self._plant.reduced
        self._plant.set_contacts(placement.contacts, loaded=placement.solved())
        if self._plant.reduced is not before:
            self._shapes_at.cache_clear()
        self._fingers.place(placement.positions, reduced=self._plant.reduced)

    def _sample_until(self, end: float) -> None:
        """Advance the plate to a time [s], sampled if there are fingers or probes."""
        if self._sampled_until >= end or self._is_sampling:  # probes look at the fingers
            return
        self._is_sampling = True
        try:
            self._sampled_until = end
            if not (self._fingers.layout.positions or self._probes):
                self._plant.skip(end)
                return
            shapes = [self._fingers.layout.shapes, *(probe.shapes for probe in self._probes)]
            times, felt = self._plant.advance(
                end,
                sample_rate=self.sample_rate,
                shapes=np.concatenate(shapes),
                precision=np.float64 if self._probes else np.float32,  # of what fingers keep
            )
            if len(times):
                ends = np.cumsum([len(each) for each in shapes])[:-1]
                under_fingers, *others = np.split(felt, ends, axis=1)
                self._fingers.record(times, under_fingers)
                for probe, part in zip([*self._probes], others, strict=True):
                    probe.record(times, part)
        finally:
            self._is_sampling = False

    def _update_plant(self) -> None:
        """Pass on to the plant what channels play, and by which clock, after their delay."""
        renewed = self._clocks.renew(self.time)
        for index, wired in enumerate(self._wired):
            playing = self.amplifiers[wired.amplifier].outputs[wired.number]
            commanded = self._commanded[index]
            is_new = playing is not commanded and playing != commanded
            if is_new or (commanded and wired.amplifier in renewed):
                self._commanded[index] = playing
                self._apply(index, playing, self._clock_of(index))
        while self._played and self._played[0][2] < self.time - HISTORY_DURATION:
            self._played.popleft()

    def _clock_of(self, index: int) -> StraightClock:
        """The clock of the amplifier of an ERA."""
        return self._clocks.straight[self._wired[index].amplifier]

    def _apply(self, index: int, playing: Voices, clock: StraightClock) -> None:
        """Let an output move the base of an ERA by a clock, after its amplifier's delay."""
        since = self.time + self._delays[index]
        self._plant.set_input(index, self._motion(index, playing, clock), since=since)
        self._played.append((index, self._applied_outputs[index], since))
        self._applied_outputs[index] = playing

    def _motion(self, index: int, playing: Voices, clock: StraightClock) -> Motion:
        """The base motion of an ERA by the output of its channel, imperfections included."""
        stroke, delay = self.rig.eras[index].full_level, self._delays[index]
        errors = self._errors[index]
        moving = [*playing, *imperfections.of_voices(playing, errors.harmonic)]
        return realised(motion_of(moving, clock, stroke=stroke, delay=delay), errors)


def _tabulated(solve: Callable[[], LoadedPlate], sample_rate: float) -> LoadedPlate:
    """A plate with the exponentials that are needed first."""
    loaded = solve()
    loaded.exponentials(sample_rate)
    return loaded


def _plant_of(real: Rig, time: float) -> Plant:
    """The plant of a rig as it is, at rest at a time [s]."""
    reduced = _reduced(
        real.plate, real.mesh, tuple(real.eras), tuple(real.masses), real.limits.frequency_max
    )
    return Plant(reduced, real.eras, loads=real.masses, time=time)


@lru_cache(maxsize=2)  # successive benches of one rig share it
def _reduced(
    plate: Plate,
    mesh: Mesh,
    eras: tuple[Source, ...],
    loads: tuple[PointLoad, ...],
    frequency_max: float,
) -> ReducedPlate:
    points = footprints_of(eras, loads)
    return reduce_plate(plate, mesh, points, frequency_max=frequency_max)


def _feet(rig: Rig, amplifier: str) -> list[Accelerometer]:
    """A sensor at the foot of each ERA of an amplifier, in the order of its channels."""
    wired = {
        channel.number: name
        for name, channel in rig.wiring.items()
        if channel.amplifier == amplifier
    }
    return [
        Accelerometer(name, rig.era(name).x, rig.era(name).y, reach=REACH, channel=number)
        for number, name in sorted(wired.items())
    ]


def _channel_count(rig: Rig, amplifier: str) -> int:
    numbers = [channel.number for channel in rig.wiring.values() if channel.amplifier == amplifier]
    return max(numbers, default=0) + 1


async def keep_time(bench: Bench) -> None:
    """Advance the bench with time.monotonic(), one clock for all processes, until cancelled."""
    while True:
        bench.advance(threads.now())
        await asyncio.sleep(_TICK)
