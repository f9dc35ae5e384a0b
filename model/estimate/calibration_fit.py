"""The plate of a rig of data sheets at its sensors, and the values that are fitted of it."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray, IntArray
from model.estimate.forward import ForwardModel, Sensor
from model.estimate.measurement import Responses
from model.estimate.space import (
    KINDS,
    MAX_GUESSED,
    VALUE_UNITS,
    Values,
    reduced_modes,
    rig_with,
    space_by_sheets,
)
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig

_LOWEST, _HIGHEST = 0.1, 1.2  # of modes that shift: of the lowest frequency, of the highest tone

_ADDED_KINDS = {"loss_factor": "loss_added", "damping": "damping_added"}


@dataclass(frozen=True)
class Parameter:
    """A fitted value of a rig: of the plate, of an ERA or of a foot."""

    kind: str
    """Kind of value, as a key of `VALUE_UNITS`."""
    era: str
    """Name of the ERA, "" for the plate and for feet."""
    field: str = ""
    """Attribute of the ERA, which exciters name differently; by default the kind."""
    foot: str = ""
    """Name of the foot, "" for other values."""

    @property
    def name(self) -> str:
        """Name in reports."""
        if self.foot:
            return f"foot {self.foot} stiffness"
        return f"{self.era or 'plate'} {self.field or self.kind}"

    @property
    def unit(self) -> str:
        """Unit of its value."""
        return VALUE_UNITS[self.kind]

    @property
    def is_factor(self) -> bool:
        """Whether x is the logarithm of a factor on the rig's value, not what is added to it."""
        return self.kind in ("modulus", "stiffness", "magnet_mass", "supports")

    def of(self, rig: Rig) -> float:
        """The value in a rig."""
        if self.era:
            era = rig.era(self.era)
            return float(getattr(era, era.fields[self.kind]))
        if self.foot:
            return rig.masses[rig.feet[rig.foot_names.index(self.foot)]].stiffness
        return (
            rig.plate.material.E if self.kind == "modulus" else float(getattr(rig.plate, self.kind))
        )


@dataclass(frozen=True, eq=False)
class SensedPlate:
    """A rig's plate with sensors at points, without the rig's gains, and the values fitted of it.

    Parameters z (p,) are those of the model's space, in standard deviations from the rig's values.
    """

    rig: Rig
    model: ForwardModel
    """Its space has the n fitted values, and form errors if there are any; all else is known."""

    @cached_property
    def rows(self) -> tuple[Parameter, ...]:
        """The fitted values (n,): modulus and loss factor, those of every ERA and of every foot."""
        of_eras = (
            Parameter(kind, era.name, era.fields[kind])
            for era in self.rig.eras
            for kind in ("stiffness", "damping", "bolt_mass", "magnet_mass")
            if kind in era.fields
        )
        names = self.rig.foot_names if self.rig.uncertainty.supports else ()
        feet = (Parameter("supports", "", foot=name) for name in names)
        return (Parameter("modulus", ""), Parameter("loss_factor", ""), *of_eras, *feet)

    @cached_property
    def largest_errors(self) -> FloatArray:
        """Standard errors (n,), in deviations, beyond which a fitted value is not identified.

        Infinite for an exciter's coil and magnet, which its sheet holds; a prior holds feet, too.
        """
        by_sheet = [each for each in self.of_exciters if each.kind in ("bolt_mass", "magnet_mass")]
        rows = self.rows
        return np.array(
            [math.inf if row in by_sheet else MAX_GUESSED if row.foot else 1.0 for row in rows]
        )

    @cached_property
    def of_exciters(self) -> tuple[Parameter, ...]:
        """The fitted values of exciters."""
        exciters = {era.name for era in self.rig.eras if "force_factor" in era.fields}
        return tuple(row for row in self.rows if row.era in exciters)

    @property
    def masses(self) -> FloatArray:
        """Mass of the sensor at each point while it measures there, (s,) [kg]."""
        return np.array([sensor.mass for sensor in self.model.sensors])

    @cached_property
    def numbers(self) -> IntArray:
        """Number of each fitted value in the space (n,)."""
        names, groups = ["", *(era.name for era in self.rig.eras)], self.model.space.groups
        feet = ["", *self.rig.foot_names]
        return np.array(
            [
                groups[_ADDED_KINDS.get(row.kind, row.kind)].start
                + max(names.index(row.era) + feet.index(row.foot) - 1, 0)
                for row in self.rows
            ]
        )

    def of(self, rig: Rig) -> "SensedPlate":
        """The plate of a rig with another modulus, thickness, loss factor, ERAs and masses.

        Its free plate is not solved again.
        """
        shifting = None
        if self.model.form is not None:
            natural = np.sqrt(np.maximum(self.model.modes.eigenvalues, 0)) / (2 * np.pi)
            highest = _HIGHEST * self.model.frequencies.max()
            lowest = _LOWEST * rig.plate.lowest_bending_frequency
            shifting = int(((natural > lowest) & (natural < highest)).sum())
        names = [sensor.name for sensor in self.model.sensors]
        space = space_by_sheets(rig, names, shifting)
        eras = tuple(replace(era, gains=()) for era in rig.eras)
        return SensedPlate(rig, replace(self.model, rig=replace(rig, eras=eras), space=space))

    def responses(self, z: FloatArray | None = None) -> ComplexArray:
        """Acceleration per base displacement of each ERA at z (p,), by default the rig's values.

        Shape (f, s, eras) [1/s²].
        """
        return self.model.at(np.zeros(self.model.space.size) if z is None else z).responses

    def rig_at(self, z: FloatArray) -> Rig:
        """The rig with the fitted values of z."""
        own = np.zeros(len(z))
        own[self.numbers] = z[self.numbers]
        beside = self.model.space.groups["force_factor"]
        own[beside] = z[beside]  # with the damping that was found beside it
        values = Values.of(self.rig, self.model.space, own)
        return rig_with(self.rig, values, self.rig.uncertainty)

    def values(self, z: FloatArray) -> FloatArray:
        """The fitted values at z in their units (n,)."""
        rig = self.rig_at(z)
        return np.array([row.of(rig) for row in self.rows])

    def deviations(self, z: FloatArray) -> FloatArray:
        """Deviations of the fitted values at z (n,), in standard deviations of rigs as written.

        That is the larger of the uncertainty of data sheets and that of the rig. Losses vary by
        factors: where they exceed the rig's, their logarithm counts.
        """
        stated, std = self.rig.uncertainty, self.model.space.std[self.numbers]
        factor = math.log(stated.damping)
        of_kind = {
            "modulus": math.hypot(2 * stated.thickness, stated.modulus),
            "loss_factor": factor,
            "stiffness": math.hypot(stated.stiffness, stated.thickness),
            "magnet_mass": math.hypot(stated.stiffness, stated.thickness),
            "damping": math.hypot(factor, KINDS["damping_each"].std),
            "supports": stated.supports,
        }
        own = np.array([row.of(self.rig) for row in self.rows])
        of_rig = (own > 0) * [of_kind.get(row.kind, 0.0) for row in self.rows]
        is_lossy = (own > 0) & [row.kind in _ADDED_KINDS for row in self.rows]
        unit = std / np.where(is_lossy, own, 1.0)
        size = unit * z[self.numbers]
        is_more = is_lossy & (size > 0)
        size, unit = (np.where(is_more, np.log1p(np.abs(each)), each) for each in (size, unit))
        return np.asarray(size / np.maximum(unit, of_rig))

    def errors(self, z: FloatArray, error: FloatArray) -> FloatArray:
        """Standard errors of the fitted values at z in their units (n,), by those of z (p,)."""
        is_factor = np.array([row.is_factor for row in self.rows])
        slopes = self.model.space.std[self.numbers] * np.where(is_factor, self.values(z), 1.0)
        return np.asarray(slopes * error[self.numbers])

    def moved(self, modulus: float, stiffness: float) -> FloatArray:
        """Parameters z (p,) for logarithms of factors on the rig's modulus and stiffnesses."""
        space = self.model.space
        found = np.zeros(space.size)
        for kind, logarithm in (("modulus", modulus), ("stiffness", stiffness)):
            found[space.groups[kind]] = logarithm / space.std[space.groups[kind]]
        return found


def sensed_plate(
    rig: Rig,
    points: FloatArray,
    frequencies: FloatArray,
    *,
    masses: FloatArray | None = None,
    has_form: bool = False,
) -> SensedPlate:
    """Solve a rig's free plate once, for sensors at points (s, 2) [m] and frequencies (f,) [Hz].

    masses (s,) [kg]: of a sensor that is moved, as `Sensor.mass`, None for none; has_form: whether
    the plate may have form errors. Raises InputError for frequencies too high for its
    mesh.
    """
    rig.mesh.check_frequencies(rig.plate, frequencies)
    loads = np.zeros(len(points)) if masses is None else masses
    sensors = [
        Sensor(f"sensor {n}", x=x, y=y, mass=mass)
        for n, ((x, y), mass) in enumerate(zip(points.tolist(), loads.tolist(), strict=True))
    ]
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=float(max(frequencies.max(), 200.0)))
    form = reduced_modes(rig, free) if has_form else None
    space = space_by_sheets(rig, (), None)
    return SensedPlate(rig, ForwardModel(rig, sensors, frequencies, space, free, form=form)).of(rig)


def plate_of(rig: Rig, observation: Responses, *, has_form: bool = False) -> SensedPlate:
    """The plate of a rig at the sensors and frequencies of a measurement, as `sensed_plate`."""
    return sensed_plate(
        rig,
        observation.points,
        observation.frequencies,
        masses=observation.masses,
        has_form=has_form,
    )
