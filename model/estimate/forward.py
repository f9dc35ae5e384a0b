"""Forward model: responses of a rig's plate at its sensors for a vector of parameters.

A is the receptance of the free plate between all attachments and sensors, Z the dynamic stiffness
of what is attached there (0 at a sensor), and T = A (1 + Z A)^-1 the receptance of the plate on its
attachments. ERA j, whose gain is g_j, drives a plate that is held by the force F_j g_j, which is
(k_j + i w c_j) g_j for a moving base. Sensor s then reads

    Y_sj = -w² sigma_s l_s T_sj F_j g_j,    l_s = 1 / (1 - w² m_s T_ss),

with its gain sigma_s. A sensor of mass m_s loads the plate only while it measures, like one that is
moved from place to place.

Losses are hysteretic: a loss factor that is the same at every frequency, (1 + i eta) K, which is
not causal. At the other extreme they are viscous: each mode j of the plate on its supports loses in
proportion to frequency, eta omega / omega_j. Both agree at the resonances alone, while most tones
are beside them, so that a fit of the wrong law finds a loss factor that is off by more than noise
and form errors explain. A plate with form errors has a parameter between both laws, 0 to 1.

Derivatives of a plate's responses by all of its parameters, and by a mass at any point.

With L = 1 - T Z, a change dA of the free receptance and dZ of what is attached change the
receptance T of the plate on its attachments by L dA L^T - T dZ T. For a mode, a place or an
attachment that is a change of rank one or two (symbols as in `model.estimate.forward`). A
sensor of mass m that is on the plate while it measures adds l² w² m T_sj dT_ss to l dT_sj.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from model.arrays import ComplexArray, FloatArray, IntArray
from model.estimate.space import (
    EXCITER_KINDS,
    AttachmentPoints,
    Modes,
    ReducedModes,
    Space,
    Values,
    places_of,
)
from model.reduction.free_plate import TERMS, FreePlate, FreeReceptance, combined
from model.rig.rig import Rig
from model.structure.attachments import (
    Fingertip,
    attached_stiffness,
    coupled_forces,
    drive_forces,
    footprints_of,
)
from model.structure.modal_elasticity import (
    WITHOUT_PART,
    ModalElasticity,
    check_scales,
    lowest_elastic,
)
from model.structure.plate import LOSS_FREQUENCY

SENSOR_FOOT = 5e-3
"""Radius of the disc on which a sensor's mass acts [m]: under a point a plate is soft."""

MIN_LOSS_FACTOR = 1e-9
"""Least loss factor, so that there are derivatives by its logarithm."""

_SLOWEST = 2 * np.pi  # rad/s; of slower modes the frequency of losses is taken as this


@dataclass(frozen=True)
class Sensor:
    """A sensor of acceleration, at the bolt of an ERA or at a point of the plate."""

    name: str
    era: str = ""
    """Name of the ERA at whose bolt it is, "" for one at x, y [m]."""
    x: float = 0.0
    y: float = 0.0
    amplifier: str = ""
    """Amplifier on whose clock its phases count, "" for that of no amplifier."""
    mass: float = 0.0
    """Mass [kg] on the plate while this sensor measures, as of one that is moved."""


@dataclass(frozen=True)
class RestingFinger:
    """A finger that rests at x, y [m], with the load that is known of it."""

    x: float
    y: float
    fingertip: Fingertip
    tone: int | None = None
    """Number of the only tone during which it rests, None for all."""


@dataclass(frozen=True, eq=False)
class ForwardModel:
    """A rig's plate on its attachments, with sensors and fingers, as a function of parameters.

    Raises InputError for a plate that does not scale with a thickness or modulus that may differ.
    """

    rig: Rig
    sensors: Sequence[Sensor]
    frequencies: FloatArray
    """Frequencies of the tones (f,) [Hz]."""
    space: Space
    """Parameters, those that may differ from the rig's values among them."""
    free: FreePlate
    """The free plate, solved for the rig's thickness and modulus or for others."""
    fingers: Sequence[RestingFinger] = ()
    form: ReducedModes | None = None
    """The plate in coordinates in which it may have form errors."""
    amplifiers: Sequence[str] = ()
    """Names of the amplifiers whose clocks may be off, in the order of the delays."""
    law: ComplexArray | None = None
    """Change of the receptance (f, s, n) [m/N] where losses are viscous, None to leave it out."""
    last_places: dict[bytes, AttachmentPoints] = field(default_factory=dict)
    """The last solution for all attachments, by their footprints."""

    def __post_init__(self) -> None:
        """Raise InputError for a plate whose responses and slopes would be wrong."""
        stds = (self.space.std[self.space.groups[kind]] for kind in ("thickness", "modulus"))
        check_scales(self.rig.plate, *(1 + std for std in stds), remedy=WITHOUT_PART)

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
        after = len(names) + len(self.rig.masses) + self.mass_count + len(self.fingers)
        found = []
        for sensor in self.sensors:
            found.append(names.index(sensor.era) if sensor.era else after)
            after += not sensor.era
        return np.array(found, dtype=int)

    @cached_property
    def lateness(self) -> FloatArray:
        """Sign of the delay of each response by the clock of each amplifier, (s, n, amplifiers).

        1 where the amplifier plays, -1 where it hears, since what it hears seems early.
        """
        names = [*self.amplifiers]
        plays = [self.rig.wiring[era.name].amplifier for era in self.rig.eras]
        hears = [each.amplifier for each in self.sensors]
        own = [np.array([[each == name for name in names] for each in of]) for of in (plays, hears)]
        return np.asarray(own[0].astype(float)[None] - own[1].astype(float)[:, None])

    @property
    def modes(self) -> Modes:
        """The modes of the free plate, or its coordinates with form errors."""
        return self.form or self.free.modes

    @cached_property
    def shifted_modes(self) -> IntArray:
        """Numbers of the modes whose eigenvalues may shift, the lowest elastic ones, ascending."""
        return lowest_elastic(self.modes.eigenvalues, len(self.space.indices("mode_shifts")))

    @cached_property
    def elasticity(self) -> ModalElasticity:
        """Eigenvalues and loss factors of the modes as the rig has them."""
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
        found = [self.rig.masses[number].spring(self.omega) for number in self.rig.feet]
        return np.array(found, dtype=complex).reshape(-1, len(self.omega)).T

    @cached_property
    def drive_gains(self) -> ComplexArray:
        """Gains of the rig's ERAs in its file, (f, eras)."""
        return np.array([era.gain(self.frequencies) for era in self.rig.eras]).T

    @cached_property
    def pads(self) -> FloatArray:
        """Footprints (q, 3) of the sensors that are not at ERAs [m]."""
        alone = [
            (each.x, each.y, SENSOR_FOOT if each.mass else 0.0)
            for each in self.sensors
            if not each.era
        ]
        return np.array(alone, dtype=float).reshape(-1, 3)

    @cached_property
    def sensor_inertia(self) -> FloatArray | None:
        """omega² times the masses of the sensors (f, s) [N/m], None where they weigh nothing."""
        masses = np.array([each.mass for each in self.sensors])
        return self.omega[:, None] ** 2 * masses if masses.any() else None

    @cached_property
    def movable(self) -> IntArray:
        """Numbers of the attachments that may move: ERAs, additional masses, sensors off ERAs."""
        if not self.space.of("place", "masses", "sensor_place").any():
            return np.array([], dtype=int)
        first = len(self.rig.eras) + len(self.rig.masses)
        movable = [*range(len(self.rig.eras)), *range(first, first + self.mass_count)]
        last = first + self.mass_count + len(self.fingers)
        sensors = range(last, last + len(self.space.indices("sensor_place")) // 2)
        return np.array([*movable, *sensors], dtype=int)

    def at(self, x: FloatArray) -> "PlateAt":
        """The plate for parameters x (p,)."""
        return PlateAt(self, x)

    def places(self, values: Values) -> AttachmentPoints:
        """Solve for all attachments at their places; the last solution is kept.

        A plate with form errors is extrapolated from the rig's places by the slopes of its shapes,
        since places may leave it.
        """
        footprints = self._footprints(values)
        if self.form is not None:
            nominal = self._footprints(Values.of(self.rig, self.space, np.zeros(self.space.size)))
            return self._solved(nominal).moved(footprints, self.movable)
        footprints[:, :2] = np.clip(footprints[:, :2], 0, self._sides)
        return self._solved(footprints)

    def _solved(self, footprints: FloatArray) -> AttachmentPoints:
        key = footprints.tobytes()
        if key not in self.last_places:
            self.last_places.clear()
            self.last_places[key] = places_of(self.modes, footprints, self.movable, self._sides)
        return self.last_places[key]

    @property
    def _sides(self) -> FloatArray:
        return np.array([self.rig.plate.length, self.rig.plate.width])

    def _footprints(self, values: Values) -> FloatArray:
        """Footprints of ERAs, masses, additional masses, fingers and sensors, (a, 3) [m]."""
        feet = [era.foot for era in self.rig.eras]
        fingers = np.array([(each.x, each.y) for each in self.fingers]).reshape(-1, 2)
        points = np.vstack([values.masses[:, 1:], fingers])
        pads = self.pads.copy()
        pads[: len(values.sensor_places), :2] += values.sensor_places
        return np.vstack(
            [
                np.column_stack([values.places, feet]),
                footprints_of(self.rig.masses),
                np.column_stack([points, np.zeros(len(points))]),
                pads,
            ]
        )


class PlateAt:
    """The plate of a forward model for one vector of parameters x (p,), with a attachments.

    further (f, r, r): stiffness [rad²/s²] between its r modes that is added to theirs.
    """

    def __init__(
        self, model: ForwardModel, x: FloatArray, further: ComplexArray | None = None
    ) -> None:
        self.model, self.values = model, Values.of(model.rig, model.space, x)
        self.further = further
        self.functions = self._functions()
        """The free plate's modal receptance and truncated sums as functions of frequency."""
        self.located = model.places(self.values)
        """Shapes at all attachments."""
        w, values = model.omega[:, None], self.values
        self.sources = values.sources(model.rig)
        """The ERAs with their values."""
        self.full_levels = np.array([each.full_level for each in self.sources])
        self.force = drive_forces(model.omega, self.sources) / self.full_levels
        """Force of each ERA on a plate that is held, per unit of its drive, (f, n)."""
        loads = [
            _finger(each, logs, model.omega)
            for each, logs in zip(model.fingers, values.fingers, strict=True)
        ]
        self.finger_slopes = [slopes for _, slopes in loads]
        """Derivatives of each finger's dynamic stiffness by its parts, (f, 4)."""
        fixed = model.fixed_stiffness.copy()
        fixed[:, list(model.rig.feet)] += (values.supports - 1) * model.springs
        held = [
            attached_stiffness(model.omega, self.sources),
            fixed,
            -(w**2) * values.masses[:, 0],
            *(load[:, None] for load, _ in loads),
            np.zeros((len(w), len(model.pads))),
        ]
        self.stiffness = Z = np.concatenate(held, axis=1)
        """Dynamic stiffness of what is attached (f, a) [N/m]."""
        shapes, moved = self.located.shapes, self.solved(self.located.shapes)
        A = shapes @ moved + combined(self.functions.truncated(TERMS), self.located.truncated)
        # Nothing holds the plate at the sensors, the last ones.
        count = Z.shape[1] - len(model.pads)
        forces = coupled_forces(A[:, :count, :count], Z[:, :count], np.eye(count, dtype=complex))
        reaction = A[:, :, :count] @ forces * Z[:, None, :count]
        self.left = np.repeat(np.eye(Z.shape[1], dtype=complex)[None], len(w), axis=0)
        self.left[:, :, :count] -= reaction
        """L = 1 - T Z (f, a, a)."""
        self.receptance = A - reaction @ A[:, :count]
        """T, of the plate with its attachments (f, a, a) [m/N]."""
        self.free_receptance = A
        """A, of the free plate (f, a, a) [m/N]."""
        self.moved = moved
        """Coordinates of the free plate by a force at each attachment (f, r, a) [s²/kg]."""

    @cached_property
    def reach(self) -> ComplexArray:
        """Motion of what is attached by a force on each free mode (f, a, r) [s²/kg]."""
        return self.left @ self.moved.swapaxes(1, 2)

    def solved(self, shapes: FloatArray) -> ComplexArray:
        """Coordinates of the free plate by forces where shapes are (a, r), (f, r, a) [s²/kg]."""
        functions = self.functions
        if self.bending is None:
            return np.asarray(functions.modal[:, :, None] * shapes.T)
        h, omega2 = functions.thickness, (self.model.omega**2)[:, None]
        system = h**2 * self.bending - omega2[:, None] * self.added
        diagonal = np.arange(len(shapes.T))
        system[:, diagonal, diagonal] += h**2 * functions.elastic - omega2
        system += 0.0 if self.further is None else self.further
        return np.asarray(np.linalg.solve(system, shapes.T.astype(complex)) / h)

    @cached_property
    def lag(self) -> ComplexArray:
        """Motion of each drive relative to a slow one (f, n)."""
        return self.values.lag(self.model.frequencies)

    @cached_property
    def drive(self) -> ComplexArray:
        """Force of each drive on the plate per unit of what it plays, times -omega² (f, n)."""
        values, model = self.values, self.model
        force = self.force * values.drive_gains * model.drive_gains * self.lag
        return np.asarray(-(model.omega**2)[:, None] * force)

    @cached_property
    def scale(self) -> ComplexArray:
        """Factors from T at sensors and ERAs to responses, (f, s, n)."""
        gains = self.values.sensor_gains
        if len(self.values.sensor_scales):
            gains = gains * self.values.sensor_scales
        return np.asarray(gains[:, None] * self.drive[:, None] * self.late)

    @cached_property
    def late(self) -> ComplexArray | float:
        """Factor of responses by clocks that are off (f, s, n), 1 where they agree."""
        if not len(self.values.delays):
            return 1.0
        delays = self.model.lateness @ self.values.delays
        return np.asarray(np.exp(-1j * self.model.omega[:, None, None] * delays))

    @cached_property
    def loaded(self) -> ComplexArray:
        """Receptance between sensors and ERAs, each sensor's mass on the plate (f, s, n) [m/N]."""
        found = self.receptance[:, self.model.observed, : self.force.shape[1]]
        return np.asarray(found if self.lightness is None else self.lightness[:, :, None] * found)

    @cached_property
    def seen(self) -> ComplexArray:
        """`loaded` with losses between hysteretic and viscous, as x has them (f, s, n) [m/N]."""
        if self.model.law is None:
            return self.loaded
        return np.asarray(self.loaded + self.values.loss_law * self.model.law)

    @cached_property
    def lightness(self) -> ComplexArray | None:
        """Motion of the plate at each sensor relative to one without its mass, None where 1."""
        inertia, at = self.model.sensor_inertia, self.model.observed
        if inertia is None:
            return None
        return np.asarray(1 / (1 - inertia * self.receptance[:, at, at]))

    @cached_property
    def responses(self) -> ComplexArray:
        """Acceleration at each sensor per unit of the drive of each ERA (f, s, n).

        [1/s²] of a base that moves, [m/s²/V] of an exciter.
        """
        return np.asarray(self.scale * self.seen)

    def _functions(self) -> FreeReceptance:
        model, values = self.model, self.values
        modes, theory = model.shifted_modes, model.elasticity
        eta = (
            max(values.loss_factor, MIN_LOSS_FACTOR)
            * (model.frequencies / LOSS_FREQUENCY) ** values.loss_exponent
        )
        eigenvalues, relative = theory.eigenvalues.copy(), theory.relative_loss.copy()
        eigenvalues[modes] *= np.exp(values.mode_shifts)
        relative[modes] *= np.exp(values.mode_losses)
        loss: FloatArray = np.multiply.outer(eta, relative)
        rig, solved = model.rig.plate, model.free.plate
        thickness = values.thickness * rig.thickness / solved.thickness
        modulus = values.modulus * rig.material.E / solved.material.E
        # Soft layers and air lose beside the plate's loss factor, and deviate with their mode.
        further = theory.losses.copy()
        further[modes] *= np.exp(values.mode_shifts + values.mode_losses)
        own = loss * eigenvalues
        lossy = eigenvalues + 1j * (own + further)
        if theory.dispersion is not None:
            lossy = lossy + theory.dispersion.at(model.omega)
        self.by_loss, self.by_mode_loss = (
            np.divide(1j * each, lossy, out=np.zeros(lossy.shape, dtype=complex), where=lossy != 0)
            for each in (own, own + further)
        )
        """Change of the logarithm of each mode's stiffness with that of the plate's loss factor,
        and with that of all that the mode loses (f, r)."""
        self.by_loss_of_rest = np.asarray(1j * eta / (1 + 1j * eta))
        """The same of all but the modes, with the loss factor (f,)."""
        self.eta = eta
        """Loss factor (f,)."""
        self.modulus = modulus
        """Modulus relative to the solved plate's."""
        self.bending: ComplexArray | None = None
        """Stiffness between modes with form errors (f, r, r) [rad²/s²]; `added` is their mass."""
        if model.form is not None:
            stretched = np.einsum("g,grq->rq", values.stretch, model.form.stiffening)
            self.bending = ((1 + 1j * eta) * modulus)[:, None, None] * stretched
            shares = rig.mass * values.foreign_mass[:, None]
            self.added = model.form.cells.T @ (shares * model.form.cells)
        stiffness = np.asarray(modulus * lossy, dtype=complex)
        return model.free.receptance(model.omega, stiffness, eta, thickness, modulus)


def _finger(
    finger: RestingFinger, logs: FloatArray, omega: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Dynamic stiffness (f,) of a finger with scaled parts, and its derivatives by each (f, 4).

    logs (4,): logarithms of the factors on contact mass, pulp, phalanx and joint.
    """
    tip, rests = finger.fingertip, np.ones(len(omega))
    if finger.tone is not None:
        rests = (np.arange(len(omega)) == finger.tone).astype(float)
    mass, pulp, phalanx, joint = np.exp(logs)
    w = omega
    Zm = -(w**2) * tip.contact_mass * mass
    Zp = pulp * (tip.stiffness + 1j * w * tip.damping)
    Zb = -(w**2) * tip.phalanx_mass * phalanx
    Zj = joint * (tip.joint_stiffness + 1j * w * tip.joint_damping)
    total = Zp + Zb + Zj
    by_pulp, by_bone = ((Zb + Zj) / total) ** 2, (Zp / total) ** 2
    D = Zm + Zp * (Zb + Zj) / total
    slopes = np.column_stack([Zm, by_pulp * Zp, by_bone * Zb, by_bone * Zj])
    return rests * D, rests[:, None] * slopes


def viscous_difference(model: ForwardModel, x: FloatArray) -> ComplexArray:
    """Change of the receptance (f, s, n) [m/N] between sensors and ERAs where losses are viscous.

    For a plate with form errors, at parameters x (p,).
    """
    plate = model.at(x)
    own, viscous = _lossy(plate), _viscous(plate)
    change = 1j * plate.eta[:, None, None] * (model.omega[:, None, None] * viscous - own)
    columns = plate.force.shape[1]
    other = PlateAt(model, x, np.asarray(change))
    return np.asarray((other.receptance - plate.receptance)[:, model.observed, :columns])


def _lossy(plate: PlateAt) -> FloatArray:
    """Stiffness between coordinates that loses by the plate's loss factor (r, r) [rad²/s²]."""
    theory, rigidity = plate.model.elasticity, plate.modulus * plate.functions.thickness**2
    return np.diag(rigidity * theory.relative_loss * theory.eigenvalues)


def _viscous(plate: PlateAt) -> FloatArray:
    """Damping (r, r) [rad/s] by a loss factor of 1 of each supported mode at its resonance."""
    values, model, shapes = plate.values, plate.model, plate.located.shapes
    rig, h = model.rig, plate.functions.thickness
    springs = [each.in_time.stiffness for each in plate.sources]
    masses = [each.in_time.mass for each in plate.sources]
    factors = np.ones(len(rig.masses))
    factors[list(rig.feet)] = values.supports
    springs += [*factors * [load.stiffness for load in rig.masses]] + [0.0] * len(values.masses)
    masses += [load.mass for load in rig.masses] + [*values.masses[:, 0]]
    on_plate = shapes[: len(springs)]
    lossy = _lossy(plate)
    stiffness = lossy + (on_plate.T * springs) @ on_plate / h
    mass = np.eye(len(lossy)) + (on_plate.T * masses) @ on_plate / h
    eigenvalues, modes = linalg.eigh(stiffness, mass)
    roots = np.maximum(eigenvalues, _SLOWEST**2) ** 0.25
    weighted = mass @ modes / roots
    return np.asarray(weighted @ (modes.T @ lossy @ modes) @ weighted.T)


AnyArray: TypeAlias = NDArray[np.floating[Any]] | NDArray[np.complexfloating[Any, Any]]


def jacobian(plate: PlateAt, searched: NDArray[np.bool_] | None = None) -> ComplexArray:
    """Derivatives of the responses of a plate by x, (f, s, n, p).

    searched (p,): those of interest; of kinds without any they may be zero. By default all.
    """
    space = plate.model.space
    found = np.zeros((*plate.responses.shape, space.size), dtype=complex)
    for group, kinds in _GROUPS.items():
        wanted = space.of(*kinds)
        if not (wanted if searched is None else wanted & searched).any():
            continue
        for kind, columns in group(plate).items():
            found[..., space.groups[kind]] = columns * space.std[space.groups[kind]]
    return found


def by_mass_at(plate: PlateAt, points: FloatArray) -> ComplexArray:
    """Derivatives of the responses by a mass [kg] at points (p, 2) [m], (f, s, n, p)."""
    reach = reach_to(plate, points)
    return _outer(plate, reach, reach, plate.model.omega[:, None] ** 2)


def reach_to(plate: PlateAt, points: FloatArray) -> ComplexArray:
    """Motion of what is attached by forces at points (p, 2) [m], (f, a, p)."""
    modes, functions = plate.model.modes, plate.functions
    truncated = modes.truncated_terms(plate.located.footprints, points)
    by_modes = plate.reach @ modes.shapes_at(points).T
    return np.asarray(by_modes + plate.left @ combined(functions.truncated(TERMS), truncated))


Columns: TypeAlias = dict[str, ComplexArray]
"""Derivatives (f, s, n, m) by the m parameters of a kind, in the units of `Values`."""


def _by_plate(plate: PlateAt) -> Columns:
    """Derivatives by thickness, modulus and loss factor of the whole plate."""
    functions, reach = plate.functions, plate.reach
    seen, driven = reach[:, plate.model.observed], reach[:, _pushed(plate)].swapaxes(1, 2)

    def responses(of_modes: ComplexArray | float, of_rest: ComplexArray | float) -> ComplexArray:
        """Derivatives by a change of the log stiffness of modes (f, r) and of all else (f,)."""
        change = (seen * (of_modes * functions.elastic)[:, None]) @ driven
        if plate.bending is not None:
            change += seen @ (plate.bending * np.reshape(of_rest, (-1, 1, 1))) @ driven
        rest = np.asarray(of_rest)[..., None] * functions.truncated_by_log_q
        further = _attached(plate, combined(rest, plate.located.truncated))
        return _responses(plate, further - functions.thickness**3 * change)[..., None]

    by_stiffness = responses(1.0, 1.0)
    by_loss = responses(plate.by_loss, plate.by_loss_of_rest)
    by_mass = _responses(plate, _attached(plate, plate.free_receptance))
    powers = np.log(plate.model.frequencies / LOSS_FREQUENCY)[:, None, None, None]
    return {
        "thickness": 2 * by_stiffness - by_mass[..., None],
        "modulus": by_stiffness,
        "loss": by_loss,
        "loss_added": by_loss / max(plate.values.loss_factor, MIN_LOSS_FACTOR),
        "loss_exponent": powers * by_loss,
    }


def _attached(plate: PlateAt, change: ComplexArray) -> ComplexArray:
    """Change of T as `_responses` takes it, by one of the free receptance (f, a, a)."""
    left = plate.left
    return np.asarray(
        left[:, plate.model.observed] @ change @ left[:, _pushed(plate)].swapaxes(1, 2)
    )


def _by_modes(plate: PlateAt) -> Columns:
    modes, functions = plate.model.shifted_modes, plate.functions
    reach = plate.reach[:, :, modes]
    by_stiffness = -(functions.thickness**3) * functions.elastic[:, modes]
    return {
        "mode_shifts": _outer(plate, reach, reach, by_stiffness),
        "mode_losses": _outer(plate, reach, reach, plate.by_mode_loss[:, modes] * by_stiffness),
    }


def _by_form(plate: PlateAt) -> Columns:
    """Derivatives by form errors: foreign mass and sides, which couple modes, and the loss law."""
    model, functions = plate.model, plate.functions
    if model.form is None:
        return {}
    reach = plate.reach @ model.form.cells.T
    share = model.rig.plate.mass * functions.thickness
    by_mass = _outer(plate, reach, reach, share * plate.model.omega[:, None] ** 2)
    seen, driven = plate.reach[:, model.observed], plate.reach[:, _pushed(plate)].swapaxes(1, 2)
    factor = -(functions.q * functions.thickness)[:, None, None]
    stretched = [
        _responses(plate, factor * (seen @ slope @ driven)) for slope in model.form.stiffening
    ]
    sides = np.array([model.rig.plate.length, model.rig.plate.width])
    law = np.zeros(plate.scale.shape) if model.law is None else plate.scale * model.law
    return {
        "foreign_mass": by_mass - by_mass.mean(axis=-1, keepdims=True),
        "loss_law": law[..., None],
        "side": np.stack(stretched[:2], axis=-1) / sides,
        "poisson": stretched[2][..., None],
    }


def _by_places(plate: PlateAt) -> Columns:
    """Derivatives by the places of ERAs and sensors, and by additional masses and their places.

    A place changes the receptance in its row and its column.
    """
    model = plate.model
    n, moved = plate.force.shape[1], np.repeat(model.movable, 2)
    located, functions = plate.located, plate.functions
    rows = located.shape_slopes @ plate.moved
    rows = rows + combined(functions.truncated(TERMS), located.truncated_slopes)
    reach, own = plate.left @ rows.swapaxes(1, 2), plate.left[:, :, moved]
    ones = np.ones((len(model.omega), 1))
    by_place = _outer(plate, own, reach, ones) + _outer(plate, reach, own, ones)
    places, of_masses, of_sensors = np.split(by_place, [2 * n, 2 * (n + model.mass_count)], axis=-1)
    masses = np.empty((*by_place.shape[:-1], model.mass_count, 3), dtype=complex)
    masses[..., 1:] = of_masses.reshape(masses[..., 1:].shape)
    at = model.movable[n : n + model.mass_count]
    masses[..., 0] = _by_stiffness(plate, at, -(model.omega[:, None] ** 2))
    return {
        "place": places,
        "sensor_place": of_sensors,
        "masses": masses.reshape(*by_place.shape[:-1], -1),
    }


def _by_attachments(plate: PlateAt) -> Columns:
    """Derivatives by the values of ERAs, which also drive through them, by feet and by fingers."""
    model, values, Y = plate.model, plate.values, plate.responses
    n = plate.force.shape[1]
    eras, slopes = np.arange(n), [each.slopes(model.omega) for each in plate.sources]
    none = np.zeros((2, len(model.omega)), dtype=complex)
    found: Columns = {}
    for kind in ("stiffness", "damping", "bolt_mass", *EXCITER_KINDS):
        change, of_force = np.array([each.get(kind, none) for each in slopes]).transpose(1, 2, 0)
        found[kind] = _by_stiffness(plate, eras, change)
        found[kind][:, :, eras, eras] += Y * (of_force / plate.full_levels / plate.force)[:, None]
    for kind in EXCITER_KINDS:
        found[kind] = found[kind][..., : len(model.space.indices(kind))]
    found["damping_added"] = found["damping"]
    found["damping_each"] = found["damping"] * values.damping
    found["damping"] = found["damping_each"].sum(axis=-1, keepdims=True)
    feet = np.array([n + number for number in model.rig.feet], dtype=int)
    found["supports"] = _by_stiffness(plate, feet, values.supports * model.springs)
    first = n + len(model.rig.masses) + model.mass_count
    by_finger = [
        _by_stiffness(plate, np.full(4, first + number), slopes)
        for number, slopes in enumerate(plate.finger_slopes)
    ]
    found["fingers"] = np.concatenate([np.zeros((*Y.shape, 0)), *by_finger], axis=-1)
    return found


def _by_gains(plate: PlateAt) -> Columns:
    Y = plate.responses
    by_drive = Y[..., None] * np.eye(Y.shape[2])
    by_sensor = Y[..., None] * np.eye(Y.shape[1])[:, None]
    f = 1e-3 * plate.model.frequencies[:, None]
    by_inertia, by_drag = f**2 * plate.lag, -1j * f * plate.lag
    count = len(plate.values.delays)
    lateness = plate.model.lateness if count else np.zeros((*Y.shape[1:], 0))
    # A scale may be zero.
    unscaled = plate.values.sensor_gains[:, None] * plate.drive[:, None] * plate.late * plate.seen
    by_scale = np.eye(Y.shape[1], len(plate.values.sensor_scales))[:, None]
    return {
        "gain": by_drive,
        "phase": 1j * by_drive,
        "inertia": by_drive * by_inertia[:, None, None],
        "drag": by_drive * by_drag[:, None, None],
        "delay": -1j * plate.model.omega[:, None, None, None] * Y[..., None] * lateness,
        "sensor_gain": by_sensor,
        "sensor_phase": 1j * by_sensor,
        "sensor_scale": unscaled[..., None] * by_scale,
    }


_GROUPS: dict[Callable[[PlateAt], Columns], tuple[str, ...]] = {
    _by_plate: ("thickness", "modulus", "loss", "loss_added", "loss_exponent"),
    _by_modes: ("mode_shifts", "mode_losses"),
    _by_places: ("place", "masses", "sensor_place"),
    _by_form: ("foreign_mass", "loss_law", "side", "poisson"),
    _by_attachments: (
        "stiffness",
        "damping",
        "damping_each",
        "damping_added",
        "bolt_mass",
        *EXCITER_KINDS,
        "supports",
        "fingers",
    ),
    _by_gains: (
        "gain",
        "phase",
        "inertia",
        "drag",
        "delay",
        "sensor_gain",
        "sensor_phase",
        "sensor_scale",
    ),
}


def _by_stiffness(plate: PlateAt, at: IntArray, change: AnyArray) -> ComplexArray:
    """Responses by changes (f, m) of the dynamic stiffness of attachments (m,)."""
    columns = plate.receptance[:, :, at]
    return _outer(plate, columns, columns, -change)


def _outer(plate: PlateAt, u: AnyArray, v: AnyArray, factor: AnyArray) -> ComplexArray:
    """Responses of T = factor u v^T, (f, s, n, m), of columns (f, a, m) and factors (f, m)."""
    left = u[:, plate.model.observed] * factor[:, None]
    return _responses(plate, np.asarray(left[:, :, None] * v[:, None, _pushed(plate)]))


def _pushed(plate: PlateAt) -> slice | IntArray:
    """Columns of T whose changes count: those of ERAs, then of sensors that load the plate."""
    n = plate.force.shape[1]
    if plate.lightness is None:
        return slice(n)
    return np.concatenate([np.arange(n), plate.model.observed])


def _responses(plate: PlateAt, change: AnyArray) -> ComplexArray:
    """Change of the responses (f, s, n, ...) by one of T (f, s, columns of `_pushed`, ...)."""
    further = (1,) * (change.ndim - 3)
    n, at = plate.force.shape[1], np.arange(change.shape[1])
    found = change[:, :, :n]
    if plate.lightness is not None:
        assert plate.model.sensor_inertia is not None  # noqa: S101  there is a mass
        loaded = plate.model.sensor_inertia[:, :, None] * plate.loaded
        own = change[:, at, n + at][:, :, None]
        found = found + loaded.reshape(*loaded.shape, *further) * own
        found = found * plate.lightness.reshape(*plate.lightness.shape, 1, *further)
    return np.asarray(found * plate.scale.reshape(*plate.scale.shape, *further))
