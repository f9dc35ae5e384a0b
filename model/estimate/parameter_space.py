"""Parameter space of a rig: kinds of parameters, their priors, and the values they represent.

A vector x (p,) has one number per parameter, relative to its prior: parameter i differs from the
rig by `std[i] * x[i]`, so that every x with a prior is normal with variance 1. A `ParameterKind`
defines all parameters of one kind, such as the stiffness of each ERA. `Space` lists the parameters
of a rig; `PlateValues` contains the values of the rig for one vector x.

`model.estimate.parameters` has one class per kind.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.rig.rig import Rig, Uncertainty
from model.structure.exciter import Actuator, Exciter

MODE_SHIFTS = 12
"""Number of lowest elastic modes with separate eigenvalues and loss factors."""

ParameterValues: TypeAlias = float | NDArray[np.floating[Any]]
"""One number for all parameters of a kind, or one per parameter."""


class Prior(NamedTuple):
    """Prior distribution of the parameters of a kind, in the unit of `PlateValues`."""

    std: ParameterValues
    """Standard deviation, 0 for an exactly known parameter."""
    lower: ParameterValues = -np.inf
    """Lower bound."""
    upper: ParameterValues = np.inf
    """Upper bound."""


@dataclass(frozen=True, eq=False)
class SearchScope:
    """Uncertain parts of a rig with sensors; each `ParameterKind` takes its names from it."""

    rig: Rig
    sensors: Sequence[str]
    """Names of the sensors."""
    uncertainty: Uncertainty
    """Stated uncertainty of the rig; empty if only data sheets describe it."""
    drives_lag: bool = False
    """Whether bases follow their drive with an unknown lag."""
    masses: int = 0
    """Number of additional masses."""
    mode_count: int = MODE_SHIFTS
    """Number of elastic modes that can shift."""
    form_of: int | None = None
    """Number of sensors if the plate can have form errors, otherwise None."""

    @property
    def has_form_errors(self) -> bool:
        """Whether the plate can have form errors."""
        return self.form_of is not None

    @cached_property
    def eras(self) -> list[str]:
        """Names of the ERAs."""
        return [era.name for era in self.rig.eras]

    @cached_property
    def excites(self) -> NDArray[np.bool_]:
        """Mask of the ERAs that are exciters."""
        return np.array(["force_factor" in era.fields for era in self.rig.eras])

    @cached_property
    def sides(self) -> FloatArray:
        """Length and width of the plate [m]."""
        return np.array([self.rig.plate.length, self.rig.plate.width])


def values_of_eras(rig: Rig, kind: str) -> FloatArray:
    """Return the values of a kind from a rig file for all ERAs (n,), 0 for an ERA without a
    value."""
    return np.array([getattr(era, era.fields.get(kind, ""), 0.0) for era in rig.eras])


class ParameterKind(ABC):
    """Parameters of a kind, such as the stiffness of each ERA; see `model.estimate.parameters`.

    Parameters are differences from the rig, usually logarithms of factors.
    """

    name: str
    """Key of the kind in `Space` and `PlateValues`."""
    label: str
    """Name of a parameter in reports, without the name of its ERA, sensor or mode."""
    std: float
    """Default of `Prior.std`, for a plate without a measurement."""
    unit = "%"
    """Unit in printed reports; logarithms of factors are printed in per cent."""
    per_unit = 100.0
    """Number of report units in one unit of `PlateValues`."""
    theory = 0.0
    """Error of a fitted value from plate theory: its change with viscous losses and without shear
    deformation, for plates of 1.5 mm."""
    per_era = 0
    """Number of parameters of each ERA, 0 if they do not belong to ERAs."""
    stage = 2
    """Stage of an identification that searches it: 0 first, 1 with the positions of masses, 2
    last."""
    is_listed = False
    """Whether the report of an identification always lists it."""

    @abstractmethod
    def names(self, scope: SearchScope) -> Sequence[str]:
        """Names of all parameters; empty if the rig has no such value."""

    def prior(self, scope: SearchScope) -> Prior:
        """Prior for an installed rig."""
        return Prior(self.std)

    def datasheet_prior(self, scope: SearchScope) -> Prior:
        """Prior for a rig described only by data sheets; default: known exactly."""
        return Prior(0.0)

    def value(self, values: "PlateValues") -> Any:
        """Convert the parameters to the rig's value; default: the differences themselves."""
        return values.deviations(self.name)


@dataclass(frozen=True, eq=False)
class Space:
    """Names of all p parameters with their priors and kinds."""

    names: tuple[str, ...]
    std: FloatArray
    """`Prior.std` (p,) in the units of `PlateValues`, 0 for a known parameter."""
    lower: FloatArray
    """Lower bounds of x (p,)."""
    upper: FloatArray
    """Upper bounds of x (p,)."""
    groups: dict[str, slice]
    """Slice of the parameters of each kind."""
    kinds: Mapping[str, ParameterKind]
    """All kinds by name."""

    @classmethod
    def from_kinds(
        cls,
        kinds: Mapping[str, ParameterKind],
        scope: SearchScope,
        *,
        from_datasheets: bool = False,
    ) -> Self:
        """Return the space of all parameters that kinds have in a scope, in the order of the kinds.

        from_datasheets: whether priors are `datasheet_prior` instead of `prior`.
        """
        names: list[str] = []
        groups = {}
        priors = [np.zeros((3, 0))]
        for kind in kinds.values():
            kind_names = kind.names(scope)
            groups[kind.name] = slice(len(names), len(names) + len(kind_names))
            names += kind_names
            if kind_names:
                prior = kind.datasheet_prior(scope) if from_datasheets else kind.prior(scope)
                *rows, _ = np.broadcast_arrays(*prior, np.zeros(len(kind_names)))
                priors.append(np.array(rows))
        std, lower, upper = np.concatenate(priors, axis=1)
        scale = np.where(std > 0, std, 1.0)
        return cls(tuple(names), std, lower / scale, upper / scale, groups, kinds)

    @property
    def size(self) -> int:
        """Number of parameters p."""
        return len(self.names)

    @cached_property
    def uncertain(self) -> NDArray[np.bool_]:
        """Mask (p,) of the parameters with a prior uncertainty."""
        return self.std > 0

    def of(self, *kinds: str) -> NDArray[np.bool_]:
        """Return a mask (p,) of the uncertain parameters of some kinds."""
        chosen = np.zeros(self.size, dtype=bool)
        for kind in kinds:
            chosen[self.groups[kind]] = True
        return chosen & self.uncertain

    @cached_property
    def as_built(self) -> "Space":
        """Space of a plate that was not measured, with the default priors unless the rig states its
        own."""
        default = np.zeros(self.size)
        for kind, part in self.groups.items():
            default[part] = self.kinds[kind].std
        default = np.where(self.uncertain, default, 0.0)
        return replace(self, std=np.maximum(self.std, default))

    def indices(self, kind: str) -> range:
        """Return the indices of the parameters of a kind."""
        return range(*self.groups[kind].indices(self.size))

    def values(self, x: FloatArray, kind: str) -> FloatArray:
        """Return the differences of a kind's parameters from the rig at x (p,), in their units."""
        part = self.groups[kind]
        return self.std[part] * x[part]

    def index(self, name: str) -> int:
        """Return the index of a parameter by name; raises ValueError for an unknown one."""
        return self.names.index(name)


@dataclass(frozen=True, eq=False)
class PlateValues:
    """Values of a rig's plate for parameters x (p,), by kind.

    Each value is defined by `ParameterKind.value`. Arrays have n ERAs, m additional masses or s
    sensors.
    """

    rig: Rig
    space: Space
    x: FloatArray

    def deviations(self, kind: str) -> FloatArray:
        """Return the differences of all parameters of a kind from the rig, in their unit."""
        return self.space.values(self.x, kind)

    def factor(self, kind: str) -> float:
        """Return the factor whose logarithm is the only parameter of a kind."""
        return float(np.exp(self.deviations(kind)[0]))

    def __getitem__(self, kind: str) -> Any:
        """Return the values of a kind, without differences of other kinds that are added
        elsewhere."""
        return self.space.kinds[kind].value(self)

    def sources(self) -> tuple[Actuator, ...]:
        """The rig's ERAs with these values, without gains."""
        sources: list[Actuator] = []
        for number, era in enumerate(self.rig.eras):
            fields: dict[str, Any] = {
                name: float(self[kind][number]) for kind, name in era.fields.items()
            }
            if isinstance(era, Exciter):
                largest = era.largest_force_factor(fields["magnet_mass"])
                fields["force_factor"] = min(fields["force_factor"], largest)
            sources.append(replace(era, gains=(), **fields))
        return tuple(sources)

    def lag(self, frequencies: FloatArray) -> ComplexArray:
        """Return the motion of each drive at frequencies (f,) [Hz] relative to low frequency, (f,
        n).

        1 / (1 - inertia f² + i drag f), f in kilohertz: an actuator with a resonance at 1 /
        sqrt(inertia) and a damping ratio of drag / (2 sqrt(inertia)).
        """
        f = 1e-3 * np.asarray(frequencies)[:, None]
        return np.asarray(1 / (1 - self["inertia"] * f**2 + 1j * self["drag"] * f))
