"""Measures of onsets and endings: transient contrast, and the residual vibration of the plate."""

import math
from collections import defaultdict
from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.finger.contrast import contrast_db
from model.finger.felt_band import felt_part
from model.finger.fingertip import fingertip_points, fingertip_weights
from model.transients.base_motion import Term
from model.transients.envelope import Bases
from model.transients.hats import mean_square, steady_states
from model.transients.time_response import PlateInTime
from model.vibration.excitation import Excitation

ONSET_WINDOW = 0.100
"""Time [s] from the first motion over which an onset is measured."""

ENDING_WINDOW = 0.100
"""Time [s] after the last motion of a base over which an ending is measured."""

SAMPLE_RATE = 8000.0
"""Sixteen samples to a period of 500 Hz [Hz], so that a peak is found within 2 %."""

_FINE = 32  # samples; near the root of those of an onset


class Transients:
    """Predictions of onsets and endings of a plate on its ERAs."""

    def __init__(self, plate: PlateInTime) -> None:
        self._plate = plate
        times = np.arange(round(ONSET_WINDOW * SAMPLE_RATE)) / SAMPLE_RATE
        # Products of a coarse and a fine step: an exponential costs ten times as much.
        coarse, fine = (
            np.exp(np.outer(part, plate.eigenvalues)) for part in (times[::_FINE], times[:_FINE])
        )
        exponentials = (coarse[:, None] * fine).reshape(-1, len(plate.eigenvalues))
        self._exponentials = np.hstack([exponentials.real, exponentials.imag])[: len(times)]

    @cached_property
    def _mean_square(self) -> ComplexArray:
        return mean_square(self._plate, ENDING_WINDOW)

    def contrast_db(
        self,
        bases: Bases,
        *,
        targets: Sequence[tuple[float, float]],
        quiet: Sequence[tuple[float, float]],
    ) -> float:
        """Contrast [dB] of the peaks over the first 100 ms of bases that start from rest.

        Of what skin can feel of them (`model.finger.felt_band`); mean over the points of the
        weakest target to the loudest quiet point; positions in m.
        """
        plate = self._plate.reduced.plate
        discs = [fingertip_points(*each, plate) for each in (*targets, *quiet)]
        acceleration = felt_part(self.acceleration(bases, np.concatenate(discs)), SAMPLE_RATE)
        ends = np.cumsum([len(disc) for disc in discs])[:-1]
        peaks = np.split(np.abs(acceleration).max(axis=0), ends)
        weights = [fingertip_weights(*each, plate) for each in targets]
        count = len(targets)
        return float(contrast_db(peaks[:count], np.concatenate(peaks[count:]), weights))

    def acceleration(
        self,
        bases: Bases,
        points: FloatArray,
        *,
        duration: float = ONSET_WINDOW,
        after: Excitation | None = None,
    ) -> FloatArray:
        """Acceleration [m/s²] at points [m] (p, 2) from time 0 on, every 1 / SAMPLE_RATE, (n, p).

        after: the excitation that had been steady before; None for rest.
        """
        shapes = self._plate.shapes_at(points)
        drive = _ForcedResponse(self._plate, bases)
        z = np.zeros(len(self._plate.eigenvalues), dtype=complex)
        for state in self._steady(after or {}).values():
            z += state
        times = np.arange(round(duration * SAMPLE_RATE)) / SAMPLE_RATE
        acceleration = np.empty((len(times), len(shapes)))
        free_shapes = (shapes @ self._plate.acceleration).T
        forced_shapes = (shapes @ self._plate.displacement).T
        for since, until in drive.pieces(duration):
            z = z + drive.change(since)
            first, last = (int(index) for index in np.searchsorted(times, [since, until]))
            acceleration[first:last] = drive.forced(times[first:last], since, forced_shapes)
            for start in range(first, last, len(self._exponentials)):
                stop = min(last, start + len(self._exponentials))
                now = z * np.exp(self._plate.eigenvalues * (times[start] - since))
                free = now[:, None] * free_shapes
                acceleration[start:stop] += self._exponentials[: stop - start] @ np.vstack(
                    [free.imag, free.real]
                )
            z = z * np.exp(self._plate.eigenvalues * (until - since))
        return acceleration

    def residual_db(self, excitation: Excitation, ending: Bases) -> float:
        """Residual vibration [dB] in the 100 ms after an ending that begins at time 0.

        Root mean square acceleration over the whole plate relative to the steady one, mean over the
        phase at which the ending begins. The bases must come to rest, and each ERA must keep its
        frequency.
        """
        end_time = max((term.end for base in ending for term in base), default=0.0)
        frequencies = {tone.frequency for tone in excitation.values()}
        steady = self._steady(excitation)
        still = np.zeros(len(self._plate.eigenvalues), dtype=complex)
        residual_states: dict[float, ComplexArray] = defaultdict(lambda: still)
        power = 0.0
        for number, (era, base) in enumerate(zip(self._plate.eras, ending, strict=True)):
            alone = tuple(base if other == number else () for other in range(len(ending)))
            drive = _ForcedResponse(self._plate, alone)
            tone = excitation.get(era.name)
            frequency = tone.frequency if tone else min(frequencies)
            z = steady.get(era.name, still)
            for since, until in drive.pieces(end_time):
                z = (z + drive.change(since)) * np.exp(self._plate.eigenvalues * (until - since))
            residual_states[frequency] = residual_states[frequency] + z + drive.change(end_time)
        for frequency in frequencies:
            together = sum(
                (steady[name] for name, tone in excitation.items() if tone.frequency == frequency),
                start=still,
            )
            omega = 2 * math.pi * frequency
            power += omega**4 * float(np.linalg.norm(self._plate.displacement @ together)) ** 2
        remaining = sum(
            float((z.conj() @ self._mean_square @ z).real) for z in residual_states.values()
        )
        return 10 * math.log10(remaining / power)

    def _steady(self, excitation: Excitation) -> dict[str, ComplexArray]:
        """Steady state (2 r,) of each tone alone at time 0, the reference of phases."""
        states = {}
        for number, era in enumerate(self._plate.eras):
            tone = excitation.get(era.name)
            if tone is not None:
                unit = steady_states(self._plate, 2 * math.pi * tone.frequency)[number]
                states[era.name] = unit * (tone.phasor / era.stroke)
        return states


class _ForcedResponse:
    """Particular solutions of all terms of all bases, summed for each time and omega."""

    def __init__(self, plate: PlateInTime, bases: Bases) -> None:
        together: dict[tuple[float, float, float], list[tuple[int, Term]]] = defaultdict(list)
        for era, base in enumerate(bases):
            for term in base:
                together[term.start, term.end, term.omega].append((era, term))
        self._a0 = np.empty((len(together), len(plate.eigenvalues)), dtype=complex)
        self._a1 = np.empty_like(self._a0)
        keys = np.array(list(together)).reshape(-1, 3)
        self._start, self._end, self._s = keys[:, 0], keys[:, 1], 1j * keys[:, 2]
        for row, terms in enumerate(together.values()):
            a0, a1 = plate.particular(
                [era for era, _ in terms],
                np.full(len(terms), self._s[row]),
                [term.c0 for _, term in terms],
                [term.c1 for _, term in terms],
            )
            self._a0[row], self._a1[row] = a0.sum(axis=0), a1.sum(axis=0)

    def pieces(self, duration: float) -> list[tuple[float, float]]:
        """From 0 to a duration [s], cut where terms start or end."""
        moments = {0.0, duration, *self._start.tolist(), *self._end.tolist()}
        inside = sorted(moment for moment in moments if 0 <= moment <= duration)
        return list(pairwise(inside))

    def change(self, time: float) -> ComplexArray:
        """Change of the free vibration (2 r,) where terms start or end at a time [s]."""
        sign = (self._end == time).astype(float) - (self._start == time)
        rows = np.flatnonzero(sign)
        tau = time - self._start[rows]
        size = sign[rows] * np.exp(self._s[rows] * tau)
        return np.asarray(size @ self._a0[rows] + (size * tau) @ self._a1[rows])

    def forced(self, times: FloatArray, since: float, shapes: ComplexArray) -> FloatArray:
        """Acceleration (n, p) of the terms active from a time [s] on; shapes (2 r, p)."""
        rows = np.flatnonzero((self._start <= since) & (since < self._end))
        s = self._s[rows, None]
        b0, b1 = self._a0[rows] @ shapes, self._a1[rows] @ shapes
        tau = times[:, None] - self._start[rows]
        phase_factor = np.exp(self._s[rows] * tau)
        return np.asarray(
            (phase_factor @ (s**2 * b0 + 2 * s * b1) + (phase_factor * tau) @ (s**2 * b1)).imag
        )
