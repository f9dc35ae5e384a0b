"""What comes out of a calibration."""

from dataclasses import dataclass

from model.arrays import ComplexArray, FloatArray
from model.calibration.parameters import Parameter
from model.rig.rig import Rig

FITS = 0.25
"""Largest error of what was held out, relative to the response, of a fit to believe."""


@dataclass(frozen=True)
class FittedParameter:
    """A parameter with its value, standard error, and whether the data say anything of it.

    One that is not identified has the rig's own value and no standard error.
    """

    parameter: Parameter
    value: float
    standard_error: float | None
    at_bound: bool

    @property
    def is_identified(self) -> bool:
        """Whether the value was found in the data."""
        return self.standard_error is not None


@dataclass(frozen=True)
class SensorScale:
    """Reading per truth of a sensor, relative to the others' median, and its standard error."""

    name: str
    scale: float
    standard_error: float


@dataclass(frozen=True)
class HeldOut:
    """Prediction at sensors that the fit had not seen.

    Errors: root mean square over responses, each relative to all sensors' at its frequency and ERA;
    before: of the rig as it was.
    """

    sensors: tuple[str, ...]
    before: float
    after: float


@dataclass(frozen=True, eq=False)
class Calibration:
    """What a measurement says of a rig.

    rig: with the new values and gains; dead_sensors, dead_eras: left out; scales: the sensors that
    are not as the others, or all of them if asked for; held_out: None with too few sensors; error:
    as in HeldOut, over all that was fitted; measured, before, after: responses (f, eras, s) [1/s²]
    of the live sensors, scales taken out.
    """

    rig: Rig
    parameters: tuple[FittedParameter, ...]
    gains_error: FloatArray
    dead_sensors: tuple[str, ...]
    dead_eras: tuple[str, ...]
    scales: tuple[SensorScale, ...]
    outlier_count: int
    value_count: int
    error: float
    held_out: HeldOut | None
    sensors: tuple[str, ...]
    frequencies: FloatArray
    measured: ComplexArray
    before: ComplexArray
    after: ComplexArray

    @property
    def is_good(self) -> bool:
        """Whether the fitted plate is the measured one."""
        return bool((self.held_out.after if self.held_out else self.error) <= FITS)
