"""The plate on its attachments as a low-rank correction of the free plate (Woodbury identity)."""

import numpy as np

from model.arrays import ComplexArray


def coupled_forces(
    receptance: ComplexArray, dynamic_stiffness: ComplexArray, applied: ComplexArray
) -> ComplexArray:
    """Forces F on the free plate [N], from those applied at its attachments: (I + D R) F = P.

    receptance R (..., n, n) [m/N]: of the free plate between its attachments; dynamic_stiffness
    (..., n) [N/m]: the diagonal of D; applied P (..., n, m) [N]. An attachment reacts with -D times
    its displacement R F.
    """
    system = np.eye(receptance.shape[-1]) + dynamic_stiffness[..., None] * receptance
    return np.asarray(np.linalg.solve(system, applied))


def on_diagonal(values: ComplexArray, *, rows: int) -> ComplexArray:
    """One column for each value (..., m): zero but for the value in its own row, (..., rows, m)."""
    return np.asarray(np.eye(rows, values.shape[-1]) * values[..., None, :])
