"""Fingers on a plate on its ERAs, and the vibration that they feel on drawn plates, in numpy.

k fingers of dynamic stiffness D at centers c change fields X of a plate on its ERAs to

    X - G D P X_c,  P = (1 + G_cc D)^-1,

where G is the displacement due to a force at each finger without the others. With the others, the
acceleration is -w² G P^T. `attached_plate` defines the symbols; a case is a frequency and a
thickness. The expected power of weights w at a fingertip is w^H R w to first order,

    R = mean_p { h* h^T + dh* dh^T + dc* dc^T + sum_j |s_j t_pj|² r_j* r_j^T + sigma² diag |h|² }
        + dx* dx^T + dy* dy^T,

with h the field of each ERA, t_pj the acceleration due to a force at attachment j, and r_j the
deformation of that attachment due to each ERA at full stroke. Each change d is for one standard
deviation; s_j is the standard deviation of the stiffness. The damping c is common to all ERAs. The
stiffness of each ERA and foot, the load of each finger j, and the gains (by sigma) change
independently. These are exact derivatives of the loaded plate, except for the local deflection
under a finger. For the thickness, the term is half the sum of dh* dh^T for the plates thicker and
thinner by one standard deviation, solved exactly; it includes the modulus (`attached_plate`). The
effect of the loss factor is negligible. dx and dy are the changes of h along x and y over one
standard deviation of a finger's position, from the difference between opposite points of the
fingertip. A finger that is off also loads the plate elsewhere, which changes h far less.

`model.ensemble.kernel_plates` has the same computation in C, and puts fingers on a plate with the
faster one available.
"""

import math
from dataclasses import dataclass

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray
from model.ensemble.attached_plate import MODELED, THICKER, THINNER, PlateOnEras
from model.ensemble.draws import (
    EXACT_CLOCKS,
    ClockErrors,
    Drawing,
    Draws,
    delayed,
    draw,
    over_fingertips,
)
from model.ensemble.expected_power import expected_power, gram, power_of
from model.finger import ENDS, FINE_DIAGONAL, FINE_ENDS, FINE_POINTS


@dataclass(frozen=True, eq=False)
class LoadedContacts:
    """Fields and expected powers at g fingertips, or other groups of points, and f frequencies."""

    fields: Complex64Array
    """h (f, g, p, n) at points [m/s²]."""
    fine_fields: Complex64Array | None
    """h (f, g, fine, n) at fine points, None unless wanted."""
    power: Complex64Array
    """R (f, g, n, n)."""
    uncertain: Complex64Array
    """R without h* h^T (f, g, n, n)."""


@dataclass(frozen=True, eq=False)
class Changes:
    """Forces at attachments `a` in c cases, per standard deviation of uncertain parameters."""

    loss: Complex64Array
    """By the loss factor (c, a)."""
    damping: Complex64Array
    """By all dampers (c, a)."""
    own: Complex64Array
    """By the attachment's own stiffness (c, a)."""
    drives: Complex64Array
    """Force of each ERA as it plays (c, a), which an error of its gain multiplies."""
    by_loss: Complex64Array
    """Additional acceleration (c, p) at points per standard deviation of the loss factor."""


@dataclass(frozen=True, eq=False)
class FingertipAmplitudes:
    """Amplitudes to threshold of m tones at k fingertips, nominal and on d drawn plates."""

    means: Float32Array
    """Mean amplitude over each fingertip (m, k, 1 + d)."""
    loudest: Float32Array
    """Squared amplitude at its loudest point (m, k, 1 + d)."""
    powers: Float32Array | None
    """Squared amplitude at all points (m, k p, 1 + d), None unless wanted."""


@dataclass(frozen=True)
class DrawnPlates:
    """Plates drawn for a number of fingers; a single thickness if the thickness is certain."""

    draws: Draws
    thickness_count: int
    """Number of thicknesses of the draws."""
    first_thickness: int
    """Index of the draws' first thickness."""
    base_count: int
    """Number of thicknesses at which changes are computed."""
    first_base: int
    """Index of the first thickness at which changes are computed."""

    @classmethod
    def of(cls, plate_on_eras: PlateOnEras, finger_count: int, drawing: Drawing) -> "DrawnPlates":
        """Draw plates with a number of fingers."""
        plate = plate_on_eras.plate
        uncertainty = plate.uncertainty
        first_thickness = plate_on_eras.first.get(drawing.thicknesses, MODELED)
        thickness_count = drawing.thicknesses if first_thickness else 1
        first_base = plate_on_eras.first.get(drawing.bases, MODELED)
        base_count = drawing.bases if first_base else 1
        draws = draw(
            plate.era_count,
            finger_count,
            masses=plate.stiffness.shape[1] - plate.era_count,
            to_feet=plate.by_stiffness.shape[1] - plate.era_count,
            count=drawing.count,
            seed=drawing.seed,
            gain=uncertainty.played_gain(plate.era_count),
            phase=uncertainty.played_phase(plate.era_count),
            common_gain=uncertainty.common_gain,
            harmonic=uncertainty.harmonic,
            thicknesses=thickness_count,
        )
        return cls(draws, thickness_count, first_thickness, base_count, first_base)

    def bases_of(self, tone_count: int) -> IntArray:
        """Indices of the thicknesses at which changes are computed, for tones one after another."""
        return self.first_base + np.tile(np.arange(self.base_count), tone_count)


@dataclass(frozen=True, eq=False)
class _Fingers:
    """k fingers that hold the plate in c cases."""

    stiffness: Complex64Array
    """D (c, k) [N/m]."""
    response: Complex64Array
    """T at the fingers' centers (c, k, b), without the fingers."""
    displacement: Complex64Array
    """G (c, k, r)."""
    share: Complex64Array
    """P (c, k, k)."""

    def under_fingers(self, free: Complex64Array) -> Complex64Array:
        """Fields (c, k, q) at the fingers, from those without fingers."""
        return self.share @ free

    def coordinates(self, free: Complex64Array, under_fingers: Complex64Array) -> Complex64Array:
        """Coordinates (c, q, r) with the fingers, from those without and the fields at fingers."""
        finger_forces = self.stiffness[:, :, None] * under_fingers
        return np.asarray(free - finger_forces.swapaxes(1, 2) @ self.displacement)


def _changes_by_position(
    fields: Complex64Array, weights: Float32Array, steps: Float32Array
) -> Complex64Array:
    """Changes (f, g, j, n) of fields (f, g, p, n) for each position along x and y of fingers.

    weights (g, p): of the points, of which each finger has few; steps (k, 3).
    """
    frequency_count, group_count, _, era_count = fields.shape
    fingers_per_group = len(steps) // group_count
    by_finger = fields.reshape(frequency_count, len(steps), -1, era_count)
    finger_weights = weights.reshape(len(steps), -1).sum(axis=1)
    scale = steps[:, :2] * np.sqrt(finger_weights)[:, None]
    east, north, west, south = (by_finger[:, :, end] for end in ENDS)
    changes = np.stack([east - west, north - south], axis=2) * scale[:, :, None]
    by_group = (frequency_count, group_count, 2 * fingers_per_group, era_count)
    return np.asarray(changes.reshape(by_group))


def _displaced(
    fields: Complex64Array, steps: Float32Array, touches: Float32Array
) -> Complex64Array:
    """Change (m, k, fine, d) of fields (m, k, fine, d) by displacements (2, k, d) of fingers.

    From a quadratic polynomial through points of each fingertip, in radii from its center. A
    fingertip that is cut by an edge has a gradient only.
    """
    center = fields[:, :, 0]
    east, north, west, south = (fields[:, :, end] for end in FINE_ENDS)
    first, second, third, fourth = (fields[:, :, point] for point in FINE_DIAGONAL)
    x_steps, y_steps = steps[:, :2].T[:, :, None] * touches
    whole = 2 * steps[:, 2:]
    x, y = whole * x_steps, whole * y_steps
    by_xx = east - 2 * center + west
    by_yy = north - 2 * center + south
    by_xy = first - second + third - fourth
    slope_x = x * by_xx + y * by_xy
    slope_y = x * by_xy + y * by_yy
    at_center = x_steps * (east - west) + y_steps * (north - south)
    at_center = at_center + (x * slope_x + y * slope_y) / 2
    disc_x, disc_y = FINE_POINTS.points.T.astype(np.float32)[:, :, None]
    changes = at_center[:, :, None] + slope_x[:, :, None] * disc_x + slope_y[:, :, None] * disc_y
    return np.asarray(changes, dtype=np.complex64)


@dataclass(frozen=True, eq=False)
class TouchedPlate:
    """A plate of every thickness with k fingers on it."""

    plate_on_eras: PlateOnEras
    centers: Float32Array
    """Mode shapes (k, r) at the fingers."""
    stiffness: Complex64Array
    """Dynamic stiffness (f, k) of the fingers [N/m]."""
    load_std: Float32Array
    """Standard deviation (k,) of the logarithm of their loads."""
    clocks: ClockErrors = EXACT_CLOCKS
    """Errors of the amplifiers' clocks."""

    def sources(
        self, rows: IntArray, nodes: IntArray, points: Float32Array
    ) -> tuple[Complex64Array, Complex64Array]:
        """Return responses to forces and ERAs, in cases of rows (c,) and nodes (c,).

        Acceleration [m/s²/N] at points with shapes (p, r) for a force at each attachment and then
        each finger, (c, p, b + k); displacement of attachments and fingers for each ERA at full
        stroke [m], (c, b + k, n).
        """
        plate = self.plate_on_eras.plate
        minus_omega2 = plate.minus_omega2[rows, None, None]
        fingers = self._fingers(rows, nodes)
        free = self.plate_on_eras.by_force[rows, nodes]
        under_fingers = fingers.under_fingers(fingers.response)
        by_attachment = fingers.coordinates(free, under_fingers)
        by_finger = minus_omega2 * (fingers.share @ fingers.displacement)
        coordinates = np.concatenate([by_attachment, by_finger], axis=1)
        responses = points @ coordinates.swapaxes(1, 2)

        by_era = under_fingers[:, :, : plate.era_count]
        finger_motion = by_era * plate.forces[rows, None] / minus_omega2
        finger_forces = fingers.stiffness[:, :, None] * finger_motion
        prevented = fingers.response.swapaxes(1, 2) @ finger_forces / minus_omega2
        attachment_motion = self.plate_on_eras.moved[rows, nodes] - prevented
        return responses, np.concatenate([attachment_motion, finger_motion], axis=1)

    def fields(
        self, rows: IntArray, nodes: IntArray, weights: Complex64Array, points: Float32Array
    ) -> Complex64Array:
        """Accelerations (c, p) at points of shapes (p, r) by weights (c, n) of the ERAs."""
        forces = self.plate_on_eras.plate.forces[rows] * weights
        era_count = forces.shape[1]
        by_era = self.plate_on_eras.by_force[rows, nodes, :era_count]
        free = np.asarray(forces[:, None] @ by_era, dtype=np.complex64)
        coordinates = self._held(rows, nodes, free)
        return (points @ coordinates.swapaxes(1, 2))[:, :, 0]

    def coordinates(self) -> Complex64Array:
        """Reduced coordinates by each ERA at full stroke at all frequencies, (f, n, r)."""
        rows = np.arange(len(self.stiffness))
        nodes = np.full(len(rows), MODELED)
        return self._held(rows, nodes, self.plate_on_eras.fields)

    def forms(
        self,
        rows: IntArray,
        points: Float32Array,
        weights: Float32Array,
        error_power: Float32Array,
        fine: Float32Array | None = None,
        touch_steps: Float32Array | None = None,
    ) -> LoadedContacts:
        """Compute fields and expected powers at frequencies, by row (f,).

        points (g, p, r), fine (g, fine, r): shapes at groups of points, as under each finger;
        weights (g, p): of a group's points, sum 1; error_power (all, n): mean square of the
        discretization error of each ERA's field at all frequencies of the plate; touch_steps (k,
        3): see `FingertipShapes.touch_steps`, None for exact positions. With steps, the points of a
        group are the few points of one or more fingers.
        """
        plate = self.plate_on_eras.plate
        modeled = np.full(len(rows), MODELED)
        by_group = (len(rows), *weights.shape, -1)
        all_points = points.reshape(-1, points.shape[2])
        responses, motion = self.sources(rows, modeled, all_points)
        deformation = self._deformation(rows, motion)
        fields = self._era_fields(rows, responses)
        changes = [self._changes_by_damping(rows, responses, deformation)]
        if plate.uncertainty.changes_modes:
            changes += self._changes_by_thickness(rows, all_points, fields)

        group_fields = fields.reshape(by_group)
        own = self._rms_changes_by_stiffness(rows, responses, deformation, weights)
        if touch_steps is not None:
            by_position = _changes_by_position(group_fields, weights, touch_steps)
            own = np.concatenate([own, by_position], axis=2)
        power = expected_power(
            [group_fields, *(change.reshape(by_group) for change in changes)],
            own,
            weights,
            gain_variance=plate.uncertainty.gain_variance(plate.era_count),
            error_power=error_power[rows, None],
            shares=self.clocks.power_shares(plate.frequencies[rows]),
        )
        certain = gram(group_fields * np.sqrt(weights)[:, :, None])
        fine_fields = None
        if fine is not None:
            fine_responses, _ = self.sources(rows, modeled, fine.reshape(-1, fine.shape[2]))
            by_fine_group = (len(rows), *fine.shape[:2], -1)
            fine_fields = self._era_fields(rows, fine_responses).reshape(by_fine_group)
        return LoadedContacts(group_fields, fine_fields, power, power - certain)

    def _era_fields(self, rows: IntArray, responses: Complex64Array) -> Complex64Array:
        """Fields (f, p, n) of ERAs at full stroke, from responses to forces."""
        plate = self.plate_on_eras.plate
        return responses[:, :, : plate.era_count] * plate.forces[rows, None]

    def _deformation(self, rows: IntArray, motion: Complex64Array) -> Complex64Array:
        """Deformation (f, b + k, n) of attachments and fingers by each ERA at full stroke [m]."""
        plate = self.plate_on_eras.plate
        eras = np.arange(plate.era_count)
        deformation = -motion
        deformation[:, eras, eras] += plate.strokes[rows]
        return deformation

    def _changes_by_damping(
        self, rows: IntArray, responses: Complex64Array, deformation: Complex64Array
    ) -> Complex64Array:
        """Change (f, p, n) of the fields per standard deviation of all ERAs' damping."""
        plate = self.plate_on_eras.plate
        era_count = plate.era_count
        forces = plate.by_damping[rows, :, None] * deformation[:, :era_count]
        return responses[:, :, :era_count] @ forces

    def _changes_by_thickness(
        self, rows: IntArray, points: Float32Array, fields: Complex64Array
    ) -> list[Complex64Array]:
        """Changes (f, p, n) of the fields on the thicker and the thinner plate, by sqrt(1/2)."""
        changes = list[Complex64Array]()
        for node in (THICKER, THINNER):
            responses, _ = self.sources(rows, np.full(len(rows), node), points)
            difference = self._era_fields(rows, responses) - fields
            changes.append(difference * np.float32(math.sqrt(0.5)))
        return changes

    def _rms_changes_by_stiffness(
        self,
        rows: IntArray,
        responses: Complex64Array,
        deformation: Complex64Array,
        weights: Float32Array,
    ) -> Complex64Array:
        """RMS change (f, g, j, n) over groups of points by each ERA's and foot's stiffness and each
        finger's load, per standard deviation."""
        by_stiffness = self.plate_on_eras.plate.by_stiffness[rows]
        by_load = self.load_std * self.stiffness[rows]
        change_of_stiffness = np.concatenate([by_stiffness, by_load], axis=1)
        attachment_count = deformation.shape[1]
        fingers = np.arange(attachment_count - len(self.centers), attachment_count)
        uncertain = np.concatenate([np.arange(by_stiffness.shape[1]), fingers])
        forces = deformation[:, uncertain] * change_of_stiffness[:, :, None]
        response_power = power_of(responses[:, :, uncertain])
        by_group = response_power.reshape(len(rows), *weights.shape, -1)
        rms_responses = np.sqrt(weights[:, None] @ by_group).swapaxes(2, 3)
        return np.asarray(rms_responses * forces[:, None])

    def changes(
        self,
        rows: IntArray,
        nodes: IntArray,
        weights: Complex64Array,
        motion: Complex64Array,
        points: Float32Array,
    ) -> Changes:
        """Compute changes of forces, for weights (c, n) and the resulting motion (c, b + k) [m]."""
        plate = self.plate_on_eras.plate
        era_count = plate.era_count
        mount_count = plate.stiffness.shape[1]
        uncertain_count = plate.by_stiffness.shape[1]
        drives = np.zeros_like(motion)
        drives[:, :era_count] = plate.forces[rows] * weights
        deformation = -motion
        deformation[:, :era_count] += plate.strokes[rows] * weights
        damping = np.zeros_like(motion)
        damping[:, :era_count] = plate.by_damping[rows] * deformation[:, :era_count]
        own = np.zeros_like(motion)
        own[:, :uncertain_count] = plate.by_stiffness[rows] * deformation[:, :uncertain_count]
        by_load = self.load_std * self.stiffness[rows]
        own[:, mount_count:] = by_load * deformation[:, mount_count:]

        shapes = np.concatenate([plate.shapes, self.centers])
        stiffness = np.concatenate([plate.stiffness[rows], self.stiffness[rows]], axis=1)
        forces = np.asarray(drives - stiffness * motion, dtype=np.complex64)
        by_loss = self.plate_on_eras.by_loss[rows, nodes]
        coordinates = np.asarray(by_loss * (forces @ shapes), dtype=np.complex64)
        at_points = plate.minus_omega2[rows, None] * (coordinates @ points.T)
        loss = -stiffness * (coordinates @ shapes.T)
        return Changes(loss, damping, own, drives, at_points)

    def drawn(
        self,
        drawing: Drawing,
        rows: IntArray,
        weights: Complex64Array,
        points: Float32Array,
        shares: Float32Array,
        error_power: Float32Array,
        threshold: Float32Array,
        *,
        touch_steps: Float32Array | None = None,
        with_powers: bool = False,
    ) -> FingertipAmplitudes:
        """Compute amplitudes on the nominal plate and on drawn ones, of tones at rows (m,).

        weights (m, n): of the ERAs; points (k p, r): shapes; shares (k, p): of the points in the
        mean over a fingertip; touch_steps (k, 3): see `FingertipShapes.touch_steps`, None for exact
        positions, otherwise the points are the fine ones. At all frequencies of the plate:
        error_power (f, n), mean square of the discretization error of each ERA's field; threshold
        (f,) [m/s²].
        """
        plates = DrawnPlates.of(self.plate_on_eras, len(shares), drawing)
        draws = plates.draws
        by_thickness = self._fields_by_thickness(plates, rows, weights, points)
        nominal = by_thickness[:, 0, :, None]
        fields = by_thickness[:, 1 + draws.node].swapaxes(1, 2)
        fields = fields + self._drawn_changes(plates, drawing, rows, weights, points)
        error = np.sqrt((error_power[rows] * power_of(weights)).sum(axis=1))
        finger_errors = error[:, None, None] * draws.errors
        point_count = shares.shape[1]
        if touch_steps is not None:
            by_finger = fields.reshape(len(rows), *shares.shape, -1)
            changes = _displaced(by_finger, touch_steps, draws.touches)
            fields = (by_finger + changes).reshape(fields.shape)
        fields += finger_errors.repeat(point_count, axis=1)

        squared_threshold = (threshold[rows] ** 2)[:, None, None]
        powers = power_of(np.concatenate([nominal, fields], axis=2)) / squared_threshold
        means, loudest = over_fingertips(powers, shares)
        return FingertipAmplitudes(means, loudest, powers if with_powers else None)

    def _fields_by_thickness(
        self, plates: DrawnPlates, rows: IntArray, weights: Complex64Array, points: Float32Array
    ) -> Complex64Array:
        """Fields (m, 1 + thicknesses, p) of tones on the nominal plate and at all thicknesses."""
        first = plates.first_thickness
        nodes = np.array([MODELED, *range(first, first + plates.thickness_count)])
        fields = self.fields(
            rows.repeat(len(nodes)),
            np.tile(nodes, len(rows)),
            weights.repeat(len(nodes), axis=0),
            points,
        )
        return fields.reshape(len(rows), len(nodes), -1)

    def _drawn_changes(
        self,
        plates: DrawnPlates,
        drawing: Drawing,
        rows: IntArray,
        weights: Complex64Array,
        points: Float32Array,
    ) -> Complex64Array:
        """Changes (m, p, d) of tones' fields by all parameters but the thickness."""
        draws = plates.draws
        tone_count = len(rows)
        base_count = plates.base_count
        nodes = plates.bases_of(tone_count)
        base_rows = rows.repeat(base_count)
        base_weights = weights.repeat(base_count, axis=0)
        responses, era_motion = self.sources(base_rows, nodes, points)
        motion = np.matvec(era_motion, base_weights)
        changes = self.changes(base_rows, nodes, base_weights, motion, points)
        gains = draws.gains
        if self.clocks.errors:
            omega = self.plate_on_eras.plate.omega[base_rows]
            gains = delayed(gains, self.clocks, drawing, omega)
        force_terms = [
            changes.loss[:, :, None] * draws.loss,
            changes.damping[:, :, None] * draws.damping,
            changes.own[:, :, None] * draws.own,
            changes.drives[:, :, None] * gains,
        ]
        # Every plate is computed with the changes of its own base.
        by_base = (tone_count, base_count, -1, base_count, drawing.count // base_count)
        forces = np.add.reduce(force_terms).reshape(by_base)
        base = np.arange(base_count)
        own_forces = forces[:, base, :, base].swapaxes(0, 1)
        base_responses = responses.reshape(tone_count, base_count, *responses.shape[1:])
        field_by_loss = changes.by_loss.reshape(tone_count, base_count, -1, 1)
        by_loss = field_by_loss * draws.loss.reshape(base_count, 1, -1)
        fields = base_responses @ own_forces + by_loss
        by_tone = fields.swapaxes(1, 2).reshape(tone_count, len(points), drawing.count)
        return np.asarray(by_tone)

    def harmonics(
        self,
        drawing: Drawing,
        rows: IntArray,
        weights: Complex64Array,
        points: Float32Array,
        shares: Float32Array,
    ) -> Float32Array:
        """Mean square of second harmonics over k fingertips [m²/s⁴], (m, k, 1 + d).

        For a plate at twice the frequencies (`at_harmonics`). points (k, p, r): shapes; other
        arguments: see `drawn`. Zero for the nominal plate.
        """
        plate = self.plate_on_eras.plate
        plates = DrawnPlates.of(self.plate_on_eras, len(shares), drawing)
        base_count = plates.base_count
        base_rows = rows.repeat(base_count)
        all_points = points.reshape(-1, points.shape[2])
        responses, _ = self.sources(base_rows, plates.bases_of(len(rows)), all_points)
        forces = plate.forces[base_rows] * weights.repeat(base_count, axis=0)
        fields = responses[:, :, : plate.era_count] * forces[:, None]
        base_fields = fields.reshape(len(rows), base_count, len(all_points), -1)
        by_base = (plate.era_count, base_count, drawing.count // base_count)
        harmonic_motion = plates.draws.harmonics.reshape(by_base).swapaxes(0, 1)
        power = power_of(base_fields @ harmonic_motion).swapaxes(1, 2)
        by_finger = power.reshape(len(rows), *shares.shape, drawing.count)
        means = (shares[:, None] @ by_finger)[:, :, 0]
        return np.asarray(np.pad(means, ((0, 0), (0, 0), (1, 0))), dtype=np.float32)

    def _fingers(self, rows: IntArray, nodes: IntArray) -> _Fingers:
        """Return how the fingers hold the plate in cases of rows (c,) and nodes (c,)."""
        by_force = self.plate_on_eras.by_force[rows, nodes]
        response = self.centers @ by_force.swapaxes(1, 2)
        free = self.plate_on_eras.receptance[rows, nodes][:, None] * self.centers
        coupled = (response @ self.plate_on_eras.coupling[rows, nodes]) @ by_force
        displacement = np.asarray(free + coupled, dtype=np.complex64)
        stiffness = self.stiffness[rows]
        system = (self.centers @ displacement.swapaxes(1, 2)) * stiffness[:, None]
        fingers = np.arange(len(self.centers))
        system[:, fingers, fingers] += 1
        return _Fingers(stiffness, response, displacement, np.asarray(np.linalg.inv(system)))

    def _held(self, rows: IntArray, nodes: IntArray, free: Complex64Array) -> Complex64Array:
        """Return coordinates (c, q, r) with the fingers, from those without."""
        fingers = self._fingers(rows, nodes)
        under_fingers = fingers.under_fingers(self.centers @ free.swapaxes(1, 2))
        return fingers.coordinates(free, under_fingers)
