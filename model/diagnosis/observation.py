"""Responses measured on a rig while its channels were driven one by one."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.calibration.responses import Responses


@dataclass(frozen=True, eq=False)
class Observation(Responses):
    """Responses per commanded base displacement, by the ERA to which the rig wires the channel.

    has_phases: whether phases are relative to the drive; otherwise only phases between sensors are
    known, and no polarity.
    """

    has_phases: bool

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
        )
