"""Limits of the number of fingers, and of commands, as given by rigs and enforced by amplifiers'
guards."""

import math
from dataclasses import dataclass

MAX_CONTACTS = 20
"""Maximum number of fingers: two people with ten, or four with five; more are an arm or a spill."""

MAX_FINGERS = 10
"""Maximum number of fingers with effects unless a daemon file sets it: the fingers of one
person."""

MAX_CONTENTS = 6
"""Maximum number of simultaneous contents; with more, no plate has any contrast left."""


@dataclass(frozen=True)
class GuardLimits:
    """Limits of one amplifier: mechanical frequency [Hz] and level (1 is full stroke).

    slew [1/s]: highest rise of a level; power: sum of squared levels over all channels; on_time
    [s]: longest vibration without a pause; duty: fraction of any ten seconds; rate [1/s]:
    command sets per second, except silent ones. All of these are unlimited by default.
    """

    frequency_min: float
    frequency_max: float
    level: float
    slew: float = math.inf
    power: float = math.inf
    on_time: float = math.inf
    duty: float = 1.0
    rate: float = math.inf


MAX_FINGER_LOAD = 10.0
"""Maximum load of a finger, in fingertips; a larger load is a resting hand."""

HAND_LOAD, MAX_HAND_LOAD = 12.0, 40.0
"""Load of a resting hand of unknown size, in fingertips, and the maximum.

The load of the heel of a hand with part of its weight is between estimates from its force to the
power of two thirds (7 fingertips for 10 N) and from its area (30 for 20 cm²).
docs/concepts/people.md states sources and uncertainty.
"""
