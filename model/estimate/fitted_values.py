"""Values of a rig that fits find, with their names and keys in its file, before and after a fit."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from model.config.document import KeyPath
from model.rig.actuator_keys import ACTUATOR_KINDS as ACTUATOR_KEYS
from model.rig.rig import Rig

VALUE_UNITS = {
    "thickness": "m",
    "modulus": "Pa",
    "loss_factor": "",
    "stiffness": "N/m",
    "damping": "N s/m",
    "bolt_mass": "kg",
    "magnet_mass": "kg",
    "supports": "N/m",
}
"""Units of the values of a rig that parameters change."""

_FACTORS = ("modulus", "stiffness", "magnet_mass", "supports")  # whose x is a logarithm


@dataclass(frozen=True)
class Parameter:
    """A fitted rig value with its uncertainty."""

    kind: str
    """Kind of value: a key of `VALUE_UNITS`, or of `PARAMETER_KINDS` if differences are
    reported."""
    name: str
    """Name in reports."""
    unit: str
    """Unit of its values in printed reports."""
    era: str = ""
    """Name of its ERA, "" if it belongs to none."""
    foot: str = ""
    """Name of its foot, "" if it belongs to none."""
    before: float = 0.0
    """Value in the original rig, 0 if the difference from it is reported."""
    value: float = math.nan
    """Fitted value, NaN before a fit."""
    standard_error: float | None = None
    """Standard error of the value, None if it is not identified and keeps the rig's value."""
    prior: float = math.inf
    """Standard error before the measurement, infinite without a prior."""
    at_bound: bool = False
    """Whether it is at a bound of the search."""

    @property
    def is_identified(self) -> bool:
        """Whether the data determine the value."""
        return self.standard_error is not None

    @property
    def is_factor(self) -> bool:
        """Whether x is the logarithm of a factor on the rig's value, not an addition to it."""
        return self.kind in _FACTORS

    def path(self, rig: Rig) -> KeyPath | None:
        """Return the path of its key in a rig file, None for a value that several layers share."""
        if self.foot:
            return "supports", self.foot, "stiffness"
        if self.era:
            era = rig.era(self.era)
            return "eras", self.era, ACTUATOR_KEYS[type(era)].keys[era.fields[self.kind]]
        if rig.laminate is not None and self.kind != "loss_factor":
            return None
        if self.kind == "modulus":
            return "plate", "material", next(iter(rig.plate.material.moduli))
        return "plate", self.kind

    def of(self, rig: Rig) -> float:
        """Return the value in a rig."""
        if self.era:
            era = rig.era(self.era)
            return float(getattr(era, era.fields[self.kind]))
        if self.foot:
            foot = rig.feet[rig.foot_names.index(self.foot)]
            return rig.masses[foot].stiffness
        if self.kind == "modulus":
            return rig.plate.material.E
        return float(getattr(rig.plate, self.kind))


def parameters_of(
    rig: Rig, plate_kinds: Sequence[str], era_kinds: Sequence[str], feet: Sequence[str]
) -> tuple[Parameter, ...]:
    """Return a rig's values before a fit: the given kinds for its plate and every ERA, and feet."""
    parameters = []
    for kind in plate_kinds:
        parameters.append(Parameter(kind, name=f"plate {kind}", unit=VALUE_UNITS[kind]))
    for era in rig.eras:
        for kind in era_kinds:
            if kind in era.fields:
                name = f"{era.name} {era.fields[kind]}"
                parameters.append(Parameter(kind, name, VALUE_UNITS[kind], era=era.name))
    for foot in feet:
        name = f"foot {foot} stiffness"
        parameters.append(Parameter("supports", name, VALUE_UNITS["supports"], foot=foot))
    return tuple(replace(parameter, before=parameter.of(rig)) for parameter in parameters)


def errors_by_key(
    rig: Rig, errors: Iterable[tuple[Parameter, float | None]]
) -> dict[KeyPath, float]:
    """Return standard errors of the values in a rig file, by key path."""
    by_key = {}
    for parameter, error in errors:
        path = parameter.path(rig)
        if path and error:
            by_key[path] = float(error)
    return by_key
