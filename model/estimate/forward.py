"""Forward model: responses of a rig's plate at its sensors for a vector of parameters.

A is the receptance of the free plate between all attachments and sensors, Z the dynamic stiffness
of the attachments (0 at a sensor), and T = A (1 + Z A)^-1 the receptance of the plate with its
attachments. ERA j with gain g_j drives a clamped plate by the force F_j g_j, which is (k_j + i w
c_j) g_j for a moving base. Sensor s then measures

    Y_sj = -w² sigma_s l_s T_sj F_j g_j,    l_s = 1 / (1 - w² m_s T_ss),

with its gain sigma_s. A sensor of mass m_s loads the plate only during its own measurement, like a
sensor that is moved between positions.

Losses are hysteretic: the loss factor is constant over frequency, (1 + i eta) K, which is not
causal. The other extreme is viscous: the loss of each mode j of the supported plate is proportional
to frequency, eta omega / omega_j. Both agree only at the resonances, while most tones are off
resonance, so a fit with the wrong law finds a loss factor with an error larger than noise and form
errors explain. A plate with form errors has a parameter between both laws, 0 to 1.

With L = 1 - T Z, a change dA of the free receptance and dZ of the attachments change T by L dA L^T
- T dZ T. For a mode, a position or an attachment this change has rank one or two. A sensor of mass
m that is on the plate during its measurement adds l² w² m T_sj dT_ss to l dT_sj.

A vector x has one number per parameter, relative to its prior (`Prior.std`). `ParameterKind`
defines how all parameters of a kind change the plate and its responses; `model.estimate.parameters`
has one class per kind. `Space` names the parameters of a rig, `PlateValues` contains the values
that they represent.

A plate can also have form errors, which a rig file does not describe, such as a cable glued to it,
or inaccurately cut sides. If ignored, they bias fitted values far more than noise does, and no
residual shows the bias. They change stiffness and mass between the modes of the free plate, and
therefore its mode shapes (`ReducedModes` of `model.reduction`).
"""

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from model.arrays import ComplexArray, FloatArray, IntArray
from model.errors import InputError
from model.finger import Grid
from model.reduction.attachment_points import AttachmentPoints, Modes, places_of
from model.reduction.form_modes import ReducedModes
from model.reduction.free_plate import TERMS, FreePlate, FreeReceptance, combined
from model.rig.rig import Rig, Uncertainty
from model.structure.attachments import (
    attached_stiffness,
    coupled_forces,
    drive_forces,
    footprints_of,
)
from model.structure.exciter import Actuator, Exciter
from model.structure.modal_elasticity import (
    WITHOUT_PART,
    ModalElasticity,
    check_scales,
    lowest_elastic,
)
from model.structure.plate import LOSS_FREQUENCY

SENSOR_FOOT = 5e-3
"""Radius of the disc on which a sensor's mass acts [m]; a plate is soft under a point."""

MASS_CELLS = Grid(8, 6)
"""Possible positions of foreign mass."""

MIN_LOSS_FACTOR = 1e-9
"""Minimum loss factor, so that derivatives by its logarithm exist."""

MODE_SHIFTS = 12
"""Number of lowest elastic modes with separate eigenvalues and loss factors."""

_SLOWEST = 2 * np.pi  # rad/s; lower bound of a mode's frequency in its losses

AnyArray: TypeAlias = NDArray[np.floating[Any]] | NDArray[np.complexfloating[Any, Any]]

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


@dataclass(frozen=True)
class Sensor:
    """Acceleration sensor at the bolt of an ERA or at a point of the plate."""

    name: str
    era: str = ""
    """Name of the ERA at whose bolt it is, "" for a sensor at x, y [m]."""
    x: float = 0.0
    y: float = 0.0
    mass: float = 0.0
    """Mass [kg] on the plate during its own measurement, for a moved sensor."""


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
    stage = 2
    """Stage of an identification that searches it: 0 first, 1 with the positions of masses, 2
    last."""
    is_listed = False
    """Whether the report of an identification always lists it."""

    @abstractmethod
    def names(self, scope: SearchScope) -> Sequence[str]:
        """Names of all parameters; empty if the rig has no such value."""

    @abstractmethod
    def derivative(self, plate: "PlateAt") -> ComplexArray:
        """Derivatives of the responses by all m parameters (f, s, n, m)."""

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
    def empty(cls, kinds: Mapping[str, ParameterKind]) -> "Space":
        """A space without parameters."""
        empty = np.zeros(0)
        return cls((), empty, empty, empty, {}, kinds)

    @property
    def size(self) -> int:
        """Number of parameters p."""
        return len(self.names)

    @cached_property
    def scale(self) -> FloatArray:
        """`std` (p,), 1 for known parameters."""
        return np.where(self.std > 0, self.std, 1.0)

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

    def extended(self, kind: ParameterKind, names: Sequence[str], prior: Prior) -> "Space":
        """Return the space with parameters of another kind appended."""
        std = np.broadcast_to(prior.std, len(names))
        scale = np.where(std > 0, std, 1.0)
        return replace(
            self,
            names=(*self.names, *names),
            std=np.append(self.std, std),
            lower=np.append(self.lower, prior.lower / scale),
            upper=np.append(self.upper, prior.upper / scale),
            groups=self.groups | {kind.name: slice(self.size, self.size + len(names))},
        )

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


@dataclass(frozen=True, eq=False)
class ForwardModel:
    """A rig's plate on its attachments, with sensors, as a function of parameters.

    Raises InputError for a plate that does not scale with an uncertain thickness or modulus.
    """

    rig: Rig
    sensors: Sequence[Sensor]
    frequencies: FloatArray
    """Frequencies of the tones (f,) [Hz]."""
    space: Space
    """Parameters, including the uncertain ones."""
    free: FreePlate
    """Free plate, solved for the rig's thickness and modulus or for other values."""
    form: ReducedModes | None = None
    """Plate in coordinates that allow form errors."""
    law: ComplexArray | None = None
    """Change of the receptance (f, s, n) [m/N] if losses are viscous, None to neglect it."""
    last_places: dict[Hashable, AttachmentPoints] = field(default_factory=dict)
    """Latest solution for all attachments, by all that it depends on; copies share it."""

    def __post_init__(self) -> None:
        """Raise InputError for a plate with wrong responses and slopes."""
        groups = self.space.groups
        thickness = 1 + self.space.std[groups["thickness"]]
        modulus = 1 + self.space.std[groups["modulus"]]
        check_scales(self.rig.plate, thickness, modulus, remedy=WITHOUT_PART)

    @cached_property
    def omega(self) -> FloatArray:
        """2 pi f [rad/s], (f,)."""
        return 2 * np.pi * self.frequencies

    @cached_property
    def mass_count(self) -> int:
        """Number of additional masses."""
        return len(self.space.indices("masses")) // 3

    @cached_property
    def observed(self) -> IntArray:
        """Indices of the sensors among the attachments, (s,)."""
        names = [era.name for era in self.rig.eras]
        number = len(names) + len(self.rig.masses) + self.mass_count
        observed = []
        for sensor in self.sensors:
            if sensor.era:
                observed.append(names.index(sensor.era))
            else:
                observed.append(number)
                number += 1
        return np.array(observed, dtype=int)

    @property
    def modes(self) -> Modes:
        """Modes of the free plate, or its coordinates with form errors."""
        return self.form or self.free.modes

    @cached_property
    def shifted_modes(self) -> IntArray:
        """Indices of the modes whose eigenvalues can shift, the lowest elastic ones, ascending."""
        return lowest_elastic(self.modes.eigenvalues, len(self.space.indices("mode_shifts")))

    @cached_property
    def elasticity(self) -> ModalElasticity:
        """Eigenvalues and loss factors of the modes of the rig."""
        return ModalElasticity.of(
            self.free.plate,
            self.modes.eigenvalues,
            self.modes.losses,
            self.modes.dispersion,
        )

    @cached_property
    def fixed_stiffness(self) -> ComplexArray:
        """Dynamic stiffness of the rig's own masses (f, m) [N/m]."""
        return attached_stiffness(self.omega, self.rig.masses)

    @cached_property
    def springs(self) -> ComplexArray:
        """Dynamic stiffness of the springs of the rig's feet, with their losses (f, q) [N/m]."""
        springs = [self.rig.masses[number].spring(self.omega) for number in self.rig.feet]
        return np.array(springs, dtype=complex).reshape(-1, len(self.omega)).T

    @cached_property
    def drive_gains(self) -> ComplexArray:
        """Gains of the rig's ERAs, (f, eras)."""
        return np.array([era.gain(self.frequencies) for era in self.rig.eras]).T

    @cached_property
    def pads(self) -> FloatArray:
        """Footprints (q, 3) of the sensors that are not at ERAs [m]."""
        pads = []
        for sensor in self.sensors:
            if not sensor.era:
                pads.append((sensor.x, sensor.y, SENSOR_FOOT * bool(sensor.mass)))
        return np.array(pads, dtype=float).reshape(-1, 3)

    @cached_property
    def sensor_inertia(self) -> FloatArray | None:
        """omega² times the masses of the sensors (f, s) [N/m], None if they are massless."""
        masses = np.array([sensor.mass for sensor in self.sensors])
        return self.omega[:, None] ** 2 * masses if masses.any() else None

    @cached_property
    def movable(self) -> IntArray:
        """Indices of the attachments that can move: ERAs, additional masses, sensors off ERAs."""
        if not self.space.of("place", "masses", "sensor_place").any():
            return np.array([], dtype=int)
        eras = len(self.rig.eras)
        first_mass = eras + len(self.rig.masses)
        # Sensors follow the additional masses.
        count = self.mass_count + len(self.space.indices("sensor_place")) // 2
        return np.array([*range(eras), *range(first_mass, first_mass + count)], dtype=int)

    def at(self, x: FloatArray) -> "PlateAt":
        """Return the plate for parameters x (p,)."""
        return PlateAt(self, x)

    def places(self, values: PlateValues) -> AttachmentPoints:
        """Solve for all attachments at their positions; the latest solution is cached.

        A plate with form errors is extrapolated from the rig's positions by the slopes of its
        shapes, since positions can leave the plate.
        """
        footprints = self._footprints(values)
        if self.form is not None:
            nominal = self._footprints(PlateValues(self.rig, self.space, np.zeros(self.space.size)))
            return self._solved(nominal).moved(footprints, self.movable)
        footprints[:, :2] = np.clip(footprints[:, :2], 0, self.sides)
        return self._solved(footprints)

    def _solved(self, footprints: FloatArray) -> AttachmentPoints:
        inputs = (footprints, self.movable, self.sides)
        key = (self.modes, *[values.tobytes() for values in inputs])
        if key not in self.last_places:
            self.last_places.clear()
            self.last_places[key] = places_of(self.modes, footprints, self.movable, self.sides)
        return self.last_places[key]

    @property
    def sides(self) -> FloatArray:
        """Length and width of the plate [m]."""
        return np.array([self.rig.plate.length, self.rig.plate.width])

    def _footprints(self, values: PlateValues) -> FloatArray:
        """Footprints of ERAs, masses, additional masses and sensors, (a, 3) [m]."""
        feet = [era.foot for era in self.rig.eras]
        points = values["masses"][:, 1:]
        pads = self.pads.copy()
        pads[: len(values["sensor_place"]), :2] += values["sensor_place"]
        return np.vstack(
            [
                np.column_stack([values["place"], feet]),
                footprints_of(self.rig.masses),
                np.column_stack([points, np.zeros(len(points))]),
                pads,
            ]
        )


class PlateAt:
    """Plate of a forward model for one vector of parameters x (p,), with `a` attachments.

    further (f, r, r): additional stiffness [rad²/s²] between its r modes.
    """

    def __init__(
        self, model: ForwardModel, x: FloatArray, further: ComplexArray | None = None
    ) -> None:
        self.model = model
        self.values = PlateValues(model.rig, model.space, x)
        self.further = further
        self.functions = self._functions()
        """The free plate's modal receptance and truncated sums as functions of frequency."""
        self.located = model.places(self.values)
        """Shapes at all attachments."""
        self.sources = self.values.sources()
        """ERAs with their values."""
        self.source_slopes = [source.slopes(model.omega) for source in self.sources]
        """Derivatives of each ERA's dynamic stiffness and force with respect to its values."""
        self.full_levels = np.array([source.full_level for source in self.sources])
        self.force = drive_forces(model.omega, self.sources) / self.full_levels
        """Force of each ERA on a clamped plate, per unit of its drive, (f, n)."""
        self.stiffness = self._attached_stiffness()
        """Dynamic stiffness Z of the attachments (f, a) [N/m]."""
        self.moved = self.solved(self.located.shapes)
        """Coordinates of the free plate for a force at each attachment (f, r, a) [s²/kg]."""
        truncated = combined(self.functions.truncated(TERMS), self.located.truncated)
        self.free_receptance = A = self.located.shapes @ self.moved + truncated
        """A, receptance of the free plate (f, a, a) [m/N]."""
        # The sensors, last in order, have no stiffness.
        count = A.shape[1] - len(model.pads)
        Z = self.stiffness[:, :count]
        forces = coupled_forces(A[:, :count, :count], Z, np.eye(count, dtype=complex))
        reaction = A[:, :, :count] @ forces * Z[:, None]
        self.left = np.repeat(np.eye(A.shape[1], dtype=complex)[None], len(A), axis=0)
        self.left[:, :, :count] -= reaction
        """L = 1 - T Z (f, a, a)."""
        self.receptance = A - reaction @ A[:, :count]
        """T, receptance of the plate with its attachments (f, a, a) [m/N]."""

    def _attached_stiffness(self) -> ComplexArray:
        """Dynamic stiffness of ERAs, masses, additional masses and sensors (f, a) [N/m]."""
        model = self.model
        fixed = model.fixed_stiffness.copy()
        fixed[:, list(model.rig.feet)] += (self.values["supports"] - 1) * model.springs
        masses = -(model.omega[:, None] ** 2) * self.values["masses"][:, 0]
        sensors = np.zeros((len(model.omega), len(model.pads)))
        sources = attached_stiffness(model.omega, self.sources)
        return np.concatenate([sources, fixed, masses, sensors], axis=1)

    @cached_property
    def reach(self) -> ComplexArray:
        """Motion of the attachments for a force on each free mode (f, a, r) [s²/kg]."""
        return self.left @ self.moved.swapaxes(1, 2)

    def solved(self, shapes: FloatArray) -> ComplexArray:
        """Return coordinates of the free plate for forces with shapes (a, r), (f, r, a) [s²/kg]."""
        functions = self.functions
        if self.bending is None:
            return functions.modal[:, :, None] * shapes.T
        h = functions.thickness
        omega2 = (self.model.omega**2)[:, None]
        system = h**2 * self.bending - omega2[:, None] * self.added
        diagonal = np.arange(len(shapes.T))
        system[:, diagonal, diagonal] += h**2 * functions.elastic - omega2
        if self.further is not None:
            system += self.further
        return np.asarray(np.linalg.solve(system, shapes.T.astype(complex)) / h)

    @cached_property
    def lag(self) -> ComplexArray:
        """Motion of each drive relative to low frequency (f, n)."""
        return self.values.lag(self.model.frequencies)

    @cached_property
    def drive(self) -> ComplexArray:
        """Force of each drive on the plate per unit of its input, times -omega² (f, n)."""
        model = self.model
        force = self.force * self.values["gain"] * model.drive_gains * self.lag
        return np.asarray(-(model.omega**2)[:, None] * force)

    @cached_property
    def scale(self) -> ComplexArray:
        """Factors from T at sensors and ERAs to responses, (f, s, n)."""
        gains = self.values["sensor_gain"] * self.values["sensor_scale"]
        return np.asarray(gains[:, None] * self.drive[:, None])

    @cached_property
    def loaded(self) -> ComplexArray:
        """Receptance between sensors and ERAs, with each sensor's mass on the plate (f, s, n)
        [m/N]."""
        loaded = self.receptance[:, self.model.observed, : self.force.shape[1]]
        if self.lightness is not None:
            loaded = self.lightness[:, :, None] * loaded
        return np.asarray(loaded)

    @cached_property
    def seen(self) -> ComplexArray:
        """`loaded` with losses between hysteretic and viscous, according to x (f, s, n) [m/N]."""
        if self.model.law is None:
            return self.loaded
        return np.asarray(self.loaded + self.values["loss_law"] * self.model.law)

    @cached_property
    def lightness(self) -> ComplexArray | None:
        """Motion of the plate at each sensor relative to that without its mass, None if
        always 1."""
        inertia = self.model.sensor_inertia
        if inertia is None:
            return None
        observed = self.model.observed
        return np.asarray(1 / (1 - inertia * self.receptance[:, observed, observed]))

    @cached_property
    def responses(self) -> ComplexArray:
        """Acceleration at each sensor per unit drive of each ERA (f, s, n).

        [1/s²] for a moving base, [m/s²/V] for an exciter.
        """
        return self.scale * self.seen

    def _functions(self) -> FreeReceptance:
        """Return the free plate's receptance for these values; set the stiffness that varies."""
        model = self.model
        values = self.values
        plate = model.rig.plate
        solved = model.free.plate
        thickness = values["thickness"] * plate.thickness / solved.thickness
        self.modulus = values["modulus"] * plate.material.E / solved.material.E
        """Modulus relative to the solved plate's."""
        power = (model.frequencies / LOSS_FREQUENCY) ** values["loss_exponent"]
        self.eta = max(values["loss"], MIN_LOSS_FACTOR) * power
        """Loss factor (f,)."""
        self.by_loss_of_rest = 1j * self.eta / (1 + 1j * self.eta)
        """Derivative of the logarithm of the stiffness of the plate's rest by the loss factor
        (f,)."""
        self.bending: ComplexArray | None = None
        """Stiffness between modes with form errors (f, r, r) [rad²/s²]; `added` is their mass."""
        if model.form is not None:
            stretch = np.append(values["side"], values["poisson"])
            stretched = np.einsum("g,grq->rq", stretch, model.form.stiffening)
            self.bending = ((1 + 1j * self.eta) * self.modulus)[:, None, None] * stretched
            cell_masses = plate.mass * values["foreign_mass"][:, None]
            self.added = model.form.cells.T @ (cell_masses * model.form.cells)
        stiffness = np.asarray(self.modulus * self._lossy_eigenvalues(), dtype=complex)
        return model.free.receptance(model.omega, stiffness, self.eta, thickness, self.modulus)

    def _lossy_eigenvalues(self) -> ComplexArray:
        """Return the complex eigenvalues of all modes (f, r), and set their derivatives."""
        values = self.values
        theory = self.model.elasticity
        shifted = self.model.shifted_modes
        eigenvalues = theory.eigenvalues.copy()
        eigenvalues[shifted] *= np.exp(values["mode_shifts"])
        relative_loss = theory.relative_loss.copy()
        relative_loss[shifted] *= np.exp(values["mode_losses"])
        # Soft layers and air lose energy in addition to the plate's loss factor, and vary with
        # their mode.
        further_loss = theory.losses.copy()
        further_loss[shifted] *= np.exp(values["mode_shifts"] + values["mode_losses"])
        plate_loss: FloatArray = np.multiply.outer(self.eta, relative_loss) * eigenvalues
        total_loss = plate_loss + further_loss
        lossy = eigenvalues + 1j * total_loss
        if theory.dispersion is not None:
            lossy = lossy + theory.dispersion.at(self.model.omega)
        self.by_loss = _quotient(1j * plate_loss, lossy)
        """Derivatives of the logarithm of each mode's stiffness by the plate's loss factor (f,
        r)."""
        self.by_mode_loss = _quotient(1j * total_loss, lossy)
        """The same by the total loss of the mode (f, r)."""
        return lossy

    @property
    def reach_of_modes(self) -> tuple[ComplexArray, ComplexArray]:
        """`reach` of the observed points (f, s, r), and the transpose for the driven points (f, r,
        c)."""
        return self.reach[:, self.model.observed], self.reach[:, self.pushed].swapaxes(1, 2)

    def by_log_stiffness(
        self, of_modes: ComplexArray | float, of_rest: ComplexArray | float
    ) -> ComplexArray:
        """Derivatives by a change of the log stiffness of modes (f, r) and of the rest (f,)."""
        functions = self.functions
        observed, driven = self.reach_of_modes
        change = (observed * (of_modes * functions.elastic)[:, None]) @ driven
        if self.bending is not None:
            change += observed @ (self.bending * np.reshape(of_rest, (-1, 1, 1))) @ driven
        truncated = np.asarray(of_rest)[..., None] * functions.truncated_by_log_q
        further = self.by_free(combined(truncated, self.located.truncated))
        return self.responding(further - functions.thickness**3 * change)[..., None]

    @cached_property
    def by_log_rigidity(self) -> ComplexArray:
        """Derivatives by the logarithm of the stiffness of the whole plate."""
        return self.by_log_stiffness(1.0, 1.0)

    @cached_property
    def by_log_loss(self) -> ComplexArray:
        """Derivatives by the logarithm of the plate's loss factor."""
        return self.by_log_stiffness(self.by_loss, self.by_loss_of_rest)

    def by_free(self, change: ComplexArray) -> ComplexArray:
        """Change of T (for `responding`) due to a change of the free receptance (f, a, a)."""
        left = self.left
        return np.asarray(
            left[:, self.model.observed] @ change @ left[:, self.pushed].swapaxes(1, 2)
        )

    def by_modes(self, share: ComplexArray | float) -> ComplexArray:
        """Derivatives by the log eigenvalue of each shifting mode, times a factor (f, r)."""
        modes = self.model.shifted_modes
        reach = self.reach[:, :, modes]
        by_stiffness = -(self.functions.thickness**3) * self.functions.elastic
        return self.outer(reach, reach, (share * by_stiffness)[:, modes])

    def by_foreign_mass(self) -> ComplexArray:
        """Derivatives by each cell's fraction of the plate's mass, which is taken from the whole
        plate."""
        assert self.model.form is not None  # noqa: S101  there is foreign mass
        reach = self.reach @ self.model.form.cells.T
        share = self.model.rig.plate.mass * self.functions.thickness
        by_mass = self.outer(reach, reach, share * self.model.omega[:, None] ** 2)
        return np.asarray(by_mass - by_mass.mean(axis=-1, keepdims=True))

    def by_stretch(self, *numbers: int) -> ComplexArray:
        """Derivatives by relative length, width and Poisson's ratio, by index, through mode
        coupling."""
        assert self.model.form is not None  # noqa: S101  sides differ
        factor = -(self.functions.q * self.functions.thickness)[:, None, None]
        observed, driven = self.reach_of_modes
        slopes = []
        for stiffening in self.model.form.stiffening[list(numbers)]:
            slopes.append(self.responding(factor * (observed @ stiffening @ driven)))
        return np.stack(slopes, axis=-1)

    @cached_property
    def by_places(self) -> ComplexArray:
        """Derivatives by x and y of each movable attachment, (f, s, n, 2 v).

        A position changes the receptance in its row and its column.
        """
        located = self.located
        rows = located.shape_slopes @ self.moved
        rows = rows + combined(self.functions.truncated(TERMS), located.truncated_slopes)
        reach = self.left @ rows.swapaxes(1, 2)
        column = self.left[:, :, np.repeat(self.model.movable, 2)]
        ones = np.ones((len(self.model.omega), 1))
        return self.outer(column, reach, ones) + self.outer(reach, column, ones)

    def by_sources(self, kind: str) -> ComplexArray:
        """Derivatives by a value of each ERA, which also affects its force, (f, s, n, n)."""
        missing = np.zeros((2, len(self.model.omega)), dtype=complex)
        slopes = np.array([slopes.get(kind, missing) for slopes in self.source_slopes])
        stiffness_slopes, force_slopes = slopes.transpose(1, 2, 0)
        eras = np.arange(len(slopes))
        by_value = self.by_stiffness(eras, stiffness_slopes)
        by_force = force_slopes / self.full_levels / self.force
        by_value[:, :, eras, eras] += self.responses * by_force[:, None]
        return by_value

    def by_masses(self) -> ComplexArray:
        """Derivatives by each additional mass, its x and y in turn, (f, s, n, 3 m)."""
        first = len(self.sources)
        last = first + self.model.mass_count
        masses = self.model.movable[first:last]
        by_mass = self.by_stiffness(masses, -(self.model.omega[:, None] ** 2))[..., None]
        by_place = self.by_places[..., 2 * first : 2 * last].reshape(*by_mass.shape[:-1], 2)
        return np.concatenate([by_mass, by_place], axis=-1).reshape(*by_mass.shape[:3], -1)

    def by_drives(self, factor: ComplexArray | complex = 1.0) -> ComplexArray:
        """Derivatives by the logarithm of the gain of each drive, times a factor, (f, s, n, n)."""
        return self.responses[..., None] * np.eye(len(self.sources)) * factor

    @property
    def by_sensors(self) -> ComplexArray:
        """Derivatives by the logarithm of the gain of each sensor, (f, s, n, s)."""
        return self.responses[..., None] * np.eye(len(self.model.sensors))[:, None]

    def by_stiffness(self, at: IntArray, change: AnyArray) -> ComplexArray:
        """Derivatives by changes (f, m) of the dynamic stiffness of attachments with indices
        (m,)."""
        columns = self.receptance[:, :, at]
        return self.outer(columns, columns, -change)

    def outer(self, u: AnyArray, v: AnyArray, factor: AnyArray) -> ComplexArray:
        """Responses to T = factor u v^T, (f, s, n, m), for columns (f, a, m) and factors (f, m)."""
        left = u[:, self.model.observed] * factor[:, None]
        return self.responding(left[:, :, None] * v[:, None, self.pushed])

    @property
    def pushed(self) -> slice | IntArray:
        """Columns of T whose changes count: ERAs, then sensors that load the plate."""
        n = len(self.sources)
        if self.lightness is None:
            return slice(n)
        return np.concatenate([np.arange(n), self.model.observed])

    def responding(self, change: AnyArray) -> ComplexArray:
        """Change of the responses (f, s, n, ...) due to a change of T (f, s, columns of `pushed`,
        ...)."""
        further = (1,) * (change.ndim - 3)
        n = len(self.sources)
        motion = change[:, :, :n]
        if self.lightness is not None:
            assert self.model.sensor_inertia is not None  # noqa: S101  there is a mass
            sensors = np.arange(change.shape[1])
            at_sensor = change[:, sensors, n + sensors][:, :, None]
            loaded = self.model.sensor_inertia[:, :, None] * self.loaded
            motion = motion + loaded.reshape(*loaded.shape, *further) * at_sensor
            motion = motion * self.lightness.reshape(*self.lightness.shape, 1, *further)
        return motion * self.scale.reshape(*self.scale.shape, *further)


def _quotient(numerator: AnyArray, denominator: ComplexArray) -> ComplexArray:
    """Return a quotient, 0 for a denominator of 0."""
    zeros = np.zeros(denominator.shape, dtype=complex)
    return np.divide(numerator, denominator, out=zeros, where=denominator != 0)


def viscous_difference(model: ForwardModel, x: FloatArray) -> ComplexArray:
    """Change of the receptance (f, s, n) [m/N] between sensors and ERAs if losses are viscous.

    At parameters x (p,). Raises InputError for a plate without form errors: its supported modes
    need the residual vectors of its attachments.
    """
    if model.form is None:
        raise InputError("form must be ReducedModes for viscous losses, got None")
    plate = model.at(x)
    omega = model.omega[:, None, None]
    change = 1j * plate.eta[:, None, None] * (omega * _viscous(plate) - _lossy(plate))
    viscous_plate = PlateAt(model, x, change)
    columns = plate.force.shape[1]
    difference = viscous_plate.receptance - plate.receptance
    return np.asarray(difference[:, model.observed, :columns])


def _lossy(plate: PlateAt) -> FloatArray:
    """Stiffness between coordinates to which the plate's loss factor applies (r, r) [rad²/s²]."""
    theory, rigidity = plate.model.elasticity, plate.modulus * plate.functions.thickness**2
    return np.diag(rigidity * theory.relative_loss * theory.eigenvalues)


def _viscous(plate: PlateAt) -> FloatArray:
    """Damping (r, r) [rad/s] equivalent to a loss factor of 1 for each supported mode at
    resonance."""
    rig = plate.model.rig
    h = plate.functions.thickness
    springs = [source.in_time.stiffness for source in plate.sources]
    springs += [load.stiffness for load in rig.masses]
    for foot, factor in zip(rig.feet, plate.values["supports"], strict=True):
        springs[len(plate.sources) + foot] *= factor
    added_masses = plate.values["masses"][:, 0].tolist()
    springs += [0.0] * len(added_masses)
    masses = [source.in_time.mass for source in plate.sources]
    masses += [load.mass for load in rig.masses]
    masses += added_masses
    on_plate = plate.located.shapes[: len(springs)]
    lossy = _lossy(plate)
    stiffness = lossy + (on_plate.T * springs) @ on_plate / h
    mass = np.eye(len(lossy)) + (on_plate.T * masses) @ on_plate / h
    eigenvalues, modes = linalg.eigh(stiffness, mass)
    roots = np.maximum(eigenvalues, _SLOWEST**2) ** 0.25
    weighted = mass @ modes / roots
    return weighted @ (modes.T @ lossy @ modes) @ weighted.T


def jacobian(plate: PlateAt, searched: NDArray[np.bool_] | None = None) -> ComplexArray:
    """Derivatives of the responses of a plate by x, (f, s, n, p).

    searched (p,): mask of the requested parameters, default all; kinds without any get zeros.
    """
    space = plate.model.space
    is_requested = space.uncertain
    if searched is not None:
        is_requested = is_requested & searched
    derivatives = np.zeros((*plate.responses.shape, space.size), dtype=complex)
    for kind, part in space.groups.items():
        if is_requested[part].any():
            derivatives[..., part] = space.kinds[kind].derivative(plate) * space.std[part]
    return derivatives


def by_mass_at(plate: PlateAt, points: FloatArray) -> ComplexArray:
    """Derivatives of the responses by a mass [kg] at points (p, 2) [m], (f, s, n, p)."""
    modes = plate.model.modes
    truncated = modes.truncated_terms(plate.located.footprints, points)
    rest = combined(plate.functions.truncated(TERMS), truncated)
    reach = plate.reach @ modes.shapes_at(points).T + plate.left @ rest
    return plate.outer(reach, reach, plate.model.omega[:, None] ** 2)
