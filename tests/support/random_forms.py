"""Expected powers at fingertips without any physics in them."""

import numpy as np

from model.arrays import Complex64Array
from model.drive_modes.forms import Forms

SIGMA = 0.1
"""Relative error of each ERA's contribution."""


def random_forms(
    seed: int,
    *,
    frequencies: int = 5,
    eras: int = 3,
    targets: int = 1,
    points: int = 3,
    quiet: int = 6,
    wanted: float = 1e-6,
) -> Forms:
    """Complex normal fields at points of quiet fingertips, thresholds between 0.5 and 2."""
    rng = np.random.default_rng(seed)

    def field(*shape: int) -> Complex64Array:
        parts = rng.standard_normal((2, *shape, eras))
        return (parts[0] + 1j * parts[1]).astype(np.complex64)

    threshold = rng.uniform(0.5, 2.0, frequencies).astype(np.float32)
    at_targets = field(targets, frequencies)
    at_quiet = field(frequencies, quiet, points)
    forms = at_quiet.conj().swapaxes(2, 3) @ at_quiet / np.float32(points)
    own = np.einsum("fqii->fqi", forms)
    own *= 1 + SIGMA**2
    power = at_targets.conj()[..., :, None] * at_targets[..., None, :]
    return Forms(at_targets, power, forms, threshold, wanted, level_margin=0.0)
