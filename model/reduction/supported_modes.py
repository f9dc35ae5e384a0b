"""Modes of the plate on its ERAs: natural frequencies, damping ratios and shapes.

The modes are those of the undamped plate. A damping ratio says how much of its energy such a mode
loses, psi' C psi / (2 omega) at modal mass 1, to the plate's own losses and to the dampers of the
ERAs; that dampers also couple the modes is left out here, not in the plate in time.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from model.arrays import FloatArray
from model.reduction.modal_matrices import modal_matrices
from model.reduction.reduced_plate import ReducedPlate
from model.structure.actuator import Era
from model.structure.point_load import PointLoad


@dataclass(frozen=True, eq=False)
class SupportedModes:
    """Natural frequencies (n,) [Hz], ascending, damping ratios (n,), and shapes by `at`.

    reduced: the plate whose coordinates (r, n) the modes are given in.
    """

    natural_frequencies: FloatArray
    damping_ratios: FloatArray
    reduced: ReducedPlate
    coordinates: FloatArray

    def at(self, points: FloatArray) -> FloatArray:
        """Mode shapes at points [m] (p, 2), (p, n), scaled to modal mass 1 [1/sqrt(kg)]."""
        return np.asarray(self.reduced.at(points) @ self.coordinates)


def supported_modes(
    reduced: ReducedPlate,
    eras: Sequence[Era],
    *,
    loads: Sequence[PointLoad] = (),
    frequency_max: float,
) -> SupportedModes:
    """All modes up to a frequency [Hz], to which the plate must have been reduced.

    Raises InputError for ERAs that do not hold the plate.
    """
    M, C, K = modal_matrices(reduced, eras, loads=loads)
    squared, psi = linalg.eigh(K, M)
    omega = np.sqrt(squared)
    low = omega <= 2 * np.pi * frequency_max
    omega, psi = omega[low], psi[:, low]
    ratios = np.einsum("rn,rs,sn->n", psi, C, psi) / (2 * omega)
    return SupportedModes(omega / (2 * np.pi), ratios, reduced, psi)
