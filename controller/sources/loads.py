"""Loads of fingers, by what a panel reports: force, or size of the contact.

A load is relative to the rig's `fingertip`, a finger that presses lightly, and grows with the area
of contact (`Fingertip.scaled`). Area grows as the force to the power of two thirds (Hertz), and so
does the load: between the third of Hertz's stiffness and the first power of a pulp that stiffens
exponentially. docs/concepts/people.md has the sources, and how well this is known.
"""

from dataclasses import dataclass

LIGHT_FORCE = 0.5
"""Force [N] of a finger that presses lightly: the mean of a tap on a touch screen."""

LIGHT_MAJOR = 9.4
"""Longer axis [mm] of its contact: the mean of index fingers on touch screens."""

MIN_REPORTED, MAX_REPORTED = 0.4, 2.5
"""Bounds of a reported load: contacts of 6 to 15 mm, forces of 0.13 to 2 N.

Two standard deviations of the rig's default `uncertainty` of a load. What a panel reports beyond
them tells more of the panel than of the finger.
"""

LANDING = 0.1
"""Time [s] after which a finger that lands has its area of contact; until then none is reported."""

MIN_CHANGE = 1.5
"""Factor by which a reported load must differ from a contact's before that changes."""

_BY_FORCE, _BY_SIZE = 2 / 3, 2.0  # exponents of the load


@dataclass(frozen=True)
class LightPress:
    """Values of a panel's axes under a finger that presses lightly.

    None for an axis that the panel does not have, or whose unit it does not state.
    """

    pressure: float | None = None
    touch_major: float | None = None

    def load(self, *, pressure: float, touch_major: float) -> float | None:
        """Return the load of a contact with these values, not bounded; the force goes first.

        None without a positive value of an axis.
        """
        if self.pressure is not None and pressure > 0:
            return float((pressure / self.pressure) ** _BY_FORCE)
        if self.touch_major is not None and touch_major > 0:
            return float((touch_major / self.touch_major) ** _BY_SIZE)
        return None


def followed(known: float, reported: float) -> float:
    """Return the load of a contact: the known one, unless the reported one differs enough.

    Bounded.
    """
    if not reported > 0:  # NaN is not
        return known
    bounded = min(max(reported, MIN_REPORTED), MAX_REPORTED)
    change = max(bounded / known, known / bounded)
    return bounded if change >= MIN_CHANGE else known
