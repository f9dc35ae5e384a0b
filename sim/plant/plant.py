"""The plate in the time domain, advanced from one change of drive or contacts to the next.

The exact solutions are those of `model.transients.time_response`; the plant adds the clock, the
present base motion, and the free vibration that remains after each change.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.reduction.reduced_plate import ReducedPlate
from model.structure.actuator import Era
from model.structure.fingertip import FingertipLoad
from model.structure.point_load import PointLoad
from model.transients.base_motion import Term
from model.transients.time_response import ForcedVibration
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
        # Terms of each ERA's base that have not ended; those set at the present time, by ERA.
        self._terms: list[list[Term]] = [[] for _ in eras]
        self._set: dict[int, list[Term]] = {}
        self._moments: list[float] = []  # starts and ends of terms, ascending
        self._forced = self._current.plate.driven((), time)
        self._sampled: _Sampled | None = None  # until the drive or the contacts change
        self._free_at: tuple[FloatArray, ComplexArray] | None = None  # until the contacts change

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
        self._set[era] = _united([term for term in terms if term.end > self.time])

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
        self._forced = self._current.plate.driven(self._active(), self.time)
        self._free = self._current.plate.to_free @ (remainder - self._forced.state(self.time))
        self._sampled = self._free_at = None

    def advance(
        self, to_time: float, *, sample_rate: float, shapes: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Advance to a time [s]; returns times (n,) [s] and accelerations (n, p) [m/s²].

        shapes (p, r): of `reduced` at the points. Samples lie on the grid k / sample_rate [Hz],
        after the present time up to and including to_time.
        """
        self._apply_inputs()
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
        self._apply_inputs()
        for boundary in self._boundaries(to_time):
            self._cross_boundary(boundary)
        self._propagate_free(to_time)

    def _state(self) -> tuple[FloatArray, FloatArray]:
        """Displacement and velocity of all coordinates, the phalanges' last."""
        self._apply_inputs()
        x = (self._current.plate.free_state @ self._free).real + self._forced.state(self.time)
        r = len(x) // 2
        return x[:r], x[r:]

    def _apply_inputs(self) -> None:
        """Exchange the terms that were set at the present time, of all ERAs at once."""
        if not self._set:
            return
        changes = self._set
        self._set = {}
        if any(self._terms[era] != wanted for era, wanted in changes.items()):
            for era, wanted in changes.items():
                self._terms[era] = wanted
            self._exchange()

    def _active(self) -> list[tuple[int, Term]]:
        """The terms that move the bases at present, each with its ERA."""
        now = self.time
        return [
            (era, term)
            for era, terms in enumerate(self._terms)
            for term in terms
            if term.start <= now < term.end
        ]

    def _boundaries(self, to_time: float) -> list[float]:
        return [moment for moment in self._moments if self.time < moment <= to_time]

    def _exchange(self) -> None:
        """Let the terms of the present time drive; displacement and velocity stay continuous."""
        before = self._forced.state(self.time)
        self._forced = self._current.plate.driven(self._active(), self.time)
        jump = before - self._forced.state(self.time)
        self._free = self._free + self._current.plate.to_free @ jump
        self._moments = sorted(
            {moment for terms in self._terms for each in terms for moment in (each.start, each.end)}
        )
        self._sampled = None

    def _propagate_free(self, to_time: float) -> None:
        self._free = self._free * np.exp(self._current.plate.decay * (to_time - self.time))
        self._free[np.abs(self._free) < _NEGLIGIBLE] = 0
        self.time = to_time

    def _cross_boundary(self, boundary: float) -> None:
        """Advance to a time at which terms start or end."""
        self._propagate_free(boundary)
        self._terms = [[each for each in terms if each.end > boundary] for terms in self._terms]
        self._exchange()

    def _sample(
        self, times: FloatArray, out: FloatArray, sample_rate: float, points: FloatArray
    ) -> None:
        """Write accelerations at times on the grid under the present drive.

        points: shapes (q, r); out: (n, q).
        """
        if not len(times):
            return
        plate = self._current.plate
        sampled = self._sampled
        if sampled is None or not np.array_equal(sampled.points, points):
            if self._free_at is None or not np.array_equal(self._free_at[0], points):
                self._free_at = points, points @ plate.free_acceleration
            sampled = self._sampled = _Sampled(*self._free_at, self._forced)
        free = self._free * np.exp(plate.decay * (times[0] - self.time))
        modal = (sampled.by_free * free).T
        table = self._current.exponentials(sample_rate)
        for start in range(0, len(times), BLOCK):
            block = times[start : start + BLOCK]
            into = out[start : start + BLOCK]
            if start:
                modal = modal * np.exp(plate.decay * (BLOCK / sample_rate))[:, None]
            if modal.any():
                np.matmul(table[: len(block)], np.vstack([modal.real, modal.imag]), out=into)
            else:
                into[:] = 0
            sampled.add_forced(block, into)


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


class _Sampled:
    """Accelerations at points of shapes (q, r) while the drive stays.

    by_free: (q, m), of each free vibration.
    """

    def __init__(self, points: FloatArray, by_free: ComplexArray, forced: ForcedVibration) -> None:
        self.points, self.by_free = points, by_free
        self._time, self._omegas = forced.time, forced.omegas
        s = 1j * forced.omegas[:, None]
        constant = s**2 * forced.b0
        self._growth: FloatArray | None = None
        if forced.b1 is not None:
            constant += 2 * s * forced.b1
            growth = (s**2 * forced.b1) @ points.T
            self._growth = np.vstack([growth.imag, growth.real])
        constant = constant @ points.T
        self._constant = np.vstack([constant.imag, constant.real])

    def add_forced(self, times: FloatArray, out: FloatArray) -> None:
        """Add the forced response at times (n,) [s] to out (n, q)."""
        if not len(self._omegas):
            return
        tau = (times - self._time)[:, None]
        angle = tau * self._omegas
        phase_factor = np.hstack([np.cos(angle), np.sin(angle)])
        out += phase_factor @ self._constant
        if self._growth is not None:
            out += (phase_factor * tau) @ self._growth
