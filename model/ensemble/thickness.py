"""Plates of other thickness, exactly: where modes are close it moves several past a tone.

A plate thicker by a factor h has modal masses and frequencies that are larger by it, so that its
receptance is g = 1 / (h (h² s lambda - w²)) of s lambda and w as in `attached_plate`. Within their
uncertainty the other parameters change the response nearly in proportion.
"""

from functools import lru_cache
from statistics import NormalDist

import numpy as np

from model.arrays import Complex64Array, Float32Array, FloatArray
from model.ensemble.attached_plate import AttachedPlate
from model.ensemble.contact_forms import LoadedContacts
from model.ensemble.tone_responses import NOMINAL, THICKNESS, Tones


@lru_cache(maxsize=8)
def thickness_nodes(count: int) -> FloatArray:
    """Deviations that stand for all, in standard deviations, ascending: (count,).

    Means of strata of equal probability of the normal distribution, scaled to variance 1.
    """
    normal = NormalDist()
    bounds = [normal.inv_cdf(each / count) for each in range(1, count)]
    density = np.array([0.0, *map(normal.pdf, bounds), 0.0])
    means = -np.diff(density)
    size = np.sqrt((means**2).mean())
    found = means / size if size > 0 else means
    found.setflags(write=False)  # cached, and so shared
    return found


def thickness_remainders(
    plate: AttachedPlate,
    contacts: LoadedContacts,
    tones: Tones,
    points: Float32Array,
    responses: Complex64Array,
    nodes: FloatArray,
) -> Complex64Array:
    """What the responses at thicknesses differ by from those of `tone_responses`, (m, p, nodes).

    points (p, r): shapes; responses (m, p, columns): of `tone_responses`; nodes: deviations in
    standard deviations.
    """
    at, (m, r), count = tones.frequencies, (len(tones.frequencies), points.shape[1]), len(nodes)
    receptance = plate.receptance_at(nodes, at).reshape(m * count, r)
    shapes, a = contacts.shapes, len(contacts.shapes)
    products = (shapes[:, None] * shapes).reshape(a * a, r).T
    A = np.empty((m * count, a * a), dtype=np.complex64)
    A.real, A.imag = receptance.real @ products, receptance.imag @ products
    system = (
        A.reshape(m, count, a, a)
        * contacts.attachments.stiffness.take(at, axis=0)[:, None, :, None]
    )
    system.reshape(m, count, -1)[:, :, :: a + 1] += 1
    applied = np.zeros((m, 1, a, 1), dtype=np.complex64)
    applied[:, 0, : plate.era_count, 0] = plate.forces.take(at, axis=0) * tones.weights
    forces = np.linalg.solve(system, applied)[..., 0].reshape(m * count, a)
    modal = np.empty((m * count, r), dtype=np.complex64)
    modal.real, modal.imag = forces.real @ shapes, forces.imag @ shapes
    modal *= receptance
    modal *= np.repeat(plate.minus_omega2.take(at), count)[:, None]
    found = np.empty((m * count, len(points)), dtype=np.complex64)
    found.real, found.imag = modal.real @ points.T, modal.imag @ points.T
    remainders = found.reshape(m, count, -1).swapaxes(1, 2)
    remainders -= responses[:, :, NOMINAL, None]
    remainders -= responses[:, :, THICKNESS, None] * nodes.astype(np.float32)
    return np.asarray(remainders)
