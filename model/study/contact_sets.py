"""Random sets of contacts on a plate, at realistic distances."""

import numpy as np

from model.arrays import FloatArray, Point, least_gap
from model.errors import InputError
from model.structure.plate import Plate

MIN_DISTANCE = 0.05
"""Minimum distance between the fingers of a contact set [m], similar to fingertips of two hands."""


def are_apart(contacts: FloatArray) -> bool:
    """Whether all contacts (n, 2) [m] are MIN_DISTANCE apart."""
    return least_gap(contacts) >= MIN_DISTANCE


def random_contacts(
    rng: np.random.Generator,
    count: int,
    plate: Plate,
    *,
    margin: float = 0.0,
    apart: float = MIN_DISTANCE,
    tries: int = 10_000,
) -> tuple[Point, ...]:
    """Draw finger positions [m] on a plate.

    margin: minimum distance from the plate's edges [m]; apart: from each other [m]. Raises
    InputError if no set of positions fits in a number of tries.
    """
    sides = np.array([plate.length, plate.width])
    if 2 * margin > sides.min():
        raise InputError(
            f"fingers must be {1000 * margin:g} mm from the edges, got a plate of "
            f"{plate.length:g} x {plate.width:g} m; use a larger plate"
        )
    for _ in range(tries):
        positions = rng.uniform(margin, sides - margin, (count, 2))
        if least_gap(positions) >= apart and plate.covers(positions).all():
            return tuple((float(x), float(y)) for x, y in positions)
    raise InputError(
        f"{count} fingers must be {1000 * apart:g} mm apart, got a plate of {plate.length:g} x "
        f"{plate.width:g} m on which {tries} random sets are not; "
        "use fewer fingers or a larger plate"
    )
