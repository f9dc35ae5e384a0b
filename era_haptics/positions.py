"""Positions of fingers, one or several, and their loads."""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from model.errors import InputError
from model.table.question import Point

Positions: TypeAlias = Sequence[float] | Sequence[Sequence[float]]
"""One position x, y [m], or several; also an array of shape (2,) or (n, 2)."""


def as_points(positions: Positions, *, what: str) -> tuple[Point, ...]:
    """Positions for a question; what: the argument, for the InputError."""
    try:
        found = np.asarray(positions, dtype=float)
    except (TypeError, ValueError):
        found = np.empty(1)
    if found.size == 0:
        return ()
    if found.ndim > 2 or found.shape[-1:] != (2,):
        raise InputError(
            f"{what} must be x, y in metres from the corner SW, such as (0.08, 0.06), or a list of "
            f"these, got {positions!r}"
        )
    return tuple((float(x), float(y)) for x, y in found.reshape(-1, 2))


def as_loads(loads: Sequence[float]) -> tuple[float, ...]:
    """Loads for a question; raises InputError for anything but a sequence of numbers."""
    try:
        found = np.asarray(loads, dtype=float)
    except (TypeError, ValueError):
        found = np.empty(())
    if found.ndim != 1:
        raise InputError(
            "loads must be a sequence with one number per finger, relative to the rig's fingertip, "
            f"such as [1, 1.5], got {loads!r}"
        )
    return tuple(found.tolist())
