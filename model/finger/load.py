"""Load of a resting fingertip on the plate: a mass, a spring and a damper at its centre.

1 kN/m, 2 N s/m and 0.2 g for a finger that presses lightly. What is measured has this order and
spreads widely from finger to finger: for sideways motion 1 kN/m, 1 N s/m and 0.1 g are in use (DOI
10.1186/s40648-017-0080-8, table 1), and from 50 to 500 Hz one mass, spring and damper is a coarse
picture of a finger that presses with less than half a newton (World Haptics 2005, page 657).
"""

from collections.abc import Iterable
from dataclasses import dataclass

from model.arguments import expect_number
from model.structure.point_load import PointLoad


@dataclass(frozen=True)
class FingerLoad:
    """A finger's stiffness [N/m], damping [N s/m] and mass [kg]; by default it presses lightly.

    foot [m]: radius of its contact with the plate, 0 for a point.
    """

    stiffness: float = 1000.0
    damping: float = 2.0
    mass: float = 0.0002
    foot: float = 0.0

    def __post_init__(self) -> None:
        """Refuse values that are not finite or negative."""
        for what, unit in (
            ("stiffness", "N/m"),
            ("damping", "N s/m"),
            ("mass", "kg"),
            ("foot", "m"),
        ):
            expect_number(getattr(self, what), what=f"{what} of a finger", unit=unit)
        self.at(0.0, 0.0)

    def at(self, x: float, y: float) -> PointLoad:
        """The finger at x, y [m]."""
        return PointLoad(x, y, self.stiffness, self.damping, self.mass, self.foot)


def finger_loads(contacts: Iterable[tuple[float, float]]) -> tuple[PointLoad, ...]:
    """Loads of light fingers at contacts [m]."""
    return tuple(FingerLoad().at(x, y) for x, y in contacts)
