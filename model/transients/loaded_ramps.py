"""Start of a drive along a plain ramp, on a plate under fingers, by a numerical Laplace transform.

A plate under fingers has other modes, whose solution takes as long as several answers of a table.
At a complex frequency s fingers are a change of low rank of the plate on its ERAs, whose modes are
known: with displacements u0 of the fingers if they weighed nothing, receptances G between them and
their dynamic stiffness D, they hold the plate by the forces

    D (1 + G D)^-1 u0.

The demodulated response less its quasi-static part, which a slow ramp would give, is inverted on a
line s = i omega + sigma + i nu: it dies out, and its transform falls with the cube of nu.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.structure.fingertip import Fingertip
from model.transients.time_response import PlateInTime

_STEP = 0.001  # s; between the times of a response, which is demodulated
_MAX_TIMES = 64
_DAMPING = 5.0  # of sigma by the period; what is left after it comes back as exp(-5)
_PERIODS = 2.0  # period of the transform, in durations
_LINES = 8.0  # the band of the transform to each side, by the reciprocal of the ramp
_MIN_BAND = 200.0  # Hz


@dataclass(frozen=True, eq=False)
class _Line:
    """Line of the transform and what it needs of a ramp, for times (n,).

    p: (m,) [1/s]; ramp: (m,) its transform [s]; inverse: (n, m); rise: (n,) the ramp itself.
    """

    p: ComplexArray
    ramp: ComplexArray
    inverse: ComplexArray
    rise: FloatArray


def ramped_accelerations(
    plate: PlateInTime,
    bases: ComplexArray,
    frequency: float,
    *,
    points: FloatArray,
    fingers: Sequence[tuple[FloatArray, Fingertip]],
    ramp: float,
    duration: float,
) -> ComplexArray:
    """Demodulated accelerations (n + 1, p) [m/s²] along a raised cosine [s]; the last is steady.

    plate: without fingers; bases (eras,): motions [m] at a frequency [Hz]; points (p, r): shapes;
    fingers: shape (r,) under each and its load. At n times evenly over the duration [s].
    """
    line = _line(ramp, duration)
    omega = 2 * math.pi * frequency
    s = 1j * omega + np.append(line.p, 0.0)
    stiffness, damping, gains = (
        np.array(each)
        for each in zip(
            *((era.stiffness, era.damping, era.gain(np.array(frequency))) for era in plate.eras),
            strict=True,
        )
    )
    driven = plate.participation @ np.column_stack(
        [stiffness * gains * bases, damping * gains * bases]
    )
    modal = 1 / (s[:, None] - plate.eigenvalues)
    states = modal * (driven[:, 0] + s[:, None] * driven[:, 1])  # (m, 2 r)
    if fingers:
        states -= modal * _held(plate, modal, states, fingers, s)
    accelerations = states @ (points @ plate.displacement).T * (s**2)[:, None]
    transient = (accelerations[:-1] - accelerations[-1]) * line.ramp[:, None]
    found = line.inverse @ transient + line.rise[:, None] * accelerations[-1]
    return np.asarray(np.vstack([found, accelerations[-1:]]))


def _held(
    plate: PlateInTime,
    modal: ComplexArray,
    states: ComplexArray,
    fingers: Sequence[tuple[FloatArray, Fingertip]],
    s: ComplexArray,
) -> ComplexArray:
    """Forces of fingers on the modes (m, 2 r), of states (m, 2 r) without them."""
    shapes = np.array([shape for shape, _ in fingers])
    at_fingers = shapes @ plate.displacement  # (k, 2 r)
    forces = plate.forced @ shapes.T  # (2 r, k)
    k = len(fingers)
    products = (at_fingers[:, None] * forces.T).reshape(k * k, -1)
    receptance = (modal @ products.T).reshape(len(s), k, k)
    stiffness = np.column_stack([tip.dynamic_stiffness(-1j * s) for _, tip in fingers])
    system = receptance * stiffness[:, None] + np.eye(k)
    moved = np.linalg.solve(system, (states @ at_fingers.T)[:, :, None])[:, :, 0]
    return np.asarray((stiffness * moved) @ forces.T)


@lru_cache(maxsize=32)
def _line(ramp: float, duration: float) -> _Line:
    count = min(_MAX_TIMES, max(1, math.ceil(duration / _STEP)))
    times = duration * (np.arange(count) + 0.5) / count
    period = _PERIODS * duration
    half = math.ceil(period * max(_LINES / ramp, _MIN_BAND))
    step = 2 * math.pi / period
    p = _DAMPING / period + 1j * step * (np.arange(2 * half) - half + 0.5)
    side = math.pi / ramp
    late = np.exp(-p * ramp)
    rise = np.where(times < ramp, (1 - np.cos(side * times)) / 2, 1.0)
    transform = ((1 + late) / p - p * (1 + late) / (p**2 + side**2)) / 2
    inverse = np.exp(np.outer(times, p)) * (step / (2 * math.pi))
    return _Line(p.astype(complex), transform.astype(complex), inverse, rise)
