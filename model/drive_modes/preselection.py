"""Frequencies that are worth a search: those of the highest bounds for one target.

|c^H w| / sqrt(w^H R w) of w = R^-1 c, R the mean over the quiet fingers, is nearly the upper bound
of a frequency's robust score, and takes one system of equations where a search takes several.
"""

import numpy as np

from model.arrays import IntArray
from model.choice import best_first
from model.drive_modes.forms import Forms
from model.drive_modes.phased import PHASED

KEPT, MISSING = 16, 4
"""Frequencies kept, a multiple of what kernels take at once, and how many may miss the level."""


def preselect(forms: Forms) -> IntArray:
    """Indices of the frequencies to search for one target, ascending.

    Of forms whose one quiet form is the mean over the quiet fingers, without a margin of the level.
    """
    found = PHASED.search_all(forms)
    order = best_first(found.bound)
    reaches = found.score[order] > 0
    # Those that would be better than the best, were they loud enough.
    first = int(reaches.argmax()) if reaches.any() else len(order)
    missing = order[:first][:MISSING]
    reaching = order[reaches][: KEPT - len(missing)]
    return np.sort(np.concatenate([reaching, missing]))
