"""The simulated rig: its amplifiers, its plate in the time domain, and fingers on it.

Time is passed in; only `keep_time` reads a clock. Channels drive the ERAs by the rig's wiring,
level 1 being the full stroke, with the imperfections given.
"""

import asyncio
import math
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from drivers.playing.playback import Voice
from drivers.protocol.records import Values
from model.arrays import FloatArray
from model.fem import Mesh
from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import FingertipLoad, PointLoad, Source, check_loads, footprints_of
from model.structure.plate import Plate
from model.transients.base_motion import Motion
from registry import threads
from sim.amplifier.readings import AmplifierClock, StraightClock
from sim.amplifier.simulated_amplifier import Amplifier
from sim.bench.sensing import REACH, Probe, Sensing
from sim.bench.straight_clocks import StraightClocks
from sim.plant import second_harmonic
from sim.plant.accelerometer import Accelerometer
from sim.plant.fingers import KEPT, Felt, Fingers, Position, Record, measure_vibration
from sim.plant.imperfections import Imperfections, PlateErrors, realised
from sim.plant.loaded_plates import LoadedPlate, Placement
from sim.plant.plant import SAMPLE_RATE, Plant
from sim.plant.voiced_base import motion_of

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
        sample_rate: float = SAMPLE_RATE,
        imperfections: Imperfections = Imperfections(),  # noqa: B008  frozen
    ) -> None:
        imperfections.check(rig)
        self.rig = rig
        self.sample_rate = sample_rate
        self.imperfections = imperfections
        self._probes: list[Probe] = []
        self.time = now
        """The present time [s]."""
        # Behind the amplifiers, and advanced in few large steps: nothing acts back on them.
        self._plant = _plant_of(imperfections.plate.realised(rig), now)
        self._sampled_until = now  # up to when [s] fingers and probes have samples
        self._fingers = Fingers(self._plant.reduced)
        self._is_sampling = False
        # Fingers that are not on the plate in time yet; the newest, and those that load the plate.
        self._placements: deque[Placement] = deque()
        self.positions: Mapping[str, Position] = {}
        self._contacts: Mapping[str, FingertipLoad] = {}
        self.observers: frozenset[str] = frozenset()  # fingers without weight
        self.loads: Mapping[str, float] = {}  # by finger, relative to the rig's fingertip
        self.amplifiers: Mapping[str, Amplifier] = {
            name: Amplifier(
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
            Sensing(self, amplifier, _feet(rig, name), seed=number)
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
    def fingers(self) -> Fingers:
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
        if now - self.time > KEPT and not self._probes:  # older samples are not kept
            self._sample_plate()
            self._advance_amplifiers(now - KEPT)
            self._sampled_until = self.time
            self._plant.skip(self.time)
        while now - self.time > _MAX_STEP:
            self._advance_amplifiers(self.time + _MAX_STEP)
            self._sample_plate()
        self._advance_amplifiers(now)
        behind = self.time - self._sampled_until
        if self._probes or behind > KEPT:
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
        positions: Mapping[str, Position],
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
        positions: Mapping[str, Position],
        *,
        now: float,
        observers: Collection[str] = (),
        loads: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        """Replace the fingers as `place_fingers`, with the plate under them still to be solved.

        The amplifiers go on; the plate waits at this time until `unsolved` is solved or read.
        """
        self._fingers.check(positions)
        check_loads(loads.values())
        self.advance(now)
        self.observers = frozenset(observers) & positions.keys()
        self.loads = {name: load for name, load in loads.items() if name in positions}
        self.positions = dict(positions)
        before, self._contacts = self._contacts, self._contacts_at(positions)
        solve = None
        if self._contacts != before:
            solution = self._plant.solution(self._contacts, time=self.time)
            solve = partial(_tabulated, solution, self.sample_rate)
        placement = Placement(self.time, positions, self._contacts, solve)
        if len(self._placements) > 1 and placement.supersedes(*list(self._placements)[-2:]):
            self._placements.pop()
        self._placements.append(placement)

    @property
    def unsolved(self) -> Placement | None:
        """The first of the fingers that are to be placed whose plate is not solved, if any."""
        return next((one for one in self._placements if not one.is_solved), None)

    def change_plate(self, errors: PlateErrors, *, now: float) -> None:
        """Replace plate and ERAs by those of these errors, at rest; what plays drives them on.

        Raises InputError for ERAs that do not support the plate, which changes nothing.
        """
        self.advance(now)
        self._sample_plate()
        plant = _plant_of(errors.realised(self.rig), self.time)
        plant.set_contacts(self._plant.contacts)
        for index, playing in enumerate(self._applied_outputs):
            plant.set_input(index, self._motion(index, playing, self._clock_of(index)))
        self.imperfections = replace(self.imperfections, plate=errors)
        self._plant = plant
        self._shapes_at.cache_clear()
        self._fingers.place(self._fingers.layout.positions, reduced=plant.reduced)
        for sensing in self._sensing:
            sensing.changed(self.time)

    def place_sensors(self, sensors: Sequence[Accelerometer]) -> None:
        """Replace the sensors of the first amplifier beside those at its ERAs."""
        self._sensing[0].place(sensors)

    def records(self, since: float, until: float) -> tuple[dict[str, Record], list[float]]:
        """The record of each finger in a window of the last ten seconds [s], by id.

        Also the frequencies [Hz] driven in it, ascending.
        """
        self._sample_plate(until)
        return self._fingers.felt(since, until), self._frequencies(since, until)

    def felt(self, since: float, until: float) -> dict[str, Felt]:
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

    def _contacts_at(self, positions: Mapping[str, Position]) -> Mapping[str, FingertipLoad]:
        """The fingers that load the plate."""
        fingertip = self.rig.fingertip
        if fingertip is None:
            return {}
        return {
            name: FingertipLoad(
                *at,
                self.imperfections.load_of(name, fingertip.scaled(self.loads.get(name, 1.0))),
            )
            for name, at in positions.items()
            if name not in self.observers
        }

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

    def _place(self, placement: Placement) -> None:
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
            self._sample(end)
        finally:
            self._is_sampling = False

    def _sample(self, end: float) -> None:
        if not (self._fingers.layout.positions or self._probes):
            self._plant.skip(end)
            return
        shapes = self._listening()
        times, accelerations = self._plant.advance(
            end,
            sample_rate=self.sample_rate,
            shapes=np.concatenate(shapes),
            precision=np.float64 if self._probes else np.float32,  # of what is kept of fingers
        )
        self._pass_on(times, accelerations, shapes)

    def _listening(self) -> list[FloatArray]:
        """Shapes of the fingers, then of each probe."""
        return [self._fingers.layout.shapes, *(probe.shapes for probe in self._probes)]

    def _pass_on(self, times: FloatArray, felt: FloatArray, shapes: Sequence[FloatArray]) -> None:
        """Hand samples at these shapes over to the fingers and to each probe, if there are any."""
        if not len(times):
            return
        ends = np.cumsum([len(each) for each in shapes])[:-1]
        under_fingers, *others = np.split(felt, ends, axis=1)
        self._fingers.record(times, under_fingers)
        for probe, part in zip([*self._probes], others, strict=True):
            probe.record(times, part)

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
        while self._played and self._played[0][2] < self.time - KEPT:
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
        moving = [*playing, *second_harmonic.of_voices(playing, errors.harmonic)]
        return realised(motion_of(moving, clock, stroke=stroke, delay=delay), errors)

    def _frequencies(self, since: float, until: float) -> list[float]:
        """The frequencies [Hz] at which bases were moved by commands in a window."""
        present = [(index, output, math.inf) for index, output in enumerate(self._applied_outputs)]
        return sorted(
            {
                tone.frequency
                for index, output, end in [*self._played, *present]
                for tone in output
                if tone.transition.start + self._delays[index] < until
                and min(end, tone.silent_from + self._delays[index]) > since
            }
        )


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
