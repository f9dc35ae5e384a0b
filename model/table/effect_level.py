"""Level that is felt over a vibration of limited duration, onset included.

A plate follows its drive late: over 40 ms the root mean square at a finger is several decibels
below, on a sharp resonance ten decibels below, that of the steady vibration. The ratio of the two
is predicted from the response to the ramp of each ERA, and the drive is raised by it.
"""

import math
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.arrays import ComplexArray
from model.finger.fingertip import fingertip_points, fingertip_weights
from model.finger.perception import decibels, detection_threshold
from model.table.pattern import ONSET_RAMP, Pattern
from model.table.question import Point
from model.table.table import LocalizationTable
from model.transients.onset import ramp_responses
from model.transients.shaping import RISE
from model.vibration.excitation import Excitation
from model.vibration.peak import base_amplitudes

SHAPED_FROM = 0.2
"""Shortest duration [s] with a shaped onset, which settles in half of it."""

_STEP = 0.001  # s; between the times of a mean, which is of a demodulated response
_MAX_TIMES = 64
_MAX_KEPT = 128  # responses of one frequency to one ramp, some 100 kB each


def pulse_ramp(duration: float) -> float:
    """Plain ramp [s] of a vibration of this duration [s], a quarter of it.

    The vibration is even over its duration then: no 40 ms of a click of 40 ms are more than 0.8 dB
    (median) stronger than the first 40, along a ramp of half of it 1.5, as long as it 3 dB.
    """
    return min(ONSET_RAMP, duration / 4)


def shaped_gain_db(duration: float) -> float:
    """Level over a duration [s] relative to the steady one with a shaped onset [dB].

    The target follows a raised cosine, whose square has a mean of 3/8.
    """
    rise = min(RISE, duration)
    return 10 * math.log10(1 - 5 / 8 * rise / duration)


@dataclass(frozen=True)
class DriveLimits:
    """Limits of a drive: largest amplitude [m] by ERA, sum of squared levels, rise of one [1/s]."""

    amplitudes: Mapping[str, float]
    power: float = math.inf
    slew: float = math.inf


class EffectLevels:
    """Levels over limited durations on the plate of a table."""

    def __init__(self, table: LocalizationTable) -> None:
        self._plate, self._threshold = table.in_time, table.threshold
        self._strokes = {era.name: era.stroke for era in table.eras}
        self._kept: OrderedDict[tuple[float, float, float], ComplexArray] = OrderedDict()

    def gain_db(
        self, excitation: Excitation, *, ramp: float, duration: float, targets: Sequence[Point]
    ) -> list[float]:
        """Level over the duration [s] along a plain ramp [s], relative to the steady one [dB].

        One value for each target [m].
        """
        eras = self._plate.eras
        frequencies, phasors = base_amplitudes(excitation, eras)
        weights = phasors / [era.stroke for era in eras]
        thresholds = detection_threshold(frequencies, self._threshold)
        responses = [
            np.tensordot(row, self._responses(frequency, ramp, duration), 1) / threshold
            for frequency, row, threshold in zip(
                frequencies.tolist(), weights, thresholds, strict=True
            )
        ]
        gains = []
        for x, y in targets:
            plate = self._plate.reduced.plate
            shapes = self._plate.shapes_at(fingertip_points(x, y, plate))
            mean = fingertip_weights(x, y, plate)
            power = sum(np.abs(each @ shapes.T) ** 2 for each in responses)
            # The last row is the steady state.
            felt, steady = np.sqrt(power[:-1].mean(axis=0)), np.sqrt(power[-1])
            gains.append(float(decibels(felt @ mean / (steady @ mean))))
        return gains

    def raised(
        self,
        pattern: Pattern,
        *,
        level_db_sl: float,
        duration: float,
        targets: Sequence[Point],
        limits: DriveLimits,
        is_shaped: bool = False,
    ) -> tuple[Pattern, float]:
        """Raise or lower a pattern so that its weakest target feels a level over a duration [s].

        As far as the limits allow; returns the pattern, whose measures are the steady ones, and the
        level that is felt over the duration [dB SL].
        """
        room = self._headroom_db(pattern.excitation, limits)
        ramp = pattern.ramp if is_shaped else pulse_ramp(duration)
        for _ in range(2):  # once more where the raised drive needs a longer ramp
            gain = (
                shaped_gain_db(duration)
                if is_shaped
                else min(
                    self.gain_db(pattern.excitation, ramp=ramp, duration=duration, targets=targets)
                )
            )
            raise_db = min(level_db_sl - pattern.level_db_sl - gain, room)
            min_ramp = self._largest(pattern.excitation) * 10 ** (raise_db / 20) / limits.slew
            if min_ramp <= ramp:
                break
            ramp = min_ramp
        return replace(pattern.scaled(raise_db), ramp=ramp), pattern.level_db_sl + raise_db + gain

    def _largest(self, excitation: Excitation) -> float:
        """The highest level 0..1 of an ERA."""
        return max(tone.amplitude / self._strokes[name] for name, tone in excitation.items())

    def _headroom_db(self, excitation: Excitation, limits: DriveLimits) -> float:
        """By how much [dB] a drive may be raised."""
        room = [
            limits.amplitudes[name] / tone.amplitude
            for name, tone in excitation.items()
            if tone.amplitude > 0
        ]
        power = sum(
            (tone.amplitude / self._strokes[name]) ** 2 for name, tone in excitation.items()
        )
        # A little less, so that rounding to the steps of a wire stays within.
        return float(decibels(min([*room, math.sqrt(limits.power / power)]))) - 1e-3

    def _responses(self, frequency: float, ramp: float, duration: float) -> ComplexArray:
        """Demodulated accelerations of the reduced coordinates, (eras, n + 1, r), at full stroke.

        At n times evenly over the duration, and in the steady state.
        """
        key = (frequency, ramp, duration)
        if key not in self._kept:
            count = min(_MAX_TIMES, max(1, math.ceil(duration / _STEP)))
            times = duration * (np.arange(count) + 0.5) / count
            omega = np.array([2 * math.pi * frequency])
            self._kept[key] = ramp_responses(self._plate, omega, times, ramp, with_steady=True)[0]
            if len(self._kept) > _MAX_KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]
