"""Forward model: responses of a rig's plate at its sensors for a vector of parameters.

Plate and attachments. A is the receptance of the free plate between all `a` attachments (ERAs,
masses, additional masses, and sensors that are not at ERAs), and Z the diagonal of their dynamic
stiffness, 0 at a sensor. The plate with its attachments has the receptance

    T = A (1 + Z A)^-1 = L A,    L = 1 - T Z.

Responses. ERA j with gain g_j drives a clamped plate by the force F_j g_j, where F_j is k_j + i w
c_j for a moving base. Sensor s with gain sigma_s measures the acceleration

    Y_sj = -w² sigma_s l_s T_sj F_j g_j,    l_s = 1 / (1 - w² m_s T_ss).

The mass m_s of a sensor loads the plate only during its own measurement, like a sensor that is
moved between positions.

Form errors are differences from the rig that no rig file describes, such as inaccurately cut sides
or a cable glued to the plate. If ignored, they bias fitted values far more than noise does, and no
residual shows the bias. They couple the modes of the free plate by stiffness and mass
(`ReducedModes` of `model.reduction`): with relative thickness h, loss factor eta, relative modulus
E, and lossy eigenvalues lambda of the modes, coordinates q of the free plate follow from

    (h² E lambda + h² K - w² (1 + M)) q = phi / h

for a unit force at an attachment with shapes phi. K is the change of stiffness with the sides and
Poisson's ratio, times (1 + i eta) E; M is the foreign mass. Without form errors the system is
diagonal.

Parameters are described in `model.estimate.parameter_space`, their derivatives in
`model.estimate.derivatives`, viscous losses in `model.estimate.loss_law`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from model.arrays import ComplexArray, FloatArray, IntArray
from model.estimate.parameter_space import PlateValues, Space
from model.reduction.attachment_points import AttachmentPoints, Modes, places_of
from model.reduction.form_modes import ReducedModes
from model.reduction.free_plate import TERMS, FreePlate, FreeReceptance, combined
from model.reduction.point_cache import PointCache
from model.rig.rig import Rig
from model.structure.attachments import attached_stiffness, coupled_forces, footprints_of
from model.structure.exciter import Actuator
from model.structure.modal_elasticity import (
    WITHOUT_PART,
    ModalElasticity,
    check_scales,
    lowest_elastic,
)
from model.structure.plate import LOSS_FREQUENCY
from model.structure.sources import drive_forces

SENSOR_FOOT = 5e-3
"""Radius of the disc on which a sensor's mass acts [m]; a plate is soft under a point."""

MIN_LOSS_FACTOR = 1e-9
"""Minimum loss factor, so that its logarithm has derivatives."""


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
class ForwardModel:
    """A rig's plate on its attachments, with s sensors, as a function of parameters.

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
    viscous_change: ComplexArray | None = None
    """Change of the receptance (f, s, n) [m/N] if losses are viscous, None to neglect it; see
    `viscous_difference`."""
    latest_attachments: PointCache[AttachmentPoints] = field(default_factory=lambda: PointCache(1))
    """Attachments of the plate without form errors that were used last, shared with the models that
    `replace` derives from this one."""

    def __post_init__(self) -> None:
        """Raise InputError for a plate with wrong responses and slopes."""
        groups = self.space.groups
        thickness = 1 + self.space.std[groups["thickness"]]
        modulus = 1 + self.space.std[groups["modulus"]]
        check_scales(self.rig.plate, thickness, modulus, remedy=WITHOUT_PART)

    def at(self, x: FloatArray) -> "PlateAt":
        """Return the plate for parameters x (p,)."""
        values = PlateValues(self.rig, self.space, x)
        return PlateAt(self, values, free_plate_at(self, values))

    @cached_property
    def omega(self) -> FloatArray:
        """2 pi f [rad/s], (f,)."""
        return 2 * np.pi * self.frequencies

    @cached_property
    def sides(self) -> FloatArray:
        """Length and width of the plate (2,) [m]."""
        return np.array([self.rig.plate.length, self.rig.plate.width])

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
        modes = self.modes
        return ModalElasticity.of(
            self.free.plate, modes.eigenvalues, modes.losses, modes.dispersion
        )

    @cached_property
    def mass_stiffness(self) -> ComplexArray:
        """Dynamic stiffness of the rig's own masses (f, m) [N/m]."""
        return attached_stiffness(self.omega, self.rig.masses)

    @cached_property
    def foot_springs(self) -> ComplexArray:
        """Dynamic stiffness of the springs of the rig's feet, with their losses (f, q) [N/m]."""
        springs = [self.rig.masses[number].spring(self.omega) for number in self.rig.feet]
        return np.array(springs, dtype=complex).reshape(-1, len(self.omega)).T

    @cached_property
    def drive_gains(self) -> ComplexArray:
        """Gains of the rig's ERAs, (f, n)."""
        return np.array([era.gain(self.frequencies) for era in self.rig.eras]).T

    @cached_property
    def sensor_inertia(self) -> FloatArray | None:
        """omega² times the masses of the sensors (f, s) [N/m], None if they are massless."""
        masses = np.array([sensor.mass for sensor in self.sensors])
        return self.omega[:, None] ** 2 * masses if masses.any() else None

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

    @cached_property
    def pads(self) -> FloatArray:
        """Footprints (q, 3) of the sensors that are not at ERAs [m]."""
        pads = [
            (sensor.x, sensor.y, SENSOR_FOOT if sensor.mass else 0.0)
            for sensor in self.sensors
            if not sensor.era
        ]
        return np.array(pads, dtype=float).reshape(-1, 3)

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

    def attachments(self, values: PlateValues) -> AttachmentPoints:
        """Return the shapes of the modes at all attachments.

        A plate with form errors is extrapolated from the rig's positions by the slopes of its
        shapes, since positions can leave the plate. Other plates are solved at the positions.
        """
        footprints = self._footprints(values)
        if self.form is not None:
            return self._nominal_attachments.moved(footprints)
        located = self.latest_attachments.get(footprints)
        if located is None or not located.is_for(self.modes, self.movable):
            located = places_of(self.modes, footprints, self.movable, self.sides)
            self.latest_attachments.put(footprints, located)
        return located

    @cached_property
    def _nominal_attachments(self) -> AttachmentPoints:
        """Shapes of the modes at all attachments at the rig's positions."""
        nominal = PlateValues(self.rig, self.space, np.zeros(self.space.size))
        return places_of(self.modes, self._footprints(nominal), self.movable, self.sides)

    def _footprints(self, values: PlateValues) -> FloatArray:
        """Return the footprints of ERAs, masses, additional masses and sensors, (a, 3) [m].

        Clipped to the plate, unless form errors continue the shapes beyond it.
        """
        feet = [era.foot for era in self.rig.eras]
        points = values["masses"][:, 1:]
        pads = self.pads.copy()
        pads[: len(values["sensor_place"]), :2] += values["sensor_place"]
        footprints = np.vstack(
            [
                np.column_stack([values["place"], feet]),
                footprints_of(self.rig.masses),
                np.column_stack([points, np.zeros(len(points))]),
                pads,
            ]
        )
        if self.form is None:
            footprints[:, :2] = np.clip(footprints[:, :2], 0, self.sides)
        return footprints


class FormMatrices(NamedTuple):
    """Stiffness and mass between the r coordinates of a plate due to form errors."""

    stiffness: ComplexArray
    """K, for a relative thickness of 1 (f, r, r) [rad²/s²]."""
    mass: FloatArray
    """M, relative to the modal mass (r, r)."""
    loss_change: ComplexArray | None = None
    """Change of the stiffness with another law of losses (f, r, r) [rad²/s²], None for hysteretic
    losses."""


@dataclass(frozen=True, eq=False)
class FreePlateAt:
    """Elasticity, losses and form errors of a free plate for given parameters.

    r: modes, or coordinates of a plate with form errors.
    """

    modulus: float
    """Modulus relative to the solved plate's."""
    loss_factor: FloatArray
    """Loss factor eta of the plate, a power of frequency (f,)."""
    eigenvalues: ComplexArray
    """Eigenvalues of the modes with all losses, for a relative modulus of 1 (f, r) [rad²/s²]."""
    plate_losses: FloatArray
    """Part of their imaginary parts due to the plate's loss factor (f, r) [rad²/s²]."""
    losses: FloatArray
    """`plate_losses` and the losses of soft layers and air (f, r) [rad²/s²]."""
    receptance: FreeReceptance
    """Receptance of modes and truncated modes as functions of frequency."""
    form: FormMatrices | None
    """Coupling of the coordinates by form errors, None for a plate without them."""

    def coordinates(self, shapes: FloatArray) -> ComplexArray:
        """Return coordinates of the plate for forces with shapes (a, r), (f, r, a) [s²/kg]."""
        receptance = self.receptance
        if self.form is None:
            return receptance.modal[:, :, None] * shapes.T
        h = receptance.thickness
        omega2 = (receptance.omega**2)[:, None]
        system = h**2 * self.form.stiffness - omega2[:, None] * self.form.mass
        diagonal = np.arange(len(shapes.T))
        system[:, diagonal, diagonal] += h**2 * receptance.elastic - omega2
        if self.form.loss_change is not None:
            system += self.form.loss_change
        return np.asarray(np.linalg.solve(system, shapes.T.astype(complex)) / h)


def free_plate_at(model: ForwardModel, values: PlateValues) -> FreePlateAt:
    """Return the free plate of a model for values of its parameters."""
    solved = model.free.plate
    plate = model.rig.plate
    thickness = values["thickness"] * plate.thickness / solved.thickness
    modulus = values["modulus"] * plate.material.E / solved.material.E
    power = (model.frequencies / LOSS_FREQUENCY) ** values["loss_exponent"]
    loss_factor = max(values["loss"], MIN_LOSS_FACTOR) * power
    shifts, mode_losses = values["mode_shifts"], values["mode_losses"]
    theory = model.elasticity
    eigenvalues = _scaled_modes(model, theory.eigenvalues, shifts)
    relative_loss = _scaled_modes(model, theory.relative_loss, mode_losses)
    # Soft layers and air lose energy in addition to the plate's loss factor, and vary with their
    # mode.
    layer_losses = _scaled_modes(model, theory.losses, shifts + mode_losses)
    plate_losses: FloatArray = np.multiply.outer(loss_factor, relative_loss) * eigenvalues
    losses = plate_losses + layer_losses
    lossy_eigenvalues = eigenvalues + 1j * losses
    if theory.dispersion is not None:
        lossy_eigenvalues = lossy_eigenvalues + theory.dispersion.at(model.omega)

    form = None
    if model.form is not None:
        stretch = np.append(values["side"], values["poisson"])
        stretched = np.einsum("g,grq->rq", stretch, model.form.stiffening)
        rigidity = (1 + 1j * loss_factor) * modulus
        cells = model.form.cells
        cell_masses = plate.mass * values["foreign_mass"][:, None]
        form = FormMatrices(
            stiffness=rigidity[:, None, None] * stretched, mass=cells.T @ (cell_masses * cells)
        )
    elastic = np.asarray(modulus * lossy_eigenvalues, dtype=complex)
    return FreePlateAt(
        modulus=modulus,
        loss_factor=loss_factor,
        eigenvalues=lossy_eigenvalues,
        plate_losses=plate_losses,
        losses=losses,
        receptance=model.free.receptance(model.omega, elastic, loss_factor, thickness, modulus),
        form=form,
    )


def _scaled_modes(model: ForwardModel, theory: FloatArray, logarithms: FloatArray) -> FloatArray:
    """Return values of all modes (r,), multiplied by factors for the modes that can shift."""
    scaled = theory.copy()
    scaled[model.shifted_modes] *= np.exp(logarithms)
    return scaled


@dataclass(frozen=True, eq=False)
class PlateAt:
    """Plate of a forward model for one vector of parameters, with `a` attachments."""

    model: ForwardModel
    values: PlateValues
    """Values of the parameters."""
    free: FreePlateAt
    """The free plate with these values."""

    @cached_property
    def attachments(self) -> AttachmentPoints:
        """Shapes at all attachments."""
        return self.model.attachments(self.values)

    @cached_property
    def sources(self) -> tuple[Actuator, ...]:
        """ERAs with their values."""
        return self.values.sources()

    @cached_property
    def full_levels(self) -> FloatArray:
        """Drive of each ERA at full level (n,) [m] or [V]."""
        return np.array([source.full_level for source in self.sources])

    @cached_property
    def force(self) -> ComplexArray:
        """F, force of each ERA on a clamped plate per unit of its drive (f, n)."""
        return drive_forces(self.model.omega, self.sources) / self.full_levels

    @cached_property
    def stiffness(self) -> ComplexArray:
        """Z of the attachments that have a stiffness: all but sensors (f, z) [N/m].

        In the order of attachments: ERAs, the rig's masses, additional masses.
        """
        omega = self.model.omega
        rig_masses = self.model.mass_stiffness.copy()
        foot_changes = (self.values["supports"] - 1) * self.model.foot_springs
        rig_masses[:, list(self.model.rig.feet)] += foot_changes
        added_masses = -(omega[:, None] ** 2) * self.values["masses"][:, 0]
        sources = attached_stiffness(omega, self.sources)
        return np.concatenate([sources, rig_masses, added_masses], axis=1)

    @cached_property
    def coordinates(self) -> ComplexArray:
        """Coordinates of the free plate for a force at each attachment (f, r, a) [s²/kg]."""
        return self.free.coordinates(self.attachments.shapes)

    @cached_property
    def free_receptance(self) -> ComplexArray:
        """A, receptance of the free plate (f, a, a) [m/N]."""
        located = self.attachments
        truncated = combined(self.free.receptance.truncated(TERMS), located.truncated)
        return located.shapes @ self.coordinates + truncated

    @cached_property
    def _reaction(self) -> ComplexArray:
        """T Z, motion by the reactions to a motion of the z attachments with a stiffness (f, a,
        z)."""
        A = self.free_receptance
        Z = self.stiffness
        count = Z.shape[1]
        forces = coupled_forces(A[:, :count, :count], Z, np.eye(count, dtype=complex))
        return np.asarray(A[:, :, :count] @ forces * Z[:, None])

    @cached_property
    def coupling(self) -> ComplexArray:
        """L = 1 - T Z, motion with attachments relative to that of the free plate (f, a, a)."""
        reaction = self._reaction
        frequencies, count, stiff_count = reaction.shape
        coupling = np.repeat(np.eye(count, dtype=complex)[None], frequencies, axis=0)
        coupling[:, :, :stiff_count] -= reaction
        return coupling

    @cached_property
    def receptance(self) -> ComplexArray:
        """T, receptance of the plate with its attachments (f, a, a) [m/N]."""
        A = self.free_receptance
        return A - self._reaction @ A[:, : self.stiffness.shape[1]]

    @cached_property
    def lag(self) -> ComplexArray:
        """Motion of each drive relative to low frequency (f, n)."""
        return self.values.lag(self.model.frequencies)

    @cached_property
    def drive(self) -> ComplexArray:
        """-omega² F g, force of each drive per unit of its input times -omega² (f, n)."""
        model = self.model
        force = self.force * self.values["gain"] * model.drive_gains * self.lag
        return np.asarray(-(model.omega**2)[:, None] * force)

    @cached_property
    def scale(self) -> ComplexArray:
        """Factors from receptances between sensors and ERAs to responses, (f, s, n)."""
        gains = self.values["sensor_gain"] * self.values["sensor_scale"]
        return np.asarray(gains[:, None] * self.drive[:, None])

    @cached_property
    def load_factors(self) -> ComplexArray | None:
        """l, motion at each sensor with its mass relative to that without it (f, s), None if all
        are 1."""
        inertia = self.model.sensor_inertia
        if inertia is None:
            return None
        observed = self.model.observed
        return 1 / (1 - inertia * self.receptance[:, observed, observed])

    @cached_property
    def loaded_receptance(self) -> ComplexArray:
        """l T, receptance between sensors and ERAs with each sensor's mass (f, s, n) [m/N]."""
        loaded = self.receptance[:, self.model.observed, : len(self.sources)]
        if self.load_factors is not None:
            loaded = self.load_factors[:, :, None] * loaded
        return np.asarray(loaded)

    @cached_property
    def sensed_receptance(self) -> ComplexArray:
        """`loaded_receptance` with losses between hysteretic and viscous (f, s, n) [m/N]."""
        if self.model.viscous_change is None:
            return self.loaded_receptance
        return np.asarray(
            self.loaded_receptance + self.values["loss_law"] * self.model.viscous_change
        )

    @cached_property
    def responses(self) -> ComplexArray:
        """Y, acceleration at each sensor per unit drive of each ERA (f, s, n).

        [1/s²] for a moving base, [m/s²/V] for an exciter.
        """
        return self.scale * self.sensed_receptance
