"""The simulated rig: amplifiers and fingers on one plate in the time domain.

Time is passed in; only `keep_time` reads a clock. Channels drive the ERAs according to the rig's
wiring, with the given imperfections; level 1 is the full stroke.

The plate is solved again whenever the motion of a base changes, and a host changes the rate of an
amplifier's clock with every Ping. The plate therefore uses a straight clock for each amplifier
until it differs by `WRONG` from the amplifier's own clock.
"""

import asyncio
import math
from collections import deque
from collections.abc import Callable, Collection, Mapping
from functools import lru_cache, partial
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from drivers.playing import Voice
from drivers.protocol.definition import CLOCK_TURN
from drivers.protocol.records import Values
from model.arrays import Point
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
from sim.amplifier.amplifier_clock import AmplifierClock, StraightClock
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.plant.era_motions import harmonics_of_voices, motion_of, realised
from sim.plant.finger_placement import FingerPlacement
from sim.plant.fingers import (
    HISTORY_DURATION,
    FeltVibration,
    FingerRecord,
    PlateFingers,
    measure_vibration,
)
from sim.plant.imperfections import Imperfections
from sim.plant.loaded_plate import LoadedPlate
from sim.plant.plant import PLANT_SAMPLE_RATE, Plant

WRONG = 0.5e-6
"""Largest error of a clock of the plate [s], 0.1 degrees at 500 Hz; then it is replaced."""

_SOON = 0.05  # s; a clock wrong within this time has a new rate, not a corrected one
_ALIKE = 10e-6  # of a pace; tolerance of rates that a host derives from inexact readings
_DRIFT = 0.1e-6  # s; tolerance for the warm-up of a crystal


class StraightClocks:
    """Straight approximations of amplifier clocks by name, valid at a time [s]."""

    def __init__(self, clocks: Mapping[str, AmplifierClock], *, time: float) -> None:
        self._clocks = clocks
        self.straight = {name: clock.straight(time) for name, clock in clocks.items()}
        """Current clocks by name."""
        self._due = dict.fromkeys(clocks, time)
        self._changes = dict.fromkeys(clocks, 0)
        self.renew(time)

    @property
    def next_due(self) -> float:
        """Time [s] of the next check of a clock."""
        return min(self._due.values())

    def renew(self, time: float) -> list[str]:
        """Replace clocks that are no longer valid at a time [s]; return their names."""
        renewed = []
        for name, clock in self._clocks.items():
            if time < self._due[name] and self._changes[name] == clock.changes:
                continue
            self._changes[name] = clock.changes
            now = clock.straight(time)
            lasts = _lasts(self.straight[name], now)
            if lasts < _SOON:
                known = self.straight[name]
                # The mean pace since the previous replacement, if it is similar.
                mean = known.pace + _behind(known, now) / max(now.time - known.time, _SOON)
                self.straight[name] = (
                    now._replace(pace=mean) if abs(mean - now.pace) < _ALIKE else now
                )
                lasts = _lasts(self.straight[name], now)
                renewed.append(name)
            self._due[name] = time + min(lasts / 2, clock.steady(time, _DRIFT))
        return renewed


def _lasts(known: StraightClock, now: StraightClock) -> float:
    """Return how long [s] a clock remains accurate, negative if it is wrong."""
    drift, left = abs(now.pace - known.pace), WRONG - abs(_behind(known, now))
    return left / drift if drift else math.copysign(math.inf, left)


def _behind(known: StraightClock, now: StraightClock) -> float:
    """Return the lag of a clock behind the current one [s]."""
    return math.remainder(now.shown - known.at(now.time), CLOCK_TURN)


_TICK = 0.01  # s; of `keep_time`
_MAX_BEHIND = 0.1  # s; lag of the plate behind the amplifiers
_MAX_STEP = 1.0  # s; sampled in one step

Voices: TypeAlias = tuple[Voice, ...]
"""Voices of a channel."""


class Bench:
    """A simulated rig at rest at time now [s]; sample_rate [Hz]: of fingers.

    Fingers load the plate like the rig's fingertip. imperfections: differences between bench and
    rig. Raises InputError for unknown channels.
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
        """The rig with the errors of plate and ERAs, and its feet."""
        self.time = now
        """Current time [s]."""
        # Lags behind the amplifiers, in few large steps: nothing acts back on them.
        self._plant = _plant_of(self.real, now)
        self._sampled_until = now  # up to when [s] fingers have samples
        self._fingers = PlateFingers(self._plant.reduced)
        # Fingers not yet on the plate; the newest placement, and the placement that loads the
        # plate.
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
        # By ERA: voices of its channel, and those moving its base after the amplifier's delay.
        self._wired = [rig.wiring[era.name] for era in rig.eras]
        self._commanded: list[Voices] = [()] * len(rig.eras)
        self._applied_outputs: list[Voices] = [()] * len(rig.eras)
        self._delays = [imperfections.delays.get(one.amplifier, 0.0) for one in self._wired]
        self._errors = [imperfections.errors_of(era.name, rig) for era in rig.eras]
        # Voices that moved the base of an ERA, with the time of their end [s].
        self._played: deque[tuple[int, Voices, float]] = deque()

    @property
    def fingers(self) -> PlateFingers:
        """The fingers, with their vibration up to the current time."""
        self._sample_plate()
        return self._fingers

    def advance(self, now: float) -> None:
        """Advance to a time [s]; each event happens at its own time."""
        self._advance(now)
        if self.time - self._sampled_until >= _MAX_BEHIND:
            self._sample_what_is_solved()

    def _advance(self, now: float) -> None:
        """Advance the amplifiers to a time [s]; the plate may stay behind."""
        if now - self.time > HISTORY_DURATION:  # older samples are not kept
            self._sample_plate()
            self._advance_amplifiers(now - HISTORY_DURATION)
            self._sampled_until = self.time
            self._plant.skip(self.time)
        while now - self.time > _MAX_STEP:
            self._advance_amplifiers(self.time + _MAX_STEP)
            self._sample_plate()
        self._advance_amplifiers(now)
        behind = self.time - self._sampled_until
        if behind > HISTORY_DURATION:
            self._sample_plate()
        elif behind > _MAX_STEP:
            self._sample_what_is_solved()

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
        """The first pending placement of fingers without a solved plate, if any."""
        return next((one for one in self._placements if not one.is_solved), None)

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
        """Advance the plate to a time [s] or the current one.

        solves: whether to solve unsolved placements; otherwise stops at the first unsolved one.
        """
        end = min(until, self.time)
        while self._placements and self._placements[0].time <= end:
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
        self._plant.set_contacts(placement.contacts, loaded=placement.solved())
        self._fingers.place(placement.positions, reduced=self._plant.reduced)

    def _sample_until(self, end: float) -> None:
        """Advance the plate to a time [s], sampled if there are fingers."""
        if self._sampled_until >= end:
            return
        self._sampled_until = end
        layout = self._fingers.layout
        if not layout.positions:
            self._plant.skip(end)
            return
        times, accelerations = self._plant.advance(
            end, sample_rate=self.sample_rate, shapes=layout.shapes, precision=np.float32
        )
        if len(times):
            self._fingers.record(times, accelerations)

    def _update_plant(self) -> None:
        """Pass the voices of channels and their clocks to the plant, after their delay."""
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
        moving = [*playing, *harmonics_of_voices(playing, errors.harmonic)]
        return realised(motion_of(moving, clock, stroke=stroke, delay=delay), errors)


def _tabulated(solve: Callable[[], LoadedPlate], sample_rate: float) -> LoadedPlate:
    """A plate with the exponentials that are needed first."""
    loaded = solve()
    loaded.exponentials(sample_rate)
    return loaded


def _plant_of(real: Rig, time: float) -> Plant:
    """The plant of a real rig, at rest at a time [s]."""
    reduced = _reduced(
        real.plate, real.mesh, tuple(real.eras), tuple(real.masses), real.limits.frequency_max
    )
    return Plant(reduced, real.eras, loads=real.masses, time=time)


@lru_cache(maxsize=2)  # shared by successive benches of the same rig
def _reduced(
    plate: Plate,
    mesh: Mesh,
    eras: tuple[Source, ...],
    loads: tuple[PointLoad, ...],
    frequency_max: float,
) -> ReducedPlate:
    points = footprints_of(eras, loads)
    return reduce_plate(plate, mesh, points, frequency_max=frequency_max)


def _channel_count(rig: Rig, amplifier: str) -> int:
    numbers = [channel.number for channel in rig.wiring.values() if channel.amplifier == amplifier]
    return max(numbers, default=0) + 1


async def keep_time(bench: Bench) -> None:
    """Advance the bench with time.monotonic(), one clock for all processes, until cancelled."""
    while True:
        bench.advance(threads.now())
        await asyncio.sleep(_TICK)
