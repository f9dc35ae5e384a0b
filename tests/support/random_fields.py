"""Fields of ERAs at fingertips without any physics in them."""

import numpy as np

from model.arrays import Complex64Array
from model.drive_modes.fields import Fields


def random_fields(
    seed: int,
    *,
    frequencies: int = 5,
    eras: int = 3,
    targets: int = 1,
    points: int = 3,
    quiet: int = 6,
    has_no_quiet_contacts: bool = False,
    wanted: float = 1e-6,
) -> Fields:
    """Complex normal numbers, and thresholds between 0.5 and 2; points: of each target."""
    rng = np.random.default_rng(seed)

    def field(count: int) -> Complex64Array:
        parts = rng.standard_normal((2, frequencies, eras, count))
        return (parts[0] + 1j * parts[1]).astype(np.complex64)

    threshold = rng.uniform(0.5, 2.0, frequencies).astype(np.float32)
    at_targets = tuple(field(points) for _ in range(targets))
    return Fields(at_targets, field(quiet), has_no_quiet_contacts, threshold, wanted)
