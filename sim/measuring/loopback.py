"""What the cable from an output to an input tells: delay, converters, and lost blocks."""

import numpy as np

from drivers.errors import LinkError
from model.arrays import ComplexArray, FloatArray

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
