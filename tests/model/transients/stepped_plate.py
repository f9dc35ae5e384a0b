"""A plate moved by its bases, integrated step by step."""

from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from kit.plates import Motion, make_paper_rig
from model.arrays import FloatArray
from model.reduction.reduced_plate import reduce_plate
from model.reduction.supported_plate import modal_matrices
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.transients.plate_in_time import PlateInTime, plate_in_time


def make_plate_in_time(*, frequency_max: float = 500.0) -> tuple[Rig, PlateInTime]:
    """The rig and its plate; modes enough for a frequency [Hz]."""
    rig = make_paper_rig(16, 12)
    reduced = reduce_plate(
        rig.plate, rig.mesh, footprints_of(rig.eras), frequency_max=frequency_max
    )
    return rig, plate_in_time(reduced, rig.eras)


def stepped_acceleration(
    plate: PlateInTime, bases: list[Motion], times: FloatArray, *, breaks: FloatArray
) -> FloatArray:
    """Acceleration of the reduced coordinates (n, r) from rest, by a tight Runge-Kutta solver.

    times (n,) ascending; breaks: where a base's velocity jumps [s], from 0 to the end.
    """
    M, C, K = modal_matrices(plate.reduced, plate.eras)
    phi = plate.reduced.at(footprints_of(plate.eras))
    inverse = np.linalg.inv(M)

    def acceleration(t: float, x: FloatArray) -> FloatArray:
        force = np.zeros(len(phi))
        for number, (era, base) in enumerate(zip(plate.eras, bases, strict=True)):
            y, dy = base(t)
            force[number] = era.stiffness * y + era.damping * dy
        q, v = np.split(x, 2)
        return np.asarray(inverse @ (phi.T @ force - C @ v - K @ q))

    def slope(t: float, x: FloatArray) -> FloatArray:
        return np.concatenate([x[len(x) // 2 :], acceleration(t, x)])

    x = np.zeros(2 * len(K))
    result = np.empty((len(times), len(K)))
    for start, stop in pairwise(breaks):
        inside = np.flatnonzero((times >= start) & (times < stop))
        moments = np.append(times[inside], stop)
        if len(moments) > 1 and moments[0] == start:
            result[inside[0]] = acceleration(start, x)
        solved = solve_ivp(
            slope, (start, stop), x, "DOP853", moments, rtol=1e-10, atol=1e-15, max_step=1e-4
        )
        for column, index in enumerate(inside):
            # Just inside the piece, so that a jump at its start has happened.
            result[index] = acceleration(max(times[index], start + 1e-12), solved.y[:, column])
        x = solved.y[:, -1]
    return result
