"""Measures of onsets and endings: transient contrast, and the residual vibration of the plate."""

import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.finger import contrast_db, felt_part, fingertip_points, fingertip_weights
from model.transients.base_motion import BaseMotions, Bases
from model.transients.knots import mean_square, steady_states
from model.transients.time_response import ForcedVibration, PlateInTime
from model.vibration import Excitation

ONSET_WINDOW = 0.100
"""Time [s] from the first motion over which an onset is measured."""

ENDING_WINDOW = 0.100
"""Time [s] after the last motion of a base over which an ending is measured."""

SAMPLE_RATE = 8000.0
"""Sixteen samples to a period of 500 Hz [Hz], so that a peak is found within 2 %."""

_FINE = 32  # samples; near the root of those of an onset


class _Piece(NamedTuple):
    """A time [s] without changes: number of its forced solution, free part z, and z at its end."""

    since: float
    until: float
    forced: ForcedVibration
    number: int
    free: ComplexArray
    last: ComplexArray


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

        Of what skin can feel of them (`model.finger`); mean over the points of the
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
        plate = self._plate
        shapes = plate.shapes_at(points)
        times = np.arange(round(duration * SAMPLE_RATE)) / SAMPLE_RATE
        acceleration = np.empty((len(times), len(shapes)))
        free_shapes = (shapes @ plate.acceleration).T
        forced_shapes = (shapes @ plate.displacement).T
        for piece in self._pieces(bases, self._steady(after or {}), duration):
            first, last = np.searchsorted(times, [piece.since, piece.until]).tolist()
            acceleration[first:last] = piece.forced.acceleration(
                piece.number, times[first:last], forced_shapes
            )
            for start in range(first, last, len(self._exponentials)):
                stop = min(last, start + len(self._exponentials))
                now = piece.free * np.exp(plate.eigenvalues * (times[start] - piece.since))
                free = now[:, None] * free_shapes
                acceleration[start:stop] += self._exponentials[: stop - start] @ np.vstack(
                    [free.imag, free.real]
                )
        return acceleration

    def residual_db(self, excitation: Excitation, ending: Bases) -> float:
        """Residual vibration [dB] in the 100 ms after an ending that begins at time 0.

        Root mean square acceleration over the whole plate relative to the steady one, mean over the
        phase at which the ending begins. The bases must come to rest, and each ERA must keep its
        frequency.
        """
        end_time = max((term.end for base in ending for term in base), default=0.0)
        frequencies = sorted({tone.frequency for tone in excitation.values()})
        played = [
            excitation[era.name].frequency if era.name in excitation else frequencies[0]
            for era in self._plate.eras
        ]
        remaining = power = 0.0
        for frequency in frequencies:
            own = {name: tone for name, tone in excitation.items() if tone.frequency == frequency}
            bases = tuple(
                base if each == frequency else () for each, base in zip(played, ending, strict=True)
            )
            left = steady = self._steady(own)
            for piece in self._pieces(bases, steady, end_time):
                left = piece.last
            remaining += float((left.conj() @ self._mean_square @ left).real)
            moved = (self._plate.displacement @ steady)[: len(self._plate.reduced.omega)]
            size = float(np.linalg.norm(moved))
            power += (2 * math.pi * frequency) ** 4 * size**2
        return 10 * math.log10(remaining / power)

    def _pieces(self, bases: Bases, total: ComplexArray, duration: float) -> Iterator[_Piece]:
        """From time 0 to a duration [s], from a state z (2 r,), between changes of the bases."""
        motions = BaseMotions(bases)
        edges = sorted({0.0, *motions.moments(0, 0.0, duration), duration})
        forced = self._plate.driven(motions, [0] * len(edges), edges)
        for number, (since, until) in enumerate(pairwise(edges)):
            before, after = forced.modal([number, number], [since, until])
            free = total - before
            total = after + free * np.exp(self._plate.eigenvalues * (until - since))
            yield _Piece(since, until, forced, number, free, total)

    def _steady(self, excitation: Excitation) -> ComplexArray:
        """Steady state (2 r,) at time 0, the reference of phases."""
        state = np.zeros(len(self._plate.eigenvalues), dtype=complex)
        for number, era in enumerate(self._plate.eras):
            tone = excitation.get(era.name)
            if tone is not None:
                unit = steady_states(self._plate, 2 * math.pi * tone.frequency)[number]
                state += unit * (tone.phasor / era.full_level)
        return state
