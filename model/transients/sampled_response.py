"""Response of a plate in the time domain to samples of band-limited signals, from rest.

Between samples a signal is the trigonometric polynomial through them, with a closed-form solution
for each sinusoid; a free vibration makes up for their sum at time 0.
"""

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.transients.base_motion import rise
from model.transients.plate_in_time import PlateInTime

_BATCH = 512  # frequencies or samples per batch, some kilobytes each


def from_rest(
    plate: PlateInTime,
    signals: FloatArray,
    shapes: FloatArray,
    *,
    sample_rate: float,
    factors: ComplexArray,
) -> FloatArray:
    """Return the acceleration (n, p) [m/s²] from rest, at the times of samples from time 0 on.

    signals (eras, n) in full strokes, sampled at sample_rate [Hz]; shapes (p, r) of the reduced
    plate at points; factors (eras,): gain and phase of each ERA. Displacement and velocity of the
    plate are 0 at time 0: a base that jumps there passes on no impulse, like a ramp of 0.
    """
    count = signals.shape[1]
    continued = _continued(signals)
    period = continued.shape[1]
    spectrum: ComplexArray = factors * np.fft.rfft(continued).T
    s = np.asarray(2j * np.pi * np.fft.rfftfreq(period, 1 / sample_rate), dtype=np.complex128)
    points = plate.with_far_ends(shapes)
    forced_shapes = (points @ plate.displacement).T
    free_shapes = (points @ plate.free_acceleration).T
    forced = np.empty((len(s), len(points)), dtype=complex)
    start = np.zeros(len(plate.eigenvalues), dtype=complex)
    for first in range(0, len(s), _BATCH):
        batch = slice(first, first + _BATCH)
        z = plate.following_all(s[batch], spectrum[batch])
        forced[batch] = s[batch, None] ** 2 * (z @ forced_shapes)
        counted_twice = z[0] if first == 0 else 0  # 0 Hz has no conjugate
        start += 2 * z.sum(axis=0) - counted_twice
    free = -plate.to_free @ (plate.vectors @ start).real / period
    ringing = list[FloatArray]()
    for times in np.array_split(np.arange(count) / sample_rate, 1 + count // _BATCH):
        decays = np.exp(np.outer(times, plate.decay))
        ringing.append(((free * decays) @ free_shapes).real)
    return np.asarray(np.fft.irfft(forced, period, axis=0)[:count] + np.concatenate(ringing))


def _continued(signals: FloatArray) -> FloatArray:
    """Continue signals (eras, n) from their last samples and fade them to rest, (eras, 2 n - 1).

    The continuation has no effect on earlier times; a jump would show between samples. An odd
    number of samples has no frequency at half their rate.
    """
    count = signals.shape[1]
    onward = 2 * signals[:, -1:] - signals[:, -2::-1]
    fading = 1 - rise(np.arange(1.0, count), count)
    return np.hstack([signals, fading * onward])
