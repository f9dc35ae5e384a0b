"""A vibration of limited duration compared with the steady one of the same drive."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from model.answer.pattern import Pattern
from model.arrays import ComplexArray, FloatArray, IntArray
from model.drive_modes.forms import Drive
from model.finger.perception import decibels


@dataclass(frozen=True)
class PulseGains:
    """Levels over the duration on the nominal plate.

    targets: level relative to the steady one [dB], of each; quiet_db_sl: level at the loudest quiet
    point over as long, at its strongest; None without one.
    """

    targets: list[float]
    quiet_db_sl: float | None

    def contrast_db(self, pattern: Pattern) -> float | None:
        """Contrast over the duration on nine of ten plates [dB]; None without quiet fingers.

        pattern: that of these gains, whose measures are the steady ones.
        """
        if self.quiet_db_sl is None:
            return None
        return promised_over_effect_db(
            pattern, pattern.level_db_sl + min(self.targets) - self.quiet_db_sl
        )


def pulse_gains(
    squares: FloatArray, weights: FloatArray, *, count: int, share: float
) -> PulseGains:
    """Gains from squared amplitudes to threshold (n + 1, k, p), the last of them lasting.

    weights (t, p): of the points of the targets, which come first; count: times within the part
    that is followed; share: of it in the duration, the rest of which is steady.
    """
    t, lasting = len(weights), squares[-1]
    sums = np.cumsum(squares[:-1], axis=0)
    sums[count:] -= sums[:-count].copy()
    power = share * sums[count - 1 :] / count + (1 - share) * lasting
    felt = (np.sqrt(power[0, :t]) * weights).sum(axis=1)
    gains = decibels(felt / (np.sqrt(lasting[:t]) * weights).sum(axis=1)).tolist()
    if len(lasting) == t:
        return PulseGains(gains, None)
    return PulseGains(gains, float(decibels(np.sqrt(power[:, t:].max()))))


@dataclass(frozen=True, eq=False)
class PulseResponses:
    """Accelerations at k fingertips over a short effect of each ERA alone at full stroke.

    rows (f,): of the table's frequencies; values (f, eras, n + 1, k, p) [m/s²]: demodulated, the
    last of the steady vibration; threshold (f,) [m/s²]; weights (t, p), count and share as for
    `pulse_gains`.
    """

    rows: IntArray
    values: ComplexArray
    threshold: FloatArray
    weights: FloatArray
    count: int
    share: float

    def gains(self, drive: Drive) -> PulseGains:
        """Gains of a drive at full level; its frequencies are rows of the table."""
        squares = np.zeros(self.values.shape[2:])
        for row, weights in drive:
            at = int(np.searchsorted(self.rows, row))
            field = np.tensordot(weights, self.values[at], axes=1)
            squares += (field.real**2 + field.imag**2) / self.threshold[at] ** 2
        return pulse_gains(squares, self.weights, count=self.count, share=self.share)


@dataclass(frozen=True)
class OverEffect:
    """A short effect along a plain ramp: its duration [s], and the solution over it.

    solve: responses at ascending rows (f,) of the table's frequencies.
    """

    duration: float
    solve: Callable[[IntArray], PulseResponses]
    _solved: dict[tuple[int, ...], PulseResponses] = field(default_factory=dict)

    def responses(self, rows: IntArray) -> PulseResponses:
        """Responses at ascending rows, solved once."""
        key = tuple(rows.tolist())
        if key not in self._solved:
            self._solved[key] = self.solve(rows)
        return self._solved[key]


_IN_PHASE = 0.1
"""Correlation of what other plates add with the nominal plate's ringing, on nine of ten of them.

So about nine of ten plates keep what is promised of a click (docs/measured/promise.md); with none,
four of five of those of four ERAs do.
"""


def contrast_over_effect(
    ringing: FloatArray, steady: FloatArray, promised: FloatArray
) -> FloatArray:
    """Contrast over a duration on nine of ten plates, as a ratio of amplitudes.

    ringing: over the duration on the nominal plate; steady, promised: of the steady vibration on
    the nominal plate, and on nine of ten. What other plates add at the quiet fingers is felt
    over the duration as at the target, in phase with the ringing by a part.
    """
    others = np.sqrt(np.maximum(promised**-2.0 - steady**-2.0, 0.0))
    own = 1.0 / ringing
    return np.asarray((own**2 + 2 * _IN_PHASE * own * others + others**2) ** -0.5)


def promised_over_effect_db(pattern: Pattern, ringing_db: float) -> float:
    """Contrast over a duration on nine of ten plates [dB], from that on the nominal plate.

    pattern: with the steady contrasts.
    """
    steady, promised = pattern.felt_contrast_db, pattern.robust_felt_contrast_db
    if steady is None or promised is None:
        return ringing_db
    ratios = 10 ** (np.array([ringing_db, steady, promised]) / 20)
    return float(decibels(contrast_over_effect(*ratios)))
