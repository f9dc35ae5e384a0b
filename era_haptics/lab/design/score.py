"""Fast score of ERA layouts.

The score is the expected contrast over sampled contact sets, computed like answers
(`model.ensemble.expected_power`, `model.phased_weights`), at a few frequencies, from the
receptances of the free plate. Each finger loads the plate at its own position; its effect on the
other fingers is neglected, so everything is computed once per finger. With ERAs e of dynamic
stiffness Z on the plate, a finger f of dynamic stiffness D and its points p:

    K = (1 + Z A_ee)^-1,  G = A_pe K,  L = A_pf - G Z A_ef,  M = D / (1 + D L_f)
    t_e = G_p - L_p M G_f,  h = -w² t_e z stroke,  r_e = stroke - u_e,  r_f = -u_f
    R = mean_p {h* h^T + dh* dh^T + dc* dc^T + sum_j |s_j w² t_j|² r_j* r_j^T + sigma² diag |h|²}
        + field² mean_plate diag |h|²

where dh comes from the plates thicker and thinner by one standard deviation, each solved exactly
with half weight, dc from the ERAs' damping, and s_j from each ERA's stiffness and the finger's
load. The last term is over the plate without fingers, like `LocalizationTable.error_power`. The
score of a set is |h_t w|² / max_q w^H R_q w of the best weights w at the best frequency, minus a
tenth of the missing level, since an answer that has to reach the level loses
little contrast. With several contents it is the score of the worst one, with all other fingers
quiet, because their crosstalk sums to little more than the highest. Each content is then searched
at a multiple of the level, since they share the stroke.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from era_haptics.lab.design.set_scores import SetScores
from model.arrays import Complex64Array, Float32Array, FloatArray, IntArray
from model.ensemble.attached_plate import Mounts, mounts_of
from model.ensemble.expected_power import expected_power, power_of
from model.finger import FIVE_POINTS, Grid, fingertips_on
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig, Uncertainty
from model.structure.attachments import coupled_forces
from model.structure.exciter import Actuator

_SMALLEST = np.float32(1e-30)


@dataclass(frozen=True, eq=False)
class PlaceReceptances:
    """Receptances [m/N] of c positions on plates of v thicknesses, the nominal one first.

    at (c, 2) [m]; between (v, f, c, c); to_tips (v, f, m p, c): at the points of m fingertips;
    to_plate (f, g, c): over the nominal plate, empty if the rig's field has no uncertainty.
    """

    at: FloatArray
    between: Complex64Array
    to_tips: Complex64Array
    to_plate: Complex64Array


class _TouchedPlates(NamedTuple):
    """Plates of v thicknesses on n ERAs, each with one of m fingers at its position."""

    transfer: Complex64Array
    """t (v, f, m, p, n) [m/N]: from the ERAs' forces to the points of the finger."""
    unloaded: Complex64Array
    """G_f (v, f, m, n) [m/N]: to the center of the finger, without its load."""
    own: Complex64Array
    """L (v, f, m, p) [m/N]: from the center of the finger to its points."""
    release: Complex64Array
    """1 / (1 + D L_f) (v, f, m)."""


class Scorer:
    """Score layouts on a rig's plate, solved once, with given contact sets.

    frequencies (f,) [Hz]; sets: contacts (fingers, 2) [m] of each set, those with contents first;
    eras: ERAs of every layout in order: kept ones at their positions, then one at any position;
    additional ones equal it.
    """

    def __init__(
        self,
        rig: Rig,
        frequencies: FloatArray,
        sets: Sequence[FloatArray],
        *,
        eras: Sequence[Actuator],
        contents: int = 1,
    ) -> None:
        plate = rig.plate
        omega = 2 * np.pi * frequencies
        self._rig = rig
        self._eras = tuple(eras)
        self._frequencies = frequencies
        self._contents = contents
        self._thicknesses = _thicknesses_of(rig.uncertainty)
        self._mounts = mounts_of(eras, (), omega, rig.uncertainty)
        self._minus_omega2 = self._mounts.minus_omega2[:, None, None]
        self._finger_stiffness = _finger_stiffness(rig, omega)
        self._set_scores = SetScores(rig, frequencies, contents)
        self._free = solve_free_plate(plate, rig.mesh, frequency_max=float(frequencies.max()))
        centers, numbers = np.unique(np.vstack(sets), axis=0, return_inverse=True)
        points, weights = fingertips_on(
            centers, length=plate.length, width=plate.width, rule=FIVE_POINTS
        )
        self._points = points.reshape(-1, 2)
        self._weights: Float32Array = weights.astype(np.float32)  # (m, p), the center first
        has_field = rig.uncertainty.field > 0
        self._cells = Grid(12, 9).centers(plate) if has_field else np.empty((0, 2))
        sizes = [len(contacts) for contacts in sets]
        self._groups = _grouped_by_size(numbers.ravel(), sizes)
        self._own = self._own_receptances(centers)

    def _own_receptances(self, centers: FloatArray) -> Complex64Array:
        """Return the receptances from the center of each fingertip to its points, (v, f, m, p)."""
        to_tips = self._solved(centers).to_tips
        by_tip = to_tips.reshape(*to_tips.shape[:2], *self._weights.shape, -1)
        tips = np.arange(len(centers))
        own = by_tip[:, :, tips, :, tips]
        return np.moveaxis(own, 0, 2)

    def places(self, at: FloatArray) -> PlaceReceptances:
        """Solve for ERAs at positions [m] (c, 2): kept ones at their own, else the last."""
        *fixed_eras, last = self._eras
        feet = np.full(len(at), last.foot)
        for era in fixed_eras:
            feet[(at == [era.x, era.y]).all(axis=1)] = era.foot
        return self._solved(np.column_stack([at, feet]))

    def _solved(self, footprints: FloatArray) -> PlaceReceptances:
        loads = self._rig.masses
        between, to_points = self._free.receptances(
            footprints,
            self._points,
            self._frequencies,
            loads=loads,
            thickness=self._thicknesses,
        )
        _, to_plate = self._free.receptances(
            footprints, self._cells, self._frequencies, loads=loads
        )
        return PlaceReceptances(
            at=footprints[:, :2],
            between=between.astype(np.complex64),
            to_tips=np.ascontiguousarray(to_points.swapaxes(2, 3), dtype=np.complex64),
            to_plate=np.asarray(to_plate.swapaxes(1, 2), dtype=np.complex64),
        )

    def mean(self, places: PlaceReceptances, chosen: IntArray) -> float:
        """Return the mean score [dB] of ERAs at chosen positions (n,), equal weight per number of
        fingers."""
        target, power = self._fields(places, chosen)
        means = [self._worst_content(target, power, fingers).mean() for fingers in self._groups]
        return float(np.mean(means))

    def _worst_content(
        self, target: Complex64Array, power: Complex64Array, fingers: IntArray
    ) -> FloatArray:
        """Return the score [dB] of the worst content for sets (s, k) of fingers, (s,)."""
        scores = []
        for content in range(self._contents):
            content_first = np.roll(fingers, -content, axis=1)
            scores.append(self._set_scores.of_sets(target, power, content_first))
        return np.asarray(np.min(scores, axis=0))

    # Fields

    def _fields(
        self, places: PlaceReceptances, chosen: IntArray
    ) -> tuple[Complex64Array, Complex64Array]:
        """Return mean fields (f, m, n) [m/s²] at the fingertips, and expected power there (f, m, n,
        n)."""
        eras = self._mounted(len(chosen))
        between = places.between[:, :, chosen[:, None], chosen]
        identity = np.eye(len(chosen), dtype=np.complex64)
        coupling = coupled_forces(between, eras.stiffness, identity)  # K
        plates = self._touched(places.to_tips[:, :, :, chosen], eras, coupling)
        fields = plates.transfer * self._acceleration_per_transfer(eras)[:, None]
        nominal = fields[0]
        held_forces = coupling[0] * eras.forces[:, None]
        motion = -(between[0] @ held_forces)  # r_e
        diagonals = motion.reshape(len(motion), -1)[:, :: len(chosen) + 1]
        diagonals += eras.strokes
        by_damping = self._field_by_damping(plates.transfer[0], eras, motion)
        by_thickness = (fields[1:] - nominal) * np.float32(math.sqrt(0.5))
        independent = self._independent_errors(plates, eras, motion)
        error_power = self._field_error(places, chosen, eras, coupling[0])
        power = expected_power(
            [nominal, by_damping, *by_thickness],
            independent,
            self._weights,
            gain_variance=self._rig.uncertainty.gain_variance(len(chosen)),
            error_power=error_power,
        )
        mean_field = (nominal * self._weights[..., None]).sum(axis=2)
        return mean_field, power

    def _mounted(self, count: int) -> Mounts:
        """Return `count` ERAs; additional ones equal the last."""
        mounts = self._mounts
        last = mounts.stiffness.shape[1] - 1
        numbers = np.minimum(np.arange(count), last)
        return replace(
            mounts,
            stiffness=mounts.stiffness[:, numbers],
            strokes=mounts.strokes[:, numbers],
            by_stiffness=mounts.by_stiffness[:, numbers],
            by_damping=mounts.by_damping[:, numbers],
            forces=mounts.forces[:, numbers],
        )

    def _acceleration_per_transfer(self, eras: Mounts) -> Complex64Array:
        """Acceleration [m/s²] at full stroke per unit of receptance, (f, 1, n)."""
        return np.asarray(self._minus_omega2 * eras.forces[:, None])

    def _touched(
        self, to_tips: Complex64Array, eras: Mounts, coupling: Complex64Array
    ) -> _TouchedPlates:
        """Mount plates on ERAs and add each finger; to_tips (v, f, m p, n): of the free plates."""
        points = self._weights.shape[1]
        by_tip = (*to_tips.shape[:2], *self._weights.shape, to_tips.shape[-1])
        unloaded = to_tips @ coupling  # G
        at_centers = unloaded[:, :, ::points]
        unloaded = unloaded.reshape(by_tip)
        to_centers = to_tips[:, :, ::points] * eras.stiffness[:, None]
        held = to_centers[..., None, :] * unloaded
        own = self._own - held.sum(axis=-1)
        release = 1 / (1 + self._finger_stiffness * own[..., 0])
        finger_stiffness = self._finger_stiffness * release
        reaction = own * finger_stiffness[..., None]
        transfer = unloaded - reaction[..., None] * at_centers[:, :, :, None]
        return _TouchedPlates(transfer, at_centers, own, release)

    def _independent_errors(
        self, plates: _TouchedPlates, eras: Mounts, motion: Complex64Array
    ) -> Complex64Array:
        """Return the fields (f, m, j, n) of independent errors: each ERA's stiffness, and the
        finger's load."""
        transfer_size = np.sqrt(_mean_power(plates.transfer[0], self._weights))
        reach = transfer_size * -self._minus_omega2
        force = eras.by_stiffness[:, :, None] * motion
        by_stiffness = reach[..., None] * force[:, None]
        load_std = self._rig.uncertainty.fingertip
        if load_std == 0:
            return np.asarray(by_stiffness)
        release = plates.release[0]
        own_size = np.sqrt(_mean_power(plates.own[0][..., None], self._weights))
        by_load = own_size * np.abs(release)[..., None]
        reaction = self._finger_stiffness * release
        load = by_load * np.float32(load_std) * reaction[..., None]
        field = load * plates.unloaded[0] * self._acceleration_per_transfer(eras)
        return np.concatenate([by_stiffness, field[:, :, None]], axis=2)

    def _field_error(
        self,
        places: PlaceReceptances,
        chosen: IntArray,
        eras: Mounts,
        coupling: Complex64Array,
    ) -> Float32Array:
        """Return the power (f, 1, n) of the model's errors, relative to the whole plate."""
        error = np.full((len(coupling), 1, len(chosen)), _SMALLEST)
        field_std = self._rig.uncertainty.field
        if field_std > 0:
            to_plate = places.to_plate[:, :, chosen]
            over_plate = to_plate @ coupling * self._acceleration_per_transfer(eras)
            mean_square = (np.abs(over_plate) ** 2).mean(axis=1, keepdims=True)
            error += np.float32(field_std**2) * mean_square
        return error

    def _field_by_damping(
        self, transfer: Complex64Array, eras: Mounts, motion: Complex64Array
    ) -> Complex64Array:
        """Return the change dc (f, m, p, n) of the field per standard deviation of the damping.

        transfer (f, m, p, n): of the nominal plate.
        """
        flat_transfer = transfer.reshape(len(transfer), -1, transfer.shape[-1])
        force = self._minus_omega2 * eras.by_damping[:, :, None] * motion
        return np.asarray((flat_transfer @ force).reshape(transfer.shape))


def _thicknesses_of(uncertainty: Uncertainty) -> FloatArray:
    """Return relative thicknesses (v,): the nominal plate, then one standard deviation up and down.

    A modulus shifts resonances like a thickness.
    """
    std = uncertainty.frequency
    return np.array([1.0, 1 + std, 1 - std] if std > 0 else [1.0])


def _finger_stiffness(rig: Rig, omega: FloatArray) -> Complex64Array:
    """Return the dynamic stiffness D (f, 1) of a fingertip [N/m], 0 for weightless ones."""
    if rig.fingertip is None:
        return np.zeros((len(omega), 1), dtype=np.complex64)
    return rig.fingertip.dynamic_stiffness(omega).astype(np.complex64)[:, None]


def _grouped_by_size(numbers: IntArray, sizes: Sequence[int]) -> tuple[IntArray, ...]:
    """Group concatenated sets of finger numbers: one array (s, k) for each size k."""
    starts = np.cumsum(sizes) - sizes
    groups = []
    for size in np.unique(sizes).tolist():
        of_size = starts[np.equal(sizes, size)]
        groups.append(numbers[of_size[:, None] + np.arange(size)])
    return tuple(groups)


def _mean_power(values: Complex64Array, weights: Float32Array) -> Float32Array:
    """Return the mean of |values|² (f, m, p, n) over fingertips with weights (m, p), (f, m, n)."""
    return np.asarray((weights[:, None] @ power_of(values))[:, :, 0])
