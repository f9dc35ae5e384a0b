"""The plate in the time domain, advanced from one change of drive or contacts to the next.

There is no step size. Between changes the motion is a sum of free vibrations, which decay, and of
forced ones (`model.transients.plate_in_time`); every change adds free vibrations that keep
displacement and velocity continuous.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.reduction.reduced_plate import ReducedPlate
from model.structure.attachments import PointLoad
from model.structure.fingertips import FingertipLoad
from model.structure.sources import Source
from model.transients.base_motion import BaseMotions, Motion
from model.transients.plate_in_time import ForcedVibration
from sim.plant.loaded_plate import (
    LoadedPlate,
    LoadedPlateCache,
    PlateUnderContacts,
    carried_state,
)
from sim.plant.plate_sampler import Sampler

PLANT_SAMPLE_RATE = 10_000.0
"""Default sampling rate [Hz]: peaks at 500 Hz are sampled to within 1.3 %."""

_MAX_JOINT = 8  # changes of the drive that are solved together


@dataclass(frozen=True, slots=True)
class _Change:
    """A change of the drive at a time [s] to the terms of a set of motions that move then.

    is_input: whether that set begins.
    """

    time: float
    set_number: int
    is_input: bool


@dataclass(frozen=True, slots=True)
class _Stretch:
    """Vibration up to a time [s], between changes of the drive.

    includes_end: whether a sample at its end belongs to it; free (m,): amplitude of each free
    vibration at the time of the forced one; solution: index of the forced vibration's solution.
    """

    end: float
    includes_end: bool
    free: ComplexArray
    forced: ForcedVibration
    solution: int


class Plant:
    """A reduced plate on its ERAs with loads, at rest at `time` [s].

    loaded: the plate under the present contacts; contacts: by id of the finger. Raises InputError
    for ERAs that do not support the plate.
    """

    def __init__(
        self,
        reduced: ReducedPlate,
        eras: Sequence[Source],
        *,
        loads: Sequence[PointLoad] = (),
        time: float = 0.0,
    ) -> None:
        self.time = time
        self.contacts: Mapping[str, FingertipLoad] = {}
        self._plates = LoadedPlateCache(reduced, eras, loads)
        self.loaded: LoadedPlate = self._plates.solution((), time=time)()
        # The motion of each ERA's base, and later motions by start time [s] and ERA.
        self._inputs: list[Motion] = [()] * len(eras)
        self._scheduled: dict[float, dict[int, Motion]] = {}
        # Sets of motions that are solved together, and the index of the present set.
        self._motions = BaseMotions(self._inputs)
        self._set = 0
        # Forced vibrations for changes that are solved together, and the index of the present one.
        self._forced = self.loaded.plate.driven(self._motions, [0], [time])
        self._solution = 0
        # Amplitude of each free vibration at the time of the present solution.
        self._free = np.zeros(len(self.loaded.plate.decay), dtype=complex)
        # Sampler of the present contacts; None until the first sample.
        self._sampler: Sampler | None = None

    @property
    def reduced(self) -> ReducedPlate:
        """The plate in its present coordinates, which depend on the contacts."""
        return self.loaded.reduced

    def set_input(self, era: int, motion: Motion, *, since: float | None = None) -> None:
        """Set the base motion of an ERA after a time [s], by default the present one.

        Its parts may start later.
        """
        moment = self.time if since is None else max(since, self.time)
        self._scheduled.setdefault(moment, {})[era] = tuple(motion)

    def solution(
        self, contacts: Mapping[str, FingertipLoad], *, time: float
    ) -> Callable[[], LoadedPlate]:
        """Return a function that solves the plate under the contacts from a time [s] on.

        The function may run in any thread. Calls of this method and of `set_contacts` must be in
        order of time.
        """
        return self._plates.solution(tuple(contacts.values()), time=time)

    def set_contacts(
        self, contacts: Mapping[str, FingertipLoad], *, loaded: LoadedPlate | None = None
    ) -> None:
        """Replace the contacts, by id of the finger; a new finger's phalanx is at rest.

        loaded: the plate under them, if it is solved already.

        Displacement and velocity of the plate, and of the phalanges of fingers that stay, are
        continuous; energy in pulp, masses and joint of a finger comes and goes with it.
        """
        if contacts == self.contacts:
            return
        old = PlateUnderContacts(self.loaded, self.contacts)
        state = np.concatenate(self.state)
        new_loaded = loaded or self.solution(contacts, time=self.time)()
        new = PlateUnderContacts(new_loaded, contacts)
        self.loaded = new_loaded
        self.contacts = dict(contacts)
        self._forced = new_loaded.plate.driven(self._motions, [self._set], [self.time])
        self._solution = 0
        free_state = carried_state(state, old, new) - self._forced.state(0, self.time)
        self._free = new_loaded.plate.to_free @ free_state
        self._sampler = None

    def advance(
        self,
        to_time: float,
        *,
        sample_rate: float,
        shapes: FloatArray,
        precision: type[np.floating] = np.float64,
    ) -> tuple[FloatArray, FloatArray]:
        """Advance to a time [s]; returns times (n,) [s] and accelerations (n, p) [m/s²].

        shapes (p, r): of `reduced` at the points. Samples lie on the grid k / sample_rate [Hz],
        after the present time up to and including to_time. precision: of the accelerations, double,
        or single, which is quicker, to 1e-6 of their peak.
        """
        first = np.floor(self.time * sample_rate) + 1
        last = np.floor(to_time * sample_rate)
        times = np.arange(first, last + 1) / sample_rate
        shapes = self.loaded.plate.with_far_ends(shapes)
        point_count, coordinate_count = shapes.shape
        if point_count < 2 * coordinate_count:  # few points are sampled directly
            sampler = self._sampler_at(shapes, sample_rate, precision)
            return times, self._samples(sampler, times, int(first), to_time)
        # Many points are sampled by way of the coordinates.
        sampler = self._sampler_at(np.eye(coordinate_count), sample_rate, np.float64)
        coordinates = self._samples(sampler, times, int(first), to_time)
        return times, (coordinates @ shapes.T).astype(precision, copy=False)

    def _samples(
        self, sampler: Sampler, times: FloatArray, first: int, to_time: float
    ) -> FloatArray:
        """Advance to a time [s]; returns the samples at times (n,) [s]; first: k of the first."""
        samples = np.empty((len(times), len(sampler.points)), dtype=sampler.precision)
        begin = 0
        for stretch in self._advance(to_time):
            # A term moves the base from its start on, an input after the moment it is set, which
            # is rounded to the grid as to_time is.
            if stretch.includes_end:
                end = math.floor(stretch.end * sampler.sample_rate) - first + 1
            else:
                end = int(np.searchsorted(times, stretch.end))
            if end > begin:
                sampler.sample(
                    times[begin:end],
                    samples[begin:end],
                    free=stretch.free,
                    forced=stretch.forced,
                    solution=stretch.solution,
                )
                begin = end
        return samples

    def skip(self, to_time: float) -> None:
        """Advance to a time [s] without sampling."""
        if to_time > self.time:
            self._advance(to_time)

    def _sampler_at(
        self, points: FloatArray, sample_rate: float, precision: type[np.floating]
    ) -> Sampler:
        """The present sampler if it suits the points, rate and precision; otherwise a new one."""
        sampler = self._sampler
        if (
            sampler is None
            or sampler.sample_rate != sample_rate
            or sampler.precision is not precision
            or not np.array_equal(sampler.points, points)
        ):
            sampler = Sampler(self.loaded, points, sample_rate=sample_rate, precision=precision)
            self._sampler = sampler
        return sampler

    @property
    def state(self) -> tuple[FloatArray, FloatArray]:
        """Present displacement and velocity, (r + m + n,) each.

        Of the coordinates of `reduced`, then of free magnets and of each contact's phalanx [m],
        [m/s].
        """
        self._advance(self.time)
        plate = self.loaded.plate
        elapsed = self.time - self._forced.times[self._solution]
        free = self._free * np.exp(plate.decay * elapsed)
        forced_state = self._forced.state(self._solution, self.time)
        state = (plate.free_state @ free).real + forced_state
        count = len(state) // 2
        return state[:count], state[count:]

    def _advance(self, to_time: float) -> list[_Stretch]:
        """Advance to a time [s]; return the stretches between changes of the drive."""
        stretches: list[_Stretch] = []
        moments = sorted([moment for moment in self._scheduled if moment <= to_time])
        for until in (*moments[_MAX_JOINT - 1 :: _MAX_JOINT], to_time):
            changes = self._next_changes(until)
            for start in range(0, len(changes), _MAX_JOINT):
                self._cross(changes[start : start + _MAX_JOINT], stretches)
            stretches.append(self._end_stretch(until, includes_end=True))
        return stretches

    def _next_changes(self, until: float) -> list[_Change]:
        """Changes of the drive up to a time [s], in order."""
        sets = [self._inputs]
        begins = [self.time]
        for moment in sorted([moment for moment in self._scheduled if moment <= until]):
            motions = self._scheduled.pop(moment)
            if any(self._inputs[era] != motion for era, motion in motions.items()):
                self._inputs = self._inputs.copy()
                for era, motion in motions.items():
                    self._inputs[era] = motion
                sets.append(self._inputs)
                begins.append(moment)
        if len(sets) > 1:
            self._motions = BaseMotions(*sets, since=self.time)
            self._set = 0
        changes: list[_Change] = []
        for begin, end in pairwise([*begins, until]):
            for moment in self._motions.moments(self._set, begin, end):
                changes.append(_Change(moment, self._set, is_input=False))
            if self._set + 1 < len(sets):
                self._set += 1
                changes.append(_Change(end, self._set, is_input=True))
        return changes

    def _cross(self, changes: Sequence[_Change], stretches: list[_Stretch]) -> None:
        """Advance to the last of a few changes; displacement and velocity stay continuous."""
        count = len(changes)
        times = [change.time for change in changes]
        set_numbers = [change.set_number for change in changes]
        plate = self.loaded.plate
        forced = plate.driven(self._motions, set_numbers, times)
        # In one call: every new solution at its begin, and all but the last at their ends.
        solutions = list(range(count))
        states = forced.as_free(solutions + solutions[:-1], times + times[1:])
        present_end = self._forced.as_free([self._solution], times[:1])
        states_before = np.concatenate([present_end, states[count:]])
        jumps = states_before - states[:count]
        begins = [self._forced.times[self._solution], *times[:-1]]
        durations = np.subtract(times, begins)
        decays = np.exp(durations[:, None] * plate.decay)
        for number, change in enumerate(changes):
            stretches.append(self._end_stretch(change.time, includes_end=change.is_input))
            self._free = self._free * decays[number] + jumps[number]
            self._forced = forced
            self._solution = number

    def _end_stretch(self, end: float, *, includes_end: bool) -> _Stretch:
        """Advance to the end of a stretch."""
        self.time = end
        return _Stretch(end, includes_end, self._free, self._forced, self._solution)
