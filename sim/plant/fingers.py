"""Fingertips on the plate, with samples of the last ten seconds.

The load of a finger on the plate is in `sim.plant.loaded_plate`.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from model.answer.stimulus import check_on_plate
from model.arrays import ComplexArray, Float32Array, FloatArray, Point
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

    points (p, 2) [m], the center first; weights (p,) of the points in the mean over the fingertip;
    times (n,) [s]; accelerations (n, p) [m/s²].
    """

    points: FloatArray
    weights: FloatArray
    times: FloatArray
    accelerations: FloatArray


@dataclass(frozen=True, eq=False)
class _Piece:
    """Accelerations (n, p) [m/s²] at times (n,) [s] while all fingers stayed at their positions."""

    layout: FingerPositions
    times: FloatArray
    accelerations: Float32Array


class PlateFingers:
    """Fingers on a reduced plate by id, and their accelerations in the last ten seconds."""

    def __init__(self, reduced: ReducedPlate) -> None:
        self._reduced = reduced
        self._pieces: deque[_Piece] = deque()
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
            single = accelerations.astype(np.float32, copy=False)
            self._pieces.append(_Piece(self.layout, times, single))
        oldest = times[-1] - HISTORY_DURATION
        while self._pieces and self._pieces[0].times[-1] < oldest:
            self._pieces.popleft()

    def felt(self, since: float, until: float) -> dict[str, FingerRecord]:
        """The record of each finger in since <= t <= until [s], at its last position.

        The record of a finger that moved begins with its last move.
        """
        pieces = []
        last_layouts: dict[str, FingerPositions] = {}
        for piece in self._pieces:
            if piece.times[-1] >= since and piece.times[0] <= until:
                pieces.append(piece)
                for name in piece.layout.positions:
                    last_layouts[name] = piece.layout
        records = {}
        for name, layout in last_layouts.items():
            records[name] = _join(name, layout, pieces, since=since, until=until)
        return records

    def _lay_out(self, positions: Mapping[str, Point]) -> FingerPositions:
        plate = self._reduced.plate
        columns = {}
        points_by_finger = [np.zeros((0, 2))]
        weights_by_finger = [np.zeros(0)]
        start = 0
        for name, position in positions.items():
            fingertip = fingertip_points(*position, plate)
            points_by_finger.append(fingertip)
            weights_by_finger.append(fingertip_weights(*position, plate))
            columns[name] = slice(start, start + len(fingertip))
            start += len(fingertip)
        points = np.concatenate(points_by_finger)
        weights = np.concatenate(weights_by_finger)
        shapes = self._reduced.at(points)
        return FingerPositions(dict(positions), points, weights, shapes, columns)


def _join(
    name: str,
    last: FingerPositions,
    pieces: Sequence[_Piece],
    *,
    since: float,
    until: float,
) -> FingerRecord:
    """Join the pieces at a finger's last position to its record."""
    times: list[FloatArray] = []
    accelerations: list[Float32Array] = []
    for piece in reversed(pieces):
        if not times and name not in piece.layout.positions:
            continue  # lifted before the end of the window
        if piece.layout.positions.get(name) != last.positions[name]:
            break
        is_inside = (piece.times >= since) & (piece.times <= until)
        times.append(piece.times[is_inside])
        accelerations.append(piece.accelerations[is_inside, piece.layout.columns[name]])
    times.reverse()
    accelerations.reverse()
    columns = last.columns[name]
    return FingerRecord(
        points=last.points[columns],
        weights=last.weights[columns],
        times=np.concatenate(times),
        accelerations=np.concatenate(accelerations).astype(np.float64),
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
    times = record.times
    samples = record.accelerations
    if len(times):
        amplitude = np.abs(fit_tones(times - times[0], samples, frequencies))
        peak = felt_peaks(times, samples)
    else:
        amplitude = np.zeros((len(frequencies), len(record.points)))
        peak = np.zeros(len(record.points))
    return FeltVibration(record.points, record.weights, tuple(frequencies), amplitude, peak)


def felt_peaks(times: FloatArray, samples: FloatArray) -> FloatArray:
    """Peaks (p,) of the part of samples (n, p) that skin can feel, at even times (n,) [s]."""
    if len(times) < 2:
        return np.asarray(np.abs(samples).max(axis=0))
    rate = (len(times) - 1) / (times[-1] - times[0])
    felt = felt_part(samples, round(rate, 3))
    return np.asarray(np.abs(felt).max(axis=0))


def fit_tones(times: FloatArray, samples: FloatArray, frequencies: Sequence[float]) -> ComplexArray:
    """Complex amplitudes a (f, p) of Im[a exp(i omega t)] in samples (n, p), by least squares.

    frequencies [Hz].
    """
    angles = 2 * np.pi * np.outer(times, np.asarray(frequencies, dtype=float))
    basis = np.hstack([np.sin(angles), np.cos(angles)])
    fit = np.linalg.lstsq(basis, samples, rcond=None)[0]
    count = len(frequencies)
    return np.asarray(fit[:count] + 1j * fit[count:])
