"""Response of a plate under fingers to an envelope, by a numerical Laplace transform.

The modes under fingers would take as long as several answers of a table. At a complex frequency s
fingers are a change of low rank of the plate on its ERAs, whose modes are known: with displacements
u0 of weightless fingers, receptances G between them and dynamic stiffness D, they hold the plate by
the forces (1 + D G)^-1 D u0.

The demodulated response less its quasi-static part, which a slow envelope would give, is inverted
on the line s = i omega + sigma + i nu by a discrete Fourier transform; the response after the end
of the period wraps around, attenuated by exp(-sigma period). For long envelopes the plate is solved
every half hertz, with linear interpolation, up to where smooth envelopes have a spectrum, which is
ended along a raised cosine.
"""

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from scipy import fft

from model.arrays import Complex64Array, ComplexArray, FloatArray
from model.structure.attachments import coupled_forces
from model.structure.fingertips import Fingertip
from model.transients.plate_in_time import PlateInTime

_DAMPING = 5.0
"""sigma times the period."""

_LONG_RESOLUTION = 0.5
"""Distance between lines [Hz] at which the plate is solved for long envelopes."""

_LONG_BAND = 80.0
"""Band [Hz] to each side of the frequency in which it is solved for long envelopes."""

_GUARD = 12
"""Steps after the end that are computed and left out.

Because spectra are cut off, the plate seems to ring before a jump at the start. This ringing wraps
around to the end, where the errors are largest.
"""

FingerOnShapes: TypeAlias = tuple[FloatArray, Fingertip]
"""The plate's shapes (r,) under a finger, and its load."""


def enveloped_accelerations(
    plate: PlateInTime,
    bases: ComplexArray,
    frequency: float,
    *,
    points: FloatArray,
    fingers: Sequence[FingerOnShapes],
    envelope: FloatArray,
    step: float,
) -> ComplexArray:
    """Return demodulated accelerations (n + 1, p) [m/s²] along an envelope from rest, then steady.

    At the times of the envelope, whose values (n,) are a step [s] apart. plate: without fingers;
    bases (eras,): motions [m] at a frequency [Hz], which the envelope multiplies; points (p, r):
    shapes; fingers: shape (r,) under each and its load.
    """
    padded = np.pad(envelope, (0, _GUARD))
    count = len(padded)
    period = count * step
    growth = np.exp(_DAMPING / count * np.arange(count))
    spectrum = np.fft.fft(padded / growth)
    nu = np.fft.fftfreq(count, step)

    lines = np.sort(nu)
    if 1 / period < _LONG_RESOLUTION:
        lines = np.arange(-_LONG_BAND, _LONG_BAND + _LONG_RESOLUTION, _LONG_RESOLUTION)
    s = np.asarray(2j * math.pi * (frequency + np.append(lines, 0.0)), dtype=complex)
    s[:-1] += _DAMPING / period
    response = _response_under_fingers(plate, s, bases, frequency, points, fingers)
    steady = response[-1]

    transient = ((response[:-1] - steady) * _taper(lines)[:, None]).astype(np.complex64)
    is_in_band = np.abs(nu) <= lines[-1]
    band_spectrum = spectrum[is_in_band, None].astype(np.complex64)
    transient_spectrum = np.zeros((count, len(steady)), dtype=np.complex64)
    transient_spectrum[is_in_band] = band_spectrum * (
        _between_lines(lines, transient, nu[is_in_band])
    )

    accelerations = fft.ifft(transient_spectrum, axis=0) * growth[:, None].astype(np.float32)
    accelerations += padded[:, None].astype(np.float32) * steady.astype(np.complex64)
    return np.append(accelerations[: len(envelope)], steady[None], axis=0)


def _taper(lines: FloatArray) -> FloatArray:
    """Return the raised cosine that ends a spectrum over the outer halves of ascending lines."""
    to_edge = np.minimum(1 - np.abs(lines / lines[0]), 0.5)
    return np.asarray(np.sin(np.pi * to_edge) ** 2)


def _between_lines(
    lines: FloatArray, values: Complex64Array, frequencies: FloatArray
) -> Complex64Array:
    """Interpolate values (l, p) at ascending lines (l,) linearly at frequencies (n,), (n, p)."""
    upper = np.clip(np.searchsorted(lines, frequencies), 1, len(lines) - 1)
    lower = upper - 1
    share = (lines[upper] - frequencies) / (lines[upper] - lines[lower])
    lower_share = share.astype(np.float32)[:, None]
    between: Complex64Array = lower_share * values[lower] + (1 - lower_share) * values[upper]
    return between


def _response_under_fingers(
    plate: PlateInTime,
    s: ComplexArray,
    bases: ComplexArray,
    frequency: float,
    points: FloatArray,
    fingers: Sequence[FingerOnShapes],
) -> ComplexArray:
    """Return accelerations (m, p) under fingers at complex frequencies s (m,) by bases (eras,)."""
    by_source = _by_source(plate, s, bases, frequency, points, fingers)
    by_drive = by_source[:, 0]
    by_rate = s[:, None] * by_source[:, 1]
    weightless = by_drive + by_rate
    point_count = len(points)
    displacements = weightless[:, :point_count]
    if fingers:
        stiffness = np.column_stack([tip.dynamic_stiffness(-1j * s) for _, tip in fingers])
        receptance = by_source[:, 2:, point_count:].swapaxes(1, 2)
        applied = (stiffness * weightless[:, point_count:])[:, :, None]
        forces = coupled_forces(receptance, stiffness, applied)[:, :, 0]  # (m, k)
        prevented = forces[:, None] @ by_source[:, 2:, :point_count]
        displacements = displacements - prevented[:, 0]
    return np.asarray(displacements * (s**2)[:, None])


def _by_source(
    plate: PlateInTime,
    s: ComplexArray,
    bases: ComplexArray,
    frequency: float,
    points: FloatArray,
    fingers: Sequence[FingerOnShapes],
) -> ComplexArray:
    """Return displacements (m, 2 + k, p + k) of the plate without fingers, at s (m,) by source.

    Sources: the bases' drives, their rates, and a unit force at each of the k fingers. Columns: the
    points, then the fingers.
    """
    finger_shapes = [shape for shape, _ in fingers]
    shapes = plate.with_far_ends(np.vstack([points, *finger_shapes]))
    modal_shapes = (shapes @ plate.displacement).astype(np.complex64)  # (p + k, 2 r)

    gains = np.array([era.gain(np.array(frequency)) for era in plate.eras], dtype=complex)
    driven = np.array([gains * bases * plate.by_drive, gains * bases * plate.by_rate])
    by_bases = (driven @ plate.participation.T).astype(np.complex64)  # (2, 2 r)
    by_fingers = (shapes[len(points) :] @ plate.forced.T).astype(np.complex64)  # (k, 2 r)
    sources = np.concatenate([by_bases, by_fingers])

    residues = sources[:, None] * modal_shapes
    residue_rows = residues.reshape(-1, modal_shapes.shape[1])
    poles = (1 / (s[:, None] - plate.eigenvalues)).astype(np.complex64)
    displacements = poles @ residue_rows.T
    return displacements.reshape(len(s), len(sources), len(shapes)).astype(complex)
