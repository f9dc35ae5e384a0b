"""Plates of several thicknesses with their ERAs and masses eliminated, once for each table.

Attachments b, the ERAs first; free receptance A(x, y) = phi_x diag(g) phi_y^T:

    K = (1 + Z A)^-1,  T = -w² K^T phi g,  Y = -(Z + Z A Z) / w⁴

T is the acceleration of the reduced coordinates by a force at each attachment of the plate on its
ERAs, whose receptance between places x and y is phi_x g phi_y^T + (T phi_x)^T Y T phi_y: the
attachments never appear again.

Thicknesses are solved exactly: where modes are close they move several past a tone. Within their
uncertainty the other parameters change the response nearly in proportion.
"""

from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist

import numpy as np

from model.arrays import Complex64Array, FloatArray
from model.ensemble.attached_plate import AttachedPlate
from model.structure.attachments import coupled_forces

MODELLED = 0
THICKER, THINNER = 1, 2
"""Thicknesses by a standard deviation from the nominal one, by index."""


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


@dataclass(frozen=True, eq=False)
class PlateOnEras:
    """The plate on its b attachments, without fingers, at f frequencies and t thicknesses.

    - plate: at the frequencies
    - first: index of the first thickness of as many `thickness_nodes`, by their number
    - receptance: (f, t, r) g of the free plate; by_loss: (f, t, r) its change by one standard
      deviation of the loss factor
    - by_force: (f, t, b, r) T [m/s²/N]; coupling: (f, t, b, b) Y
    - moved: (f, t, b, n) displacement of the attachments by each ERA at full stroke [m]
    """

    plate: AttachedPlate
    first: dict[int, int]
    receptance: Complex64Array
    by_loss: Complex64Array
    by_force: Complex64Array
    coupling: Complex64Array
    moved: Complex64Array

    @classmethod
    def of(cls, plate: AttachedPlate, *node_counts: int) -> "PlateOnEras":
        """Eliminate the attachments of a plate of so many `thickness_nodes`, several counts.

        Where its thickness is certain there is the nominal one alone.
        """
        deviations, first = [np.zeros(1)], {}
        if plate.uncertainty.thickness > 0:
            deviations.append(np.array([1.0, -1.0]))
            for count in node_counts:
                first[count] = sum(map(len, deviations))
                deviations.append(thickness_nodes(count))
        every = np.concatenate(deviations)
        (f, b), t, r = plate.stiffness.shape, len(every), plate.shapes.shape[1]
        n, single = plate.era_count, np.complex64
        sizes = ((f, t, r), (f, t, r), (f, t, b, r), (f, t, b, b), (f, t, b, n))
        found = [np.empty(size, dtype=single) for size in sizes]
        for row in range(f):
            receptance, by_loss = plate.of_thicknesses(every, row)
            parts = receptance, by_loss, *_eliminated(plate, row, receptance)
            for to, part in zip(found, parts, strict=True):
                to[row] = part
        return cls(plate, first, *found)

    @property
    def fields(self) -> Complex64Array:
        """Accelerations of the reduced coordinates by each ERA at full stroke, (f, n, r)."""
        plate = self.plate
        return self.by_force[:, MODELLED, : plate.era_count] * plate.forces[:, :, None]


def _eliminated(
    plate: AttachedPlate, row: int, receptance: Complex64Array
) -> tuple[Complex64Array, ...]:
    """T, Y and motion at a row of the frequencies for plates of receptances g (t, r), (t, ...)."""
    Z, w2, n = plate.stiffness[row], plate.minus_omega2[row], plate.era_count
    modal = plate.shapes * receptance[:, None]
    A = modal @ plate.shapes.T
    K = coupled_forces(A, Z, np.eye(len(Z), dtype=np.complex64))
    coupling = np.asarray(Z[:, None] * A * Z, dtype=np.complex64)
    coupling.reshape(len(A), -1)[:, :: len(Z) + 1] += Z
    moved = np.asarray(A @ (K[:, :, :n] * plate.forces[row]))
    by_force = np.asarray(w2 * (K.swapaxes(1, 2) @ modal), dtype=np.complex64)
    return by_force, np.asarray(-coupling / w2**2), moved
