"""Change of the complex eigenvalues of modes with frequency, by adhesives and air."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from model.arrays import ComplexArray, FloatArray


@dataclass(frozen=True, eq=False)
class Dispersion:
    """What is added to the eigenvalues of r modes, which they have at their own frequencies.

    frequencies (k,) [Hz], ascending; values (k, r) [rad²/s²]: in the mode's own shape; a cubic
    spline of the logarithm of frequency in between, constant outside.
    """

    frequencies: FloatArray
    values: ComplexArray

    def at(self, omega: FloatArray) -> ComplexArray:
        """At omega (f,) [rad/s], (f, r) [rad²/s²]."""
        low, high = self.frequencies[[0, -1]]
        frequencies = np.clip(np.asarray(omega) / (2 * np.pi), low, high)
        return np.asarray(self._spline(np.log(frequencies)))

    def padded(self, count: int) -> "Dispersion":
        """With further modes that do not change."""
        return Dispersion(self.frequencies, np.pad(self.values, ((0, 0), (0, count))))

    @cached_property
    def _spline(self) -> Any:
        from scipy.interpolate import CubicSpline  # which homogeneous plates do not need

        return CubicSpline(np.log(self.frequencies), self.values, axis=0)
