"""Where fingers are, as people write it: one place, or several."""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from model.errors import InputError
from model.table.question import Point

Places: TypeAlias = Sequence[float] | Sequence[Sequence[float]]
"""One place x, y [m], or several; also as an array of shape (2,) or (n, 2)."""


def as_points(places: Places, *, what: str) -> tuple[Point, ...]:
    """All of them, for a question; what: names them in the InputError for what are no places."""
    try:
        found = np.asarray(places, dtype=float)
    except (TypeError, ValueError):
        found = np.empty(1)
    if found.size == 0:
        return ()
    if found.ndim > 2 or found.shape[-1:] != (2,):
        raise InputError(
            f"{what}={places!r} is no place; a finger is at x, y in metres from the corner SW, "
            "such as (0.08, 0.06), and several are a list of such"
        )
    return tuple((float(x), float(y)) for x, y in found.reshape(-1, 2))
