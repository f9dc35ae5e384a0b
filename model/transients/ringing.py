"""Ringing of a plate over a short drive along plain ramps, from responses of each ERA alone.

A ramp also excites the plate's own modes, whose ringing is not balanced at a quiet finger. The
response to the ramp of each ERA is known in closed form, and that of a drive is their weighted sum.
"""

import math
from dataclasses import dataclass

import numpy as np

from model.arrays import ComplexArray, Float32Array, FloatArray
from model.transients.base_motion import rise
from model.transients.time_response import PlateInTime

RINGING_TIMES = 6
"""Times at which a short effect is evaluated; those of the ringing after it are as close."""

_MIN_RINGING_TIME = 0.02  # s; after a short effect, of what weights are first searched by

BATCH = 32  # frequencies solved together: some ten megabytes


@dataclass(frozen=True, eq=False)
class RampedRinging:
    """What a plate adds to a short drive at full stroke, at n times during and after it.

    envelope: (n,) of the drive; parts: (2, f, eras, n, r) real and imaginary part of the
    acceleration of the reduced coordinates beyond that of a slow drive.
    """

    envelope: Float32Array
    parts: Float32Array


def ramped_ringing(
    plate: PlateInTime, frequencies: FloatArray, *, ramp: float, duration: float
) -> RampedRinging:
    """Solve ringing at each of the frequencies (f,) [Hz]; ramp, duration [s]."""
    spacing = duration / RINGING_TIMES
    end = RINGING_TIMES
    n = end + math.ceil(max(duration / 2, _MIN_RINGING_TIME) / spacing)
    times = spacing * (np.arange(n) + 0.5)
    every = np.append(times, times[end:] - duration)
    risen = rise(every, ramp)
    envelope = risen[:n].copy()
    envelope[end:] -= risen[n:]
    found = []
    for omega in np.split(2 * np.pi * frequencies, range(BATCH, len(frequencies), BATCH)):
        responses, steady = ramp_responses(plate, omega, every, ramp)
        ringing = responses[:, :, :n] - envelope[:, None] * steady[:, :, None]
        ringing[:, :, end:] -= responses[:, :, n:]
        found.append(np.array([ringing.real, ringing.imag], dtype=np.float32))
    return RampedRinging(envelope.astype(np.float32), np.concatenate(found, axis=1))


def ramp_responses(
    plate: PlateInTime, omega: FloatArray, times: FloatArray, ramp: float
) -> tuple[ComplexArray, ComplexArray]:
    """Acceleration of the reduced coordinates to each ERA's ramp alone, (f, eras, n, r).

    And the steady one, (f, eras, r). Demodulated: without the factor exp(i omega t). Before the
    ramp is over the base moves as the sum of three exponentials, see
    `model.transients.base_motion.raised_cosine`.
    """
    side = np.pi / ramp
    coefficients = np.array([0.5, -0.25, -0.25])
    s = np.asarray(1j * (omega[:, None] + [0, side, -side]), dtype=complex)
    states, _ = plate.following(s.ravel())
    states = states.reshape(len(omega), 3, len(plate.eras), -1).swapaxes(1, 2)
    accelerations = states @ plate.displacement.T * (s**2)[:, None, :, None]

    rising = times < ramp
    phase_factors = coefficients * np.exp(1j * np.outer(times, [0, side, -side]))  # (n, 3)
    phase_factors[~rising] = [1, 0, 0]
    forced = phase_factors @ accelerations
    # Free vibration from the start of the ramp, and from its end.
    start = -(coefficients @ states)
    end = (coefficients * [1, -1, -1]) @ states - states[:, :, 0]
    rates = plate.eigenvalues - 1j * omega[:, None]
    decay = np.exp(times[:, None] * rates[:, None, :])[:, None]
    # Only from the end of the ramp on: before it, what decays fast would overflow.
    later = np.exp((times[~rising, None] - ramp) * rates[:, None, :])[:, None]
    free = start[:, :, None] * decay
    free[:, :, ~rising] += end[:, :, None] * later
    return np.asarray(forced + free @ plate.acceleration.T), accelerations[:, :, 0]
