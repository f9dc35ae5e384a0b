"""Exciters on a plate, integrated step by step, as a second solution of their motion and heat.

The exciter behind a resistor is the far end of a sound card, in time; by the trapezoidal rule it is
at a frequency f the exact circuit at tan(pi f / rate) rate / pi, 0.14 % above at 1 kHz and 48 kHz,
and less below.
"""

import numpy as np
from scipy.signal import cont2discrete

from model.arrays import ComplexArray, FloatArray
from model.reduction.reduced_plate import reduce_plate
from model.reduction.supported_plate import modal_matrices
from model.rig.rig import Rig
from model.rig.rig_summary import exciters_of
from model.structure.attachments import footprints_of

STEP = 1e-4
"""Time [s] between samples."""


class Magnets:
    """Plate and magnets of a rig, from rest."""

    def __init__(self, rig: Rig) -> None:
        eras, places = rig.eras, footprints_of(rig.eras, rig.masses)
        reduced = reduce_plate(rig.plate, rig.mesh, places, frequency_max=rig.limits.frequency_max)
        shapes = reduced.at(places)
        M, C, K = modal_matrices(reduced, eras, loads=rig.masses, attachment_shapes=shapes)
        size, count = len(K), len(eras)
        inverse = np.linalg.inv(M)
        gaps = np.hstack([shapes[:count], -np.eye(count)])  # between the ends of each exciter
        velocities = np.hstack([np.zeros((size, size)), np.eye(size)])
        accelerations = np.hstack([-inverse @ K, -inverse @ C])
        A = np.vstack([velocities, accelerations])
        B = np.vstack([np.zeros((size, count)), inverse @ gaps.T])
        self._gaps = np.hstack([gaps, np.zeros((count, size))])
        model = (A, B, self._gaps, np.zeros((count, count)))
        self._a, self._b, *_ = cont2discrete(model, STEP)
        self._exciters = exciters_of(rig)
        models = [era.in_time for era in eras]
        self._by_drive = np.array([model.by_drive for model in models])
        self._by_rate = np.array([model.by_rate for model in models])

    def moved(self, volts: ComplexArray) -> ComplexArray:
        """Motion of each coil in its magnet (n, exciters) [m] by voltages, phasors as these.

        By Bl (u - L u' / R) / R. Their magnitude is what it is at the worst phase of all tones
        together.
        """
        rates = np.gradient(volts, STEP, axis=0)
        forces = volts * self._by_drive + rates * self._by_rate
        motion = np.empty_like(forces)
        state = np.zeros(len(self._a), dtype=complex)
        for number, force in enumerate(forces):
            motion[number] = self._gaps @ state
            state = self._a @ state + self._b @ force
        return motion

    def heat(self, volts: ComplexArray, moved: ComplexArray) -> FloatArray:
        """Power in each coil (n, exciters) [W], a mean over a cycle, back EMF included."""
        rates = np.gradient(moved, STEP, axis=0)
        powers = []
        for number, exciter in enumerate(self._exciters):
            back_emf = exciter.force_factor * rates[:, number]
            currents = (volts[:, number] - back_emf) / exciter.loop_resistance
            powers.append(np.abs(currents) ** 2 * exciter.resistance / 2)
        return np.stack(powers, axis=1)
