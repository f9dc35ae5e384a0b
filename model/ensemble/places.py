"""Places of sources that are off: what counts as errors of their stiffnesses, and what of fields.

A source acts with its force F on a plate that moves by w, F = F_0 - Z w at drives of all sources,
at other shapes, phi + d, and is moved otherwise: a force F d - phi Z d w, a couple and a force.
Both act by linear functions of the drives. An error of its stiffness acts by another one, of how
far it is deformed, (base - w): what is proportional to it counts as such an error, which drives
that deform the source little make small. For ERAs, whose force is Z (base - w) but for their bolts,
this is all of the couple. An exciter is a force that its spring does not deform; what drives leave
of its couple is an error of its field, one of each finger.
"""

from dataclasses import replace

import numpy as np

from model.arrays import Complex64Array, Float32Array, FloatArray
from model.ensemble.attached_plate import MODELLED, PlateOnEras


def with_places(
    on: PlateOnEras, shifts: FloatArray, gram: Float32Array
) -> tuple[PlateOnEras, FloatArray]:
    """Let the sources' places be off: the plate with larger errors of their stiffnesses.

    And mean square over the plate of the error of each source's field beside these [m²/s⁴], (f, n),
    at full stroke. shifts (n, 2, r): change of the shapes at the sources, by one standard deviation
    along x and y; gram (r, r): mean of the shapes' products over the plate. Of the modelled plate
    without fingers; a stiffness counts that changes the fields of all sources by as much.
    """
    plate, n = on.plate, on.plate.era_count
    deformed = np.eye(n) * plate.strokes[:, None] - on.moved[:, MODELLED, :n]
    size = np.linalg.norm(deformed, axis=2)
    by_one = np.linalg.norm(on.by_force[:, MODELLED, :n], axis=2) * size
    changed, left = np.empty_like(by_one), np.empty_like(by_one)
    for row, along in enumerate(deformed / size[..., None]):
        changed[row], left[row] = _by_places(on, row, shifts, along, gram)
    by_stiffness = np.hypot(np.abs(plate.by_stiffness), changed / by_one)
    by_stiffness = by_stiffness * np.exp(1j * np.angle(plate.by_stiffness))
    found = replace(plate, by_stiffness=by_stiffness.astype(np.complex64))
    return replace(on, plate=found), left


def _by_places(
    on: PlateOnEras, row: int, shifts: FloatArray, along: Complex64Array, gram: Float32Array
) -> tuple[FloatArray, FloatArray]:
    """Size of the change of all fields together as each source is off, as far as it is deformed.

    Of accelerations of the coordinates, (n,) [m/s²], at a row of the frequencies; along (n, n): how
    far drives deform each source, of norm 1. And mean square of what is left of each field, (n,).
    """
    plate, n, w2 = on.plate, on.plate.era_count, on.plate.minus_omega2[row]
    g, T, Z = on.receptance[row, MODELLED], on.by_force[row, MODELLED], plate.stiffness[row]
    forces = np.diag(plate.forces[row]) - Z[:n, None] * on.moved[row, MODELLED, :n]
    held = (forces * along.conj()).sum(axis=1, keepdims=True) * along

    def fields(acting: Complex64Array) -> Complex64Array:
        free = g * acting
        return np.asarray(w2 * free - ((free @ plate.shapes.T) * Z) @ T)

    couples = fields(shifts)  # (n, 2, r), by a force of 1 N
    tilted = Z[:n, None, None] * (shifts @ (on.fields[row] / w2).T)  # (n, 2, n)
    changed = held[:, None, :, None] * couples[:, :, None]
    changed = changed - tilted[..., None] * T[:n, None, None]
    square = np.vecdot(couples, couples @ gram).real.sum(axis=1)
    left = (np.abs(forces - held) ** 2 * square[:, None]).sum(axis=0)
    return np.linalg.norm(changed.reshape(n, -1), axis=1), left
