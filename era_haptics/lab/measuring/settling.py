"""Settling time of a plate: how long a signal plays before its response is recorded.

A free vibration decays as exp(-decay t). It has decayed to 1 % at t = ln(100) / decay.
"""

import math

import numpy as np

from era_haptics.lab.measuring.multisine import PERIOD
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.transients.plate_in_time import plate_in_time

MIN_SETTLING = 1.0
"""Minimum settling time [s] of a run; a plate with a typical loss factor has settled."""

_MAX_SETTLING = 5.0  # s
_REMAINING = 0.01  # of a free vibration, after settling


def plate_settling_time(rig: Rig) -> float:
    """Time [s] until free vibrations have decayed to 1 %, in whole periods from 1 to 5 s.

    The slowest mode within the rig's frequency limits decides, since signals stay within them.
    Raises InputError for a plate that is not supported.
    """
    limits = rig.limits
    points = footprints_of(rig.eras, rig.masses)
    reduced = reduce_plate(rig.plate, rig.mesh, points, frequency_max=limits.frequency_max)
    modes = plate_in_time(reduced, rig.eras, loads=rig.masses).eigenvalues  # -decay + i omega
    hertz = np.abs(modes.imag) / (2 * np.pi)
    is_within = (hertz >= limits.frequency_min) & (hertz <= limits.frequency_max)
    slowest_decay = -float(modes.real[is_within].max(initial=-math.inf))
    decay = max(slowest_decay, -math.log(_REMAINING) / _MAX_SETTLING)
    periods = math.ceil(-math.log(_REMAINING) / decay / PERIOD)
    return max(MIN_SETTLING, PERIOD * periods)
