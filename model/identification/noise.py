"""How noisy readings in service are, by what the plate and its fingers leave of them.

An error that is taken too large hides a change until other parameters have taken it up. The most
likely variance is that of the residuals over the numbers that no parameter takes up (D. J. C.
MacKay, Bayesian interpolation, Neural Computation 4, 1992, 415-447, eq. 4.11).
"""

from collections import deque

import numpy as np

from model.identification.settled_update import Updated

_PATTERNS = 60
_FIRST = 8.0
_LEAST = 0.3


class NoiseLevel:
    """Noise of readings relative to the largest that a `SettledPattern` states, 0.3 to 1.

    It begins at the largest. Below 0.3 a plate is never known: what a finger's model leaves counts
    as noise, too. Never above 1, or a change would make itself unremarkable.
    """

    def __init__(self) -> None:
        self._recent: deque[tuple[float, float]] = deque(maxlen=_PATTERNS)
        self.relative = 1.0

    def take(self, updated: Updated) -> None:
        """Take what an update by a pattern of this noise has left of it."""
        self._recent.append((self.relative**2 * updated.misfit, updated.freedom))
        misfit, freedom = np.array(self._recent).sum(axis=0) + _FIRST
        self.relative = float(np.clip(np.sqrt(misfit / freedom), _LEAST, 1.0))
