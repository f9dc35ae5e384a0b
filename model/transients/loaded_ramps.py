"""Start of a drive along a plain ramp, on a plate under fingers, by a numerical Laplace transform.

A plate under fingers has other modes, whose solution takes as long as several answers of a table.
At a complex frequency s fingers are a change of low rank of the plate on its ERAs, whose modes are
known: with displacements u0 of the fingers if they weighed nothing, receptances G between them and
their dynamic stiffness D, they hold the plate by the forces

    (1 + D G)^-1 D u0.

The demodulated response less its quasi-static part, which a slow ramp would give, is inverted on a
line s = i omega + sigma + i nu: it dies out, and its transform falls with the cube of nu.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.structure.attachments import Fingertip, coupled_forces
from model.transients.base_motion import rise
from model.transients.time_response import PlateInTime

_STEP = 0.001  # s; between the times of a response, which is demodulated
_MAX_TIMES = 48
_DAMPING = 5.0  # of sigma by the time that is followed; what comes after it returns as exp(-5)
_LINES = 8.0  # the band of the transform to each side, by the reciprocal of the ramp
_MIN_BAND = 200.0  # Hz


@dataclass(frozen=True, eq=False)
class _TransformLine:
    """Line of the transform and what it needs of a drive, for times (n,).

    p: (m,) [1/s]; transform: (m,) [s] of its envelope; inverse: (n, m); envelope: (n,).
    """

    p: ComplexArray
    transform: ComplexArray
    inverse: ComplexArray
    envelope: FloatArray

    def in_time(self, accelerations: ComplexArray) -> ComplexArray:
        """Accelerations (d, n + 1, p) in time from those on the line, (d, m + 1, p).

        The last is the steady one, of both.
        """
        steady = accelerations[:, -1:]
        transient = accelerations[:, :-1] - steady
        transient = (transient * self.transform[:, None]).astype(self.inverse.dtype)
        d, m, p = transient.shape
        found = (self.inverse @ transient.swapaxes(0, 1).reshape(m, d * p)).reshape(-1, d, p)
        lasting = self.envelope[:, None] * steady
        return np.concatenate([found.swapaxes(0, 1) + lasting, steady], axis=1)


def ramped_accelerations(
    plate: PlateInTime,
    bases: ComplexArray,
    frequency: float,
    *,
    points: FloatArray,
    fingers: Sequence[tuple[FloatArray, Fingertip]],
    ramp: float,
    duration: float,
    after: float | None,
) -> ComplexArray:
    """Demodulated accelerations (n + 1, p) [m/s²] along a raised cosine [s]; the last is steady.

    After the duration [s] the drive fades in the same way, and is followed for a time [s]; not with
    None. plate: without fingers; bases (eras,): motions [m] at a frequency [Hz]; points (p, r):
    shapes; fingers: shape (r,) under each and its load. At n times at even distances, of which
    `time_count` are within the duration.
    """
    line = _line(ramp, duration, after, _LINES, time_count(duration))
    s = 2j * math.pi * frequency + np.append(line.p, 0.0)
    springs, dampers = (each * bases for each in _by_motion(plate, frequency))
    driven = np.array([springs, dampers]) @ plate.participation.T
    factors = np.stack([np.ones_like(s), s], axis=1)
    found = _held_by(plate, s, driven, factors, np.ones((2, 1)), points, fingers)
    return np.asarray(line.in_time(found)[0])


def ramped_responses(
    plate: PlateInTime,
    frequency: float,
    *,
    points: FloatArray,
    fingers: Sequence[tuple[FloatArray, Fingertip]],
    ramp: float,
    duration: float,
    after: float | None,
) -> ComplexArray:
    """As `ramped_accelerations` of each ERA alone at full stroke: (eras, n + 1, p).

    With half of the lines and of the times, and in single precision: to choose by.
    """
    line = _line(ramp, duration, after, _LINES / 2, response_count(duration))
    s = 2j * math.pi * frequency + np.append(line.p, 0.0)
    springs, dampers = _by_motion(plate, frequency)
    strokes = np.array([era.stroke for era in plate.eras])
    factors = (springs + s[:, None] * dampers) * strokes
    driven = plate.participation.T
    found = _held_by(plate, s, driven, factors, np.eye(len(strokes)), points, fingers)
    return line.in_time(found)


def _by_motion(plate: PlateInTime, frequency: float) -> tuple[ComplexArray, ...]:
    """Force of each ERA by its motion [N/m] and by its velocity [N s/m], (eras,) each."""
    gains = np.array([era.gain(np.array(frequency)) for era in plate.eras], dtype=complex)
    return tuple(np.asarray(gains * each) for each in (plate.springs, plate.dampers))


def _held_by(
    plate: PlateInTime,
    s: ComplexArray,
    driven: ComplexArray,
    factors: ComplexArray,
    sums: FloatArray,
    points: FloatArray,
    fingers: Sequence[tuple[FloatArray, Fingertip]],
) -> ComplexArray:
    """Accelerations (d, m, p) at complex frequencies s (m,), held by fingers.

    driven (c, 2 r), factors (m, c): what drives the modes, and how strongly at each; sums (c, d):
    of it in each drive.
    """
    single, p, c, k = np.complex64, len(points), len(driven), len(fingers)
    shapes = np.vstack([points, *(shape for shape, _ in fingers)])
    at = (shapes @ plate.displacement).astype(single)  # (p + k, 2 r)
    forced = (shapes[p:] @ plate.forced.T).astype(single)  # (k, 2 r)
    modal = (1 / (s[:, None] - plate.eigenvalues)).astype(single)
    sources = np.concatenate([driven.astype(single), forced])
    moved = modal @ (sources[:, None] * at).reshape(-1, at.shape[1]).T
    moved = moved.reshape(len(s), c + k, p + k).astype(complex)
    by_drive = sums.T @ (moved[:, :c] * factors[:, :, None])  # (m, d, p + k)
    found = by_drive[:, :, :p]
    if fingers:
        stiffness = np.column_stack([tip.dynamic_stiffness(-1j * s) for _, tip in fingers])
        receptance = moved[:, c:, p:].swapaxes(1, 2)
        applied = stiffness[:, :, None] * by_drive[:, :, p:].swapaxes(1, 2)
        forces = coupled_forces(receptance, stiffness, applied)  # (m, k, d)
        found = found - forces.swapaxes(1, 2) @ moved[:, c:, :p]
    return np.asarray((found * (s**2)[:, None, None]).swapaxes(0, 1))


def time_count(duration: float) -> int:
    """Number of times within a duration [s]."""
    return min(_MAX_TIMES, max(1, math.ceil(duration / _STEP)))


def response_count(duration: float) -> int:
    """Number of times of `ramped_responses` within a duration [s]."""
    return (time_count(duration) + 1) // 2


@lru_cache(maxsize=32)
def _line(
    ramp: float, duration: float, after: float | None, lines: float, within: int
) -> _TransformLine:
    spacing = duration / within
    count = within + math.ceil((after or 0.0) / spacing)
    times = np.asarray(spacing * (np.arange(count) + 0.5), dtype=float)
    period = count * spacing
    half = math.ceil(period * max(lines / ramp, _MIN_BAND))
    step = 2 * math.pi / period
    p = _DAMPING / period + 1j * step * (np.arange(2 * half) - half + 0.5)
    side = math.pi / ramp
    late = np.exp(-p * ramp)
    transform = ((1 + late) / p - p * (1 + late) / (p**2 + side**2)) / 2
    drive = rise(times, ramp)
    if after is not None:
        transform *= 1 - np.exp(-p * duration)
        drive -= rise(np.asarray(times - duration), ramp)
    inverse = np.exp(np.outer(times, p)) * (step / (2 * math.pi))
    return _TransformLine(
        p.astype(complex), transform.astype(complex), inverse.astype(np.complex64), drive
    )
