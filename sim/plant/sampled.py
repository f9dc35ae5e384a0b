"""The plate in the time domain under bases that move along samples, joined by straight lines.

For amplifiers that make waveforms of their own. As in `sim.plant.plant` no step size enters: a base
that moves along a straight line has a closed-form solution, and every corner adds a free vibration.
"""

import numpy as np

from model.arrays import ComplexArray, FloatArray
from sim.plant.loaded_plates import LoadedPlate, carried_state
from sim.plant.plant import Plant


class SampledPlant:
    """The plate of a plant that nothing else drives, at rest before sample 0; rate [Hz].

    It has the coordinates of the plant, and follows its contacts. An ERA's measured gain over
    frequency is that at 0 Hz, since samples have no frequency.
    """

    def __init__(self, plant: Plant, *, rate: float) -> None:
        from scipy.signal import lfilter  # takes half a second to load

        self._filter = lfilter
        self.rate = rate
        self._plant = plant
        self._contacts = plant.contacts
        self._bases = np.zeros(len(plant.loaded.plate.eras))  # at the last sample [m]
        self._slopes = np.zeros(len(plant.loaded.plate.eras))  # before it [m/s]
        self._use(plant.loaded)
        self._free = np.zeros(len(plant.loaded.plate.decay), dtype=complex)

    def follow(self) -> None:
        """Go on under the plant's present contacts."""
        if self._plant.loaded is self._current and self._plant.contacts == self._contacts:
            return
        before = self._current, self._contacts
        state = (self._current.plate.free_state @ (self._free + self._forced)).real
        self._contacts = self._plant.contacts
        self._use(self._plant.loaded)
        state = carried_state(state, before, (self._current, self._contacts))
        self._free = self._current.plate.to_free @ state - self._forced

    def advance(self, bases: FloatArray, *, shapes: FloatArray) -> FloatArray:
        """Advance by the next samples, the bases' motion (n, eras) [m].

        shapes (p, r): of the plant's `reduced` at points. Return their accelerations (n, p)
        [m/s²] half a sample before each: at the samples themselves the velocity of a base, and
        with it the force of its damper, jumps.
        """
        plate = self._current.plate
        slopes = np.diff(bases, axis=0, prepend=self._bases[None]) * self.rate
        corners = -np.diff(slopes, axis=0, prepend=self._slopes[None]) @ self._by_slope
        free = np.empty_like(corners)
        factor = np.exp(plate.decay / self.rate)
        for mode, one in enumerate(factor):
            state = np.array([one * self._free[mode]])
            free[:, mode], _ = self._filter([one], [1.0, -one], corners[:, mode], zi=state)
        if len(bases):
            self._free, self._bases, self._slopes = free[-1], bases[-1], slopes[-1]
        points = plate.with_far_ends(shapes) @ plate.free_acceleration
        halfway = free * np.exp(-plate.decay / (2 * self.rate))
        return np.asarray((halfway @ points.T).real)

    def _use(self, plate: LoadedPlate) -> None:
        """Go on with a plate; find its forced vibration for bases of 1 m and of 1 m/s."""
        self._current = plate
        strokes = np.array([[era.full_level] for era in plate.plate.eras])
        self._by_base, self._by_slope = (
            found[0] / strokes @ plate.plate.vectors.T @ plate.plate.to_free.T
            for found in plate.plate.following(np.zeros(1, dtype=complex))
        )

    @property
    def _forced(self) -> ComplexArray:
        return np.asarray(self._bases @ self._by_base + self._slopes @ self._by_slope)
