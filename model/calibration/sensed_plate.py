"""A rig's plate at sensors, for values of what responses there determine.

The forward model of an identification (`model.identification.forward`) with modulus and loss factor
of the plate, and stiffness, damping and bolt mass of each ERA. The free plate is solved once.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray, IntArray
from model.identification.derivatives import jacobian
from model.identification.form_errors import reduced_modes
from model.identification.forward import ForwardModel, PlateAt, Sensor
from model.identification.identified_rig import rig_with
from model.identification.parameters import FORM, KINDS, Space, space_of
from model.identification.values import Values
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.rig.uncertainty import Uncertainty
from model.structure.attachments import damping_from_ratio

# Prior standard deviations: data sheets give moduli, thicknesses and springs, and little on losses.
_MODULUS_STD = 0.07  # of its logarithm
_STIFFNESS_STD = 0.10  # of its logarithm
_LOSS_STD, _MIN_LOSS_STD = 0.7, 0.003  # of itself, and at least
_DAMPING_STD, _MIN_DAMPING_RATIO_STD = 0.7, 0.015
_BOLT_STD = 0.05  # of the plate's mass that an ERA carries
_MODE_SHIFT = 0.003  # of an eigenvalue: theory and mesh
_LOWEST, _HIGHEST = 0.1, 1.2  # of modes that shift: of the lowest frequency, of the highest tone
_UNITS = {
    "modulus": "Pa",
    "loss_factor": "",
    "stiffness": "N/m",
    "damping": "N s/m",
    "bolt_mass": "kg",
}
STARTS = [
    (modulus, stiffness)
    for modulus in np.log(np.linspace(0.6, 1.6, 11)).tolist()
    for stiffness in np.log([0.4, 0.6, 0.8, 1.0, 1.25, 1.6, 2.5]).tolist()
]
"""Logarithms of factors on modulus and stiffnesses from which to search."""

_KINDS = {"loss_factor": "loss_added", "damping": "damping_added"}


@dataclass(frozen=True)
class Parameter:
    """A value of a rig that is fitted: kind, and ERA, "" for the plate."""

    kind: str
    era: str

    @property
    def name(self) -> str:
        """Name in reports."""
        return f"{self.era} {self.kind}" if self.era else f"plate {self.kind}"

    @property
    def unit(self) -> str:
        """Unit of its value."""
        return _UNITS[self.kind]

    @property
    def is_factor(self) -> bool:
        """Whether x is the logarithm of a factor on the rig's value, not what is added to it."""
        return self.kind in ("modulus", "stiffness")

    def of(self, rig: Rig) -> float:
        """The value in a rig."""
        if self.era:
            return float(getattr(rig.era(self.era), self.kind))
        return rig.plate.material.E if self.kind == "modulus" else rig.plate.loss_factor


@dataclass(frozen=True, eq=False)
class Parameters:
    """The n parameters of a rig: modulus and loss factor, then those of every ERA.

    space: of the forward model, in which all others are known; x (n,): in prior standard
    deviations from the rig's values.
    """

    rig: Rig
    space: Space
    rows: tuple[Parameter, ...]

    @classmethod
    def of(
        cls, rig: Rig, sensors: tuple[str, ...] = (), *, form_modes: int | None = None
    ) -> "Parameters":
        """Those of a rig with sensors by name; form_modes: that may shift, beside form errors."""
        rows = [Parameter("modulus", ""), Parameter("loss_factor", "")]
        for era in rig.eras:
            rows += [Parameter(kind, era.name) for kind in ("stiffness", "damping", "bolt_mass")]
        return cls(rig, _space(rig, sensors, form_modes), tuple(rows))

    @cached_property
    def numbers(self) -> IntArray:
        """Where each is in the space, (n,)."""
        names = [era.name for era in self.rig.eras]
        found = []
        for row in self.rows:
            group = self.space.groups[_KINDS.get(row.kind, row.kind)]
            found.append(group.start + (names.index(row.era) if row.era else 0))
        return np.array(found)

    @property
    def bounds(self) -> FloatArray:
        """Lower and upper bounds of x, (2, n)."""
        return np.array([self.space.lower, self.space.upper])[:, self.numbers]

    def full(self, x: FloatArray) -> FloatArray:
        """All parameters of the space."""
        found = np.zeros(self.space.size)
        found[self.numbers] = x
        return found

    def rig_at(self, x: FloatArray) -> Rig:
        """The rig with the values of x (n,)."""
        values = Values.of(self.rig, self.space, self.full(x))
        return rig_with(self.rig, values, self.rig.uncertainty)

    def values(self, x: FloatArray) -> FloatArray:
        """Values at x (n,) in their units."""
        rig = self.rig_at(x)
        return np.array([row.of(rig) for row in self.rows])

    def slopes(self, x: FloatArray) -> FloatArray:
        """Derivatives of the values by x (n,)."""
        is_factor = np.array([row.is_factor for row in self.rows])
        return self.space.std[self.numbers] * np.where(is_factor, self.values(x), 1.0)

    def moved(self, modulus: float, stiffness: float) -> FloatArray:
        """Values x (n,) of a modulus and stiffnesses by logarithms of factors on the rig's."""
        logarithms = {"modulus": modulus, "stiffness": stiffness}
        found = np.array([logarithms.get(row.kind, 0.0) for row in self.rows])
        return np.asarray(found / self.space.std[self.numbers])


@dataclass(frozen=True, eq=False)
class SensedPlate:
    """A rig's plate with sensors at points, without the rig's gains."""

    parameters: Parameters
    model: ForwardModel

    def at_some(self, kept: NDArray[np.bool_]) -> "SensedPlate":
        """Select some of the sensors (s,)."""
        sensors = list(compress(self.model.sensors, kept))
        model = replace(self.model, sensors=sensors, last_places={})
        return replace(self, model=model).of(self.parameters.rig)

    def of(self, rig: Rig) -> "SensedPlate":
        """The same of a rig with other values of its plate's modulus, thickness and loss factor.

        And of its ERAs and masses.
        """
        names = tuple(sensor.name for sensor in self.model.sensors)
        shifting = None
        if self.model.form is not None:
            natural = np.sqrt(np.maximum(self.model.modes.eigenvalues, 0)) / (2 * np.pi)
            highest = _HIGHEST * self.model.frequencies.max()
            lowest = _LOWEST * rig.plate.lowest_bending_frequency
            shifting = int(((natural > lowest) & (natural < highest)).sum())
        parameters = Parameters.of(rig, names, form_modes=shifting)
        eras = tuple(replace(era, gains=()) for era in rig.eras)
        model = replace(self.model, rig=replace(rig, eras=eras), space=parameters.space)
        return SensedPlate(parameters, model)

    def at(self, x: FloatArray) -> PlateAt:
        """The plate for parameters x (n,)."""
        return self.model.at(self.parameters.full(x))

    def responses(self, x: FloatArray | None = None) -> ComplexArray:
        """Acceleration per base displacement [1/s²] of each ERA, (f, e, s); of x, else the rig."""
        x = np.zeros(len(self.parameters.rows)) if x is None else x
        return np.swapaxes(self.at(x).responses, 1, 2)

    def slopes(self, x: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Responses (f, e, s), and derivatives by x (n, f, e, s)."""
        plate = self.at(x)
        by_x = np.moveaxis(jacobian(plate)[..., self.parameters.numbers], 3, 0)
        return np.swapaxes(plate.responses, 1, 2), np.swapaxes(by_x, 2, 3)


def sensed_plate(
    rig: Rig, points: FloatArray, frequencies: FloatArray, *, has_form: bool = False
) -> SensedPlate:
    """Solve a rig's free plate once, for sensors at points (s, 2) [m] and frequencies (f,) [Hz].

    has_form: whether it may have form errors. Raises InputError for frequencies too high for its
    mesh.
    """
    rig.mesh.check_frequencies(rig.plate, frequencies)
    sensors = [Sensor(f"sensor {n}", x=x, y=y) for n, (x, y) in enumerate(points.tolist())]
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=float(max(frequencies.max(), 200.0)))
    form = reduced_modes(rig, free) if has_form else None
    parameters = Parameters.of(rig)
    model = ForwardModel(rig, sensors, frequencies, parameters.space, free, form=form)
    return SensedPlate(parameters, model).of(rig)


def _space(rig: Rig, sensors: tuple[str, ...], form_modes: int | None) -> Space:
    """A space with priors of a plate that was not measured, all else known but form errors."""
    plate, count = rig.plate, len(rig.eras)
    space = space_of(
        rig,
        sensors,
        Uncertainty.none(),
        mode_count=form_modes or 0,
        form_of=None if form_modes is None else len(sensors),
    )
    share, loss = plate.mass / count, plate.loss_factor
    damping, bolt = np.array([(era.damping, era.bolt_mass) for era in rig.eras]).T
    # Bounds and deviations are relative to the mass that an ERA carries.
    unit = np.array(
        [
            damping_from_ratio(1.0, stiffness=era.stiffness, plate_mass=plate.mass, era_count=count)
            for era in rig.eras
        ]
    )
    kinds = {
        "modulus": (_MODULUS_STD, -math.log(3.0), math.log(3.0)),
        "stiffness": (_STIFFNESS_STD, -math.log(10.0), math.log(10.0)),
        "loss_added": (max(_LOSS_STD * loss, _MIN_LOSS_STD), -loss, max(0.5 - loss, loss)),
        "damping_added": (
            np.maximum(_DAMPING_STD * damping, _MIN_DAMPING_RATIO_STD * unit),
            -damping,
            np.maximum(2 * unit - damping, damping),
        ),
        "bolt_mass": (_BOLT_STD * share, -bolt, np.maximum(5 * share - bolt, bolt)),
    }
    if form_modes is not None:
        # Places may leave the plate, whose shapes go on by their slopes.
        kinds |= {kind: (KINDS[kind].std, -np.inf, np.inf) for kind in (*FORM, "place")}
        kinds["mode_shifts"] = (_MODE_SHIFT, -np.inf, np.inf)
    columns = np.repeat([[0.0], [-np.inf], [np.inf]], space.size, axis=1)
    for kind, (std, lower, upper) in kinds.items():
        part = space.groups[kind]
        columns[0, part], columns[1, part], columns[2, part] = std, lower / std, upper / std
    return replace(space, std=columns[0], lower=columns[1], upper=columns[2])
