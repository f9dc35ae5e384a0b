"""Responses of a plate that is not quite built as its rig says, with their derivatives.

A rig file has no words for an ERA that is a millimetre beside its place, a cable glued to the
plate, or sides that are not cut to size. Left out, such form errors bias what is fitted by far more
than noise does, and no residual shows by how much. Here each is a parameter of its own, held near
zero by its tolerance:

    ((1 + i eta) Lambda - omega² + sum_j phi_j^T D_j phi_j) q = phi_a^T (k + i omega c),
    a = -omega² phi_p q

Lambda: eigenvalues of the free plate, phi: shapes at what is attached (j), at the driven ERA (a)
and at a sensor (p), D: dynamic stiffness. With P = S^-1 phi_p^T of the same symmetric system S, the
derivative by any parameter is P (db - dS q): no further solve.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray, IntArray, lattice
from model.calibration.sensed_plate import Parameters
from model.fem.mesh import Mesh
from model.fem.plate import element_slopes
from model.reduction.place_slopes import place_slopes
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig
from model.spectral.shape_stiffness import stiffness_slopes
from model.structure.attachments import attached_stiffness, footprints_of
from model.structure.modal_elasticity import ModalElasticity

# Tolerances: standard deviations.
ERA_PLACE = 1.5e-3  # m, along each side
SENSOR_PLACE = 0.5e-3  # m, a ruler's
SENSOR_SCALE = 0.01  # of itself
SIDE = 0.5e-3  # m
POISSON = 0.015  # of Poisson's ratio
FOREIGN_MASS = 0.01  # of the plate's, spread over the cells below
_MASS_CELLS = (8, 6)
_MODE_SHIFT = 0.003  # of an eigenvalue: theory and mesh


def mass_scale_error(rig: Rig) -> float:
    """Standard error of the whole mass, relative: all that is fitted but losses scales with it."""
    plate = rig.plate
    return math.hypot(FOREIGN_MASS, SIDE / plate.length, SIDE / plate.width)


@dataclass(frozen=True, eq=False)
class FormModel:
    """A reduced plate (r modes) at e ERAs, s sensors and c cells of foreign mass.

    further (f, r): what layers and air add to the eigenvalues; *_shapes (n, r); *_slopes (2, n, r):
    their derivatives along x and y [1/m]; rest (f, r, r): dynamic stiffness of the rig's own
    masses; stiffening (g, r, r): derivatives of the modal
    stiffness by length, width (relative) and Poisson's ratio; loss_ratios (f, r, r): of its loss
    factor to the plate's; shifted: modes with a shift of their own; std (t,): tolerances of the
    form errors, in that order.
    """

    modulus: float
    eigenvalues: FloatArray
    further: ComplexArray
    omega: FloatArray
    rest: ComplexArray
    era_shapes: FloatArray
    era_slopes: FloatArray
    sensor_shapes: FloatArray
    sensor_slopes: FloatArray
    cell_shapes: FloatArray
    stiffening: FloatArray
    loss_ratios: FloatArray
    shifted: IntArray
    std: FloatArray

    @property
    def frequencies(self) -> FloatArray:
        """Of the responses (f,) [Hz]."""
        return self.omega / (2 * np.pi)

    def at(self, kept: NDArray[np.bool_]) -> "FormModel":
        """Select some of the sensors (s,)."""
        return replace(
            self,
            sensor_shapes=self.sensor_shapes[kept],
            sensor_slopes=self.sensor_slopes[:, kept],
            std=self.select(self.std, kept),
        )

    def select(self, form: FloatArray, kept: NDArray[np.bool_]) -> FloatArray:
        """Form errors (t,) of some of the sensors (s,)."""
        eras, sensors, rest = np.split(form, np.cumsum(self._counts)[:2])
        return np.concatenate([eras, sensors.reshape(2, -1)[:, kept].ravel(), rest])

    @property
    def sides(self) -> slice:
        """Where length and width are among the form errors."""
        first = sum(self._counts[:3])
        return slice(first, first + 2)

    def places(self, form: FloatArray) -> FloatArray:
        """How far ERAs are from the rig's places by form errors (t,), (2, e) [m]."""
        count = 2 * len(self.era_shapes)
        return np.asarray((self.std * form)[:count].reshape(2, -1))

    @property
    def _counts(self) -> list[int]:
        """Numbers of form errors: ERA and sensor places, cells of mass, stiffenings, shifts."""
        places = (2 * len(each) for each in (self.era_shapes, self.sensor_shapes))
        return [*places, *map(len, (self.cell_shapes, self.stiffening, self.shifted))]

    def responses(
        self,
        parameters: Parameters,
        x: FloatArray,
        form: FloatArray,
        *,
        has_form: bool = True,
    ) -> tuple[ComplexArray, ComplexArray]:
        """Responses (f, e, s) [1/s²] of x (n,) and form errors (t,), and derivatives (n + t, ...).

        form: in their tolerances; without has_form derivatives are by x alone (n, ...).
        """
        era_count, sensor_count = len(self.era_shapes), len(self.sensor_shapes)
        values, slope = parameters.values(x), parameters.slopes(x)
        ends = np.cumsum(self._counts)[:-1]
        places, sensor_places, masses, bent, shifts = np.split(self.std * form, ends)
        masses = masses - masses.mean()
        phi = self.era_shapes + np.einsum(
            "dn,dnr->nr", places.reshape(2, era_count), self.era_slopes
        )
        psi = self.sensor_shapes + np.einsum(
            "dn,dnr->nr", sensor_places.reshape(2, sensor_count), self.sensor_slopes
        )
        k, c, m = values[2:].reshape(era_count, 3).T
        omega = self.omega[:, None]
        base = k + 1j * omega * c
        shifted = self.eigenvalues.copy()
        shifted[self.shifted] *= 1 + shifts
        stiffer = values[0] / self.modulus
        elastic = stiffer * (np.diag(shifted) + np.einsum("g,grq->rq", bent, self.stiffening))
        attached = np.concatenate([base - omega**2 * m, -(omega**2) * masses], axis=1)
        shapes = np.vstack([phi, self.cell_shapes])
        system = self.rest + np.einsum("fj,jr,jq->frq", attached, shapes, shapes, optimize=True)
        lossy = 1 + 1j * values[1] * self.loss_ratios
        bending = lossy * elastic + stiffer * self.further[:, :, None] * np.eye(len(elastic))
        system += bending
        diagonal = np.arange(len(elastic))
        system[:, diagonal, diagonal] -= omega**2
        right = np.empty((len(self.omega), len(elastic), era_count + sensor_count), dtype=complex)
        right[..., :era_count] = phi.T * base[:, None, :]
        right[..., era_count:] = psi.T
        solved = np.linalg.solve(system, right)
        q, P = solved[..., :era_count], solved[..., era_count:]
        response = np.swapaxes(psi @ q, 1, 2)

        # Displacement of what is attached, by the drive (f, e, j) and to a force at a sensor.
        moved = np.swapaxes(shapes @ q, 1, 2)
        seen = np.swapaxes(shapes @ P, 1, 2)  # (f, s, j)
        driven = np.eye(era_count)
        # Relative to the base: the spring's and the damper's extension.
        extension = driven - moved[..., :era_count]
        by_spring = extension[:, :, None, :] * seen[:, None, :, :era_count]  # (f, e, s, e)
        by_mass = moved[:, :, None, :] * seen[:, None, :, :]  # (f, e, s, j), times omega²
        wide = omega[:, :, None, None]
        seen_modes = np.swapaxes(P, 1, 2)

        def bent_by(stiffness: ComplexArray) -> ComplexArray:
            return np.asarray(np.swapaxes(seen_modes @ (stiffness @ q), 1, 2))

        found = [
            -bent_by(bending) * slope[0] / values[0],
            -1j * bent_by(self.loss_ratios * elastic) * slope[1],
        ]
        for era in range(era_count):
            at = 2 + 3 * era
            found += [
                by_spring[..., era] * slope[at],
                1j * omega[:, :, None] * by_spring[..., era] * slope[at + 1],
                (wide**2 * by_mass)[..., era] * slope[at + 2],
            ]
        scale = -(omega**2)[:, :, None]
        if not has_form:
            return scale * response, scale * np.array(found)
        for direction in range(2):
            steeper = self.era_slopes[direction]
            moved_more = np.swapaxes(steeper @ q, 1, 2)
            seen_more = np.swapaxes(steeper @ P, 1, 2)
            force = base[:, None] * driven - attached[:, None, :era_count] * moved[..., :era_count]
            turned = force[:, :, None] * seen_more[:, None] - (
                attached[:, None, None, :era_count]
                * moved_more[:, :, None]
                * seen[:, None, :, :era_count]
            )
            found += [turned[..., era] for era in range(era_count)]
        for direction in range(2):
            tilt = np.swapaxes(self.sensor_slopes[direction] @ q, 1, 2)
            for sensor in range(sensor_count):
                only = np.zeros_like(response)
                only[..., sensor] = tilt[..., sensor]
                found.append(only)
        by_cell = wide**2 * by_mass[..., era_count:]
        by_cell = by_cell - by_cell.mean(axis=3, keepdims=True)
        found += list(np.moveaxis(by_cell, 3, 0))
        found += [-stiffer * bent_by(lossy * change) for change in self.stiffening]
        for mode in self.shifted:
            alone = q[:, mode, :, None] * P[:, mode, None, :]
            loss = lossy[:, mode, mode, None, None]
            found.append(-loss * stiffer * self.eigenvalues[mode] * alone)
        derivatives = np.array(found)
        derivatives[len(x) :] *= self.std[:, None, None, None]
        return scale * response, scale * derivatives


def form_model(rig: Rig, points: FloatArray, frequencies: FloatArray) -> FormModel:
    """Solve a rig's free plate for sensors at points (s, 2) [m] and frequencies (f,) [Hz]."""
    plate = rig.plate
    sides = np.array([plate.length, plate.width])
    high = float(max(frequencies.max(), 200.0))
    at_eras, at_masses = footprints_of(rig.eras), footprints_of(rig.masses)
    attached = np.vstack([at_eras, at_masses])
    reduced = reduce_plate(plate, rig.mesh, attached, frequency_max=high)
    eigenvalues = reduced.omega**2
    elasticity = ModalElasticity.of(plate, eigenvalues, reduced.losses, reduced.dispersion)
    omega = 2 * np.pi * frequencies

    natural = np.sqrt(np.maximum(eigenvalues, 0))
    low = np.flatnonzero(
        (natural > 0.1 * plate.lowest_bending_frequency * 2 * math.pi)
        & (natural < 1.2 * omega.max())
    )
    cells = lattice(
        *((np.arange(n) + 0.5) / n * side for n, side in zip(_MASS_CELLS, sides, strict=True))
    )
    loads = attached_stiffness((), rig.masses, omega).reshape(len(omega), -1)
    mass_shapes = reduced.at(at_masses) if len(at_masses) else np.empty((0, len(eigenvalues)))
    std = np.concatenate(
        [
            np.full(2 * len(rig.eras), ERA_PLACE),
            np.full(2 * len(points), SENSOR_PLACE),
            np.full(len(cells), FOREIGN_MASS * plate.mass / math.sqrt(len(cells))),
            SIDE / sides,
            [POISSON],
            np.full(len(low), _MODE_SHIFT),
        ]
    )
    ratios = np.sqrt(elasticity.loss_ratios(omega))
    return FormModel(
        plate.material.E,
        elasticity.eigenvalues,
        np.broadcast_to(elasticity.further(omega), (len(omega), len(eigenvalues))),
        omega,
        np.einsum("fj,jr,jq->frq", loads, mass_shapes, mass_shapes, optimize=True),
        reduced.at(at_eras),
        place_slopes(reduced.at, at_eras, sides).swapaxes(0, 1),
        reduced.at(points),
        place_slopes(reduced.at, points, sides).swapaxes(0, 1),
        reduced.at(cells),
        _stiffening(rig, reduced.unknowns(), math.sqrt(plate.lowest_bending_frequency * high)),
        ratios[:, :, None] * ratios[:, None, :],
        low,
        std,
    )


def _stiffening(rig: Rig, unknowns: Sequence[FloatArray], frequency: float) -> FloatArray:
    """Derivatives of the stiffness between shapes, with the moduli at a frequency [Hz]."""
    match rig.mesh:
        case Mesh():
            return element_slopes(rig.plate, rig.mesh, unknowns[0])
        case _:
            degrees = rig.mesh.nx, rig.mesh.ny
            return stiffness_slopes(rig.plate, degrees, unknowns, frequency=frequency)
