"""Load of a contact, relative to the rig's `fingertip`: a lightly pressing finger.

The load grows with the contact area (`Fingertip.scaled`). Area, and so load, grows with the force
to the power of 2/3 (Hertz); this is between 1/3, the exponent of Hertz's stiffness, and 1, the
exponent of a pulp with exponential stiffening. docs/concepts/people.md gives the sources and their
uncertainty.
"""

import math
from dataclasses import dataclass

from registry.limits import HAND_LOAD, MAX_FINGER_LOAD

LIGHT_FORCE = 0.5
"""Force [N] of a lightly pressing finger: mean of taps on touch screens."""

LIGHT_MAJOR = 9.4
"""Longer axis [mm] of its contact: mean of index fingers on touch screens."""

MIN_REPORTED = 0.4
MAX_REPORTED = 2.5
"""Bounds of a reported load: contacts of 6 to 15 mm, forces of 0.13 to 2 N.

They are two standard deviations of the rig's default `uncertainty` of a load. Values outside are
due to the panel rather than the finger.
"""

MAX_FINGER_MAJOR = 25.0
"""Longer axis [mm] above which a contact is a hand; the largest fingers have 20 mm."""

HAND_MAJOR = 50.0
"""Longer axis [mm] of a hand with `HAND_LOAD`: a circle of 20 cm²."""

MAX_HAND_MAJOR = 1e3
"""Longer axis [mm] above which a reported contact counts as this long; no hand is as long."""

LANDING = 0.1
"""Time [s] until the contact area of a landing finger is stable; earlier loads are ignored."""

MIN_CHANGE = 1.5
"""Minimum factor between a reported and the current load of a contact for a change."""

_FORCE_EXPONENT = 2 / 3  # of the load
_SIZE_EXPONENT = 2.0  # of the load


@dataclass(frozen=True)
class LightPress:
    """Values of a panel's axes under a lightly pressing finger.

    None for an axis that the panel lacks, or whose unit it does not report.
    """

    pressure: float | None = None
    touch_major: float | None = None

    def load(self, *, touch_major: float, pressure: float = 0.0) -> float | None:
        """Return the load of a contact with these values; force is preferred.

        None without a positive value of an axis. A contact larger than a finger has the load of a
        hand of its size, at least HAND_LOAD; a finger has at most MAX_FINGER_LOAD.
        """
        size = touch_major / (self.touch_major or math.inf)
        if size > MAX_FINGER_MAJOR / LIGHT_MAJOR:
            major = min(size * LIGHT_MAJOR, MAX_HAND_MAJOR)  # its power is finite
            relative_size = major / HAND_MAJOR
            return HAND_LOAD * float(max(1.0, relative_size**_SIZE_EXPONENT))
        if self.pressure is not None and pressure > 0:
            load = (pressure / self.pressure) ** _FORCE_EXPONENT
            return float(min(load, MAX_FINGER_LOAD))
        return float(size**_SIZE_EXPONENT) if size > 0 else None


IN_MM = LightPress(touch_major=LIGHT_MAJOR)
"""Return the load for the longer axis [mm] of a contact."""


def followed(load: float, reported: float) -> float:
    """Return the new load of a contact: the reported load, bounded, if it differs enough."""
    if not reported > 0:  # NaN is not
        return load
    bounded = min(max(reported, MIN_REPORTED), MAX_REPORTED)
    factor = max(bounded / load, load / bounded)
    return bounded if factor >= MIN_CHANGE else load
