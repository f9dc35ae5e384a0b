"""The plate in the time domain, advanced from one change of drive or contacts to the next.

The exact solutions are those of `model.transients.time_response`; the plant adds the clock, the
present base motion, and the free vibration that remains after each change.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.reduction.reduced_plate import ReducedPlate
from model.structure.attachments import FingertipLoad, PointLoad, Source
from model.transients.base_motion import BaseMotions, Motion
from model.transients.time_response import ForcedVibration
from sim.plant.loaded_plates import LoadedPlate, LoadedPlateCache, carried_state
from sim.plant.sampler import Sampler

SAMPLE_RATE = 10_000.0
"""Default sampling rate [Hz]: peaks at 500 Hz are sampled to within 1.3 %."""

_AT_ONCE = 8  # changes of the drive that are solved together


class _Change(NamedTuple):
    """A change of the drive at a time [s] to the terms of a set of motions that move then.

    is_input: whether that set begins.
    """

    time: float
    set_number: int
    is_input: bool


class _Stretch(NamedTuple):
    """Vibration up to a time [s], between changes of the drive.

    includes_end: whether a sample at its end belongs to it; free (m,): amplitude of each free
    vibration at the time of the forced one, which is a solution by its number.
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
        self._plates = LoadedPlateCache(reduced, eras, loads)
        self.loaded: LoadedPlate = self._plates.solution((), time=time)()
        self.contacts: Mapping[str, FingertipLoad] = {}
        # Amplitude of each free vibration at the time of the present solution.
        self._free = np.zeros(len(self.loaded.plate.decay), dtype=complex)
        # The motion of each ERA's base; those that follow, by time [s] and ERA.
        self._inputs: list[Motion] = [()] * len(eras)
        self._scheduled: dict[float, dict[int, Motion]] = {}
        # The sets of motions and the solutions that were found together, and the present ones.
        self._motions = BaseMotions(self._inputs)
        self._set = 0
        self._forced = self.loaded.plate.driven(self._motions, [0], [time])
        self._solution = 0
        self._sampler: Sampler | None = None  # until the contacts change

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
        """What solves the plate under the contacts from a time [s] on, in any thread.

        Calls must be in order of time, also with those of `set_contacts`.
        """
        return self._plates.solution(tuple(contacts.values()), time=time)

    def set_contacts(
        self, contacts: Mapping[str, FingertipLoad], *, loaded: LoadedPlate | None = None
    ) -> None:
        """Replace the contacts, by id of the finger; a new finger's phalanx is at rest.

        loaded: the plate under them, where it is solved already.

        Displacement and velocity of the plate, and of the phalanges of fingers that stay, are
        continuous; energy in pulp, masses and joint of a finger comes and goes with it.
        """
        if contacts == self.contacts:
            return
        before = self.loaded, self.contacts
        state = np.concatenate(self.state)
        self.loaded = loaded or self.solution(contacts, time=self.time)()
        self.contacts = dict(contacts)
        remainder = carried_state(state, before, (self.loaded, contacts))
        self._forced = self.loaded.plate.driven(self._motions, [self._set], [self.time])
        self._solution = 0
        self._free = self.loaded.plate.to_free @ (remainder - self._forced.state(0, self.time))
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
        # Few points are sampled directly, many by way of the coordinates.
        is_direct = len(shapes) < 2 * shapes.shape[1]
        points = shapes if is_direct else np.eye(shapes.shape[1])
        sampler = self._sampler_at(points, sample_rate, precision if is_direct else np.float64)
        samples = np.empty((len(times), len(points)), dtype=sampler.precision)
        done = 0
        for each in self._advance(to_time):
            # A term moves the base from its start on, an input after the moment it is set, which
            # is rounded to the grid as to_time is.
            if each.includes_end:
                upto = math.floor(each.end * sample_rate) - int(first) + 1
            else:
                upto = int(np.searchsorted(times, each.end))
            if upto > done:
                sampler.sample(
                    times[done:upto],
                    samples[done:upto],
                    free=each.free,
                    forced=each.forced,
                    solution=each.solution,
                )
                done = upto
        return times, samples if is_direct else (samples @ shapes.T).astype(precision, copy=False)

    def skip(self, to_time: float) -> None:
        """Advance to a time [s] without sampling."""
        if to_time > self.time:
            self._advance(to_time)

    def _sampler_at(
        self, points: FloatArray, sample_rate: float, precision: type[np.floating]
    ) -> Sampler:
        """The sampler that is kept, or another for other points, another rate or precision."""
        kept = self._sampler
        if (
            kept is None
            or kept.sample_rate != sample_rate
            or kept.precision is not precision
            or not np.array_equal(kept.points, points)
        ):
            kept = self._sampler = Sampler(
                self.loaded, points, sample_rate=sample_rate, precision=precision
            )
        return kept

    @property
    def state(self) -> tuple[FloatArray, FloatArray]:
        """Present displacement and velocity, (r + m + n,) each.

        Of the coordinates of `reduced`, then of free magnets and of each contact's phalanx [m],
        [m/s].
        """
        self._advance(self.time)
        plate, since = self.loaded.plate, self._forced.times[self._solution]
        free = self._free * np.exp(plate.decay * (self.time - since))
        x = (plate.free_state @ free).real + self._forced.state(self._solution, self.time)
        r = len(x) // 2
        return x[:r], x[r:]

    def _advance(self, to_time: float) -> list[_Stretch]:
        """Advance to a time [s]; return the stretches between changes of the drive."""
        stretches: list[_Stretch] = []
        moments = sorted([moment for moment in self._scheduled if moment <= to_time])
        for until in (*moments[_AT_ONCE - 1 :: _AT_ONCE], to_time):
            changes = self._next_changes(until)
            for start in range(0, len(changes), _AT_ONCE):
                self._cross(changes[start : start + _AT_ONCE], stretches)
            stretches.append(self._end_stretch(until, includes_end=True))
        return stretches

    def _next_changes(self, until: float) -> list[_Change]:
        """Changes of the drive up to a time [s], in order."""
        sets, begins = [self._inputs], [self.time]
        for moment in sorted([moment for moment in self._scheduled if moment <= until]):
            changes = self._scheduled.pop(moment)
            if any(self._inputs[era] != motion for era, motion in changes.items()):
                self._inputs = self._inputs.copy()
                for era, motion in changes.items():
                    self._inputs[era] = motion
                sets.append(self._inputs)
                begins.append(moment)
        if len(sets) > 1:
            self._motions, self._set = BaseMotions(*sets, since=self.time), 0
        found: list[_Change] = []
        for begin, end in pairwise([*begins, until]):
            for moment in self._motions.moments(self._set, begin, end):
                found.append(_Change(moment, self._set, is_input=False))
            if self._set + 1 < len(sets):
                self._set += 1
                found.append(_Change(end, self._set, is_input=True))
        return found

    def _cross(self, changes: Sequence[_Change], stretches: list[_Stretch]) -> None:
        """Advance to the last of a few changes; displacement and velocity stay continuous."""
        numbers, times = range(len(changes)), [change.time for change in changes]
        plate, before = self.loaded.plate, self._forced.times[self._solution]
        forced = plate.driven(self._motions, [change.set_number for change in changes], times)
        states = forced.as_free([*numbers, *numbers[:-1]], times + times[1:])
        first = self._forced.as_free([self._solution], times[:1])
        jumps = np.concatenate([first, states[len(changes) :]]) - states[: len(changes)]
        lasted = [time - begin for begin, time in pairwise([before, *times])]
        decays = np.exp(np.array(lasted)[:, None] * plate.decay)
        for number, change in enumerate(changes):
            stretches.append(self._end_stretch(change.time, includes_end=change.is_input))
            self._free = self._free * decays[number] + jumps[number]
            self._forced, self._solution = forced, number

    def _end_stretch(self, end: float, *, includes_end: bool) -> _Stretch:
        """Advance to the end of a stretch."""
        self.time = end
        return _Stretch(end, includes_end, self._free, self._forced, self._solution)
