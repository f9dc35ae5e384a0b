"""Limits of commands, which a rig file states and the guard of each amplifier enforces."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class GuardLimits:
    """Limits of one amplifier: mechanical frequency [Hz] and level (1 is full stroke).

    slew [1/s]: highest rise of a level; power: sum of squared levels over all channels; on_time
    [s]: longest vibration without a pause; duty: fraction of any ten seconds; rate [1/s]: of
    command sets that are not silent. All of these are unlimited by default.
    """

    frequency_min: float
    frequency_max: float
    level: float
    slew: float = math.inf
    power: float = math.inf
    on_time: float = math.inf
    duty: float = 1.0
    rate: float = math.inf
