"""Responses measured on a rig while its channels were driven one by one and in pairs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.calibration.responses import Responses


@dataclass(frozen=True, eq=False)
class Pair:
    """Two channels driven alike at one frequency [Hz], in phase: values (s,) [1/s²].

    eras: indices of the ERAs to which the rig wires them.
    """

    frequency: float
    eras: tuple[int, int]
    values: ComplexArray


@dataclass(frozen=True, eq=False)
class Observation(Responses):
    """Responses per commanded base displacement, by the ERA to which the rig wires the channel.

    has_phases: whether phases are relative to the drive; otherwise only phases between sensors are
    known, and polarity follows from pairs. floor (s,): values without a drive, a bound of the noise
    [1/s²]; None if not measured.
    """

    has_phases: bool
    pairs: Sequence[Pair] = ()
    floor: FloatArray | None = None

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Mask of the ERAs whose channels were driven (e,)."""
        return np.asarray(np.isfinite(self.values).any(axis=(0, 2)))

    def without(self, sensors: NDArray[np.bool_]) -> "Observation":
        """Remove some of the sensors (s,)."""
        kept = ~sensors
        return replace(
            self,
            sensors=tuple(name for name, keep in zip(self.sensors, kept, strict=True) if keep),
            points=self.points[kept],
            values=self.values[:, :, kept],
            pairs=[replace(pair, values=pair.values[kept]) for pair in self.pairs],
            floor=None if self.floor is None else self.floor[kept],
        )
