"""The plate in the time domain, advanced from one change of drive or contacts to the next.

No step size enters. Between changes the motion is a sum of free vibrations, which decay, and of
forced ones (`model.transients.time_response`); every change adds free vibrations that keep
displacement and velocity continuous. Accelerations are sampled from tables of exponentials, with
one matrix product per block of samples.

A fingertip acts at a point, and its phalanx moves: a low-rank change and one more coordinate. The
reduced basis is extended by the static vectors of the point, and the small system diagonalised
again; solutions are cached by the set of contacts. Structural damping is that of the plate on its
ERAs. Fingers that come to rest are solved separately: a large plate takes a tenth of a second,
while its amplifiers must continue to reply.
"""

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import chain, pairwise
from typing import NamedTuple, TypeAlias

import numpy as np

from model.arrays import ComplexArray, FloatArray, Point
from model.reduction.reduced_plate import ReducedPlate
from model.structure.attachments import FingertipLoad, PointLoad, Source
from model.transients.base_motion import BaseMotions, Motion
from model.transients.time_response import ForcedVibration, PlateInTime, plate_in_time

Footprint: TypeAlias = tuple[float, float, float]
"""x, y, radius [m]."""

_BLOCK = 512  # samples per table of exponentials; a power of 2

# s; a point keeps its static vectors for so long after a lift, ten times as long as their motion
# takes to decay.
_KEEP_LIFTED = 0.2
_MAX_LIFTED = 8  # points; a sliding finger leaves many
_MAX_SOLVED = 32  # sets of contacts, of about a megabyte each


@dataclass(frozen=True, eq=False)
class LoadedPlate:
    """The plate under a set of contacts, reduced for forces at them."""

    reduced: ReducedPlate
    plate: PlateInTime
    _tables: dict[float, ComplexArray] = field(default_factory=dict)

    def exponentials(self, sample_rate: float) -> ComplexArray:
        """exp(eigenvalue k / sample_rate [Hz]), k up to a block, (_BLOCK, m)."""
        if sample_rate not in self._tables:
            self._tables.clear()
            self._tables[sample_rate] = exponentials(self.plate.decay, sample_rate)
        return self._tables[sample_rate]


def exponentials(s: ComplexArray, sample_rate: float) -> ComplexArray:
    """exp(s k / sample_rate) for s (n,) [1/s] and k up to a block, (_BLOCK, n)."""
    table = np.ones((_BLOCK, len(s)), dtype=complex)
    done = 1
    while done < _BLOCK:  # doubled, since an exponential costs ten products
        np.multiply(table[:done], np.exp(s * (done / sample_rate)), out=table[done : 2 * done])
        done *= 2
    return table


Under: TypeAlias = tuple[LoadedPlate, Mapping[str, FingertipLoad]]
"""A loaded plate with its contacts by id of the finger, in the order of its coordinates."""


def carried_state(state: FloatArray, before: Under, after: Under) -> FloatArray:
    """Displacement and velocity of all coordinates, (2 r,), carried to another set of contacts.

    The state of the plate, of magnets and of remaining fingers' phalanges is continuous; a new
    finger's phalanx is at rest.
    """
    (plate, contacts), (other, wanted) = before, after
    halves, count = np.split(state, 2), len(plate.reduced.omega)
    fixed = len(halves[0]) - len(contacts)
    moving = dict(zip(contacts, np.transpose([half[fixed:] for half in halves]), strict=True))
    phalanges = np.reshape([moving.get(id, (0.0, 0.0)) for id in wanted], (-1, 2)).T
    motion = [half[:count] for half in halves]
    if other.reduced is not plate.reduced:
        carried = other.reduced.projection_from(plate.reduced)
        motion = [carried @ half for half in motion]
    magnets = [half[count:fixed] for half in halves]
    return np.concatenate([*chain.from_iterable(zip(motion, magnets, phalanges, strict=True))])


class LoadedPlateCache:
    """Solutions of a plate on its ERAs with its loads, for any contacts.

    reduced: for forces at the ERAs and loads. Raises InputError for ERAs that do not support it.
    """

    def __init__(
        self, reduced: ReducedPlate, eras: Sequence[Source], loads: Sequence[PointLoad]
    ) -> None:
        self._unloaded = reduced
        self._eras = tuple(eras)
        self._loads = tuple(loads)
        self._lifted: dict[Footprint, float] = {}  # by point: when [s]
        self._resting: tuple[Footprint, ...] = ()
        self._solved = lru_cache(_MAX_SOLVED)(self._solve)
        self._reduced_at = lru_cache(_MAX_SOLVED)(self._reduce)

    def solution(
        self, contacts: Sequence[FingertipLoad], *, time: float
    ) -> Callable[[], LoadedPlate]:
        """What solves the plate under these contacts from a time [s] on, in any thread.

        Calls must be in order of time.
        """
        resting = tuple(sorted({(each.x, each.y, each.foot) for each in contacts}))
        for point in self._resting:
            self._lifted.pop(point, None)
            self._lifted[point] = time
        self._resting = resting
        recent = [
            point
            for point, when in self._lifted.items()
            if time - when < _KEEP_LIFTED and point not in resting
        ][-_MAX_LIFTED:]
        self._lifted = {point: self._lifted[point] for point in recent}
        return partial(self._solved, (*resting, *sorted(recent)), tuple(contacts))

    def _solve(
        self, points: tuple[Footprint, ...], contacts: tuple[FingertipLoad, ...]
    ) -> LoadedPlate:
        if not points:
            unloaded = _solve_unloaded(self._unloaded, self._eras, self._loads)
            return LoadedPlate(self._unloaded, unloaded)
        reduced = self._reduced_at(points)
        plate = plate_in_time(reduced, self._eras, loads=self._loads, contacts=contacts)
        return LoadedPlate(reduced, plate)

    def _reduce(self, points: tuple[Footprint, ...]) -> ReducedPlate:
        return self._unloaded.with_attachments_at(np.array(points))


@lru_cache(maxsize=2)  # shared by successive benches of the same rig
def _solve_unloaded(
    reduced: ReducedPlate, eras: tuple[Source, ...], loads: tuple[PointLoad, ...]
) -> PlateInTime:
    return plate_in_time(reduced, eras, loads=loads)


class FingerPlacement:
    """Positions [m] and loads of all fingers by id from a time [s] on.

    solve: returns the plate under them, may be called in any thread, and is called once; None where
    what loads the plate stays.
    """

    def __init__(
        self,
        time: float,
        positions: Mapping[str, Point],
        contacts: Mapping[str, FingertipLoad],
        solve: Callable[[], LoadedPlate] | None,
    ) -> None:
        self.time = time
        self.positions = dict(positions)
        self.contacts = contacts
        self.is_solved = solve is None
        self._is_started = False
        self._solve = solve
        self._lock = threading.Lock()
        self._loaded: LoadedPlate | None = None

    def supersedes(self, before: "FingerPlacement", last: "FingerPlacement") -> bool:
        """Whether the last placement can be left out, for fingers that slide faster than is solved.

        Its solution has not begun, and it only moved the same fingers.
        """
        is_slide = self.positions.keys() == last.positions.keys() == before.positions.keys()
        return is_slide and not (last.is_solved or last._is_started)

    def solved(self) -> LoadedPlate | None:
        """The plate under these fingers, solved if necessary; raises the errors of solving."""
        self._is_started = True
        with self._lock:
            try:
                if self._loaded is None and self._solve is not None:
                    self._loaded = self._solve()
                return self._loaded
            finally:
                self.is_solved = True


_NEGLIGIBLE = 1e-17  # of the strongest free vibration: a tenth of its rounding error
_SMALLEST = 1e-60  # m/s²; subnormal numbers are slow
_TABLES_KEPT = 8  # sets of omegas


class Sampler:
    """Samples a loaded plate at points with mode shapes (q, r), including phalanges.

    precision: of the sums, double or single; all other steps use double.
    """

    def __init__(
        self,
        loaded: LoadedPlate,
        points: FloatArray,
        *,
        sample_rate: float,
        precision: type[np.floating] = np.float64,
    ) -> None:
        self.points = points
        self.sample_rate = sample_rate
        self.precision = precision
        plate = loaded.plate
        self._by_forced = np.ascontiguousarray((points @ plate.displacement).T)
        # Conjugate exponents and amplitudes at the points (m, q), fastest decay last.
        self._decay = plate.decay.conj()
        self._free = (points @ plate.free_acceleration).conj().T
        self._strengths = np.abs(self._free).max(axis=1, initial=0.0)
        self._free_table = self._columns(loaded.exponentials(sample_rate))
        self._forced: ForcedVibration | None = None
        self._solution = -1  # current solution, with its conjugate amplitudes (n, q):
        self._constant = self._growth = self._free[:0]  # of all solutions, and per second
        self._exponents = self._decay[:0]
        self._forced_table = self._free_table[:, :0]

    def sample(
        self,
        times: FloatArray,
        out: FloatArray,
        *,
        free: ComplexArray,
        forced: ForcedVibration,
        solution: int,
    ) -> None:
        """Write accelerations at times (n,) [s], evenly spaced, to out (n, q).

        free (m,): amplitude of each free vibration at the time of the forced one, a solution by
        index.
        """
        if forced is not self._forced or solution != self._solution:
            self._use(forced, solution)
        rows = forced.rows(solution)
        for start in range(0, len(times), _BLOCK):
            into = out[start : start + _BLOCK]
            tau = float(times[start] - forced.times[solution])
            now = np.exp(self._decay * tau) * free.conj()
            strengths = np.abs(now) * self._strengths
            counts = strengths > max(_NEGLIGIBLE * strengths.max(), _SMALLEST)
            last = counts.nonzero()[0][-1:]
            kept = int(last[0]) + 1 if len(last) else 0  # how many free vibrations count
            amplitudes = self._rows(self._free[:kept] * now[:kept, None])
            np.matmul(self._free_table[: len(into), : 2 * kept], amplitudes, out=into)
            driven: ComplexArray = self._constant[rows]
            if forced.a1 is not None:
                driven = np.vstack([driven + tau * self._growth[rows], self._growth[rows]])
            turned = driven * np.exp(self._exponents * tau)[:, None]
            into += self._forced_table[: len(into)] @ self._rows(turned)

    def _rows(self, amplitudes: ComplexArray) -> FloatArray:
        """Real and imaginary parts (2 n, q) of amplitudes (n, q), one after the other."""
        parts = np.stack([amplitudes.real, amplitudes.imag], axis=1, dtype=self.precision)
        return parts.reshape(2 * len(amplitudes), len(self.points))

    def _columns(self, table: ComplexArray) -> FloatArray:
        """Real and imaginary parts (n, 2 k) of a table (n, k)."""
        return np.ascontiguousarray(table).view(float).astype(self.precision, copy=False)

    def _use(self, forced: ForcedVibration, solution: int) -> None:
        """Tabulate the exponentials of a solution."""
        if forced is not self._forced:
            self._forced = forced
            s = 1j * forced.omegas[:, None]
            constant = s**2 * forced.a0
            if forced.a1 is not None:
                constant += 2 * s * forced.a1
                # Im[a exp(s t)] is Re[-i a exp(s t)].
                self._growth = np.asarray(1j * ((s**2 * forced.a1) @ self._by_forced).conj())
            self._constant = np.asarray(1j * (constant @ self._by_forced).conj())
        self._solution = solution
        omegas = forced.omegas[forced.rows(solution)]
        table = _sinusoids(omegas.tobytes(), self.sample_rate)
        self._exponents = np.asarray(-1j * omegas, dtype=complex)
        if forced.a1 is not None:
            table = np.hstack([table, np.arange(_BLOCK)[:, None] / self.sample_rate * table])
            self._exponents = np.tile(self._exponents, 2)
        self._forced_table = self._columns(table)


@lru_cache(_TABLES_KEPT)
def _sinusoids(omegas: bytes, sample_rate: float) -> ComplexArray:
    """exp(i omega k / sample_rate) for k up to a block, (_BLOCK, n)."""
    return exponentials(np.asarray(1j * np.frombuffer(omegas), dtype=complex), sample_rate)


PLANT_SAMPLE_RATE = 10_000.0
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

        Calls, including `set_contacts`, must be in order of time.
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
