"""Bases that move along samples, against SciPy's integration of the equations of motion."""

import numpy as np
from scipy.signal import StateSpace, lsim

from model.reduction.reduced_plate import modal_matrices, reduce_plate
from model.structure.attachments import Fingertip, fingertip_loads, footprints_of
from model.transients.time_response import from_rest, plate_in_time
from plates import make_paper_rig

RATE, COUNT, FINER = 5000.0, 400, 64


def chirp(times: np.ndarray) -> np.ndarray:
    """A burst from 60 to 400 Hz that comes and goes smoothly within 70 ms."""
    window = np.exp(-(((times - 0.04) / 0.009) ** 2))
    return np.asarray(window * np.sin(2 * np.pi * (60 * times + 2100 * times**2)))


def test_bursts_are_followed_as_scipy_integrates() -> None:
    """Two ERAs at once, one late and turned, a finger on the plate: to 1e-4 of the peak.

    SciPy is given the bases' motion and velocity 64 times as finely, joined by straight lines. With
    twice as many samples the plate moves the same, to 1e-7, as band-limited signals say no more.
    """
    rig = make_paper_rig(12, 9)
    tips = fingertip_loads(Fingertip(), [(0.1, 0.08)])
    reduced = reduce_plate(rig.plate, rig.mesh, footprints_of(rig.eras, (), tips))
    plate = plate_in_time(reduced, rig.eras, contacts=tips)
    points = np.array([[0.1, 0.08], [0.25, 0.2]])

    def played(rate: float, count: int) -> np.ndarray:
        times, signals = np.arange(count) / rate, np.zeros((4, count))
        signals[0], signals[3] = 0.8 * chirp(times), -0.5 * chirp(times - 0.003)
        factors = np.ones(4, dtype=complex)
        return from_rest(plate, signals, reduced.at(points), sample_rate=rate, factors=factors)

    found = played(RATE, COUNT)
    finer = played(2 * RATE, 2 * COUNT)[::2]
    np.testing.assert_allclose(found, finer, atol=1e-7 * np.abs(finer).max())

    M, C, K = modal_matrices(reduced, rig.eras, contacts=tips)
    r, inverse = len(M), np.linalg.inv(M)
    phi = np.pad(reduced.at(footprints_of(rig.eras)), ((0, 0), (0, 1)))[[0, 3]].T
    A = np.block([[np.zeros((r, r)), np.eye(r)], [-inverse @ K, -inverse @ C]])
    eras = [rig.eras[0], rig.eras[3]]
    k, c = (np.array([getattr(era, key) for era in eras]) for key in ("stiffness", "damping"))
    B = np.vstack([np.zeros((r, 4)), inverse @ np.hstack([phi * k, phi * c])])
    shapes = np.pad(reduced.at(points), ((0, 0), (0, 1)))
    system = StateSpace(A, B, shapes @ A[r:], shapes @ B[r:])  # gives the acceleration
    fine = np.arange(COUNT * FINER) / (RATE * FINER)
    bases = np.array([0.8 * chirp(fine), -0.5 * chirp(fine - 0.003)]).T * rig.eras[0].stroke
    _, expected, _ = lsim(system, np.hstack([bases, np.gradient(bases, fine, axis=0)]), fine)
    np.testing.assert_allclose(found, expected[::FINER], atol=1e-4 * np.abs(expected).max())
