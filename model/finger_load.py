"""What a resting fingertip does to the plate: a mass, a spring and a damper at its centre.

1 kN/m, 2 N s/m and 0.2 g for a finger that presses lightly. What is measured has this order and
spreads widely from finger to finger: for sideways motion 1 kN/m, 1 N s/m and 0.1 g are in use (DOI
10.1186/s40648-017-0080-8, table 1), and from 50 to 500 Hz one mass, spring and damper is a coarse
picture of a finger that presses with less than half a newton (World Haptics 2005, page 657).
"""

from collections.abc import Iterable

from model.point_load import PointLoad

FINGER_STIFFNESS = 1000.0  # N/m
FINGER_DAMPING = 2.0  # N s/m
FINGER_MASS = 0.0002  # kg


def finger_loads(contacts: Iterable[tuple[float, float]]) -> tuple[PointLoad, ...]:
    """What fingers at contacts [m] do to the plate."""
    return tuple(
        PointLoad(x, y, FINGER_STIFFNESS, FINGER_DAMPING, FINGER_MASS) for x, y in contacts
    )
