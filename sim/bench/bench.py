"""The simulated rig: amplifiers and fingers on one plate in the time domain.

Time is passed in; only `keep_time` reads a clock. Channels drive the ERAs according to the rig's
wiring, with the given imperfections; level 1 is the full stroke.
"""

import asyncio
import math
from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from drivers.protocol.records import Values
from drivers.voices import Voice
from model.arrays import Point
from model.fem import Mesh
from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import PointLoad, footprints_of
from model.structure.fingertips import FingertipLoad, check_loads, with_patches
from model.structure.plate import Plate
from model.structure.sources import Source
from model.transients.base_motion import Motion
from registry import limits, threads
from sim.amplifier.amplifier_clock import AmplifierClock, StraightClock
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.bench.straight_clocks import StraightClocks
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

_TICK = 0.01  # s; of `keep_time`
_MAX_BEHIND = 0.1  # s; lag of the plate behind the amplifiers
_MAX_STEP = 1.0  # s; sampled in one step

Voices: TypeAlias = tuple[Voice, ...]
"""Voices of a channel."""


@dataclass(frozen=True, slots=True)
class _Output:
    """Voices that move the base of an ERA by index, until a time [s]."""

    era: int
    voices: Voices
    end: float


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
        # The plate lags behind the amplifiers, in few large steps: it does not act back on them.
        self._plant = _plant_of(self.real, now)
        self._sampled_until = now  # time [s] up to which fingers have samples
        self._fingers = PlateFingers(self._plant.reduced)
        self._placements: deque[FingerPlacement] = deque()  # not yet on the plate
        # Of the newest placement: positions and contacts of its fingers.
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
        # By ERA: its channel, the voices of the channel, and the voices that move its base, which
        # follow after the amplifier's delay.
        self._wired = [rig.wiring[era.name] for era in rig.eras]
        self._commanded: list[Voices] = [()] * len(rig.eras)
        self._applied_outputs: list[Voices] = [()] * len(rig.eras)
        self._delays = [imperfections.delays.get(channel.amplifier, 0.0) for channel in self._wired]
        self._errors = [imperfections.errors_of(era.name, rig) for era in rig.eras]
        self._ended_outputs: deque[_Output] = deque()

    def sample_fingers(self) -> PlateFingers:
        """Advance the plate to the current time; returns the fingers with their vibration."""
        self._sample_plate()
        return self._fingers

    def advance(self, now: float) -> None:
        """Advance to a time [s]; each event happens at its own time."""
        self._advance(now)
        if self.time - self._sampled_until >= _MAX_BEHIND:
            self._sample_what_is_solved()

    def change(self, now: float, change: Callable[[], object]) -> None:
        """Advance to a time [s], call a function that changes amplifiers, and move the plate."""
        self.advance(now)
        change()
        self.advance(now)

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

        observers: fingers without weight; loads: of other fingers relative to the rig's fingertip,
        by default 1.
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
        """Replace the fingers like `place_fingers`, but do not solve the plate under them yet.

        The amplifiers go on; the plate waits at this time until `unsolved` is solved or read.
        """
        self._fingers.check(positions)
        check_loads(loads.values(), highest=limits.MAX_HAND_LOAD)
        self.advance(now)
        self.observers = frozenset(observers) & positions.keys()
        self.loads = {name: load for name, load in loads.items() if name in positions}
        self.positions = dict(positions)
        contacts = self._contacts_at(positions)
        solve = None
        if contacts != self._contacts:
            solution = self._plant.solution(contacts, time=self.time)
            solve = partial(_tabulated, solution, self.sample_rate)
        self._contacts = contacts
        placement = FingerPlacement(self.time, positions, self._contacts, solve)
        if len(self._placements) > 1 and placement.supersedes(*list(self._placements)[-2:]):
            self._placements.pop()
        self._placements.append(placement)

    @property
    def unsolved(self) -> FingerPlacement | None:
        """The first pending placement of fingers without a solved plate, if any."""
        for placement in self._placements:
            if not placement.is_solved:
                return placement
        return None

    def records(self, since: float, until: float) -> tuple[dict[str, FingerRecord], list[float]]:
        """The record of each finger in a window of the last ten seconds [s], by id.

        Also the frequencies [Hz] driven in it, ascending.
        """
        self._sample_plate(until)
        return self._fingers.felt(since, until), self._driven_frequencies(since, until)

    def _driven_frequencies(self, since: float, until: float) -> list[float]:
        """Frequencies [Hz] that drive an ERA in a window [s], ascending."""
        outputs = list(self._ended_outputs)
        for era, voices in enumerate(self._applied_outputs):
            outputs.append(_Output(era, voices, math.inf))
        frequencies: set[float] = set()
        for output in outputs:
            delay = self._delays[output.era]
            for voice in output.voices:
                begin = voice.transition.start + delay
                end = min(output.end, voice.silent_from + delay)
                if begin < until and end > since:
                    frequencies.add(voice.frequency)
        return sorted(frequencies)

    def felt(self, since: float, until: float) -> dict[str, FeltVibration]:
        """Vibration at each finger in a window of the last ten seconds [s], by id."""
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
        fingertip = self.rig.fingertip
        if fingertip is None:
            return {}
        contacts: dict[str, FingertipLoad] = {}
        plate_size = (self.rig.plate.length, self.rig.plate.width)
        for name, position in positions.items():
            if name in self.observers:
                continue
            load = self.loads.get(name, 1.0)
            patch_positions, patch_loads = with_patches([position], [load], plate_size)
            patches = zip(patch_positions, patch_loads, strict=True)
            for number, (patch_position, patch_load) in enumerate(patches):
                key = f"{name} patch {number}" if number else name
                loading = self.imperfections.load_of(name, fingertip.under(patch_load))
                contacts[key] = FingertipLoad(*patch_position, loading)
        return contacts

    def _sample_plate(self, until: float = math.inf, *, solves: bool = True) -> None:
        """Advance the plate to a time [s], at most to the current time.

        solves: whether to solve unsolved placements; otherwise stop at the first of them.
        """
        end = min(until, self.time)
        while self._placements and self._placements[0].time <= end:
            placement = self._placements[0]
            if not (solves or placement.is_solved):
                end = placement.time
                break
            self._placements.popleft()
            self._place(placement)
        self._sample_until(end)

    def _sample_what_is_solved(self) -> None:
        """Advance the plate by a second at most, up to a placement that is unsolved."""
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
        for era, channel in enumerate(self._wired):
            voices = self.amplifiers[channel.amplifier].outputs[channel.number]
            commanded = self._commanded[era]
            is_new = voices is not commanded and voices != commanded
            if is_new or (commanded and channel.amplifier in renewed):
                self._commanded[era] = voices
                self._apply(era, voices, self._clocks.straight[channel.amplifier])
        oldest = self.time - HISTORY_DURATION
        while self._ended_outputs and self._ended_outputs[0].end < oldest:
            self._ended_outputs.popleft()

    def _apply(self, era: int, voices: Voices, clock: StraightClock) -> None:
        """Let voices move the base of an ERA according to a clock, after its amplifier's delay."""
        since = self.time + self._delays[era]
        self._plant.set_input(era, self._motion(era, voices, clock), since=since)
        self._ended_outputs.append(_Output(era, self._applied_outputs[era], since))
        self._applied_outputs[era] = voices

    def _motion(self, era: int, voices: Voices, clock: StraightClock) -> Motion:
        """The base motion of an ERA due to the voices of its channel, with imperfections."""
        stroke = self.rig.eras[era].full_level
        delay = self._delays[era]
        errors = self._errors[era]
        all_voices = [*voices, *harmonics_of_voices(voices, errors.harmonic)]
        return realised(motion_of(all_voices, clock, stroke=stroke, delay=delay), errors)


def _tabulated(solve: Callable[[], LoadedPlate], sample_rate: float) -> LoadedPlate:
    """The solved plate, with the exponentials that its first samples need."""
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
