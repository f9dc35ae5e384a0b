"""Parameters of ERAs and their drives, of masses, and of feet."""

import math
from collections.abc import Sequence

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.estimate.derivatives import ResponseDerivatives
from model.estimate.parameter_kinds import (
    AS_BUILT,
    DAMPING_STD,
    MIN_LOSS_STD,
    DifferentiableKind,
    EraFactor,
    EraParameter,
    ExciterFactor,
    PlateParameter,
    StatedByRig,
    added_prior,
    form_error_prior,
)
from model.estimate.parameter_space import (
    PlateValues,
    Prior,
    SearchScope,
    values_of_eras,
)
from model.structure.attachments import FEET_DEVIATE
from model.structure.sources import damping_from_ratio

_COIL_MASS_STD = 0.2
"""Assumed standard deviation of a coil mass from a data sheet, relative."""


class Stiffness(StatedByRig, EraFactor):
    """Logarithm of a factor on the stiffness of each ERA."""

    name = label = "stiffness"
    std = AS_BUILT.stiffness
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
    std = DAMPING_STD
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
        return added_prior(damping, std=MIN_LOSS_STD * damping, largest=2.0 * critical_damping)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.era_values("damping")


class DriveGain(StatedByRig, EraParameter):
    """Logarithm of a factor on the gain of each drive, which multiplies the rig's gains."""

    name = label = "gain"
    std = AS_BUILT.gain
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
    std = math.radians(AS_BUILT.phase_deg)
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
        return added_prior(bolt, std=std, largest=np.where(is_coil, 2 * bolt, 5.0 * carried))

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
        return form_error_prior(scope, self.std)

    def value(self, values: PlateValues) -> FloatArray:
        """Positions of the ERAs (n, 2) [m]."""
        positions = np.array([(era.x, era.y) for era in values.rig.eras])
        return positions + values.deviations(self.name).reshape(-1, 2)

    def derivative(self, derivatives: ResponseDerivatives) -> ComplexArray:
        return derivatives.positions[..., : 2 * len(derivatives.plate.sources)]


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
