"""Plates of other thickness, exactly: where modes are close it moves several past a tone.

Their receptance is that of `attached_plate`. Within their uncertainty the other parameters change
the response nearly in proportion.
"""

from functools import lru_cache, partial
from statistics import NormalDist

import numpy as np

from model.arrays import Complex64Array, Float32Array, FloatArray
from model.compiled.kernels import kernels
from model.ensemble.attached_plate import AttachedPlate
from model.ensemble.contact_forms import LoadedContacts
from model.ensemble.thickness_kernel import responses as by_kernel
from model.ensemble.tone_responses import Tones


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


def responses_of_thicknesses(
    plate: AttachedPlate,
    contacts: LoadedContacts,
    tones: Tones,
    points: Float32Array,
    nodes: FloatArray,
) -> Complex64Array:
    """Accelerations [m/s²] at points of plates of other thickness, (m, p, nodes).

    points (p, r): shapes; nodes: deviations of the thickness in standard deviations.
    """
    at, r, count = tones.frequencies, points.shape[1], len(nodes)
    m, a = len(at), len(contacts.shapes)
    applied = np.zeros((m, a), dtype=np.complex64)
    applied[:, : plate.era_count] = plate.forces.take(at, axis=0) * tones.weights
    found_by = kernels()
    by = _by_numpy if found_by is None else partial(by_kernel, found_by)
    found = by(
        shapes=contacts.shapes,
        at_points=points,
        receptance=plate.receptance_at(nodes, at).reshape(m * count, r),
        stiffness=contacts.attachments.stiffness.take(at, axis=0).repeat(count, axis=0),
        applied=applied.repeat(count, axis=0),
        minus_omega2=plate.minus_omega2.take(at).repeat(count),
    )
    return found.reshape(m, count, len(points)).swapaxes(1, 2)


def _by_numpy(
    *,
    shapes: Float32Array,
    at_points: Float32Array,
    receptance: Complex64Array,
    stiffness: Complex64Array,
    applied: Complex64Array,
    minus_omega2: Float32Array,
) -> Complex64Array:
    """Accelerations (c, p) at points of shapes at_points (p, r), as the kernel finds them.

    shapes (a, r) of the attachments; in c cases receptance (c, r), dynamic stiffness and applied
    forces of the attachments (c, a), and minus_omega2 (c,).
    """
    (a, r), c = shapes.shape, len(receptance)
    products = (shapes[:, None] * shapes).reshape(a * a, r).T
    A = np.empty((c, a * a), dtype=np.complex64)
    A.real, A.imag = receptance.real @ products, receptance.imag @ products
    system = A.reshape(c, a, a) * stiffness[:, :, None]
    system.reshape(c, -1)[:, :: a + 1] += 1
    forces = np.linalg.solve(system, applied[..., None])[..., 0]
    modal = np.empty((c, r), dtype=np.complex64)
    modal.real, modal.imag = forces.real @ shapes, forces.imag @ shapes
    modal *= receptance
    modal *= minus_omega2[:, None]
    found = np.empty((c, len(at_points)), dtype=np.complex64)
    found.real, found.imag = modal.real @ at_points.T, modal.imag @ at_points.T
    return found
