"""Exciters by another solution than the product's: motions of magnets, and one behind a resistor.

The terms of every output are recorded as they reach the plate, sampled, and move the matrices of
plate and magnets, whose motion is integrated step by step. The exciter behind a resistor is the far
end of a sound card, in time; by the trapezoidal rule it is at a frequency f the exact circuit at
tan(pi f / rate) rate / pi, 0.14 % above at 1 kHz and 48 kHz, and less below.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.signal import bilinear_zpk, cont2discrete, sosfilt, zpk2sos

from model.arrays import ComplexArray, FloatArray
from model.reduction.reduced_plate import modal_matrices, reduce_plate
from model.rig.rig import Rig
from model.rig.rig_summary import exciters_of
from model.structure.attachments import footprints_of
from model.transients.base_motion import Motion
from sim.plant.plant import Plant

STEP = 1e-4
"""Time [s] between samples."""


@dataclass
class Outputs:
    """Terms that exciters are driven by: exciter, terms and since when [s], in order."""

    changes: list[tuple[int, Motion, float]] = field(default_factory=list)

    @classmethod
    @contextmanager
    def recorded(cls) -> Iterator["Outputs"]:
        """All that simulated plates are driven by."""
        found, obey = cls(), Plant.set_input

        def note(plant: Plant, era: int, motion: Motion, **given: Any) -> None:
            found.changes.append((era, tuple(motion), given.get("since", plant.time)))
            obey(plant, era, motion, **given)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Plant, "set_input", note)
            yield found

    def volts(self, exciters: int, *, after: float = 0.1) -> ComplexArray:
        """Voltages (n, exciters) as phasors, of which the imaginary part is played.

        From the first change to some time [s] after the last.
        """
        begin, end = self.changes[0][2], self.changes[-1][2] + after
        times = begin + STEP * np.arange(round((end - begin) / STEP))
        found: ComplexArray = np.zeros((len(times), exciters), dtype=complex)
        for number in range(exciters):
            own = [(since, motion) for era, motion, since in self.changes if era == number]
            for (since, motion), (until, _) in pairwise([*own, (end, ())]):
                first, last = np.searchsorted(times, [since, until])
                for term in motion:
                    each = times[first:last]
                    tau = each - term.start
                    wave = (term.c0 + term.c1 * tau) * np.exp(1j * term.omega * tau)
                    found[first:last, number] += np.where(
                        (each >= term.start) & (each < term.end), wave, 0
                    )
        return found


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


class ExciterCircuit:
    """Voltages before a 25 mm exciter and over a resistor in series, by that of an output.

    Inputs are these two, late by some samples as of converters, with a noise [full scale];
    is_glued: whether the coil is held. Values in SI units, written here.
    """

    outputs, inputs = 1, 2
    COIL, MAGNET, STIFFNESS, DAMPING = 1.61e-3, 109.29e-3, 3189.2, 0.7553
    FORCE_FACTOR, RESISTANCE, INDUCTANCE, SERIES = 3.63, 4.3, 1e-4, 10.0
    DELAY = 73

    def __init__(self, *, is_glued: bool, rate: float, noise: float = 1e-6) -> None:
        moving = self.MAGNET
        if not is_glued:
            moving = self.COIL * self.MAGNET / (self.COIL + self.MAGNET)
        # Current, velocity and way of the coil in the magnet.
        resistance = self.RESISTANCE + self.SERIES
        a = np.array(
            [
                [-resistance / self.INDUCTANCE, -self.FORCE_FACTOR / self.INDUCTANCE, 0],
                [self.FORCE_FACTOR / moving, -self.DAMPING / moving, -self.STIFFNESS / moving],
                [0, 1, 0],
            ]
        )
        zeros = np.roots([moving, self.DAMPING, self.STIFFNESS])  # where the coil may move freely
        analog = zeros, np.linalg.eigvals(a), self.SERIES / self.INDUCTANCE
        self._sections = zpk2sos(*bilinear_zpk(*analog, fs=rate))
        self._state = np.zeros((len(self._sections), 2))
        self._late = np.zeros((self.DELAY, 2))
        self._noise, self._random = noise, np.random.default_rng(1)

    def advance(self, played: FloatArray) -> FloatArray:
        """Samples (n, 2) for samples (n, 1)."""
        over, self._state = sosfilt(self._sections, played[:, 0], zi=self._state)
        voltages = np.stack([played[:, 0], over], axis=1)
        whole = np.concatenate([self._late, voltages])
        self._late = whole[-self.DELAY :]
        heard = whole[: len(played)]
        return heard + self._noise * self._random.normal(size=heard.shape)
