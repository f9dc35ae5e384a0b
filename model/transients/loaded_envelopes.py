"""Drives along an envelope, on a plate under fingers, by a numerical Laplace transform.

A plate under fingers has other modes, whose solution takes as long as several answers of a table.
At a complex frequency s fingers are a change of low rank of the plate on its ERAs, whose modes are
known: with displacements u0 of the fingers if they weighed nothing, receptances G between them and
their dynamic stiffness D, they hold the plate by the forces

    (1 + D G)^-1 D u0.

The demodulated response less its quasi-static part, which a slow envelope would give, is inverted
on a line s = i omega + sigma + i nu by a discrete Fourier transform: what comes after the time that
is followed returns as exp(-sigma period). For long envelopes the plate is solved every half hertz,
linear between, and as far as smooth ones have a spectrum, which ends along a raised cosine.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy import fft

from model.arrays import ComplexArray, FloatArray
from model.structure.attachments import Fingertip, coupled_forces
from model.transients.time_response import PlateInTime

_DAMPING = 5.0  # sigma times the period, by which what is late has grown

_RESOLUTION, _LONG_BAND = 0.5, 80.0  # Hz; of what is long, to each side

_GUARD = 12
"""Steps after the end that are left out: before a jump at the start the plate seems to ring, for no
spectrum is without an end, and that comes round there, where it has grown most."""


def enveloped_accelerations(
    plate: PlateInTime,
    bases: ComplexArray,
    frequency: float,
    *,
    points: FloatArray,
    fingers: Sequence[tuple[FloatArray, Fingertip]],
    envelope: FloatArray,
    step: float,
) -> ComplexArray:
    """Demodulated accelerations (n + 1, p) [m/s²] along an envelope from rest; the last is steady.

    plate: without fingers; bases (eras,): motions [m] at a frequency [Hz], times the envelope (n,),
    whose values are a step [s] apart; points (p, r): shapes; fingers: shape (r,) under each and its
    load. At the times of the envelope.
    """
    asked, envelope = len(envelope), np.pad(envelope, (0, _GUARD))
    count = len(envelope)
    growth = np.exp(_DAMPING / count * np.arange(count))
    transform, nu = np.fft.fft(envelope / growth), np.fft.fftfreq(count, step)
    lines = np.sort(nu)
    if 1 / (count * step) < _RESOLUTION:
        lines = np.arange(-_LONG_BAND, _LONG_BAND + _RESOLUTION, _RESOLUTION)
    s = np.asarray(2j * math.pi * (frequency + np.append(lines, 0.0)), dtype=complex)
    s[:-1] += _DAMPING / (count * step)
    found = _held_by(plate, s, bases, frequency, points, fingers)
    steady = found[-1]
    ends = np.sin(np.pi * np.minimum(1 - np.abs(lines / lines[0]), 0.5)) ** 2
    transient = ((found[:-1] - steady) * ends[:, None]).astype(np.complex64)
    is_near = np.abs(nu) <= lines[-1]
    after = np.clip(np.searchsorted(lines, nu[is_near]), 1, len(lines) - 1)
    share = ((lines[after] - nu[is_near]) / (lines[after] - lines[after - 1])).astype(np.float32)
    between = share[:, None] * transient[after - 1] + (1 - share[:, None]) * transient[after]
    every = np.zeros((count, len(steady)), dtype=np.complex64)
    every[is_near] = transform[is_near, None].astype(np.complex64) * between
    found = fft.ifft(every, axis=0) * growth[:, None].astype(np.float32)
    found += envelope[:, None].astype(np.float32) * steady.astype(np.complex64)
    return np.append(found[:asked], steady[None], axis=0)


def _held_by(
    plate: PlateInTime,
    s: ComplexArray,
    bases: ComplexArray,
    frequency: float,
    points: FloatArray,
    fingers: Sequence[tuple[FloatArray, Fingertip]],
) -> ComplexArray:
    """Accelerations (m, p) at complex frequencies s (m,) by bases (eras,), held by fingers."""
    single, p, k = np.complex64, len(points), len(fingers)
    gains = np.array([era.gain(np.array(frequency)) for era in plate.eras], dtype=complex)
    driven = np.array([gains * bases * each for each in (plate.by_drive, plate.by_rate)])
    shapes = plate.with_far_ends(np.vstack([points, *(shape for shape, _ in fingers)]))
    at = (shapes @ plate.displacement).astype(single)  # (p + k, 2 r)
    forced = (shapes[p:] @ plate.forced.T).astype(single)  # (k, 2 r)
    modal = (1 / (s[:, None] - plate.eigenvalues)).astype(single)
    sources = np.concatenate([(driven @ plate.participation.T).astype(single), forced])
    moved = modal @ (sources[:, None] * at).reshape(-1, at.shape[1]).T
    moved = moved.reshape(len(s), 2 + k, p + k).astype(complex)
    by_drive = moved[:, 0] + s[:, None] * moved[:, 1]
    found = by_drive[:, :p]
    if fingers:
        stiffness = np.column_stack([tip.dynamic_stiffness(-1j * s) for _, tip in fingers])
        receptance = moved[:, 2:, p:].swapaxes(1, 2)
        applied = (stiffness * by_drive[:, p:])[:, :, None]
        forces = coupled_forces(receptance, stiffness, applied)[:, :, 0]  # (m, k)
        found = found - (forces[:, None] @ moved[:, 2:, :p])[:, 0]
    return np.asarray(found * (s**2)[:, None])
