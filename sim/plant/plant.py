"""The plate in the time domain, advanced from one change of drive or contacts to the next.

The exact solutions are those of `model.transients.time_response`; the plant adds the clock, the
present base motion, and the free vibration that remains after each change.
"""

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence

import numpy as np

from model.arrays import FloatArray
from model.reduction.reduced_plate import ReducedPlate
from model.structure.actuator import Era
from model.structure.fingertip import FingertipLoad
from model.structure.point_load import PointLoad
from model.transients.base_motion import BaseMotions, Term
from sim.plant.loaded_plates import LoadedPlate, LoadedPlateCache, carried_state
from sim.plant.sampler import Sampler

SAMPLE_RATE = 10_000.0
"""Default sampling rate [Hz]: peaks at 500 Hz are sampled to within 1.3 %."""

_NEGLIGIBLE = (
    1e-60  # modal amplitude; smaller values are set to zero, since subnormal numbers are slow
)


class Plant:
    """A reduced plate on its ERAs with loads, at rest at `time` [s].

    Raises InputError for ERAs that do not support the plate.
    """

    def __init__(
        self,
        reduced: ReducedPlate,
        eras: Sequence[Era],
        *,
        loads: Sequence[PointLoad] = (),
        time: float = 0.0,
    ) -> None:
        self.time = time
        self._plates = LoadedPlateCache(reduced, eras, loads)
        self._current: LoadedPlate = self._plates.under((), time=time)
        self._contacts: Mapping[str, FingertipLoad] = {}
        self._free = np.zeros(len(self._current.plate.decay), dtype=complex)
        # Terms of each ERA's base; those that follow, by time [s] and ERA.
        self._terms: list[list[Term]] = [[] for _ in eras]
        self._motions = BaseMotions(())
        self._scheduled: dict[float, dict[int, list[Term]]] = {}
        self._forced = self._current.plate.driven(self._motions, time)
        self._sampler: Sampler | None = None  # until the contacts change

    @property
    def reduced(self) -> ReducedPlate:
        """The plate in its present coordinates, which depend on the contacts."""
        return self._current.reduced

    @property
    def loaded(self) -> LoadedPlate:
        """The plate under the present contacts."""
        return self._current

    @property
    def contacts(self) -> Mapping[str, FingertipLoad]:
        """The present contacts by id of the finger."""
        return self._contacts

    @property
    def state(self) -> tuple[FloatArray, FloatArray]:
        """Present displacement and velocity, (r,) each, in the coordinates of `reduced`."""
        q, v = self._state()
        r = len(self.reduced.omega)
        return q[:r], v[:r]

    @property
    def phalanges(self) -> tuple[FloatArray, FloatArray]:
        """Present displacement [m] and velocity [m/s] of each contact's phalanx, (n,) each."""
        q, v = self._state()
        r = len(self.reduced.omega)
        return q[r:], v[r:]

    def set_input(self, era: int, terms: Sequence[Term], *, since: float | None = None) -> None:
        """Set the base motion of an ERA after a time [s], by default the present one.

        Terms may start later.
        """
        moment = self.time if since is None else max(since, self.time)
        self._scheduled.setdefault(moment, {})[era] = list(terms)

    def set_contacts(self, contacts: Mapping[str, FingertipLoad]) -> None:
        """Replace the contacts, by id of the finger; a new finger's phalanx is at rest.

        Displacement and velocity of the plate, and of the phalanges of fingers that stay, are
        continuous; energy in pulp, masses and joint of a finger comes and goes with it.
        """
        if contacts == self._contacts:
            return
        before = self._current, self._contacts
        state = np.concatenate(self._state())
        self._current = self._plates.under(tuple(contacts.values()), time=self.time)
        self._contacts = dict(contacts)
        remainder = carried_state(state, before, (self._current, contacts))
        self._forced = self._current.plate.driven(self._motions, self.time)
        self._free = self._current.plate.to_free @ (remainder - self._forced.state(self.time))
        self._sampler = None

    def advance(
        self, to_time: float, *, sample_rate: float, shapes: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Advance to a time [s]; returns times (n,) [s] and accelerations (n, p) [m/s²].

        shapes (p, r): of `reduced` at the points. Samples lie on the grid k / sample_rate [Hz],
        after the present time up to and including to_time.
        """
        first = np.floor(self.time * sample_rate) + 1
        last = np.floor(to_time * sample_rate)
        times = np.arange(first, last + 1) / sample_rate
        shapes = self._current.plate.with_phalanges(shapes)
        # Few points are sampled directly, many by way of the coordinates.
        is_direct = len(shapes) < 2 * shapes.shape[1]
        points = shapes if is_direct else np.eye(shapes.shape[1])
        sampler = self._sampler_at(points, sample_rate)
        samples = np.empty((len(times), len(points)))
        done = 0

        def sample(upto: int) -> None:
            nonlocal done
            if upto > done:
                sampler.sample(
                    times[done:upto],
                    samples[done:upto],
                    free=self._free * np.exp(self._current.plate.decay * (times[done] - self.time)),
                    forced=self._forced,
                )
                done = upto

        while (change := self._next_change) <= to_time:
            # A term moves the base from its start on, an input after the moment it is set, which
            # is rounded to the grid as to_time is.
            if change == self._next_moment:
                sample(int(np.searchsorted(times, change)))
            else:
                sample(int(np.floor(change * sample_rate) - first) + 1)
            self._cross(change)
        sample(len(times))
        self._propagate_free(to_time)
        return times, samples if is_direct else samples @ shapes.T

    def skip(self, to_time: float) -> None:
        """Advance to a time [s] without sampling."""
        if to_time <= self.time:
            return
        while (change := self._next_change) <= to_time:
            self._cross(change)
        self._propagate_free(to_time)

    def _sampler_at(self, points: FloatArray, sample_rate: float) -> Sampler:
        """The sampler that is kept, or another for other points or another rate."""
        kept = self._sampler
        if (
            kept is None
            or kept.sample_rate != sample_rate
            or not np.array_equal(kept.points, points)
        ):
            kept = self._sampler = Sampler(self._current, points, sample_rate=sample_rate)
        return kept

    def _state(self) -> tuple[FloatArray, FloatArray]:
        """Displacement and velocity of all coordinates, the phalanges' last."""
        self._apply_inputs()
        x = (self._current.plate.free_state @ self._free).real + self._forced.state(self.time)
        r = len(x) // 2
        return x[:r], x[r:]

    @property
    def _next_moment(self) -> float:
        """Time of the next start or end of a term [s]."""
        moments = self._motions.moments
        number = bisect_right(moments, self.time)
        return moments[number] if number < len(moments) else math.inf

    @property
    def _next_change(self) -> float:
        """Time of the next change of the drive [s]."""
        return min(self._next_moment, min(self._scheduled, default=math.inf))

    def _cross(self, change: float) -> None:
        """Advance to the next change of the drive, and let it happen."""
        if change < self._next_moment:
            self._propagate_free(change)
            self._apply_inputs()
            return
        self._propagate_free(change)
        self._exchange()

    def _apply_inputs(self) -> None:
        """Exchange the terms that were set up to the present time, of all ERAs at once."""
        changes: dict[int, list[Term]] = {}
        for moment in sorted(self._scheduled):
            if moment <= self.time:
                changes |= self._scheduled.pop(moment)
        if any(self._terms[era] != terms for era, terms in changes.items()):
            for era, terms in changes.items():
                self._terms[era] = terms
            self._motions = BaseMotions(self._terms, since=self.time)
            self._exchange()

    def _exchange(self) -> None:
        """Let the terms of the present time drive; displacement and velocity stay continuous."""
        before = self._forced.as_free(self.time)
        self._forced = self._current.plate.driven(self._motions, self.time)
        self._free = self._free + before - self._forced.as_free(self.time)

    def _propagate_free(self, to_time: float) -> None:
        self._free = self._free * np.exp(self._current.plate.decay * (to_time - self.time))
        self._free[np.abs(self._free) < _NEGLIGIBLE] = 0
        self.time = to_time
