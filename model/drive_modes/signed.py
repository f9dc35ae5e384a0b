"""The drive mode `signed`: amplitudes in phase or in opposition, all ERAs at one frequency."""

import numpy as np

from model.arrays import Complex64Array
from model.drive_modes.coherent import Coherent
from model.drive_modes.phased import solve_phased


def solve_signed(
    R: Complex64Array, c: Complex64Array, _: Complex64Array | None = None
) -> Complex64Array:
    """Real weights for which |c^H w| is largest for its w^H R w, which then is w^T Re(R) w.

    A common phase of all targets is free; the best one follows from the top eigenvector of the form
    of real and imaginary part of c, in closed form by half an angle.
    """
    parts = np.stack([c.real, c.imag], axis=-1)
    solved = np.linalg.solve(R.real, parts)
    form = parts.swapaxes(1, 2) @ solved
    angle = np.arctan2(2 * form[:, 0, 1], form[:, 0, 0] - form[:, 1, 1]) / 2
    w = solved[:, :, 0] * np.cos(angle)[:, None] + solved[:, :, 1] * np.sin(angle)[:, None]
    return np.asarray(w, dtype=np.complex64)


SIGNED = Coherent(solve_signed, phases=(1, 5), iterations=8, bound=solve_phased)
