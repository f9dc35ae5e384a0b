"""The paper's plate on its ERAs in time: a stepping solver, amplitudes and distances."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from model.arrays import ComplexArray, FloatArray
from model.reduction.reduced_plate import modal_matrices, reduce_plate
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.transients.time_response import PlateInTime, plate_in_time
from paper_plate import make_paper_rig

Motion = Callable[[float], tuple[float, float]]
"""Displacement [m] and velocity [m/s] of a base at a time [s]."""


def make_plate_in_time(*, frequency_max: float = 500.0) -> tuple[Rig, PlateInTime]:
    """The rig and its plate; modes enough for a frequency [Hz]."""
    rig = make_paper_rig(16, 12)
    reduced = reduce_plate(
        rig.plate, rig.mesh, footprints_of(rig.eras), frequency_max=frequency_max
    )
    return rig, plate_in_time(reduced, rig.eras)


def lock_in(times: FloatArray, samples: FloatArray, frequency: float) -> ComplexArray:
    """Complex amplitudes (p,) A of Im[A exp(i w t)] in samples (n, p), by least squares."""
    w = 2 * np.pi * frequency
    basis = np.column_stack([np.sin(w * times), np.cos(w * times)])
    fit = np.linalg.lstsq(basis, samples, rcond=None)[0]
    return np.asarray(fit[0] + 1j * fit[1])


def apart(found: FloatArray, expected: FloatArray) -> float:
    """Relative L2 distance."""
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


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
