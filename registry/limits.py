"""Limits on the number and load of fingers, and on the commands for an amplifier."""

import math
from dataclasses import dataclass

MAX_CONTACTS = 20
"""Maximum number of contacts on a plate: both hands of two people. More are an arm or a spill."""

MAX_FINGERS = 10
"""Default for the maximum number of fingers with effects: both hands of a person."""

MAX_CONTENTS = 6
"""Maximum number of simultaneous contents; with more, no plate has any contrast left."""

MAX_FINGER_LOAD = 10.0
"""Maximum load of a finger, in fingertips; a larger load is a resting hand."""

HAND_LOAD = 12.0
"""Load of a resting hand of unknown size, in fingertips.

The value is between two estimates for the heel of a hand: 7 from its force (10 N, to the power of
two thirds) and 30 from its area (20 cm²). Sources and uncertainty: docs/concepts/people.md.
"""

MAX_HAND_LOAD = 40.0
"""Maximum load of a resting hand, in fingertips."""


@dataclass(frozen=True)
class GuardLimits:
    """Limits on the commands for one amplifier."""

    frequency_min: float
    """Minimum frequency of the vibration [Hz]."""
    frequency_max: float
    """Maximum frequency of the vibration [Hz]."""
    level: float
    """Maximum level of a channel; 1 is the full amplitude."""
    slew: float = math.inf
    """Maximum rise of a channel's level [1/s]."""
    power: float = math.inf
    """Maximum sum of the squared levels of all channels."""
    on_time: float = math.inf
    """Maximum duration of a vibration without a pause [s]."""
    duty: float = 1.0
    """Maximum fraction of any ten seconds in which a channel vibrates."""
    rate: float = math.inf
    """Maximum number of command sets per second, not counting silent ones [1/s]."""
