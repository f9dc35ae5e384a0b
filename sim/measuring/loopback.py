"""What cables tell: delay, converters, lost blocks, and whether inputs have the outputs' clock.

Two devices, or an aggregate of two, drift by 10 to 100 millionths. What is played in several runs
is then no longer orthogonal, and nothing else shows it where the loop-back has the right clock.
"""

from collections.abc import Sequence

import numpy as np

from drivers.errors import LinkError
from model.arrays import ComplexArray, FloatArray
from sim.measuring.multisine import PERIOD, Multisine

SILENT = 1e-5
"""Of full scale, rms: what an input without a signal stays below."""

_MAX_DELAY = 0.1  # s; lines 10 Hz apart repeat then
_NEARLY = 0.95
_STRAIGHT = 0.5  # rad
_AS_LATE = 0.02  # of the gain; one sample more at 500 Hz and 48 kHz makes 0.065
_SAME = 1e-3  # of periods; a lost block makes them differ by 0.8


def is_whole(periods: FloatArray, *, samples: int) -> bool:
    """Whether all periods of the loop-back (n,) are alike: no block was lost between them.

    Not so where it is silent, which tells nothing.
    """
    each = periods.reshape(-1, samples)
    size = np.linalg.norm(each[0])
    differ = np.linalg.norm(each - each[0], axis=1).max()
    return bool(size > SILENT * np.sqrt(samples) and differ <= _SAME * size)


def is_as_late(gain: ComplexArray, before: ComplexArray) -> bool:
    """Whether two gains (f,) have one delay, which a block lost between two runs changes."""
    return bool(np.abs(gain - before).max() <= _AS_LATE * np.abs(before).max())


def converters(response: ComplexArray) -> ComplexArray:
    """The loop-back's complex response (f,) with a modulus of 1 in the median.

    Dividing by it takes out the delay, fractions of a sample included, and the shape of filters;
    gains are left, since those of a level and of a sensitivity are stated.
    """
    return np.asarray(response / np.median(np.abs(response)))


def latency(response: ComplexArray, frequencies: FloatArray) -> float:
    """Delay [s] of a response at frequencies [Hz], from 0 to 0.1 s, by the slope of its phase.

    Lines d apart tell delays below 1 / d apart only.

    Raises LinkError where the phase is no straight line, so that nothing is known of the delay.
    """
    unit = response / np.abs(response)
    tried = np.arange(0, _MAX_DELAY, 0.1 / frequencies.max())
    alike = np.abs(np.exp(2j * np.pi * np.outer(tried, frequencies)) @ unit)
    # Lines at equal distances have several such delays: the shortest is meant.
    near = np.flatnonzero(alike > _NEARLY * alike.max())
    first_group = near[near - near[0] == np.arange(len(near))]
    nearest = tried[first_group[alike[first_group].argmax()]]
    rest = unit * np.exp(2j * np.pi * frequencies * nearest)
    phase = np.angle(rest / rest.mean())
    slope, first = np.polyfit(frequencies, phase, 1)
    if np.abs(phase - slope * frequencies - first).max() > _STRAIGHT:
        raise LinkError(
            f"loop-back: its phase must be that of a delay up to {1e3 * _MAX_DELAY:g} ms; check "
            "the cable, and that nothing else feeds this input"
        )
    return float(nearest - slope / (2 * np.pi))


TOLERANCE = 2e-6
"""Of a clock; 13 s of measuring turn 500 Hz by 5 degrees."""

_MAX_DRIFT = 1e-3  # a lost block of 64 samples at 48 kHz looks like more
_ALIKE = 0.999
_SURE = 5.0  # standard errors


def certain_drift(multisine: Multisine, runs: Sequence[FloatArray]) -> float:
    """Drift of an input's clock relative to the outputs', from whole periods of each run, (n,).

    Least squares of the phase 2 pi f t drift between the first and the last period, t apart,
    weighted by the power of each line. 0 where that is within its error, or not all that makes
    periods differ, as a lost block does.
    """
    n = multisine.samples
    first = np.array([multisine.found(each[:n]) for each in runs])
    last = np.array([multisine.found(each[-n:]) for each in runs])
    apart = PERIOD * (len(runs[0]) / n - 1)
    turned = last * first.conj()
    weights = np.abs(turned)
    slopes = np.broadcast_to(2 * np.pi * multisine.frequencies * apart, weights.shape)
    phases = np.angle(turned)
    moment = max(float((weights * slopes**2).sum()), 1e-300)
    relative = float((weights * slopes * phases).sum()) / moment
    rest = phases - slopes * relative
    error = np.sqrt(float((weights**2 * slopes**2 * rest**2).sum())) / moment
    alike = np.abs((turned * np.exp(-1j * slopes * relative)).sum()) / max(weights.sum(), 1e-300)
    size = abs(relative)
    is_certain = TOLERANCE < size < _MAX_DRIFT and size > _SURE * error and alike > _ALIKE
    return relative if is_certain else 0.0
