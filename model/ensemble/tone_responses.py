"""Responses at the fingertips to tones, and their changes by every uncertain parameter.

Columns of the responses, in the order of `draws`: nominal; by one standard deviation of the loss
factor, of the ERAs' damping together, of each ERA's stiffness, of each finger's load; the part of
each ERA, which its gain multiplies. Formulas: `contact_forms`.
"""

from dataclasses import dataclass

import numpy as np

from model.arrays import Complex64Array, Float32Array, IntArray
from model.ensemble.attached_plate import AttachedPlate
from model.ensemble.contact_forms import LoadedContacts

NOMINAL, LOSS, DAMPING, FIRST_STIFFNESS = range(4)
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
    sources, columns = _sources_and_columns(plate, contacts, tones)
    r, m, _ = sources.shape
    found = (points @ sources.reshape(r, -1).view(np.float32)).view(np.complex64)
    return np.asarray(found.reshape(len(points), m, -1).swapaxes(0, 1) @ columns)


def drawn_changes(
    plate: AttachedPlate,
    contacts: LoadedContacts,
    tones: Tones,
    points: Float32Array,
    factors: Complex64Array,
) -> Complex64Array:
    """Changes of the accelerations [m/s²] at points of shapes (p, r) by uncertain parameters.

    factors (m, columns, d): of drawn plates for each tone, of which that of `NOMINAL` is left out.
    The result is (p, m, d).
    """
    sources, columns = _sources_and_columns(plate, contacts, tones)
    driven = columns[:, :, 1:] @ factors[:, 1:]
    modal = (sources.swapaxes(0, 1) @ driven).swapaxes(0, 1)
    r, m, d = modal.shape
    found = points @ np.ascontiguousarray(modal).reshape(r, -1).view(np.float32)
    return found.view(np.complex64).reshape(len(points), m, d)


def _sources_and_columns(
    plate: AttachedPlate, contacts: LoadedContacts, tones: Tones
) -> tuple[Complex64Array, Complex64Array]:
    """Reduced coordinates by each source, (r, m, a + 2), and each source's share in the columns.

    Sources: a force at each attachment; the forces held, and the change of the receptance for them.
    """
    at, n = tones.frequencies, plate.era_count
    shapes, (m, a) = contacts.shapes, (len(at), len(contacts.shapes))
    forces = np.matvec(contacts.forces.take(at, axis=0), tones.weights)  # (m, a)
    motion = np.matvec(contacts.motion.take(at, axis=0), tones.weights)
    modal = np.stack([plate.receptance.take(at, axis=0), plate.by_loss.take(at, axis=0)], axis=2)
    sources = np.empty((shapes.shape[1], m, a + 2), dtype=np.complex64)
    by_force = shapes.T @ contacts.inverse.take(at, axis=0)
    sources[:, :, :a] = (by_force * modal[:, :, :1]).swapaxes(0, 1)
    free = (forces @ shapes)[:, :, None] * modal
    sources[:, :, a:] = free.swapaxes(0, 1)

    attachments = contacts.attachments
    uncertain, era = attachments.uncertain, np.arange(n)
    end = FIRST_STIFFNESS + len(uncertain)
    columns = np.zeros((m, a + 2, end + n), dtype=np.complex64)
    columns[:, [a, a + 1], [NOMINAL, LOSS]] = 1
    columns[:, :a, LOSS] = -attachments.stiffness.take(at, axis=0) * (free[:, :, 1] @ shapes.T)
    columns[:, :n, DAMPING] = plate.by_damping.take(at, axis=0) * motion[:, :n]
    changes = attachments.changes.take(at, axis=0) * motion.take(uncertain, axis=1)
    columns[:, uncertain, np.arange(FIRST_STIFFNESS, end)] = changes
    columns[:, era, end + era] = plate.forces.take(at, axis=0) * tones.weights
    columns *= plate.minus_omega2.take(at)[:, None, None]
    return sources, columns
