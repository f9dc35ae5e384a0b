"""The plate from rest under bases that move along samples of band-limited signals.

Between samples a signal is the trigonometric polynomial through them, to each of whose sinusoids
the plate in time has a closed-form solution; a free vibration makes up for what all of them are at
time 0. So no step size enters, as elsewhere in `model.transients`.
"""

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.transients.base_motion import rise
from model.transients.time_response import PlateInTime

_AT_ONCE = 512  # frequencies or samples, at some kilobytes each


def from_rest(
    plate: PlateInTime,
    signals: FloatArray,
    shapes: FloatArray,
    *,
    sample_rate: float,
    factors: ComplexArray,
) -> FloatArray:
    """Acceleration [m/s²] at the times of the samples, the first at time 0, (n, p).

    signals (eras, n) in full strokes, sampled at sample_rate [Hz]; shapes (p, r) of the reduced
    plate at points; factors (eras,): gain and phase of each ERA. Displacement and velocity of the
    plate are 0 at time 0; as with a ramp of 0, a base that jumps there passes on no impulse.
    """
    count = signals.shape[1]
    continued = _continued(signals)
    period = continued.shape[1]
    spectrum: ComplexArray = factors * np.fft.rfft(continued).T
    s = np.asarray(2j * np.pi * np.fft.rfftfreq(period, 1 / sample_rate), dtype=np.complex128)
    points = plate.with_far_ends(shapes)
    by_forced, by_free = (points @ plate.displacement).T, (points @ plate.free_acceleration).T
    forced = np.empty((len(s), len(points)), dtype=complex)
    start = np.zeros(len(plate.eigenvalues), dtype=complex)
    for first in range(0, len(s), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        z = plate.following_all(s[some], spectrum[some])
        forced[some] = s[some, None] ** 2 * (z @ by_forced)
        start += 2 * z.sum(axis=0) - (z[0] if first == 0 else 0)
    free = -plate.to_free @ (plate.vectors @ start).real / period
    ringing = [
        ((free * np.exp(np.outer(times, plate.decay))) @ by_free).real
        for times in np.array_split(np.arange(count) / sample_rate, 1 + count // _AT_ONCE)
    ]
    return np.asarray(np.fft.irfft(forced, period, axis=0)[:count] + np.concatenate(ringing))


def _continued(signals: FloatArray) -> FloatArray:
    """Signals (eras, n) that go on from their last samples and fade to rest, (eras, 2 n - 1).

    What comes later moves nothing before; a jump would show between samples. An odd number of
    samples has no frequency of half their rate.
    """
    count = signals.shape[1]
    onward = 2 * signals[:, -1:] - signals[:, -2::-1]
    fading = 1 - rise(np.arange(1.0, count), count)
    return np.hstack([signals, fading * onward])
