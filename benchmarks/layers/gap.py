"""Air in a gap by finite differences of its pressure, without shapes or modes.

Solves lap p + omega² rho b / B p = -omega² rho b w / d over the plate, p = 0 at open edges and no
slope across sealed ones, on cells with the pressure in their middles.
"""

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from model.arrays import ComplexArray, FloatArray
from model.structure.plate import AirGap


def cell_middles(length: float, width: float, cells: tuple[int, int]) -> tuple[FloatArray, ...]:
    """Coordinates x and y [m] of the middles of cells, each (nx, ny)."""
    x, y = (
        (np.arange(count) + 0.5) * side / count
        for count, side in zip(cells, (length, width), strict=True)
    )
    return tuple(np.meshgrid(x, y, indexing="ij"))


def air_pressure(
    gap: AirGap, deflection: FloatArray, frequency: float, *, length: float, width: float
) -> ComplexArray:
    """Pressure [Pa] against a deflection (nx, ny) [m] away from the gap, (nx, ny)."""
    nx, ny = deflection.shape
    omega2 = (2 * np.pi * frequency) ** 2
    inertia = gap.inertia(frequency)
    along_x = sparse.kron(_second(nx, length / nx, gap.closed), sparse.csr_array(np.eye(ny)))
    along_y = sparse.kron(sparse.csr_array(np.eye(nx)), _second(ny, width / ny, gap.closed))
    compressed = omega2 * inertia / gap.bulk_modulus(frequency) * np.ones(nx * ny)
    matrix = sparse.csc_array(along_x) + sparse.csc_array(along_y)
    matrix = sparse.csc_array(matrix + sparse.diags_array(compressed))
    source = -omega2 * inertia / gap.depth * deflection.ravel()
    return np.asarray(spsolve(matrix, source.astype(complex))).reshape(nx, ny)


def _second(count: int, step: float, closed: bool) -> sparse.csr_array:
    """Second difference [1/m²] between the middles of cells."""
    diagonal = np.full(count, -2.0)
    diagonal[[0, -1]] = -1.0 if closed else -3.0  # the edge is half a cell away
    off = np.ones(count - 1)
    whole = np.diag(off, -1) + np.diag(diagonal) + np.diag(off, 1)
    return sparse.csr_array(whole / step**2)
