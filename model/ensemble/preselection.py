"""Frequencies that are worth a search, before the exact forms at any of them are computed.

With the ERAs eliminated beforehand only the fingers are left to be attached: the plate on its ERAs
has receptance G and fields h0, the fingers D a field h = h0 - G D (1 + G D)^-1 h0. The form of the
mean over the quiet fingers follows as in `contact_forms`, but for what hardly changes the order of
frequencies: the deviation of a finger's load, what the thickness changes through a finger's load,
and what the fingers change in the motion of the ERAs. |c^H w| / sqrt(w^H R w) of w = R^-1 c is then
nearly the upper bound of a frequency's robust score.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray
from model.choice import best_first
from model.ensemble.attached_plate import AttachedPlate
from model.ensemble.contact_forms import RIDGE, gram, inverse_with, power_of
from model.ensemble.preselection_kernel import PreselectionKernel

KEPT, MISSING = 16, 4
"""Frequencies kept, a multiple of what kernels take at once, and how many may miss the level."""

MAX_FINGERS_RANKED_BY_POINTS = 4
"""Quiet fingers up to which nulls are so deep that the points of each count, not its centre."""


@dataclass(frozen=True, eq=False)
class Preselection:
    """Ranks the frequencies of a plate for a target and quiet fingers.

    error_power (f, n): mean square of the discretisation error of each ERA's field.
    """

    plate: AttachedPlate
    error_power: Float32Array

    def __reduce__(self) -> tuple[type["Preselection"], tuple[AttachedPlate, Float32Array]]:
        """Another process takes the kernel from its own library."""
        return Preselection, (self.plate, self.error_power)

    def rows(
        self,
        points: Float32Array,
        weights: Float32Array,
        wanted: Float32Array,
        among: IntArray,
        loads: Sequence[float] = (),
    ) -> IntArray:
        """Indices of the frequencies to search, ascending.

        points (k, p, r): shapes under each finger, the target first, its centre first; weights (k,
        p): of its points, sum 1; wanted (f,): amplitude at the target [m/s²]; among
        (n,): frequencies to choose from, by index; loads (k,): of each finger relative to the rig's
        fingertip, empty for 1.
        """
        score, amplitude = self.scores(points, weights, loads)
        order = among[best_first(score[among])]
        reaches = amplitude[order] >= wanted[order]
        # Those that would be better than the best, were they loud enough.
        first = int(reaches.argmax()) if reaches.any() else len(order)
        missing = order[:first][:MISSING]
        reaching = order[reaches][: KEPT - len(missing)]
        return np.sort(np.concatenate([reaching, missing]))

    def scores(
        self, points: Float32Array, weights: Float32Array, loads: Sequence[float] = ()
    ) -> tuple[Float32Array, Float32Array]:
        """Bounds of the score, and amplitudes of the target [m/s²] within full stroke, (f,)."""
        k, b = len(points), self.plate.stiffness.shape[1]
        if k > 1 + MAX_FINGERS_RANKED_BY_POINTS:
            points, weights = points[:, :1], np.ones((k, 1), dtype=np.float32)
        fingers = self.plate.with_fingers(k, loads).stiffness[:, b:]
        by = self._by_numpy if self._kernel is None else self._kernel.score
        return by(points, weights, fingers)

    def _by_numpy(
        self, points: Float32Array, weights: Float32Array, fingers: Complex64Array
    ) -> tuple[Float32Array, Float32Array]:
        plate, base = self.plate, self._base
        (f, b), n, k = plate.stiffness.shape, plate.era_count, len(points)
        p = points.shape[1]
        every = points.reshape(k * p, -1)
        by_force = (
            (every @ base.modal).view(np.complex64).reshape(k * p, f, b + 2 * n).swapaxes(0, 1)
        )
        from_attached = by_force[:, :, :b]
        products = (every[:, None] * points[:, 0]).reshape(k * p * k, -1)
        free = (products @ plate.modal_rows).view(np.complex64).reshape(k * p, k, f)
        G = np.ascontiguousarray(free.transpose(2, 0, 1))
        G -= from_attached @ (base.held @ from_attached[:, ::p].swapaxes(1, 2))
        G *= fingers[:, None]
        # Fields of the ERAs, of a force at each, and their change by the thickness.
        fields = np.concatenate([from_attached @ base.fields, by_force[:, :, b:]], axis=2)
        at_centres = np.linalg.solve(np.eye(k, dtype=np.complex64) + G[:, ::p], fields[:, ::p])
        fields = at_centres if p == 1 else fields - G @ at_centres

        target = (weights[0] @ fields[:, :p, :n]).conj()
        share = weights[1:].reshape(-1, 1) / np.float32(k - 1)
        quiet = fields[:, p:] * np.sqrt(share)
        h, to_quiet = quiet[:, :, :n], quiet[:, :, n : 2 * n]
        reach = np.sqrt(np.add.reduce(power_of(to_quiet), axis=1))[:, :, None]
        thicker = quiet[:, :, 2 * n :].reshape(f, -1, n)
        changes = [to_quiet @ base.by_damping, thicker, reach * base.by_stiffness]
        rows = np.concatenate([h, *changes], axis=1)
        R = gram(rows)
        diagonal = R.reshape(f, -1)[:, :: n + 1]
        diagonal += plate.gain_variance * np.add.reduce(power_of(h), axis=1) + self.error_power
        diagonal *= 1 + RIDGE
        w = np.linalg.solve(R, target[..., None])[..., 0]
        value = np.maximum(np.vecdot(target, w).real, 0)
        return np.sqrt(value), value / np.maximum.reduce(np.abs(w), axis=1)

    @cached_property
    def _kernel(self) -> PreselectionKernel | None:
        """The same in C, where it can be compiled."""
        plate, base = self.plate, self._base
        (f, b), n = plate.stiffness.shape, plate.era_count
        modal = base.modal.view(np.complex64).reshape(-1, f, b + 2 * n)
        return PreselectionKernel.of(
            gain_variance=plate.gain_variance,
            ridge=RIDGE,
            modal=modal.transpose(1, 2, 0),
            receptance=plate.receptance,
            fields=base.fields,
            held=base.held,
            by_damping=base.by_damping,
            by_stiffness=base.by_stiffness,
            error=self.error_power,
        )

    @cached_property
    def _base(self) -> "_PlateOnEras":
        """What does not depend on the fingers."""
        plate = self.plate
        (f, r), n, shapes = plate.receptance.shape, plate.era_count, plate.shapes
        single = partial(np.asarray, dtype=np.complex64)
        A = single((plate.receptance[:, None] * shapes) @ shapes.T)
        K = inverse_with(plate.stiffness, A)
        held = K * plate.stiffness[:, None]
        forces = K[:, :, :n] * plate.forces[:, None]
        motion = A @ -forces
        motion.reshape(f, -1)[:, : n * n : n + 1] += plate.strokes
        by_force = plate.receptance[:, :, None] * shapes.T
        minus_omega2 = plate.minus_omega2[:, None, None]
        modal = plate.receptance[:, :, None] * (shapes.T @ forces)
        columns = [by_force]
        for receptance in plate.deviating.swapaxes(0, 1):
            other = inverse_with(plate.stiffness, single((receptance[:, None] * shapes) @ shapes.T))
            moved = receptance[:, :, None] * (shapes.T @ (other[:, :, :n] * plate.forces[:, None]))
            columns.append(minus_omega2 * (moved - modal) * np.float32(math.sqrt(0.5)))
        modal = np.concatenate(columns, axis=2).swapaxes(0, 1)
        return _PlateOnEras(
            single(modal, order="C").reshape(r, -1).view(np.float32),
            single(np.concatenate([forces, K[:, :, :n]], axis=2) * minus_omega2),
            held,
            plate.by_damping[:, :, None] * motion[:, :n],
            plate.by_stiffness[:, :, None] * motion[:, :n],
        )


@dataclass(frozen=True, eq=False)
class _PlateOnEras:
    """A plate on its n ERAs and masses, b in all, without fingers.

    - modal: (r, 2 f (b + 2 n)) of each attachment's force, and of each ERA's changes by thickness
    - fields: (f, b, 2 n) forces at the attachments by each ERA at full stroke, and by a force there
    - held: (f, b, b) forces held by the attachments for a motion of each
    - by_damping, by_stiffness: (f, n, n) forces of a deviating damper or spring, by ERA driven
    """

    modal: Float32Array
    fields: Complex64Array
    held: Complex64Array
    by_damping: Complex64Array
    by_stiffness: Complex64Array
