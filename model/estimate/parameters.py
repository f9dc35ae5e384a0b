"""Parameters of a plate that a fit can change, one class per kind.

A kind is, for example, the stiffness of the ERAs: one parameter per ERA, the logarithm of a factor
on the rig's value. Its class defines

- `names`: the names of its parameters for a given rig;
- `prior` and `datasheet_prior`: their uncertainty before a fit, for an installed rig and for a rig
  described only by data sheets;
- `value`: the value of the rig that they represent;
- `derivative`: the derivatives of the plate's responses with respect to them.

To add a kind, write a class, add it to `ALL_KINDS`, and use its value (`values[name]`) in
`model.estimate.forward`. `jacobian` collects the derivatives of all kinds.
`tests/model/estimate/test_identify.py` compares every derivative with a difference quotient.
"""

import math
from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.estimate.derivatives import ResponseDerivatives
from model.estimate.forward import MIN_LOSS_FACTOR, PlateAt
from model.estimate.parameter_space import (
    ParameterKind,
    ParameterValues,
    PlateValues,
    Prior,
    SearchScope,
    values_of_eras,
)
from model.finger import Grid
from model.rig.rig import Uncertainty
from model.structure.attachments import FEET_DEVIATE
from model.structure.plate import LOSS_FREQUENCY, MAX_LOSS_EXPONENT, MAX_LOSS_FACTOR
from model.structure.sources import damping_from_ratio

MASS_CELLS = Grid(8, 6)
"""Possible positions of foreign mass."""

_COIL_MASS_STD = 0.2
"""Assumed standard deviation of a coil mass from a data sheet, relative."""

_AS_BUILT = Uncertainty()
_DAMPING_STD = math.log(_AS_BUILT.damping)
_MIN_LOSS_STD = 0.7
"""Minimum standard deviation of a loss from a data sheet, relative."""


# Base classes: names of parameters, and priors that several kinds share.


class DifferentiableKind(ParameterKind):
    """A kind of parameters with derivatives of the responses."""

    @abstractmethod
    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        """Derivatives of the responses by all m parameters (f, s, n, m)."""


class StatedByRig(DifferentiableKind):
    """A kind whose name is also the key of its standard deviation in the rig's `uncertainty`."""

    def prior(self, scope: SearchScope) -> Prior:
        std: float = getattr(scope.uncertainty, self.name)
        return Prior(std)


class PlateParameter(DifferentiableKind):
    """Kind with a single parameter."""

    def names(self, scope: SearchScope) -> Sequence[str]:
        return [self.label]


class EraParameter(DifferentiableKind):
    """Kind with one parameter per ERA."""

    per_era = 1

    def names(self, scope: SearchScope) -> Sequence[str]:
        return [f"{self.label} {era}" for era in scope.eras]


class SensorParameter(DifferentiableKind):
    """Kind with one parameter per sensor."""

    def names(self, scope: SearchScope) -> Sequence[str]:
        return [f"{self.label} {sensor}" for sensor in scope.sensors]


class ModeParameter(DifferentiableKind):
    """Kind with one parameter for each of the lowest elastic modes."""

    def names(self, scope: SearchScope) -> Sequence[str]:
        return [f"{self.label} {n}" for n in range(1, scope.mode_count + 1)]


class FormError(DifferentiableKind):
    """Kind that exists only on plates with form errors, exactly known for an installed rig."""

    def names(self, scope: SearchScope) -> Sequence[str]:
        return self.form_names(scope) if scope.has_form_errors else ()

    def form_names(self, scope: SearchScope) -> Sequence[str]:
        """Names of the parameters of a plate with form errors."""
        return [self.label]

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        return _form_error_prior(scope, self.std)


class EraFactor(EraParameter):
    """Logarithm of a factor on a value of each ERA, whose rig-file key is the kind's name."""

    largest_factor = 10.0
    """Largest factor that a fit to data sheets can find."""

    def value(self, values: PlateValues) -> FloatArray:
        factors = np.exp(values.deviations(self.name))
        return values_of_eras(values.rig, self.name) * factors

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.era_values(self.name)

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        std = max(self.std, scope.rig.uncertainty.stiffness)
        bound = math.log(self.largest_factor)
        return Prior(std, -bound, bound)


class ExciterFactor(EraFactor):
    """Logarithm of a factor on a value that exciters have and other ERAs do not."""

    std = _AS_BUILT.stiffness

    def names(self, scope: SearchScope) -> Sequence[str]:
        return super().names(scope) if scope.excites.any() else ()

    def prior(self, scope: SearchScope) -> Prior:
        return Prior(scope.uncertainty.stiffness * scope.excites)

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        prior = super().datasheet_prior(scope)
        return prior._replace(std=prior.std * scope.excites)


# The plate.


class ThicknessFactor(StatedByRig, PlateParameter):
    """Logarithm of a factor on the thickness; the bending stiffness has its third power."""

    name = label = "thickness"
    std = _AS_BUILT.thickness
    stage = 0
    is_listed = True

    def value(self, values: PlateValues) -> float:
        return values.factor(self.name)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return 2 * derivatives.rigidity - derivatives.free_receptance


class ModulusFactor(PlateParameter):
    """Logarithm of a factor on Young's modulus; known exactly if the thickness is."""

    name = label = "modulus"
    std = _AS_BUILT.modulus
    is_listed = True

    def prior(self, scope: SearchScope) -> Prior:
        std = self.std if scope.uncertainty.thickness > 0 else 0.0
        return Prior(max(std, scope.uncertainty.elasticity))

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        return Prior(0.07, -math.log(3.0), math.log(3.0))

    def value(self, values: PlateValues) -> float:
        return values.factor(self.name)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.rigidity


class LossFactor(PlateParameter):
    """Logarithm of a factor on the plate's loss factor."""

    name = "loss"
    label = "loss factor"
    std = _DAMPING_STD
    stage = 0
    is_listed = True

    def prior(self, scope: SearchScope) -> Prior:
        return _loss_prior(scope, math.log(scope.uncertainty.damping))

    def value(self, values: PlateValues) -> float:
        """Loss factor of the plate, including `LossAdded`."""
        scaled = values.rig.plate.loss_factor * values.factor("loss")
        added = values.deviations("loss_added")[0]
        return float(np.clip(scaled + added, 0.0, MAX_LOSS_FACTOR))

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.loss_factor


class LossAdded(PlateParameter):
    """Loss factor added to the rig's, which may be zero."""

    name = "loss_added"
    label = "further loss factor"
    std = 0.0
    unit = ""
    per_unit = 1.0

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        loss_factor = scope.rig.plate.loss_factor
        return _added_prior(loss_factor, std=max(_MIN_LOSS_STD * loss_factor, 0.003), largest=0.5)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        loss_factor = derivatives.plate.values["loss"]
        return np.asarray(derivatives.loss_factor / max(loss_factor, MIN_LOSS_FACTOR))


class LossExponent(PlateParameter):
    """Change of the power of frequency that the loss factor follows."""

    name = "loss_exponent"
    label = "loss exponent"
    std = 0.3
    unit = ""
    per_unit = 1.0

    def prior(self, scope: SearchScope) -> Prior:
        exponent = scope.rig.plate.loss_exponent
        lower, upper = -MAX_LOSS_EXPONENT - exponent, MAX_LOSS_EXPONENT - exponent
        return Prior(_loss_prior(scope, self.std).std, lower, upper)

    def value(self, values: PlateValues) -> float:
        return float(values.rig.plate.loss_exponent + values.deviations(self.name)[0])

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        log_frequency = np.log(derivatives.plate.model.frequencies / LOSS_FREQUENCY)
        return log_frequency[:, None, None, None] * derivatives.loss_factor


class ModeStiffness(ModeParameter):
    """Logarithm of a factor on the eigenvalue of each of the lowest modes."""

    name = "mode_shifts"
    label = "stiffness of mode"
    std = 0.01
    theory = 3e-3

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        return Prior(0.003)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.mode_stiffness


class ModeLoss(ModeParameter):
    """Logarithm of a factor on the loss factor of each of the lowest modes."""

    name = "mode_losses"
    label = "loss of mode"
    std = 0.5

    def prior(self, scope: SearchScope) -> Prior:
        return _loss_prior(scope, self.std)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.mode_losses


# ERAs and their drives.


class Stiffness(StatedByRig, EraFactor):
    """Logarithm of a factor on the stiffness of each ERA."""

    name = label = "stiffness"
    std = _AS_BUILT.stiffness
    theory = 3e-3
    stage = 0
    is_listed = True

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        """Prior of stiffnesses from data sheets, which are more precise than assumed values."""
        std = max(0.10, scope.rig.uncertainty.stiffness)
        return super().datasheet_prior(scope)._replace(std=std)


class Damping(PlateParameter):
    """Logarithm of a common factor on the damping of all ERAs."""

    name = label = "damping"
    std = _DAMPING_STD
    stage = 0
    is_listed = True

    def prior(self, scope: SearchScope) -> Prior:
        return Prior(math.log(scope.uncertainty.damping) * _uncertain_damping(scope).max())

    def value(self, values: PlateValues) -> FloatArray:
        """Damping of each ERA (n,) [N s/m], combining the three kinds that change it."""
        log_factors = values.deviations("damping") + values.deviations("damping_each")
        scaled = values_of_eras(values.rig, "damping") * np.exp(log_factors)
        return np.maximum(scaled + values.deviations("damping_added"), 0.0)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return np.asarray(_log_damping_derivatives(derivatives).sum(axis=-1, keepdims=True))


class DampingOfEra(EraParameter):
    """Logarithm of a factor on the damping of each ERA; known exactly if `Damping` is."""

    name = "damping_each"
    label = "damping"
    std = 0.2
    theory = 0.01
    stage = 0

    def prior(self, scope: SearchScope) -> Prior:
        return Prior(self.std * _uncertain_damping(scope))

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return _log_damping_derivatives(derivatives)


class DampingAdded(EraParameter):
    """Damping added to the rig's, which may be zero. Data sheets seldom state it."""

    name = "damping_added"
    label = "further damping"
    std = 0.0
    unit = "N s/m"
    per_unit = 1.0

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        """Prior from a damping ratio of each ERA on its share of the plate."""
        rig = scope.rig
        critical_damping = np.array(
            [
                damping_from_ratio(
                    1.0,
                    stiffness=era.in_time.stiffness,
                    plate_mass=rig.plate.mass,
                    era_count=len(rig.eras),
                )
                for era in rig.eras
            ]
        )
        damping = values_of_eras(rig, "damping")
        return _added_prior(damping, std=_MIN_LOSS_STD * damping, largest=2.0 * critical_damping)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.era_values("damping")


class DriveGain(StatedByRig, EraParameter):
    """Logarithm of a factor on the gain of each drive, which multiplies the rig's gains."""

    name = label = "gain"
    std = _AS_BUILT.gain
    stage = 0
    is_listed = True

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        return Prior(1.0, -8.0, 8.0)

    def value(self, values: PlateValues) -> ComplexArray:
        """Complex factor on each gain, with the phase of `DrivePhase`."""
        return np.exp(values.deviations("gain") + 1j * values.deviations("phase"))

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.drive_gains()


class DrivePhase(EraParameter):
    """Phase of each drive [rad]."""

    name = label = "phase"
    std = math.radians(_AS_BUILT.phase_deg)
    unit = "°"
    per_unit = math.degrees(1)
    stage = 0
    is_listed = True

    def prior(self, scope: SearchScope) -> Prior:
        return Prior(math.radians(scope.uncertainty.phase_deg))

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.drive_gains(1j)


class DriveInertia(EraParameter):
    """Inertia of each drive [1/kHz²]; one standard deviation corresponds to a resonance at
    700 Hz."""

    name = "inertia"
    label = "inertia of drive"
    std = 1 / 0.7**2
    unit = "/kHz²"
    per_unit = 1.0
    stage = 0

    def prior(self, scope: SearchScope) -> Prior:
        return _lag_prior(scope, self.std)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        kilohertz = 1e-3 * derivatives.plate.model.frequencies[:, None]
        factor = kilohertz**2 * derivatives.plate.lag
        return derivatives.drive_gains(factor[:, None, None])


class DriveDrag(EraParameter):
    """Drag of each drive [1/kHz]; one standard deviation corresponds to a damping ratio of 0.5 at
    700 Hz."""

    name = "drag"
    label = "drag of drive"
    std = 1 / 0.7
    unit = "/kHz"
    per_unit = 1.0
    stage = 0

    def prior(self, scope: SearchScope) -> Prior:
        return _lag_prior(scope, self.std)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        kilohertz = 1e-3 * derivatives.plate.model.frequencies[:, None]
        factor = -1j * kilohertz * derivatives.plate.lag
        return derivatives.drive_gains(factor[:, None, None])


class BoltMass(EraParameter):
    """Mass added to the bolt of each ERA, or to the coil of an exciter [kg]."""

    name = "bolt_mass"
    label = "bolt mass"
    std = 0.5e-3
    unit = "g"
    per_unit = 1e3

    def prior(self, scope: SearchScope) -> Prior:
        return Prior(self.std, lower=-values_of_eras(scope.rig, "bolt_mass"))

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        """Prior of coils from their data sheets, which omit the glue; bolts have no data sheet.

        A coil's mass and the gain of its drive change a response in the same way, so its prior
        must be narrow.
        """
        bolt = values_of_eras(scope.rig, "bolt_mass")
        carried = scope.rig.plate.mass / len(scope.rig.eras)
        is_coil = scope.excites & (bolt > 0)
        std = np.where(is_coil, _COIL_MASS_STD * bolt, 0.05 * carried)
        return _added_prior(bolt, std=std, largest=np.where(is_coil, 2 * bolt, 5.0 * carried))

    def value(self, values: PlateValues) -> FloatArray:
        added = values.deviations(self.name)
        return np.maximum(values_of_eras(values.rig, self.name) + added, 0.0)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.era_values("bolt_mass")


class MagnetMass(ExciterFactor):
    """Logarithm of a factor on the magnet mass of each exciter."""

    name = "magnet_mass"
    label = "magnet mass"


class ForceFactor(ExciterFactor):
    """Logarithm of a factor on the force factor of each exciter.

    The coil also damps, like the suspension; responses cannot separate the two.
    """

    name = "force_factor"
    label = "force factor"
    largest_factor = math.inf


class EraLocation(DifferentiableKind):
    """x and y of each ERA, relative to the rig's [m].

    On a plate with form errors an ERA can leave the plate, whose mode shapes are continued
    linearly.
    """

    name = "place"
    std = 1.5e-3
    unit = "mm"
    per_unit = 1e3
    theory = 1e-4
    per_era = 2
    stage = 1

    def names(self, scope: SearchScope) -> Sequence[str]:
        return [f"{axis} of {era}" for era in scope.eras for axis in "xy"]

    def prior(self, scope: SearchScope) -> Prior:
        """Prior of positions that were measured with a ruler and are on the plate."""
        positions = np.array([(era.x, era.y) for era in scope.rig.eras])
        return Prior(self.std, -positions.ravel(), (scope.sides - positions).ravel())

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        return _form_error_prior(scope, self.std)

    def value(self, values: PlateValues) -> FloatArray:
        """Positions of the ERAs (n, 2) [m]."""
        positions = np.array([(era.x, era.y) for era in values.rig.eras])
        return positions + values.deviations(self.name).reshape(-1, 2)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.positions[..., : 2 * len(derivatives.plate.sources)]


# Other attachments of the plate


class AddedMasses(DifferentiableKind):
    """Additional masses [kg], each with x and y from the middle of the plate [m]."""

    name = "masses"
    std = 2e-3
    unit = "g"
    per_unit = 1e3
    stage = 1

    def names(self, scope: SearchScope) -> Sequence[str]:
        numbers = range(1, scope.masses + 1)
        return [f"{axis}mass {n}" for n in numbers for axis in ("", "x of ", "y of ")]

    def prior(self, scope: SearchScope) -> Prior:
        half = scope.sides / 2
        one_mass = Prior(
            std=np.array([self.std, *scope.sides / 3]),
            lower=np.array([0.0, *-half]),
            upper=np.array([np.inf, *half]),
        )
        return Prior(*(np.tile(values, scope.masses) for values in one_mass))

    def value(self, values: PlateValues) -> FloatArray:
        """Mass [kg], x and y [m] of each mass (m, 3), moved onto the plate if outside."""
        masses = values.deviations(self.name).reshape(-1, 3)
        plate = values.rig.plate
        sides = np.array([plate.length, plate.width])
        masses[:, 1:] = np.clip(masses[:, 1:] + sides / 2, 0, sides)
        return masses

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.added_masses


class FootStiffness(StatedByRig):
    """Logarithm of a factor on the stiffness of each foot."""

    name = "supports"
    std = FEET_DEVIATE
    is_listed = True

    def names(self, scope: SearchScope) -> Sequence[str]:
        return [f"stiffness of foot {foot}" for foot in scope.rig.foot_names]

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        return Prior(scope.rig.uncertainty.supports, -math.log(10.0), math.log(10.0))

    def value(self, values: PlateValues) -> FloatArray:
        return np.exp(values.deviations(self.name))

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        plate = derivatives.plate
        feet = len(plate.sources) + np.array(plate.model.rig.feet, dtype=int)
        springs = plate.values[self.name] * plate.model.foot_springs
        return derivatives.attachment_stiffness(feet, springs)


# Sensors.


class SensorGain(SensorParameter):
    """Logarithm of a factor on the gain of each sensor."""

    name = "sensor_gain"
    label = "gain of sensor"
    std = 0.05
    stage = 0

    def value(self, values: PlateValues) -> ComplexArray:
        """Complex factor on each gain, with the phase of `SensorPhase`."""
        return np.exp(values.deviations("sensor_gain") + 1j * values.deviations("sensor_phase"))

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.sensor_gains


class SensorPhase(SensorParameter):
    """Phase of each sensor [rad]."""

    name = "sensor_phase"
    label = "phase of sensor"
    std = math.radians(5)
    unit = "°"
    per_unit = math.degrees(1)
    stage = 0

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return 1j * derivatives.sensor_gains


# Form errors, which no rig file describes: inaccurate cutting, positions, and attached cables


class SensorScale(FormError):
    """Relative error of each sensor's scale."""

    name = "sensor_scale"
    std = 0.01

    def form_names(self, scope: SearchScope) -> Sequence[str]:
        return [f"scale of sensor {sensor}" for sensor in scope.sensors]

    def value(self, values: PlateValues) -> FloatArray | float:
        """Factor on each sensor's reading, 1 on a plate without form errors."""
        errors = values.deviations(self.name)
        return 1 + errors if errors.size else 1.0

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        plate = derivatives.plate
        gain = plate.values["sensor_gain"][:, None]
        unscaled = gain * plate.drive[:, None] * plate.sensed_receptance
        return np.asarray(unscaled[..., None] * np.eye(len(plate.model.sensors))[:, None])


class SensorPosition(FormError):
    """x and y of each sensor that is not at an ERA, relative to the rig's [m]."""

    name = "sensor_place"
    std = 0.5e-3
    unit = "mm"
    per_unit = 1e3

    def form_names(self, scope: SearchScope) -> Sequence[str]:
        return [f"{axis} of sensor {n}" for n in range(scope.form_of or 0) for axis in "xy"]

    def value(self, values: PlateValues) -> FloatArray:
        return values.deviations(self.name).reshape(-1, 2)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        plate = derivatives.plate
        first = len(plate.sources) + plate.model.mass_count
        return derivatives.positions[..., 2 * first :]


class ForeignMass(FormError):
    """Mass in each cell of the plate, as a share of the plate's mass; the sum is zero.

    The prior is 1 % of the plate's mass over all cells.
    """

    name = "foreign_mass"
    std = 0.01 / math.sqrt(MASS_CELLS.cell_count)

    def form_names(self, scope: SearchScope) -> Sequence[str]:
        return [f"mass {n}" for n in range(MASS_CELLS.cell_count)]

    def value(self, values: PlateValues) -> FloatArray:
        shares = values.deviations(self.name)
        return np.asarray(shares - shares.mean())

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.foreign_mass


class SideLength(FormError):
    """Error of length and width [m]."""

    name = "side"
    std = 0.5e-3
    unit = "mm"
    per_unit = 1e3

    def form_names(self, scope: SearchScope) -> Sequence[str]:
        return ["length", "width"]

    def value(self, values: PlateValues) -> FloatArray:
        """Relative errors of length and width (2,)."""
        plate = values.rig.plate
        return values.deviations(self.name) / [plate.length, plate.width]

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.stretch(0, 1) / derivatives.plate.model.sides


class PoissonRatio(FormError):
    """Error of Poisson's ratio."""

    name = "poisson"
    label = "Poisson's ratio"
    std = 0.015
    unit = ""
    per_unit = 1.0

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.stretch(2)


class LossLaw(FormError):
    """Law of losses, from hysteretic (0) to viscous (1); see `model.estimate.loss_law`."""

    name = "loss_law"
    label = "loss law"
    std = 1.0
    unit = ""
    per_unit = 1.0

    def value(self, values: PlateValues) -> float:
        return float(values.deviations(self.name).sum())

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        change = derivatives.plate.model.viscous_change
        return (derivatives.plate.scale * (0.0 if change is None else change))[..., None]


ALL_KINDS: tuple[DifferentiableKind, ...] = (
    ThicknessFactor(),
    ModulusFactor(),
    Stiffness(),
    Damping(),
    DampingOfEra(),
    DampingAdded(),
    LossFactor(),
    LossAdded(),
    LossExponent(),
    DriveGain(),
    DrivePhase(),
    DriveInertia(),
    DriveDrag(),
    SensorGain(),
    SensorPhase(),
    BoltMass(),
    MagnetMass(),
    ForceFactor(),
    EraLocation(),
    AddedMasses(),
    ModeStiffness(),
    ModeLoss(),
    FootStiffness(),
    SensorScale(),
    SensorPosition(),
    ForeignMass(),
    SideLength(),
    PoissonRatio(),
    LossLaw(),
)
"""All kinds of parameters, in the order in which a space lists them."""

PARAMETER_KINDS: dict[str, DifferentiableKind] = {kind.name: kind for kind in ALL_KINDS}
"""All kinds of parameters by name."""

FORM_ERRORS = tuple(kind.name for kind in ALL_KINDS if isinstance(kind, FormError))
"""Names of the kinds that only a plate with form errors has."""


def jacobian(plate: PlateAt, searched: NDArray[np.bool_] | None = None) -> ComplexArray:
    """Derivatives of the responses of a plate by x, (f, s, n, p).

    searched (p,): mask of the requested parameters, default all; kinds without any get zeros.
    """
    space = plate.model.space
    is_requested = space.uncertain
    if searched is not None:
        is_requested = is_requested & searched
    derivatives = ResponseDerivatives(plate)
    slopes = np.zeros((*plate.responses.shape, space.size), dtype=complex)
    for name, part in space.groups.items():
        if is_requested[part].any():
            slopes[..., part] = PARAMETER_KINDS[name].derivative(derivatives) * space.std[part]
    return slopes


def _added_prior(
    value: ParameterValues, *, std: ParameterValues, largest: ParameterValues
) -> Prior:
    """Return the prior of an addition to a value that cannot become negative."""
    return Prior(std, -value, np.maximum(largest - value, value))


def _form_error_prior(scope: SearchScope, std: float) -> Prior:
    """Return the prior of a form error, exactly known on a plate without form errors."""
    return Prior(std if scope.has_form_errors else 0.0)


def _loss_prior(scope: SearchScope, std: float) -> Prior:
    """Return the prior of a loss of the plate, exactly known on a plate without it."""
    is_uncertain = scope.uncertainty.damping > 1 and scope.rig.plate.loss_factor > 0
    return Prior(std if is_uncertain else 0.0)


def _lag_prior(scope: SearchScope, std: float) -> Prior:
    """Return the prior of the unknown lag of each drive.

    A measured gain includes the lag of its drive, and an exciter's force includes its coil's lag.
    """
    has_gains = [bool(era.gains) for era in scope.rig.eras]
    is_known = np.array(has_gains) | scope.excites
    return Prior(std * (~is_known & scope.drives_lag), lower=0.0)


def _uncertain_damping(scope: SearchScope) -> FloatArray:
    """1 for each ERA whose damping is uncertain, otherwise 0, (n,)."""
    is_damped = np.array([era.damping > 0 for era in scope.rig.eras])
    return (is_damped & (scope.uncertainty.damping > 1)).astype(float)


def _log_damping_derivatives(derivatives: ResponseDerivatives) -> ComplexArray:
    """Derivatives by the logarithm of the damping of each ERA (f, s, n, n)."""
    return np.asarray(derivatives.era_values("damping") * derivatives.plate.values["damping"])
