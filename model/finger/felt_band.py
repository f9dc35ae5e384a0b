"""The part of a vibration that skin can feel: up to 1 kHz.

Pacinian corpuscles answer to about 1 kHz (docs/concepts/people.md). What is above it in an onset is
the ringing of a fingertip's contact mass on the plate beneath it and of modes far beyond the drive,
of which models with different numbers of modes say different things.
"""

from functools import cache

import numpy as np

from model.arrays import FloatArray

_CUTOFF = 1250.0  # Hz; where half of a tone passes
_HALF_LENGTH = 0.002  # s; of the filter: 0.5 % up to 850 Hz, 40 dB from 1.65 kHz on


def felt_part(samples: FloatArray, sample_rate: float) -> FloatArray:
    """The part of samples (n, p) at a rate [Hz] that is up to 1 kHz, without delay, (n, p).

    Before and after the samples is silence. Sampled too slowly to hold more, they stay as they are.
    """
    if sample_rate <= 2 * _CUTOFF or not samples.size:
        return samples
    kernel = _kernel(sample_rate)
    beyond = len(kernel) // 2
    columns = [np.convolve(each, kernel)[beyond : beyond + len(samples)] for each in samples.T]
    return np.array(columns).T


@cache
def _kernel(sample_rate: float) -> FloatArray:
    """A windowed sinc whose sum is 1."""
    count = round(_HALF_LENGTH * sample_rate)
    number = np.arange(-count, count + 1)
    window = np.hanning(len(number) + 2)[1:-1]
    kernel = window * np.sinc(2 * _CUTOFF / sample_rate * number)
    return np.asarray(kernel / kernel.sum())
