"""The sweep of a peer that leaves solving to scipy: one sparse factorisation per frequency."""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from benchmarks.plate.problem import LOSS_FACTOR, OMEGA, STROKE, hold


def sweep(
    stiffness: sparse.csc_array,
    mass: sparse.csc_array,
    touch: NDArray[np.int64],
    observe: NDArray[np.int64],
) -> NDArray[np.complex128]:
    """Acceleration (f, eras, p) from matrices (n, n) and the dof of ERAs and observed points.

    The options of SuperLU are those that make it fast here; its defaults take two to three times as
    long.
    """
    size = stiffness.shape[0]
    stiffness = ((1 + 1j * LOSS_FACTOR) * stiffness).tocsc()
    result = np.empty((len(OMEGA), len(touch), len(observe)), dtype=complex)
    for row, omega in enumerate(OMEGA):
        springs = sparse.csc_array(
            (np.full(len(touch), hold(omega)), (touch, touch)), shape=(size, size)
        )
        factor = splu(
            (stiffness - omega**2 * mass + springs).tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        force = np.zeros((size, len(touch)), dtype=complex)
        force[touch, np.arange(len(touch))] = hold(omega) * STROKE
        result[row] = -(omega**2) * factor.solve(force)[observe].T
    return result
