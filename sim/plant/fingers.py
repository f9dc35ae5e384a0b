"""Fingertips on the plate, with samples of the last ten seconds.

The load of a finger on the plate is in `sim.plant.plant`.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from model.answer.stimulus import check_on_plate
from model.arrays import ComplexArray, FloatArray, Point
from model.errors import InputError
from model.finger import felt_part, fingertip_points, fingertip_weights
from model.reduction.reduced_plate import ReducedPlate

HISTORY_DURATION = 10.0  # s
_MAX_FINGERS = 32  # four people with eight fingers each


@dataclass(frozen=True, eq=False)
class FingerPositions:
    """Positions of fingers, the points of their tips (p, 2) [m], and the shapes there.

    weights (p,): of the points in the mean over their tip; shapes (p, r); columns: the points of
    each finger.
    """

    positions: Mapping[str, Point]
    points: FloatArray
    weights: FloatArray
    shapes: FloatArray
    columns: Mapping[str, slice]


@dataclass(frozen=True)
class FingerRecord:
    """Accelerations under one finger while it stayed at one position.

    points (p, 2) [m], the centre first, weights (p,) in the mean over the tip; times (n,) [s];
    accelerations (n, p) [m/s²].
    """

    points: FloatArray
    weights: FloatArray
    times: FloatArray
    accelerations: FloatArray


class PlateFingers:
    """Fingers on a reduced plate by id, and their accelerations in the last ten seconds."""

    def __init__(self, reduced: ReducedPlate) -> None:
        self._reduced = reduced
        self._pieces: deque[tuple[FingerPositions, FloatArray, FloatArray]] = deque()
        self.layout = self._lay_out({})

    def place(self, positions: Mapping[str, Point], *, reduced: ReducedPlate | None = None) -> None:
        """Replace the fingers by those at these positions [m]; InputError changes nothing.

        reduced: the plate in new coordinates, if they change.
        """
        self.check(positions)
        reduced = reduced or self._reduced
        if dict(positions) != dict(self.layout.positions) or reduced is not self._reduced:
            self._reduced = reduced
            self.layout = self._lay_out(positions)

    def check(self, positions: Mapping[str, Point]) -> None:
        """Raise InputError for too many fingers, or positions [m] off the plate."""
        if len(positions) > _MAX_FINGERS:
            raise InputError(
                f"number of fingers must be at most {_MAX_FINGERS}, got {len(positions)}"
            )
        for name, position in positions.items():
            check_on_plate(f"finger {name}", [position], self._reduced.plate)

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Keep samples at the points of the layout: times (n,) [s], accelerations (n, p) [m/s²]."""
        if accelerations.shape[1]:
            self._pieces.append((self.layout, times, accelerations.astype(np.float32, copy=False)))
        while self._pieces and self._pieces[0][1][-1] < times[-1] - HISTORY_DURATION:
            self._pieces.popleft()

    def felt(self, since: float, until: float) -> dict[str, FingerRecord]:
        """The record of each finger in since <= t <= until [s], at its last position.

        Of a finger that moved only the part after the last move is included.
        """
        pieces = [piece for piece in self._pieces if piece[1][-1] >= since and piece[1][0] <= until]
        last = {name: layout for layout, _, _ in pieces for name in layout.positions}
        return {
            name: _join(name, layout, pieces, since=since, until=until)
            for name, layout in last.items()
        }

    def _lay_out(self, positions: Mapping[str, Point]) -> FingerPositions:
        plate, columns = self._reduced.plate, {}
        points, weights = [np.zeros((0, 2))], [np.zeros(0)]
        start = 0
        for name, at in positions.items():
            points.append(fingertip_points(*at, plate))
            weights.append(fingertip_weights(*at, plate))
            columns[name] = slice(start, start + len(points[-1]))
            start += len(points[-1])
        together = np.concatenate(points)
        shapes = self._reduced.at(together)
        return FingerPositions(dict(positions), together, np.concatenate(weights), shapes, columns)


def _join(
    name: str,
    last: FingerPositions,
    pieces: list[tuple[FingerPositions, FloatArray, FloatArray]],
    *,
    since: float,
    until: float,
) -> FingerRecord:
    """Join the pieces at a finger's last position to its record."""
    stay: list[tuple[FloatArray, FloatArray]] = []
    for layout, times, accelerations in reversed(pieces):
        if not stay and name not in layout.positions:
            continue  # lifted before the end of the window
        if layout.positions.get(name) != last.positions[name]:
            break
        inside = (times >= since) & (times <= until)
        stay.append((times[inside], accelerations[inside, layout.columns[name]]))
    stay.reverse()
    return FingerRecord(
        points=last.points[last.columns[name]],
        weights=last.weights[last.columns[name]],
        times=np.concatenate([times for times, _ in stay]),
        accelerations=np.concatenate([part for _, part in stay]).astype(np.float64),
    )


@dataclass(frozen=True)
class FeltVibration:
    """points (p, 2) [m]; frequencies (f,) [Hz]; amplitude (f, p) [m/s²]; peak (p,) [m/s²].

    weights (p,): of the points in the mean over the fingertip.
    """

    points: FloatArray
    weights: FloatArray
    frequencies: tuple[float, ...]
    amplitude: FloatArray
    peak: FloatArray


def measure_vibration(record: FingerRecord, frequencies: Sequence[float]) -> FeltVibration:
    """Peak at each point up to 1 kHz, and the amplitude of each frequency [Hz] by least squares.

    The fit of sines and cosines assumes steady vibration: the window must exclude transients, and
    be longer than the inverse of the smallest frequency difference. With fewer samples than
    unknowns the result is the minimum-norm solution.
    """
    times, samples = record.times, record.accelerations
    count, points = len(frequencies), len(record.points)
    if not len(times):
        amplitude, peak = np.zeros((count, points)), np.zeros(points)
    else:
        amplitude = np.abs(fit_tones(times - times[0], samples, frequencies))
        peak = felt_peaks(times, samples)
    return FeltVibration(record.points, record.weights, tuple(frequencies), amplitude, peak)


def felt_peaks(times: FloatArray, samples: FloatArray) -> FloatArray:
    """Peaks (p,) of what skin can feel of evenly spaced samples (n, p) at times (n,) [s]."""
    if len(times) < 2:
        return np.asarray(np.abs(samples).max(axis=0))
    rate = (len(times) - 1) / (times[-1] - times[0])
    return np.asarray(np.abs(felt_part(samples, round(rate, 3))).max(axis=0))


def fit_tones(times: FloatArray, samples: FloatArray, frequencies: Sequence[float]) -> ComplexArray:
    """Complex amplitudes a (f, p) of Im[a exp(i omega t)] in samples (n, p), by least squares.

    frequencies [Hz].
    """
    angles = 2 * np.pi * np.outer(times, np.asarray(frequencies, dtype=float))
    basis = np.hstack([np.sin(angles), np.cos(angles)])
    fit = np.linalg.lstsq(basis, samples, rcond=None)[0]
    count = len(frequencies)
    return np.asarray(fit[:count] + 1j * fit[count:])
