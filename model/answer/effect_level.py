"""Level that is felt over a vibration of limited duration, onset included.

A plate follows its drive late: over 40 ms the root mean square at a finger is several decibels
below, on a sharp resonance ten decibels below, that of the steady vibration. The ratio of the two
is predicted from the response to the ramp of each ERA, and the drive is raised by it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from model.answer.pattern import IMPERCEPTIBLE_DB_SL, ONSET_RAMP, Pattern
from model.answer.pulse_gains import PulseGains, PulseResponses, pulse_gains
from model.answer.question import SHAPED_FROM, Question
from model.arrays import Float32Array, FloatArray, IntArray
from model.finger.perception import decibels, detection_threshold
from model.structure.attachments import Fingertip, fingertip_loads
from model.table.raster_kernel import read_fingertips
from model.table.table import LocalizationTable
from model.transients.knots import RISE
from model.transients.loaded_ramps import (
    ramped_accelerations,
    ramped_responses,
    response_count,
    time_count,
)
from model.transients.ringing import ringing_time
from model.vibration.excitation import Excitation, base_amplitudes

MIN_RAISED_CONTRAST_DB = 6.0
"""Contrast over an effect down to which its drive is raised: quiet fingers feel half of it."""


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
    """Limits of a drive.

    amplitudes: largest ones [m], by ERA; power: sum of squared levels; slew: rise of one [1/s];
    lowers: whether a drive is also lowered for the quiet fingers, not only kept from a raise.
    """

    amplitudes: Mapping[str, float]
    power: float = math.inf
    slew: float = math.inf
    lowers: bool = False


@dataclass(frozen=True)
class RaisedPattern:
    """A pattern, whose measures are the steady ones, and the level felt over a duration [dB SL].

    held_back_db: by how much more it would have been raised but for the quiet fingers;
    promised_contrast_db: of it to what the loudest quiet finger feels over as long, on nine of ten
    plates; None without one.
    """

    pattern: Pattern
    level_db_sl: float
    held_back_db: float
    promised_contrast_db: float | None


class EffectLevels:
    """Levels over limited durations on the plate of a table, under the fingers of a question."""

    def __init__(self, table: LocalizationTable) -> None:
        self._table, self._plate = table, table.in_time

    def gains_db(
        self, excitation: Excitation, question: Question, *, ramp: float, duration: float
    ) -> PulseGains:
        """Levels over the duration [s] along a plain ramp [s], relative to steady ones."""
        table, part = self._table, _Part.of(duration)
        tips = read_fingertips(table, question.contacts)
        k, p, r = tips.fine.shape
        squares = np.zeros(())
        for frequency, bases in zip(*base_amplitudes(excitation, table.eras), strict=True):
            found = ramped_accelerations(
                self._plate,
                bases,
                float(frequency),
                points=tips.fine.reshape(-1, r).astype(float),
                fingers=self._fingers(tips.fine, question),
                ramp=ramp,
                duration=part.duration,
                after=part.after,
            )
            threshold = detection_threshold(frequency, table.threshold)
            squares = squares + (found.real**2 + found.imag**2) / threshold**2
        return pulse_gains(
            squares.reshape(-1, k, p),
            tips.fine_weights[: len(question.targets)].astype(float),
            count=time_count(part.duration),
            share=part.share,
        )

    def responses(self, rows: IntArray, *, question: Question, duration: float) -> PulseResponses:
        """Responses over a duration [s] along the ramp of it, at rows of the table's frequencies.

        At the few points of each fingertip by which drives are searched.
        """
        table, part = self._table, _Part.of(duration)
        tips = read_fingertips(table, question.contacts)
        k, p, r = tips.few.shape
        frequencies = table.frequencies[rows]
        values = [
            ramped_responses(
                self._plate,
                frequency,
                points=tips.few.reshape(-1, r).astype(float),
                fingers=self._fingers(tips.few, question),
                ramp=pulse_ramp(duration),
                duration=part.duration,
                after=part.after,
            )
            for frequency in frequencies.tolist()
        ]
        return PulseResponses(
            rows,
            np.array(values).reshape(len(rows), len(table.eras), -1, k, p),
            detection_threshold(frequencies, table.threshold),
            tips.few_weights[: len(question.targets)].astype(float),
            response_count(part.duration),
            part.share,
        )

    def _fingers(
        self, tips: Float32Array, question: Question
    ) -> list[tuple[FloatArray, Fingertip]]:
        """Shapes (r,) of the plate under the fingers on it, from (k, p, r), and their loads."""
        loads = fingertip_loads(self._table.fingertip, question.contacts, question.loads)
        centres = tips[: len(loads), 0].astype(float)
        return [(centre, load.fingertip) for centre, load in zip(centres, loads, strict=True)]

    def raised(
        self,
        pattern: Pattern,
        question: Question,
        *,
        level_db_sl: float,
        duration: float,
        limits: DriveLimits,
    ) -> RaisedPattern:
        """Raise or lower a pattern so that its weakest target feels a level over a duration [s].

        As far as the limits allow.
        """
        room = self._headroom_db(pattern.excitation, limits)
        is_shaped = question.envelopes
        ramp = pattern.ramp if is_shaped else pulse_ramp(duration)
        for _ in range(2):  # once more where the raised drive needs a longer ramp
            if is_shaped:
                gain, allowed = shaped_gain_db(duration), math.inf
                contrast = pattern.robust_felt_contrast_db
            else:
                gains = self.gains_db(pattern.excitation, question, ramp=ramp, duration=duration)
                gain = min(gains.targets)
                contrast = gains.contrast_db(pattern)
                allowed = _allowed_db(pattern.level_db_sl + gain, contrast, level_db_sl)
                if not limits.lowers:
                    allowed = max(allowed, 0.0)
            wanted = min(level_db_sl - pattern.level_db_sl - gain, room)
            raise_db = min(wanted, allowed)
            min_ramp = self._largest(pattern.excitation) * 10 ** (raise_db / 20) / limits.slew
            if min_ramp <= ramp:
                break
            ramp = min_ramp
        return RaisedPattern(
            replace(pattern.scaled(raise_db), ramp=ramp),
            level_db_sl=pattern.level_db_sl + raise_db + gain,
            held_back_db=wanted - raise_db,
            promised_contrast_db=contrast,
        )

    def _largest(self, excitation: Excitation) -> float:
        """The highest level 0..1 of an ERA."""
        return max(tone.amplitude / self._table.strokes[name] for name, tone in excitation.items())

    def _headroom_db(self, excitation: Excitation, limits: DriveLimits) -> float:
        """By how much [dB] a drive may be raised."""
        room = [
            limits.amplitudes[name] / tone.amplitude
            for name, tone in excitation.items()
            if tone.amplitude > 0
        ]
        power = sum(
            (tone.amplitude / self._table.strokes[name]) ** 2 for name, tone in excitation.items()
        )
        # A little less, so that rounding to the steps of a wire stays within.
        return float(decibels(min([*room, math.sqrt(limits.power / power)]))) - 1e-3


def _allowed_db(felt_db_sl: float, contrast_db: float | None, level_db_sl: float) -> float:
    """By how much [dB] quiet fingers allow to raise what is felt towards a level."""
    if contrast_db is None:
        return math.inf
    quiet_db_sl = felt_db_sl - contrast_db
    return max(level_db_sl - MIN_RAISED_CONTRAST_DB, IMPERCEPTIBLE_DB_SL) - quiet_db_sl


@dataclass(frozen=True)
class _Part:
    """Part of an effect that is followed: its duration and what is followed after it [s].

    after: None where the effect goes on; share: of the part in the duration.
    """

    duration: float
    after: float | None
    share: float

    @classmethod
    def of(cls, duration: float) -> "_Part":
        """Short ones to beyond their end, where a quiet finger may feel most."""
        length = min(duration, SHAPED_FROM)  # the rest is steady
        after = ringing_time(duration) if duration <= SHAPED_FROM else None
        return cls(length, after, length / duration)
