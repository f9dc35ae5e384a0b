"""The plate in the time domain under bases that move along samples, joined by straight lines.

For amplifiers that make waveforms of their own. As in `sim.plant.plant` no step size enters: a base
that moves along a straight line has a closed-form solution, and every corner adds a free vibration.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.signal import lfilter

from model.arrays import ComplexArray, FloatArray
from model.reduction.reduced_plate import ReducedPlate
from model.structure.actuator import Era
from model.structure.fingertip import FingertipLoad
from model.structure.point_load import PointLoad
from sim.plant.loaded_plates import LoadedPlate, LoadedPlateCache, carried_state


class SampledPlant:
    """A reduced plate on its ERAs with loads, at rest before sample 0; rate [Hz]: of the samples.

    An ERA's measured gain over frequency is that at 0 Hz, since samples have no frequency. Raises
    InputError for ERAs that do not support the plate.
    """

    def __init__(
        self,
        reduced: ReducedPlate,
        eras: Sequence[Era],
        *,
        rate: float,
        loads: Sequence[PointLoad] = (),
    ) -> None:
        self.rate = rate
        self.sample = 0  # number of the next one
        self._plates = LoadedPlateCache(reduced, eras, loads)
        self._contacts: Mapping[str, FingertipLoad] = {}
        self._bases = np.zeros(len(eras))  # at the last sample [m]
        self._slopes = np.zeros(len(eras))  # before it [m/s]
        self._use(self._plates.under((), time=0.0))
        self._free = np.zeros(len(self._current.plate.decay), dtype=complex)

    @property
    def reduced(self) -> ReducedPlate:
        """The plate in its present coordinates, which depend on the contacts."""
        return self._current.reduced

    def set_contacts(self, contacts: Mapping[str, FingertipLoad]) -> None:
        """Replace the contacts by id of the finger, as `Plant.set_contacts`."""
        if contacts == self._contacts:
            return
        before, self._contacts = (self._current, self._contacts), dict(contacts)
        state = (self._current.plate.free_state @ (self._free + self._forced)).real
        self._use(self._plates.under(tuple(contacts.values()), time=self.sample / self.rate))
        state = carried_state(state, before, (self._current, contacts))
        self._free = self._current.plate.to_free @ state - self._forced

    def advance(self, bases: FloatArray, *, shapes: FloatArray) -> FloatArray:
        """Advance by the next samples, the bases' motion (n, eras) [m].

        shapes (p, r): of `reduced` at points. Return their accelerations (n, p) [m/s²] at the
        samples.
        """
        plate = self._current.plate
        slopes = np.diff(bases, axis=0, prepend=self._bases[None]) * self.rate
        corners = -np.diff(slopes, axis=0, prepend=self._slopes[None]) @ self._by_slope
        free = np.empty_like(corners)
        factor = np.exp(plate.decay / self.rate)
        for mode, one in enumerate(factor):
            state = np.array([one * self._free[mode]])
            free[:, mode], _ = lfilter([one], [1.0, -one], corners[:, mode], zi=state)
        if len(bases):
            self._free, self._bases, self._slopes = free[-1], bases[-1], slopes[-1]
            self.sample += len(bases)
        points = plate.with_phalanges(shapes) @ plate.free_acceleration
        return np.asarray((free @ points.T).real)

    def _use(self, plate: LoadedPlate) -> None:
        """Go on with a plate; find its forced vibration for bases of 1 m and of 1 m/s."""
        self._current = plate
        count = len(self._bases)
        still = np.zeros(2 * count, dtype=complex)
        ones, zeros = np.ones(count), np.zeros(count)
        solutions, _ = plate.plate.particular(
            [*range(count)] * 2, still, np.r_[ones, zeros], np.r_[zeros, ones]
        )
        halves = solutions @ plate.plate.vectors.T @ plate.plate.to_free.T
        self._by_base, self._by_slope = halves[:count], halves[count:]

    @property
    def _forced(self) -> ComplexArray:
        return np.asarray(self._bases @ self._by_base + self._slopes @ self._by_slope)
