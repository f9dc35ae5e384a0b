"""Random places of fingers that are apart from each other, as fingertips of two hands are."""

import numpy as np

from model.arrays import FloatArray, Point, least_gap
from model.errors import InputError
from model.structure.plate import Plate

MIN_DISTANCE = 0.05
"""Distance of the fingers of a contact set at least [m], as fingertips of two hands."""


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
    """Draw places [m] of fingers on a plate, so far apart and from its edges [m].

    Raises InputError where no try finds any.
    """
    sides = np.array([plate.length, plate.width])
    for _ in range(tries):
        places = rng.uniform(margin, sides - margin, (count, 2))
        if least_gap(places) >= apart:
            return tuple((float(x), float(y)) for x, y in places)
    raise InputError(
        f"{count} fingers must be {1000 * apart:g} mm apart, got a plate of {plate.length:g} x "
        f"{plate.width:g} m on which {tries} random sets are not; "
        "use fewer fingers or a larger plate"
    )
