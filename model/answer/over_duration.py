"""Stimuli of limited duration: what fingers feel of a drive over it, onset and ringing included.

A plate follows its drive late: over 40 ms the root mean square at a finger is several decibels
below, on a sharp resonance ten decibels below, that of the steady vibration, and it rings on. A
target counts by the mean of its demodulated acceleration over the duration, another fingertip by
its power, that after the end included.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.answer.fingers import SHAPED_FROM
from model.answer.fingers_on_plate import FingerForms
from model.arrays import Complex64Array, FloatArray
from model.drive_modes.forms import Forms
from model.ensemble.touched_plate import gram
from model.transients.knots import RISE

ONSET_RAMP = 0.040
"""Duration of a plain ramp [s].

Twice what just avoids a click: the slower start gains 4 dB of contrast over the first 100 ms, and
at 20 dB SL the target still feels it after a fifth of it (docs/concepts/transients.md).
"""

_IN_PHASE = 0.1
"""Correlation of what other plates add with the nominal plate's ringing.

So about nine of ten plates keep what is promised of a click (docs/measured/promise.md); with none,
four of five of those of four ERAs do.
"""


_MIN_RINGING_TIME = 0.02  # s; over which what quiet fingers feel after the end is followed


def pulse_ramp(duration: float) -> float:
    """Plain ramp [s] of a vibration of this duration [s], a quarter of it.

    The vibration is even over its duration then: no 40 ms of a click of 40 ms are more than 0.8 dB
    (median) stronger than the first 40, along a ramp of half of it 1.5, as long as it 3 dB.
    """
    return min(ONSET_RAMP, duration / 4)


def shaped_gain(duration: float) -> float:
    """Amplitude over a duration [s] relative to the steady one with a shaped onset.

    The target follows a raised cosine, whose square has a mean of 3/8.
    """
    return math.sqrt(1 - 5 / 8 * min(RISE, duration) / duration)


@dataclass(frozen=True)
class FollowedPart:
    """Part of an effect that is followed: its duration and what is followed after it [s].

    after: None where the effect goes on; share: of the part in the duration.
    """

    duration: float
    after: float | None
    share: float

    @classmethod
    def of(cls, duration: float) -> "FollowedPart":
        """Short ones to beyond their end, where a quiet finger may feel most."""
        length = min(duration, SHAPED_FROM)  # the rest is steady
        after = max(duration / 2, _MIN_RINGING_TIME) if duration <= SHAPED_FROM else None
        return cls(length, after, length / duration)


@dataclass(frozen=True, eq=False)
class OverDuration:
    """What k fingers feel of a drive over a duration on the nominal plate.

    gains (k,): mean amplitude relative to the steady one; heard (k, p): squared amplitude to
    threshold at each point over as long, at its strongest.
    """

    gains: FloatArray
    heard: FloatArray

    @classmethod
    def of(
        cls, squares: FloatArray, weights: FloatArray, *, count: int, share: float
    ) -> "OverDuration":
        """From squared amplitudes to threshold (n + 1, k, p), the last of them lasting.

        weights (k, p): of the points in the mean; count: times within the part that is followed;
        share: of it in the duration, the rest of which is steady.
        """
        lasting, sums = squares[-1], np.cumsum(squares[:-1], axis=0)
        sums[count:] -= sums[:-count].copy()
        power = share * sums[count - 1 :] / count + (1 - share) * lasting
        felt = (np.sqrt(power[0]) * weights).sum(axis=1)
        steady = (np.sqrt(lasting) * weights).sum(axis=1)
        return cls(felt / np.maximum(steady, 1e-30), power.max(axis=0))


def on_drawn_plates(power: FloatArray, heard: FloatArray, gain: FloatArray | float) -> FloatArray:
    """Power over a duration on drawn plates (..., 1 + d), from the steady one, nominal first.

    heard (...): over the duration on the nominal plate; gain: amplitude at the target over the
    duration relative to the steady one. What other plates add is felt over the duration as at the
    target, in phase with the ringing by a part.
    """
    others = gain * np.sqrt(np.maximum(power - power[..., :1], 0.0))
    own = np.sqrt(heard)[..., None]
    return np.asarray(own * own + 2 * _IN_PHASE * own * others + others * others)


def forms_of(
    steady: Forms,
    formed: FingerForms,
    targets: Sequence[int],
    others: Sequence[int],
    over: Complex64Array,
    count: int,
) -> Forms:
    """Forms from fields over an effect (f, k, times, p, n); count: times until its end."""
    targets, others = [*targets], [*others]
    weights, (f, _, _, _, n) = formed.fingers.tips.few_weights, over.shape
    at = over[:, targets, :count].mean(axis=2)
    scale = np.sqrt(weights[others])[:, None, :, None]
    lasting, during = (
        (each[:, others] * scale / np.float32(math.sqrt(length))).reshape(f, len(others), -1, n)
        for each, length in ((formed.contacts.fields[:, :, None], 1), (over, count))
    )
    return replace(
        steady,
        targets=(at * weights[targets, :, None]).sum(axis=2).swapaxes(0, 1),
        quiet=np.ascontiguousarray(steady.quiet + gram(during) - gram(lasting)),
        level_margin=0.0,
        few=None,
        fine=None,
    )
