"""Responses at the fingertips to tones, and their changes by every uncertain parameter.

Columns of the responses, in the order of `draws`: nominal; by one standard deviation of the
thickness, of the loss factor, of the ERAs' damping together, of each ERA's stiffness, of each
finger's load; the part of each ERA, which its gain multiplies; the discretisation error at each
finger. Formulas: `contact_forms`.
"""

from dataclasses import dataclass

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray
from model.ensemble.attached_plate import AttachedPlate
from model.ensemble.contact_forms import LoadedContacts

NOMINAL, THICKNESS, LOSS, DAMPING, FIRST_STIFFNESS = range(5)
"""Columns of the responses before those of each finger and of each ERA's gain."""


@dataclass(frozen=True, eq=False)
class Tones:
    """m tones: indices of their frequencies (m,), and the weights of all ERAs (m, n)."""

    frequencies: IntArray
    weights: Complex64Array


def tone_responses(
    plate: AttachedPlate,
    contacts: LoadedContacts,
    tones: Tones,
    points: Float32Array,
    error: Float32Array,
) -> Complex64Array:
    """Accelerations [m/s²] at the points of k fingers, of shapes (k p, r): (m, k p, columns).

    error (m,): root mean square of the discretisation error of each tone's field.
    """
    at, n, b = tones.frequencies, plate.era_count, plate.stiffness.shape[1]
    w = tones.weights[:, :, None]
    shapes, stiffness = contacts.shapes, contacts.stiffness.take(at, axis=0)
    receptance = plate.receptance.take(at, axis=0)[:, :, None]
    forces = (contacts.forces.take(at, axis=0) @ w)[:, :, 0]  # (m, a)
    motion = (contacts.motion.take(at, axis=0) @ w)[:, :, 0]
    by_force = (shapes.T @ contacts.inverse.take(at, axis=0)) * receptance  # (m, r, a)
    modal_force = forces @ shapes
    k = len(shapes) - b
    modal = np.empty((len(at), len(by_force[0]), 4 + n + k + n), dtype=np.complex64)
    modal[:, :, NOMINAL] = modal_force * receptance[:, :, 0]
    for column, change in ((THICKNESS, plate.by_thickness), (LOSS, plate.by_loss)):
        free = modal_force * change.take(at, axis=0)
        held = stiffness * (free @ shapes.T)
        modal[:, :, column] = free - (by_force @ held[:, :, None])[:, :, 0]
    damping = plate.by_damping.take(at, axis=0) * motion[:, :n]
    modal[:, :, DAMPING] = (by_force[:, :, :n] @ damping[:, :, None])[:, :, 0]
    end = FIRST_STIFFNESS + n
    changes = plate.by_stiffness.take(at, axis=0) * motion[:, :n]
    modal[:, :, FIRST_STIFFNESS:end] = by_force[:, :, :n] * changes[:, None]
    changes = plate.by_finger.take(at)[:, None] * motion[:, b:]
    modal[:, :, end : end + k] = by_force[:, :, b:] * changes[:, None]
    drives = plate.forces.take(at, axis=0) * tones.weights
    modal[:, :, end + k :] = by_force[:, :, :n] * drives[:, None]
    modal *= plate.minus_omega2.take(at)[:, None, None]
    found = points @ modal.transpose(1, 0, 2).reshape(len(modal[0]), -1).view(np.float32)
    columns = modal.shape[2]
    responses = np.zeros((len(at), len(points), columns + k), dtype=np.complex64)
    by_point = found.view(np.complex64).reshape(len(points), len(at), columns)
    responses[:, :, :columns] = by_point.transpose(1, 0, 2)
    each = responses.reshape(len(at), k, -1, columns + k)
    for finger in range(k):
        each[:, finger, :, columns + finger] = error[:, None]
    return responses
