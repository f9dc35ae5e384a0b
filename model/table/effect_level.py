"""Level that is felt over a vibration of limited duration, onset included.

A plate follows its drive late: over 40 ms the root mean square at a finger is several decibels
below, on a sharp resonance ten decibels below, that of the steady vibration. The ratio of the two
is predicted from the response to the ramp of each ERA, and the drive is raised by it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from model.finger.perception import decibels, detection_threshold
from model.structure.fingertip import fingertip_loads
from model.table.pattern import IMPERCEPTIBLE_DB_SL, ONSET_RAMP, Pattern
from model.table.question import Question
from model.table.table import LocalizationTable
from model.transients.loaded_ramps import ramped_accelerations
from model.transients.shaping import RISE
from model.vibration.excitation import Excitation
from model.vibration.peak import base_amplitudes

SHAPED_FROM = 0.2
"""Shortest duration [s] with a shaped onset, which settles in half of it."""


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
    quiet_db_sl: level of quiet fingers over the duration up to which it may be raised, None for
    those of the pattern's promise, or -10 dB SL; without it no drive is lowered for them.
    """

    amplitudes: Mapping[str, float]
    power: float = math.inf
    slew: float = math.inf
    quiet_db_sl: float | None = None


@dataclass(frozen=True)
class PulseGains:
    """A vibration of limited duration compared with the steady one.

    targets: level over the duration relative to the steady one [dB], of each; quiet_db_sl: level
    over the duration at the loudest quiet point on the plate as modelled, None without one.
    """

    targets: list[float]
    quiet_db_sl: float | None


@dataclass(frozen=True)
class RaisedPattern:
    """A pattern, whose measures are the steady ones, and the level felt over a duration [dB SL].

    held_back_db: by how much more it would have been raised but for the quiet fingers.
    """

    pattern: Pattern
    level_db_sl: float
    held_back_db: float


class EffectLevels:
    """Levels over limited durations on the plate of a table, under the fingers of a question."""

    def __init__(self, table: LocalizationTable) -> None:
        self._table, self._plate = table, table.in_time
        self._strokes = {era.name: era.stroke for era in table.eras}

    def gains_db(
        self, excitation: Excitation, question: Question, *, ramp: float, duration: float
    ) -> PulseGains:
        """Levels over the duration [s] along a plain ramp [s], relative to steady ones."""
        table, contacts, t = self._table, question.contacts, len(question.targets)
        tips = table.read_fingertips(contacts)
        k, p, r = tips.fine.shape
        loads = fingertip_loads(table.fingertip, contacts, question.loads)
        centres = tips.fine[: len(loads), 0].astype(float)
        fingers = [(c, load.fingertip) for c, load in zip(centres, loads, strict=True)]
        length = min(duration, SHAPED_FROM)  # the rest is steady
        power, steady = np.zeros(k * p), np.zeros(k * p)
        frequencies, bases = base_amplitudes(excitation, table.eras)
        thresholds = detection_threshold(frequencies, table.threshold)
        for frequency, base, threshold in zip(
            frequencies.tolist(), bases, thresholds.tolist(), strict=True
        ):
            found = ramped_accelerations(
                self._plate,
                base,
                frequency,
                points=tips.fine.reshape(-1, r).astype(float),
                fingers=fingers,
                ramp=ramp,
                duration=length,
            )
            squares = np.abs(found / threshold) ** 2
            share = length / duration
            power += share * squares[:-1].mean(axis=0) + (1 - share) * squares[-1]
            steady += squares[-1]
        levels = np.sqrt(power).reshape(k, p)
        weights = tips.fine_weights[:t].astype(float)
        felt = (levels[:t] * weights).sum(axis=1)
        gains = decibels(felt / (np.sqrt(steady).reshape(k, p)[:t] * weights).sum(axis=1))
        loudest = float(decibels(levels[t:].max())) if k > t else None
        return PulseGains(gains.tolist(), loudest)

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
            else:
                gains = self.gains_db(pattern.excitation, question, ramp=ramp, duration=duration)
                gain, allowed = min(gains.targets), _allowed_db(pattern, gains, limits)
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
        )

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


def allowed_quiet_db_sl(pattern: Pattern) -> float:
    """Level that quiet fingers may feel of a pattern as promised: its robust one, or unaware."""
    promised = pattern.highest_quiet_level_db_sl
    return IMPERCEPTIBLE_DB_SL if promised is None else max(promised, IMPERCEPTIBLE_DB_SL)


def _allowed_db(pattern: Pattern, gains: PulseGains, limits: DriveLimits) -> float:
    """By how much [dB] the quiet fingers allow to raise a pattern.

    What they feel over the duration is the ringing of the modelled plate, and what other plates
    add to the steady vibration, which lags as at the targets.
    """
    promised = pattern.highest_quiet_level_db_sl
    if promised is None or gains.quiet_db_sl is None:
        return math.inf
    steady = promised + min(gains.targets)
    felt = 10 * math.log10(10 ** (gains.quiet_db_sl / 10) + 10 ** (steady / 10))
    if limits.quiet_db_sl is None:
        return max(0.0, allowed_quiet_db_sl(pattern) - felt)
    return limits.quiet_db_sl - felt
