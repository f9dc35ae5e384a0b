"""Results of a calibration."""

from dataclasses import dataclass
from typing import Any

from model.arrays import ComplexArray, FloatArray
from model.calibration.sensed_plate import Parameter
from model.files.csv_file import as_frame
from model.rig.rig import Rig

MAX_FIT_ERROR = 0.25
"""Largest relative error at held-out sensors of an acceptable fit."""

MAX_OUTLIERS = 0.1
"""Largest share of values left out of an acceptable fit."""


@dataclass(frozen=True)
class FittedParameter:
    """A parameter with the rig's value, the fitted one and its standard error.

    One that is not identified has the rig's value and no standard error.
    """

    parameter: Parameter
    before: float
    value: float
    standard_error: float | None
    at_bound: bool

    @property
    def is_identified(self) -> bool:
        """Whether the data determine the value."""
        return self.standard_error is not None


@dataclass(frozen=True)
class SensorScale:
    """Scale of a sensor relative to the others' median, and its standard error."""

    name: str
    scale: float
    standard_error: float


@dataclass(frozen=True)
class MovedEra:
    """An ERA that is clearly not at the rig's place: x, y [m] before and after, standard errors."""

    name: str
    before: tuple[float, float]
    after: tuple[float, float]
    standard_error: tuple[float, float]


@dataclass(frozen=True)
class HeldOutSensors:
    """Prediction at sensors held out of the fit.

    before, after: error of the old and the fitted rig, root mean square over responses, each
    relative to all sensors' at its frequency and ERA; median: of the fitted rig's; unexplained: by
    it, without what noise and the sensors' own tolerances explain.
    """

    sensors: tuple[str, ...]
    before: float
    after: float
    median: float
    unexplained: float


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibrated rig with everything found about the measurement.

    moved: ERAs at other places than in the rig before; gains_error (f, eras): standard errors of
    the rig's gains, NaN where unmeasured; dead_sensors, dead_eras: left out of the
    fit; scales: of sensors with a wrong scale, or of all if requested; held_out: None with too few
    sensors; error: as in HeldOut, of the fit with its form errors; chi2: of that fit, about 1;
    measured, before, after: responses (f, eras, s) [1/s²] of the live sensors, divided by their
    scales.
    """

    rig: Rig
    parameters: tuple[FittedParameter, ...]
    moved: tuple[MovedEra, ...]
    gains_error: FloatArray
    dead_sensors: tuple[str, ...]
    dead_eras: tuple[str, ...]
    scales: tuple[SensorScale, ...]
    outlier_count: int
    value_count: int
    error: float
    chi2: float
    held_out: HeldOutSensors | None
    sensors: tuple[str, ...]
    frequencies: FloatArray
    measured: ComplexArray
    before: ComplexArray
    after: ComplexArray

    def to_frame(self) -> Any:
        """Parameters before and after, their units and errors, as a pandas DataFrame.

        A row a parameter; needs pandas.
        """
        return as_frame(
            {
                "parameter": [each.parameter.name for each in self.parameters],
                "unit": [each.parameter.unit for each in self.parameters],
                "before": [each.before for each in self.parameters],
                "after": [each.value for each in self.parameters],
                "standard_error": [each.standard_error for each in self.parameters],
            }
        )

    @property
    def is_good(self) -> bool:
        """Whether the fit predicts what it was not shown; by few sensors it says nothing."""
        return self.held_out is not None and self.held_out.after <= MAX_FIT_ERROR
