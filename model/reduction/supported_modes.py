"""Modes of the plate on its ERAs: natural frequencies, damping ratios and shapes.

The modes are those of the undamped plate. A damping ratio says how much of its energy such a mode
loses, psi' C psi / (2 omega) at modal mass 1, to the plate's own losses and to the dampers of the
ERAs; that dampers also couple the modes is left out here, not in the plate in time.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from model.arguments import shown
from model.arrays import FloatArray
from model.errors import InputError
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

    def __repr__(self) -> str:
        named = ", ".join(f"{frequency:.1f}" for frequency in self.natural_frequencies)
        return f"<SupportedModes at {named} Hz>"

    def at(self, points: FloatArray) -> FloatArray:
        """Mode shapes at points [m] (p, 2), (p, n), scaled to modal mass 1 [1/sqrt(kg)].

        Raises InputError for points off the plate, and what are none.
        """
        try:
            places = np.asarray(points, dtype=float)
        except (TypeError, ValueError):
            places = np.empty(0)
        if places.shape[-1:] != (2,) or places.ndim > 2:
            raise InputError(
                f"points is {shown(points)}, not places on the plate; give x, y in metres, as in "
                "[[0.1, 0.08]]"
            )
        return np.asarray(self.reduced.at(places) @ self.coordinates)


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
    eigenvalues, psi = linalg.eigh(K, M)
    omega = np.sqrt(eigenvalues)
    low = omega <= 2 * np.pi * frequency_max
    omega, psi = omega[low], psi[:, low]
    ratios = np.einsum("rn,rs,sn->n", psi, C, psi) / (2 * omega)
    return SupportedModes(omega / (2 * np.pi), ratios, reduced, psi)
