"""How far the magnets of exciters move against their coils on the plate.

The coil moves in the magnet by T (w - y), of the plate's motion w and the base y that stands for
the current (`Exciter.base`). Worst are drives of all exciters at full level in those phases in
which what each does to a magnet adds.
"""

import math

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.exciter_checks import Excursions, exciters_of
from model.rig.rig import Rig

_STEP = 0.5  # Hz


def relative_motions(rig: Rig, free: FreePlate, frequencies: FloatArray) -> ComplexArray:
    """Motion of each exciter's coil in its magnet by each actuator at full level, (f, eras, m) [m].

    free: the rig's plate. Without fingers, under which it moves less.
    """
    exciters, omega = exciters_of(rig), 2 * np.pi * frequencies
    places = np.array([[one.x, one.y] for one in exciters])
    fields = free.acceleration(rig.eras, frequencies, places, loads=rig.masses)
    moved = fields / -(omega**2)[:, None, None]
    for number, one in enumerate(exciters):
        moved[:, rig.eras.index(one), number] -= one.base(omega)
        moved[:, :, number] = one.excursion_by(omega, moved[:, :, number])
    return moved


def excursions_of(rig: Rig) -> Excursions:
    """The excursions within the rig's frequencies and by its level."""
    limits, allowed_by = rig.limits, np.array([one.excursion for one in exciters_of(rig)])
    low, high = limits.frequency_min, limits.frequency_max
    frequencies = np.append(np.arange(low, high, _STEP), high)
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=high)
    found = limits.level * np.abs(relative_motions(rig, free, frequencies)).sum(axis=1)
    passed = found > allowed_by
    rows = np.flatnonzero(passed.any(axis=1))
    allowed = low
    if len(rows):
        allowed = float(frequencies[rows[-1] + 1]) if rows[-1] + 1 < len(passed) else math.inf
    return Excursions(found[0], found.max(axis=0), passed.any(axis=0), allowed)
