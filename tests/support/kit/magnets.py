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
        r, count, inverse = len(K), len(eras), np.linalg.inv(M)
        apart = np.hstack([shapes[:count], -np.eye(count)])
        A = np.block([[np.zeros((r, r)), np.eye(r)], [-inverse @ K, -inverse @ C]])
        B = np.vstack([np.zeros((r, count)), inverse @ apart.T])
        self._out = np.hstack([apart, np.zeros((count, r))])
        self._a, self._b, *_ = cont2discrete((A, B, self._out, np.zeros((count, count))), STEP)
        self._exciters = exciters_of(rig)
        parts = [era.in_time for era in eras]
        self._by_drive, self._by_rate = (
            np.array([getattr(each, key) for each in parts]) for key in ("by_drive", "by_rate")
        )

    def moved(self, volts: ComplexArray) -> ComplexArray:
        """Motion of each coil in its magnet (n, exciters) [m] by voltages, phasors as these.

        By Bl (u - L u' / R) / R. Their magnitude is what it is at the worst phase of all tones
        together.
        """
        forces = volts * self._by_drive + np.gradient(volts, STEP, axis=0) * self._by_rate
        state, found = np.zeros(len(self._a), dtype=complex), np.empty_like(forces)
        for number, force in enumerate(forces):
            found[number] = self._out @ state
            state = self._a @ state + self._b @ force
        return found

    def heat(self, volts: ComplexArray, moved: ComplexArray) -> FloatArray:
        """Power in each coil (n, exciters) [W], a mean over a cycle, back EMF included."""
        rates = np.gradient(moved, STEP, axis=0)
        found = []
        for number, one in enumerate(self._exciters):
            current = volts[:, number] - one.force_factor * rates[:, number]
            found.append(np.abs(current / one.loop_resistance) ** 2 * one.resistance / 2)
        return np.stack(found, axis=1)
