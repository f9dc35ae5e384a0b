"""What was measured on a rig while its channels were driven in turn, and some of them in pairs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.calibration.responses import Responses


@dataclass(frozen=True, eq=False)
class Pair:
    """Two channels driven alike, at one frequency [Hz] and in phase: values (s,) [1/s²].

    eras: the numbers of the ERAs that the rig says they drive.
    """

    frequency: float
    eras: tuple[int, int]
    values: ComplexArray


@dataclass(frozen=True, eq=False)
class Observation:
    """Acceleration per base displacement that was asked for [1/s²], NaN where there is none.

    sensors (s,) names; points (s, 2) [m]; frequencies (f,) [Hz]; values (f, e, s): by the ERA that
    the rig says the driven channel is wired to. has_phases: whether phases are those of the drive;
    if not, only those between sensors mean anything, and pairs tell polarity. floor (s,): what
    values are where nothing is driven, for noise [1/s²]; None where nobody looked.
    """

    sensors: tuple[str, ...]
    points: FloatArray
    frequencies: FloatArray
    values: ComplexArray
    has_phases: bool
    pairs: Sequence[Pair] = ()
    floor: FloatArray | None = None

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which ERAs' channels were driven (e,)."""
        return np.asarray(np.isfinite(self.values).any(axis=(0, 2)))

    def without(self, sensors: NDArray[np.bool_]) -> "Observation":
        """The same without some of the sensors (s,)."""
        kept = ~sensors
        return replace(
            self,
            sensors=tuple(name for name, keep in zip(self.sensors, kept, strict=True) if keep),
            points=self.points[kept],
            values=self.values[:, :, kept],
            pairs=[replace(pair, values=pair.values[kept]) for pair in self.pairs],
            floor=None if self.floor is None else self.floor[kept],
        )


def observation_of(responses: Responses, *, has_phases: bool) -> Observation:
    """Measured responses, by what each of the rig's channels did."""
    return Observation(
        responses.sensors,
        responses.points,
        responses.frequencies,
        responses.values,
        has_phases,
    )
