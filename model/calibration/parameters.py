"""Parameters of a rig that are fitted, with their priors and bounds."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.rig.rig import Rig
from model.structure.attachments import Era, damping_from_ratio
from model.vibration.parametric_plate import ParametricPlate

# Prior standard deviations: data sheets give moduli, thicknesses and springs, and little on losses.
_MODULUS_STD = 0.07  # of its logarithm
_STIFFNESS_STD = 0.10  # of its logarithm
_LOSS_STD, _MIN_LOSS_STD = 0.7, 0.003  # of itself, and at least
_DAMPING_STD, _MIN_DAMPING_RATIO_STD = 0.7, 0.015
_BOLT_STD = 0.05  # of the plate's mass that an ERA carries


@dataclass(frozen=True)
class Parameter:
    """A parameter: kind, ERA ("" for the plate), value in the rig and unit.

    A fit varies x: value = prior * exp(x) if is_factor, else step * x, both in that unit.
    prior_std: standard deviation of x beforehand; lower, upper: bounds of x.
    """

    kind: str
    era: str
    prior: float
    unit: str
    is_factor: bool
    step: float
    prior_std: float
    lower: float
    upper: float

    @property
    def start(self) -> float:
        """x of the rig's value."""
        return 0.0 if self.is_factor else self.prior / self.step

    def value(self, x: float) -> float:
        """The value in its unit."""
        return self.prior * math.exp(x) if self.is_factor else self.step * x

    def slope(self, x: float) -> float:
        """Derivative of the value by x."""
        return self.value(x) if self.is_factor else self.step

    def standard_error(self, x: float, error: float) -> float:
        """Standard error of the value from that of x."""
        return self.slope(x) * error

    @property
    def name(self) -> str:
        """Name in reports."""
        return f"{self.era} {self.kind}" if self.era else f"plate {self.kind}"


def parameters_of(rig: Rig) -> tuple[Parameter, ...]:
    """Modulus and loss factor of the plate, then stiffness, damping and bolt mass of every ERA."""
    plate = rig.plate
    share = plate.mass / len(rig.eras)
    found = [
        _factor("modulus", "", plate.material.E, "Pa", std=_MODULUS_STD, reach=3.0),
        _offset(
            "loss_factor",
            "",
            plate.loss_factor,
            "",
            step=0.01,
            std=max(_LOSS_STD * plate.loss_factor, _MIN_LOSS_STD),
            at_most=0.5,
        ),
    ]
    for era in rig.eras:
        # Bounds and steps are relative to the mass that the ERA carries.
        unit_damping = damping_from_ratio(
            1.0, stiffness=era.stiffness, plate_mass=plate.mass, era_count=len(rig.eras)
        )
        found += [
            _factor("stiffness", era.name, era.stiffness, "N/m", std=_STIFFNESS_STD, reach=10.0),
            _offset(
                "damping",
                era.name,
                era.damping,
                "N s/m",
                step=0.05 * unit_damping,
                std=max(_DAMPING_STD * era.damping, _MIN_DAMPING_RATIO_STD * unit_damping),
                at_most=2 * unit_damping,
            ),
            _offset(
                "bolt_mass",
                era.name,
                era.bolt_mass,
                "kg",
                step=0.05 * share,
                std=_BOLT_STD * share,
                at_most=5 * share,
            ),
        ]
    return tuple(found)


def bounds_of(parameters: Sequence[Parameter]) -> FloatArray:
    """Lower and upper bounds of x, (2, n)."""
    return np.array([(parameter.lower, parameter.upper) for parameter in parameters]).T


def responses_at(
    plate: ParametricPlate, rig: Rig, parameters: Sequence[Parameter], x: FloatArray
) -> ComplexArray:
    """Responses (f, e, p) of a rig with the values of x (n,).

    parameters: as `parameters_of` orders them.
    """
    modulus, loss_factor, eras = _values(parameters, x)
    free = plate.receptances(modulus, loss_factor, rig.plate.thickness)
    return free.responses(eras, rig.masses)


def response_slopes(
    plate: ParametricPlate, rig: Rig, parameters: Sequence[Parameter], x: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Responses as `responses_at`, and their derivatives by x (n, f, e, p)."""
    modulus, loss_factor, eras = _values(parameters, x)
    responses, slopes = plate.response_slopes(
        modulus, loss_factor, rig.plate.thickness, eras, rig.masses
    )
    own = [p.slope(float(at)) for p, at in zip(parameters, x, strict=True)]
    return responses, slopes * np.array(own)[:, None, None, None]


def _values(parameters: Sequence[Parameter], x: FloatArray) -> tuple[float, float, FloatArray]:
    """Modulus, loss factor, and stiffness, damping and bolt mass of each ERA (e, 3)."""
    values = [p.value(float(at)) for p, at in zip(parameters, x, strict=True)]
    return values[0], values[1], np.array(values[2:]).reshape(-1, 3)


def rig_with(rig: Rig, parameters: Sequence[Parameter], x: FloatArray) -> Rig:
    """Rig with the values of x (n,) and unchanged gains."""
    values = {
        (parameter.era, parameter.kind): parameter.value(float(at))
        for parameter, at in zip(parameters, x, strict=True)
    }
    factor = values["", "modulus"] / rig.plate.material.E
    plate = replace(rig.plate.scaled(modulus=factor), loss_factor=values["", "loss_factor"])
    laminate = rig.laminate and rig.laminate.scaled(modulus=factor)
    eras = tuple(_era_with(era, values) for era in rig.eras)
    return replace(rig, plate=plate, laminate=laminate, eras=eras)


def starts(parameters: Sequence[Parameter]) -> list[FloatArray]:
    """Starting points x (n,) with modulus and stiffnesses scaled."""
    own = np.array([parameter.start for parameter in parameters])
    found = []
    for modulus in np.log(np.linspace(0.6, 1.6, 11)):
        for stiffness in np.log([0.4, 0.6, 0.8, 1.0, 1.25, 1.6, 2.5]):
            moves = {"modulus": modulus, "stiffness": stiffness}
            found.append(own + [moves.get(parameter.kind, 0.0) for parameter in parameters])
    return found


def _era_with(era: Era, values: dict[tuple[str, str], float]) -> Era:
    return replace(
        era,
        stiffness=values[era.name, "stiffness"],
        damping=values[era.name, "damping"],
        bolt_mass=values[era.name, "bolt_mass"],
    )


def _factor(kind: str, era: str, prior: float, unit: str, *, std: float, reach: float) -> Parameter:
    bound = math.log(reach)
    return Parameter(kind, era, prior, unit, True, prior, std, -bound, bound)


def _offset(
    kind: str, era: str, prior: float, unit: str, *, step: float, std: float, at_most: float
) -> Parameter:
    upper = max(at_most, 2 * prior) / step
    return Parameter(kind, era, prior, unit, False, step, std / step, 0.0, upper)
