"""Envelopes of stimuli and drives: pulses, courses and ramps, and their effect at fingers.

The plate needs time to follow its drive. Over 40 ms, the RMS at a finger is several decibels below
the steady vibration, and ten decibels below it on a sharp resonance; the plate rings after the end.
The model therefore assumes that a target finger feels the mean of its demodulated acceleration over
the duration. At other fingers, the power counts, including ringing. With a course, both are
evaluated over its strongest moments (`DriveEnvelope`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy import fft

from model.arrays import FloatArray
from model.errors import InputError
from model.transients.base_motion import rise
from model.transients.excursions import CLICKS_APART, DECAYED, Swing
from model.transients.knots import RISE

ONSET_RAMP = 0.040
"""Duration of a plain ramp [s].

Twice what just avoids a click: the slower start gains 4 dB of contrast over the first 100 ms, and
at 20 dB SL the target still feels it after a fifth of the ramp (docs/concepts/transients.md).
"""

FADE_RAMP = 0.020
"""Duration of the fade under fingers that stay on the plate [s]; a shorter one feels like a tap."""

SHAPED_FROM = 0.2
"""Shortest duration of a stimulus with a shaped onset [s], which settles in half of that."""

COURSE_KNOT_STEP = 0.010
"""Interval of the knots with which amplifiers play an envelope [s], if the wires are fast
enough."""

STRONGEST = 0.040
"""Total time of the strongest moments of an envelope, which determine how it feels [s]."""

SILENCE = 1e-6
"""Replaces 0, so that levels are finite."""

_RINGING = 0.100
"""Time after a short effect over which the ringing at other fingers counts [s].

Weights suppress ringing only for this time: with 20 ms it was up to 7 dB stronger afterwards on
four ERAs, and 18 dB on a large table.
"""

_REPEATED = 0.5
"""Time [s] after the first turn for which a repeating course is predicted.

From then on, the plate's response changes by less than half a decibel.
"""

_PULSE_STEP, _MAX_PULSE_STEPS = 0.001, 48
"""Step [s] of pulses, and maximum number of steps within the duration."""

_STEP, _SHORT = 0.005, 1.0  # s; sampling interval of envelopes, halved for durations up to _SHORT
_MAX_POINTS = 20_000  # times of a course
_RESOLUTION = 1.0  # Hz, minimum resolution of an envelope's spectrum
_LEAST_AMPLITUDE = 1e-30


@dataclass(frozen=True)
class Course:
    """Envelope of a stimulus: fraction of its highest amplitude over the duration."""

    times: Sequence[float]
    """Times [s], ascending from 0 to the duration."""
    shares: Sequence[float]
    """Fraction at each time, 0 to 1; linear in between."""
    repeats: bool = False
    """Whether it starts again at its end, for as long as the finger stays."""

    def __post_init__(self) -> None:
        """Check times and fractions; raises InputError."""
        if not 2 <= len(self.times) == len(self.shares) <= _MAX_POINTS:
            raise InputError(
                f"a course must have 2 to {_MAX_POINTS} times and as many shares, got "
                f"{len(self.times)} and {len(self.shares)}"
            )
        if self.times[0] != 0 or not (np.diff(self.times) > 0).all():
            raise InputError("times of a course must ascend from 0")
        shares = np.array(self.shares)
        if not ((shares >= 0) & (shares <= 1)).all():  # False for NaN
            raise InputError(
                f"shares of a course must be 0 to 1, got {min(self.shares):g} to "
                f"{max(self.shares):g}"
            )

    @property
    def duration(self) -> float:
        """Its last time [s]."""
        return self.times[-1]

    @property
    def step(self) -> float:
        """Sampling interval [s]."""
        return _STEP if self.duration > _SHORT else _STEP / 2

    @property
    def predicted_time(self) -> float:
        """Time [s] for which it is predicted: one turn, and more turns if it repeats."""
        return self.duration + (_REPEATED if self.repeats else 0.0)

    @cached_property
    def strongest_db(self) -> float:
        """RMS of its strongest moments [dB], relative to a constant 1."""
        knots, _ = self._line
        steps = self.step * np.arange(self.duration / self.step + 1)
        starts = np.concatenate([steps, knots, knots - STRONGEST])
        energies = self._energy_until(starts + STRONGEST) - self._energy_until(starts)
        mean_square = max(float(energies.max()) / STRONGEST, SILENCE**2)
        return 10 * math.log10(mean_square)

    def _energy_until(self, times: FloatArray) -> FloatArray:
        """Return the integral of the squared fraction from 0 to times [s] (n,)."""
        if not self.repeats:
            return self._energy_of_turn(times)
        turns, rest = np.divmod(times, self.duration)
        return turns * self._energy_of_turn(np.array(self.duration)) + self._energy_of_turn(rest)

    def _energy_of_turn(self, times: FloatArray) -> FloatArray:
        """Return the integral of the squared fraction of one playback, as `_energy_until`."""
        knots, shares = self._line
        products = shares[:-1] ** 2 + shares[:-1] * shares[1:] + shares[1:] ** 2
        until_knot = np.append(0.0, np.cumsum(np.diff(knots) * products / 3))
        times = np.clip(times, 0.0, self.duration)
        before = np.searchsorted(knots, times, side="right") - 1
        first = shares[before]
        last = self.at(times)
        products = first**2 + first * last + last**2
        return np.asarray(until_knot[before] + (times - knots[before]) * products / 3)

    @cached_property
    def swings(self) -> tuple[Swing, ...]:
        """Possible playbacks of the envelope from knot to knot: once, then repeated.

        One per knot interval: slower wires use longer intervals.
        """
        swings = []
        for step in (COURSE_KNOT_STEP, 2 * COURSE_KNOT_STEP, 4 * COURSE_KNOT_STEP):
            knot_count = math.ceil(self.duration / step) + math.ceil(DECAYED / step)
            times = np.asarray(step * np.arange(1, knot_count + 1), dtype=float)
            once = self._played_at(times)
            repeated = self.at(np.mod(times, self.duration))
            shares = (0.0, *once.tolist(), *repeated.tolist())
            swings.append(Swing(shares, step))
        return tuple(swings)

    def played(self, times: FloatArray) -> FloatArray:
        """Return fractions (n,) at times [s] as amplifiers play them, from knot to knot.

        They begin at silence, which the first knot ends, and return to it after the last knot:
        after one playback, or after `predicted_time` if it repeats.
        """
        knot_count = math.ceil(self.predicted_time / COURSE_KNOT_STEP)
        knots = np.asarray(COURSE_KNOT_STEP * np.arange(1, knot_count + 1), dtype=float)
        shares = self._played_at(knots)
        if self.repeats:
            repeated = self.at(np.mod(knots, self.duration))
            shares = np.where(knots < self.predicted_time, repeated, 0.0)
        fractions = np.interp(times, np.append(0.0, knots), np.append(0.0, shares), right=0.0)
        return np.asarray(fractions)

    def _played_at(self, knots: FloatArray) -> FloatArray:
        """Return fractions at knots (n,) [s] of a single playback; 0 after its end."""
        return np.where(knots < self.duration, self.at(knots), 0.0)

    def at(self, times: FloatArray) -> FloatArray:
        """Return fractions at times [s] (n,), 0 outside."""
        return np.interp(times, *self._line, left=0.0, right=0.0)

    @cached_property
    def _line(self) -> tuple[FloatArray, FloatArray]:
        """Times and fractions as arrays, cached: they are read for every piece played."""
        return np.array(self.times), np.array(self.shares)


def pulse_ramp(duration: float) -> float:
    """Return the plain ramp [s] of a vibration: a quarter of its duration [s].

    The vibration is then nearly constant: no 40 ms of a 40 ms click (ringing included) are more
    than 0.8 dB (median) stronger than the first 40 ms. With a ramp of half the duration it is 1.5
    dB, with the full duration 3 dB.
    """
    return min(ONSET_RAMP, duration / 4)


def shaped_gain(duration: float) -> float:
    """Return the mean amplitude over a duration [s] with a shaped onset, 1 if steady.

    The target follows a raised cosine, whose square has a mean of 3/8.
    """
    return math.sqrt(1 - 5 / 8 * min(RISE, duration) / duration)


@lru_cache
def swings_of_pulse(duration: float, ramp: float) -> tuple[Swing, Swing]:
    """Return the envelopes of consecutive pulses of a duration [s], with plain ramps [s].

    The first ends along the pulse's ramp, the second along FADE_RAMP. A pulse longer than
    SHAPED_FROM counts as that long: by then its onset has decayed as far as its end will.
    """
    length = min(duration, SHAPED_FROM)
    count = math.ceil((length + DECAYED) / _PULSE_STEP)
    times = np.asarray(_PULSE_STEP * np.arange(count), dtype=float)
    onset = rise(times, ramp)
    plain = onset - rise(times - length, ramp)
    faded = onset - rise(times - length, FADE_RAMP)
    repeated_after = max(duration, CLICKS_APART)
    return (
        Swing(tuple(plain.tolist()), _PULSE_STEP, repeated_after),
        Swing(tuple(faded.tolist()), _PULSE_STEP, repeated_after),
    )


@dataclass(frozen=True, eq=False)
class OverDuration:
    """Sensation of k fingers over the duration of a drive, on the nominal plate."""

    gains: FloatArray
    """Mean amplitude (k,) relative to the steady one."""
    heard: FloatArray
    """Squared amplitude at each point relative to the threshold (k, p), mean over the strongest
    time."""


@dataclass(frozen=True, eq=False)
class DriveEnvelope:
    """Envelope of a drive, up to _RINGING after its end or until it is steady."""

    values: FloatArray
    """Envelope (n,) at even steps."""
    step: float
    """Time [s] between values."""
    within: int
    """Number of steps that are felt: the strongest steps of a course, the first of a pulse."""
    share: float = 1.0
    """Fraction of the duration covered by these steps; the rest is steady."""
    is_course: bool = False

    @classmethod
    def of_pulse(cls, duration: float, ramp: float) -> "DriveEnvelope":
        """Build the envelope of a pulse of a duration [s] with plain ramps [s].

        It includes the ringing after the end, where a quiet finger can feel most.
        """
        length = min(duration, SHAPED_FROM)  # the rest is steady
        within = min(_MAX_PULSE_STEPS, max(1, math.ceil(length / _PULSE_STEP)))
        step = length / within
        count = within + math.ceil(_RINGING / step)
        times = np.asarray(step * (np.arange(count) + 0.5), dtype=float)
        values = rise(times, ramp) - rise(times - length, ramp)
        return cls(values=values, step=step, within=within, share=length / duration)

    @classmethod
    def of_course(cls, course: Course) -> "DriveEnvelope":
        """Build the envelope of a course as it is played."""
        count = math.ceil((course.predicted_time + _RINGING) / course.step)
        times = np.asarray(course.step * np.arange(count), dtype=float)
        values = course.played(times)
        within = round(STRONGEST / course.step)
        return cls(np.maximum(values, SILENCE), course.step, within, is_course=True)

    def moments(self, squares: FloatArray) -> FloatArray:
        """Means of squares (n, ...) over the felt time, starting at each step, (n', ...)."""
        sums = np.cumsum(squares, axis=0, dtype=float)
        sums[self.within :] -= sums[: -self.within].copy()
        return sums[self.within - 1 :] / self.within

    def felt(self, squares: FloatArray, weights: FloatArray) -> OverDuration:
        """Return the sensation of k fingers from squared amplitudes relative to the threshold (n +
        1, k, p).

        The last square belongs to the steady vibration; weights (k, p): of the points in the mean
        over a fingertip.
        """
        power = self.share * self.moments(squares[:-1]) + (1 - self.share) * squares[-1]
        own_power = power if self.is_course else power[:1]
        felt = (np.sqrt(own_power) * weights).sum(axis=2).max(axis=0)
        steady = (np.sqrt(squares[-1]) * weights).sum(axis=1)
        return OverDuration(
            gains=felt / np.maximum(steady, _LEAST_AMPLITUDE), heard=power.max(axis=0)
        )

    def shares_at(self, off: FloatArray) -> FloatArray:
        """Return the fraction (b,) of the steady power in tones at distances (b,) [Hz] from the
        drive's.

        Together the tones have the energy of the drive on any plate (Parseval); for an envelope,
        the energy of its strongest moments. Energy between two tones is split in proportion to
        nearness, but near the drive's own frequency, which can be in a null, by the square of
        nearness.
        """
        count = max(len(self.values), math.ceil(1 / _RESOLUTION / self.step))
        count = fft.next_fast_len(count)
        spectrum = fft.fft(self.values, count)
        nu = fft.fftfreq(count, self.step)
        tone_shares = np.array([np.interp(nu, off, only_tone) for only_tone in np.eye(len(off))])
        carrier = int(np.argmin(np.abs(off)))
        is_near_carrier = tone_shares[carrier] > 0
        tone_shares[:, is_near_carrier] **= 2
        tone_shares[carrier, is_near_carrier] += 1 - tone_shares[:, is_near_carrier].sum(axis=0)
        tone_spectra = (spectrum * np.sqrt(tone_shares)).astype(np.complex64)
        squares = np.abs(fft.ifft(tone_spectra)) ** 2
        if self.is_course:
            power = self.moments(squares.T).max(axis=0)
            strongest = self.moments(self.values**2).max()
            return np.asarray(power * (strongest / power.sum()))
        power = self.share * squares.sum(axis=1) / self.within
        power[carrier] += 1 - self.share
        return np.asarray(power)
