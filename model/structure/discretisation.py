"""What discretisations of a plate have in common: the shortest waves that they resolve."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self

import numpy as np

from model.arrays import FloatArray
from model.errors import InputError
from model.structure.plate import Plate


@dataclass(frozen=True)
class Discretisation(ABC):
    """nx by ny elements, or polynomials of these degrees, over length by width [m]."""

    nx: int
    ny: int
    length: float
    width: float

    @property
    @abstractmethod
    def shortest_wavelength(self) -> float:
        """The shortest bending wavelength [m] that it resolves."""

    @abstractmethod
    def resolving(self, plate: Plate, frequency: float) -> Self:
        """The coarsest of its kind that resolves a frequency [Hz]."""

    def highest_frequency(self, plate: Plate) -> float:
        """The highest frequency [Hz] whose bending waves in a plate it resolves."""
        return plate.bending_frequency(self.shortest_wavelength)

    def check_frequencies(self, plate: Plate, frequencies: FloatArray) -> None:
        """Raise InputError for frequencies (f,) [Hz] not above zero, or too high for it."""
        for frequency in frequencies:
            if not (np.isfinite(frequency) and frequency > 0):
                raise InputError(f"frequency must be above zero, got {frequency} Hz")
        highest, resolved = max(frequencies, default=0.0), self.highest_frequency(plate)
        if highest > resolved:
            raise InputError(
                f"frequency must be at most {resolved:g} Hz, which mesh {self} resolves, got "
                f"{highest:g} Hz; use mesh {self.resolving(plate, highest)} or finer, or with "
                f"mesh: auto raise the upper limits.frequency to {highest:g} Hz"
            )
