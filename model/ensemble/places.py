"""Places of sources that are off: what counts as errors of their stiffnesses, and what of fields.

A source acts with its force F on a plate that moves by w, F = F_0 - Z w at drives of all sources,
at other shapes, phi + d, and is moved otherwise: a force F d - phi Z d w, a couple and a force at
its own place.

Of an ERA, which is stiff, both count as an error of its stiffness that changes the fields of all as
much. An exciter is a force of its own drive, and such an error would be one of its gain: at fingers
where its field vanishes there would be none, where a couple has a field of another shape. What of
the couple's field is that of the force counts as an error of stiffness, the rest as one of its
field, of each finger.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from model.arrays import Float32Array, FloatArray
from model.ensemble.attached_plate import MODELLED, PlateOnEras


def with_places(
    on: PlateOnEras, shifts: FloatArray, gram: Float32Array, by_field: Sequence[bool]
) -> tuple[PlateOnEras, FloatArray]:
    """Let the sources' places be off: the plate with larger errors of their stiffnesses.

    And mean square of the error of each source's field beside these [(m/s²)²], (f, n), at full
    stroke. shifts (n, 2, r): change of the shapes at the sources, by one standard deviation along x
    and y; gram (r, r): mean of the shapes' products where fingers rest; by_field (n,): whether
    couples count as errors of fields. Of the modelled plate without fingers.
    """
    plate, n = on.plate, on.plate.era_count
    deformed = np.eye(n) * plate.strokes[:, None] - on.moved[:, MODELLED, :n]
    by_one = np.linalg.norm(on.by_force[:, MODELLED, :n], axis=2)
    by_one = by_one * np.linalg.norm(deformed, axis=2)
    changed, left = np.empty_like(by_one), np.empty_like(by_one)
    for row in range(len(by_one)):
        changed[row], left[row] = _by_places(on, row, shifts, gram, np.array(by_field))
    by_stiffness, of_springs = plate.by_stiffness.copy(), plate.by_stiffness[:, :n]
    size = np.hypot(np.abs(of_springs), changed / by_one)
    by_stiffness[:, :n] = size * np.exp(1j * np.angle(of_springs))
    found = replace(plate, by_stiffness=by_stiffness)
    return replace(on, plate=found), left


def _by_places(
    on: PlateOnEras, row: int, shifts: FloatArray, gram: Float32Array, by_field: np.ndarray
) -> tuple[FloatArray, FloatArray]:
    """Size of the change of all fields together that counts as one of stiffness, (n,) [m/s²].

    Of accelerations of the coordinates, as each source is off, at a row of the frequencies. And
    mean square of what is left of each field, (n,).
    """
    plate, n, w2 = on.plate, on.plate.era_count, on.plate.minus_omega2[row]
    g, T, Z = on.receptance[row, MODELLED], on.by_force[row, MODELLED], plate.stiffness[row]
    forces = np.diag(plate.forces[row]) - Z[:n, None] * on.moved[row, MODELLED, :n]
    free = g * shifts
    couples = np.asarray(w2 * free - ((free @ plate.shapes.T) * Z) @ T)  # (n, 2, r), by 1 N
    left, T = np.zeros_like(couples), T[:n, None]
    along = T.conj() @ gram
    share = (along * couples).sum(axis=2) / (along * T).sum(axis=2)
    left[by_field] = (couples - share[..., None] * T)[by_field]
    tilted = Z[:n, None, None] * (shifts @ (on.fields[row] / w2).T)  # (n, 2, n)
    changed = forces[:, None, :, None] * (couples - left)[:, :, None]
    changed = changed - tilted[..., None] * T[:, :, None]
    square = np.vecdot(left, left @ gram).real.sum(axis=1)
    by_drive = (np.abs(forces) ** 2 * square[:, None]).sum(axis=0)
    return np.linalg.norm(changed.reshape(n, -1), axis=1), by_drive
