"""The drive mode `phased`: any amplitude and phase, all ERAs at one frequency, robustly.

The weights are R^-1 conj(h_target), see `model.drive_modes.coherent`. A spring or damper at an ERA
adds a force where the drive acts anyway: without errors the best contrast does not depend on it.
"""

import numpy as np

from model.arrays import Complex64Array
from model.drive_modes.coherent import Coherent


def solve_phased(
    R: Complex64Array, c: Complex64Array, _: Complex64Array | None = None
) -> Complex64Array:
    """Weights R^-1 c: the largest |c^H w| for their w^H R w, of any mode."""
    return np.asarray(np.linalg.solve(R, c[..., None])[..., 0])


PHASED = Coherent(solve_phased, phases=(1, 5), iterations=8)
