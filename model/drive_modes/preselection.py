"""Frequencies that are worth a search: those of the highest bounds for one target.

|c^H w| / sqrt(w^H R w) of w = R^-1 c, R the mean over the quiet fingers, is nearly the upper bound
of a frequency's robust score, and takes one system of equations where a search takes several.
"""

import numpy as np

from model.arrays import IntArray
from model.choice import best_first
from model.drive_modes.forms import Forms

KEPT, MISSING = 16, 4
"""Frequencies kept, a multiple of what kernels take at once, and how many may miss the level."""


def preselect(forms: Forms) -> IntArray:
    """Indices of the frequencies to search for one target, ascending."""
    target = forms.targets[0].conj()
    R = np.add.reduce(forms.quiet, axis=1) / np.float32(forms.quiet.shape[1])
    w = np.linalg.solve(R, target[..., None])[..., 0]
    value = np.maximum(np.vecdot(target, w).real, 0)
    amplitude = value / np.maximum.reduce(np.abs(w), axis=1)
    order = best_first(np.sqrt(value))
    reaches = amplitude[order] >= np.float32(forms.wanted) * forms.threshold[order]
    # Those that would be better than the best, were they loud enough.
    first = int(reaches.argmax()) if reaches.any() else len(order)
    missing = order[:first][:MISSING]
    reaching = order[reaches][: KEPT - len(missing)]
    return np.sort(np.concatenate([reaching, missing]))
