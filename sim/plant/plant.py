"""The plate in the time domain, advanced from one change of drive or contacts to the next.

The exact solutions are those of `model.transients.time_response`; the plant adds the clock, the
present base motion, and the free vibration that remains after each change.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from model.arrays import FloatArray
from model.reduction.reduced_plate import ReducedPlate
from model.structure.actuator import Era
from model.structure.fingertip import FingertipLoad
from model.structure.point_load import PointLoad
from model.transients.base_motion import Term
from model.transients.time_response import ParticularSolution
from sim.plant.loaded_plates import BLOCK, LoadedPlate, LoadedPlateCache, carried_state

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
        self._particular: list[list[ParticularSolution]] = [[] for _ in eras]

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

    def set_input(self, era: int, terms: Sequence[Term]) -> None:
        """Set the base motion of an ERA from now on; terms may start later."""
        # Unchanged terms continue; only the others are exchanged.
        known = {solution.term: solution for solution in self._particular[era]}
        wanted = _united([term for term in terms if term.end > self.time])
        new = self._current.plate.particular_solutions(
            era, [term for term in wanted if term not in known]
        )
        gone = [solution for term, solution in known.items() if term not in wanted]
        self._particular[era] = [
            *(solution for term, solution in known.items() if term in wanted),
            *new,
        ]
        self._exchange(self._active_of(gone), self._active_of(new))

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
        self._particular = [
            self._current.plate.particular_solutions(era, [solution.term for solution in solutions])
            for era, solutions in enumerate(self._particular)
        ]
        remainder = carried_state(state, before, (self._current, contacts))
        for solution in self._active():
            remainder = remainder - solution.state(self.time)
        self._free = self._current.plate.to_free @ remainder

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
        points = shapes if len(shapes) < 2 * shapes.shape[1] else np.eye(shapes.shape[1])
        samples = np.empty((len(times), len(points)))
        done = 0
        for boundary in self._boundaries(to_time):
            upto = int(np.searchsorted(times, boundary))
            self._sample(times[done:upto], samples[done:upto], sample_rate, points)
            done = upto
            self._cross_boundary(boundary)
        self._sample(times[done:], samples[done:], sample_rate, points)
        self._propagate_free(to_time)
        return times, samples if points is shapes else samples @ shapes.T

    def skip(self, to_time: float) -> None:
        """Advance to a time [s] without sampling."""
        if to_time <= self.time:
            return
        for boundary in self._boundaries(to_time):
            self._cross_boundary(boundary)
        self._propagate_free(to_time)

    def _state(self) -> tuple[FloatArray, FloatArray]:
        """Displacement and velocity of all coordinates, the phalanges' last."""
        x = (self._current.plate.free_state @ self._free).real
        for solution in self._active():
            x = x + solution.state(self.time)
        r = len(x) // 2
        return x[:r], x[r:]

    def _active(self) -> list[ParticularSolution]:
        return [
            solution for solutions in self._particular for solution in self._active_of(solutions)
        ]

    def _active_of(self, solutions: Sequence[ParticularSolution]) -> list[ParticularSolution]:
        return [
            solution
            for solution in solutions
            if solution.term.start <= self.time < solution.term.end
        ]

    def _boundaries(self, to_time: float) -> list[float]:
        moments = {
            moment
            for solutions in self._particular
            for solution in solutions
            for moment in (solution.term.start, solution.term.end)
        }
        return sorted(moment for moment in moments if self.time < moment <= to_time)

    def _exchange(
        self, before: Sequence[ParticularSolution], after: Sequence[ParticularSolution]
    ) -> None:
        """Replace particular solutions; displacement and velocity stay continuous."""
        if before or after:
            jump = np.zeros(self._current.plate.free_state.shape[0])
            for solution in before:
                jump += solution.state(self.time)
            for solution in after:
                jump -= solution.state(self.time)
            self._free = self._free + self._current.plate.to_free @ jump

    def _propagate_free(self, to_time: float) -> None:
        self._free = self._free * np.exp(self._current.plate.decay * (to_time - self.time))
        self._free[np.abs(self._free) < _NEGLIGIBLE] = 0
        self.time = to_time

    def _cross_boundary(self, boundary: float) -> None:
        """Advance to a time at which terms start or end."""
        before = self._active()
        self._propagate_free(boundary)
        after = self._active()
        self._exchange(
            [solution for solution in before if solution not in after],
            [solution for solution in after if solution not in before],
        )
        self._particular = [
            [solution for solution in solutions if solution.term.end > boundary]
            for solutions in self._particular
        ]

    def _sample(
        self, times: FloatArray, out: FloatArray, sample_rate: float, points: FloatArray
    ) -> None:
        """Write accelerations at times on the grid under the present drive.

        points: shapes (q, r); out: (n, q).
        """
        if not len(times):
            return
        decay = self._current.plate.decay
        free = self._free * np.exp(decay * (times[0] - self.time))
        modal = ((points @ self._current.plate.free_acceleration) * free).T
        table = self._current.exponentials(sample_rate)
        forced = _ForcedResponse(self._active(), points)
        for start in range(0, len(times), BLOCK):
            block = times[start : start + BLOCK]
            into = out[start : start + BLOCK]
            if start:
                modal = modal * np.exp(decay * (BLOCK / sample_rate))[:, None]
            if modal.any():
                np.matmul(table[: len(block)], np.vstack([modal.real, modal.imag]), out=into)
            else:
                into[:] = 0
            forced.add(block, into)


def _united(terms: Sequence[Term]) -> list[Term]:
    """Merge terms of equal interval and frequency."""
    united: dict[tuple[float, float, float], Term] = {}
    for term in terms:
        key = (term.start, term.end, term.omega)
        same = united.get(key)
        if same is not None:
            united[key] = replace(term, c0=same.c0 + term.c0, c1=same.c1 + term.c1)
        else:
            united[key] = term
    return list(united.values())


class _ForcedResponse:
    """Forced accelerations at points of shapes (q, r)."""

    def __init__(self, active: Sequence[ParticularSolution], points: FloatArray) -> None:
        self._starts = np.array([solution.term.start for solution in active])
        self._omegas = np.array([solution.term.omega for solution in active])
        r = points.shape[1]
        b0 = np.array([solution.b0 for solution in active]).reshape(-1, r)
        b1 = np.array([solution.b1 for solution in active]).reshape(-1, r)
        s = 1j * self._omegas[:, None]
        constant = (s**2 * b0 + 2 * s * b1) @ points.T
        self._constant = np.vstack([constant.imag, constant.real])
        growth = (s**2 * b1) @ points.T
        self._growth = np.vstack([growth.imag, growth.real]) if b1.any() else None

    def add(self, times: FloatArray, out: FloatArray) -> None:
        """Add the response at times (n,) [s] to out (n, q)."""
        if not len(self._omegas):
            return
        tau = times[:, None] - self._starts
        angle = self._omegas * tau
        phase_factor = np.hstack([np.cos(angle), np.sin(angle)])
        out += phase_factor @ self._constant
        if self._growth is not None:
            out += (phase_factor * np.hstack([tau, tau])) @ self._growth
