"""Responses at the fingertips to tones, and their changes by every uncertain parameter.

Columns of the responses, in the order of `draws`: nominal; by one standard deviation of the
thickness, of the loss factor, of the ERAs' damping together, of each ERA's stiffness, of each
finger's load; the part of each ERA, which its gain multiplies. Formulas: `contact_forms`.
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
    plate: AttachedPlate, contacts: LoadedContacts, tones: Tones, points: Float32Array
) -> Complex64Array:
    """Accelerations [m/s²] at points of shapes (p, r): (m, p, columns)."""
    at, n = tones.frequencies, plate.era_count
    shapes, (m, a) = contacts.shapes, (len(at), len(contacts.shapes))
    forces = np.matvec(contacts.forces.take(at, axis=0), tones.weights)  # (m, a)
    motion = np.matvec(contacts.motion.take(at, axis=0), tones.weights)
    modal = plate.modal_changes.take(at, axis=0)
    # Of a force at each attachment; of the forces held, and the changes of that.
    sources = np.empty((len(points[0]), m, a + 3), dtype=np.complex64)
    by_force = shapes.T @ contacts.inverse.take(at, axis=0)
    sources[:, :, :a] = (by_force * modal[:, :, :1]).swapaxes(0, 1)
    free = (forces @ shapes)[:, :, None] * modal
    sources[:, :, a:] = free.swapaxes(0, 1)
    found = (points @ sources.reshape(len(sources), -1).view(np.float32)).view(np.complex64)
    by_source = found.reshape(len(points), m, a + 3).swapaxes(0, 1)

    attachments = contacts.attachments
    uncertain, era = attachments.uncertain, np.arange(n)
    end = FIRST_STIFFNESS + len(uncertain)
    columns = np.zeros((m, a + 3, end + n), dtype=np.complex64)
    columns[:, [a, a + 1, a + 2], [NOMINAL, THICKNESS, LOSS]] = 1
    held = attachments.stiffness.take(at, axis=0)[:, :, None] * (shapes @ free[:, :, 1:])
    columns[:, :a, THICKNESS : LOSS + 1] = -held
    columns[:, :n, DAMPING] = plate.by_damping.take(at, axis=0) * motion[:, :n]
    changes = attachments.changes.take(at, axis=0) * motion.take(uncertain, axis=1)
    columns[:, uncertain, np.arange(FIRST_STIFFNESS, end)] = changes
    columns[:, era, end + era] = plate.forces.take(at, axis=0) * tones.weights
    columns *= plate.minus_omega2.take(at)[:, None, None]
    return np.asarray(by_source @ columns)
