"""Stimuli of limited duration: what fingers feel of a drive over it, onset and ringing included.

A plate follows its drive late: over 40 ms the root mean square at a finger is several decibels
below, on a sharp resonance ten decibels below, that of the steady vibration, and it rings on. A
target counts by the mean of its demodulated acceleration over the duration, another fingertip by
its power, that after the end included; of a course both by its strongest moments. Tones near the
frequency of a drive stand for its envelope, whichever it is (`DriveEnvelope.shares_at`): by these
weights are searched and drawn plates judged.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy import fft

from model.answer.course import SILENCE, STRONGEST, Course
from model.answer.fingers import SHAPED_FROM
from model.answer.search import Contents
from model.arrays import ComplexArray, FloatArray, IntArray, Point
from model.drive_modes import Drive, Forms
from model.finger import detection_threshold
from model.structure.attachments import fingertip_loads
from model.table.table import LocalizationTable, read_fingertips
from model.transients.base_motion import rise
from model.transients.knots import RISE
from model.transients.loaded_envelopes import enveloped_accelerations
from model.transients.swings import CLICKS_APART, DECAYED, Swing

ONSET_RAMP = 0.040
"""Duration of a plain ramp [s].

Twice what just avoids a click: the slower start gains 4 dB of contrast over the first 100 ms, and
at 20 dB SL the target still feels it after a fifth of it (docs/concepts/transients.md).
"""

RINGING = 0.100
"""Time [s] after a short effect over which what other fingers feel is followed.

Weights keep them quiet as long as they are followed, and no longer: where that was 20 ms, what
rang after was up to 7 dB stronger on four ERAs, 18 dB on a large table.
"""

_BESIDE_HZ, _LEAST_SHARE = 60.0, 1e-3
"""Distance of the frequencies beside its own that count of a drive, and the least share of one in
the power of its strongest moments."""

_PULSE_STEP, _MAX_PULSE_STEPS = 0.001, 48
"""Steps [s] of pulses, and how many one has at most within its duration."""

_RESOLUTION = 1.0  # Hz, at least; of the spectrum of an envelope
_TINY = 1e-30

FADE_RAMP = 0.020
"""Fade-out [s] under fingers that stay on the plate; a shorter one would feel like a tap."""


_LEAST_PERIODS = 1.7  # beyond that by the reciprocal of a pulse's duration is 1.4 % of its energy


def pulse_ramp(duration: float) -> float:
    """Plain ramp [s] of a vibration of this duration [s], a quarter of it.

    The vibration is even over its duration then: no 40 ms of a click of 40 ms are more than 0.8 dB
    (median) stronger than the first 40, along a ramp of half of it 1.5, as long as it 3 dB.
    """
    return min(ONSET_RAMP, duration / 4)


@lru_cache
def swings_of_pulse(duration: float, ramp: float) -> tuple[Swing, Swing]:
    """Return the swings of pulses of a duration one after the other, along plain ramps [s].

    They end along their own, or along that of contents that end. Of a long one its first
    SHAPED_FROM: by then the onset has decayed as far as the end will.
    """
    length = min(duration, SHAPED_FROM)
    count = math.ceil((length + DECAYED) / _PULSE_STEP)
    times = np.asarray(_PULSE_STEP * np.arange(count), dtype=float)
    shares = [
        rise(times, ramp) - rise(np.asarray(times - length), end) for end in (ramp, FADE_RAMP)
    ]
    again = max(duration, CLICKS_APART)
    one, other = (Swing(tuple(each.tolist()), _PULSE_STEP, again) for each in shares)
    return one, other


def shaped_gain(duration: float) -> float:
    """Amplitude over a duration [s] relative to the steady one with a shaped onset.

    The target follows a raised cosine, whose square has a mean of 3/8.
    """
    return math.sqrt(1 - 5 / 8 * min(RISE, duration) / duration)


@dataclass(frozen=True, eq=False)
class OverDuration:
    """What k fingers feel of a drive over a duration on the nominal plate.

    gains (k,): mean amplitude relative to the steady one; heard (k, p): squared amplitude to
    threshold at each point over as long, at its strongest.
    """

    gains: FloatArray
    heard: FloatArray


@dataclass(frozen=True, eq=False)
class DriveEnvelope:
    """Envelope (n,) of a drive at even steps [s], as long as it is followed.

    within: steps over which it is felt, of a course the strongest, else the first; share: of the
    followed part in the duration, the rest of which is steady.
    """

    values: FloatArray
    step: float
    within: int
    share: float = 1.0
    is_course: bool = False

    @classmethod
    def of_pulse(cls, duration: float, ramp: float) -> "DriveEnvelope":
        """Along plain ramps [s], to beyond the end, where a quiet finger may feel most."""
        length = min(duration, SHAPED_FROM)  # the rest is steady
        count = min(_MAX_PULSE_STEPS, max(1, math.ceil(length / _PULSE_STEP)))
        step = length / count
        every = count + math.ceil(RINGING / step)
        times = np.asarray(step * (np.arange(every) + 0.5), dtype=float)
        values = rise(times, ramp) - rise(np.asarray(times - length), ramp)
        return cls(np.asarray(values), step, count, length / duration)

    @classmethod
    def of_course(cls, course: Course) -> "DriveEnvelope":
        """Along a course, or a plain ramp where it starts or ends above 0."""
        count = math.ceil((course.duration + RINGING) / course.step)
        times = np.asarray(course.step * np.arange(count), dtype=float)
        after, (first, *_, last) = np.asarray(times - course.duration), course.shares
        values = course.at(times) - first * (1 - rise(times, ONSET_RAMP))
        values += np.where(after > 0, last * (1 - rise(after, ONSET_RAMP)), 0.0)
        within = round(STRONGEST / course.step)
        return cls(np.maximum(values, SILENCE), course.step, within, is_course=True)

    @property
    def lasts(self) -> float:
        """How long it is felt [s], what is steady apart."""
        return self.within * self.step

    def moments(self, squares: FloatArray) -> FloatArray:
        """Means of squares (n, ...) over what is felt, from all times on, (n', ...)."""
        sums = np.cumsum(squares, axis=0, dtype=float)
        sums[self.within :] -= sums[: -self.within].copy()
        return np.asarray(sums[self.within - 1 :] / self.within)

    def felt(self, squares: FloatArray, weights: FloatArray) -> OverDuration:
        """From squared amplitudes to threshold (n + 1, k, p), the last of them steady.

        weights (k, p): of the points in the mean.
        """
        power = self.share * self.moments(squares[:-1]) + (1 - self.share) * squares[-1]
        own = power if self.is_course else power[:1]
        felt = (np.sqrt(own) * weights).sum(axis=2).max(axis=0)
        steady = (np.sqrt(squares[-1]) * weights).sum(axis=1)
        return OverDuration(felt / np.maximum(steady, 1e-30), power.max(axis=0))

    def shares_at(self, off: FloatArray) -> FloatArray:
        """Shares (b,) of the steady power of tones that are off its frequency (b,) [Hz].

        With the energy of the drive on any plate (Parseval); of a course that of the strongest
        moments of each. Of two tones each has more of what is nearer to it: beside the drive's own,
        at which a null may be, as its square.
        """
        count = max(len(self.values), math.ceil(1 / _RESOLUTION / self.step))
        count = fft.next_fast_len(count)
        transform, nu = fft.fft(self.values, count), fft.fftfreq(count, self.step)
        near = np.array([np.interp(nu, off, each) for each in np.eye(len(off))])
        own = int(np.argmin(np.abs(off)))
        is_beside = near[own] > 0
        near[:, is_beside] **= 2
        near[own, is_beside] += 1 - near[:, is_beside].sum(axis=0)
        squares = np.abs(fft.ifft((transform * np.sqrt(near)).astype(np.complex64))) ** 2
        if self.is_course:
            power, all_ = self.moments(squares.T).max(axis=0), self.moments(self.values**2).max()
            return np.asarray(power * (all_ / power.sum()))
        power = self.share * squares.sum(axis=1) / self.within
        power[own] += 1 - self.share
        return np.asarray(power)


def on_drawn_plates(
    energies: FloatArray, heard: FloatArray, factor: FloatArray | float
) -> FloatArray:
    """Power over a duration on drawn plates (..., 1 + d), from energies, nominal first.

    heard (...): over the duration on the nominal plate; factor: of power over the duration to
    energies, as at the target. What other plates add to the energy is felt by as much.
    """
    added = factor * (energies - energies[..., :1])
    return np.asarray(np.maximum(heard[..., None] + added, 0.0))


@dataclass(frozen=True, eq=False)
class RingingUnderFingers:
    """Drives along an envelope, under fingers at places [m] of a plate.

    loads: of each relative to the rig's fingertip, empty for 1.
    """

    table: LocalizationTable
    places: tuple[Point, ...]
    loads: tuple[float, ...]
    envelope: DriveEnvelope
    _solved: dict[tuple[tuple[int, bytes], ...], OverDuration] = field(default_factory=dict)

    @classmethod
    def of_streams(
        cls, table: LocalizationTable, contents: Contents
    ) -> list["RingingUnderFingers | None"]:
        """One for each content that has a duration, None for those that last or are shaped."""
        found: list[RingingUnderFingers | None] = []
        for stream in contents.streams:
            envelope: DriveEnvelope | None = None
            if stream.course is not None:
                envelope = DriveEnvelope.of_course(stream.course)
            elif stream.duration is not None and not contents.is_shaped:
                ramp = max(pulse_ramp(stream.duration), contents.least_ramp)
                envelope = DriveEnvelope.of_pulse(stream.duration, ramp)
            fingers = table, contents.places, contents.loads
            found.append(None if envelope is None else cls(*fingers, envelope))
        return found

    @cached_property
    def shares(self) -> FloatArray:
        """Shares (f, f) of the power at its own frequency, of tones at all of the table's.

        A row for each of the table's frequencies that a drive may have.
        """
        hertz, known = self.table.frequencies, dict[tuple[float, ...], FloatArray]()
        ends = (hertz <= hertz[0] + _BESIDE_HZ).sum(), (hertz >= hertz[-1] - _BESIDE_HZ).sum()
        beyond = int(max(ends)) - 1
        wide = np.pad(hertz, beyond, mode="reflect", reflect_type="odd")
        # Tones beyond the table count as those as far within it.
        rows = np.pad(np.arange(len(hertz)), beyond, mode="reflect")
        found = np.zeros((len(hertz), len(hertz)))
        for own, at in enumerate(hertz.tolist()):
            off = np.round(wide - at, 6)
            near = np.abs(off) <= _BESIDE_HZ
            key = tuple(off[near].tolist())
            if key not in known:
                known[key] = self.envelope.shares_at(off[near])
            np.add.at(found[own], rows[near], known[key])
        strongest = self.envelope.moments(self.envelope.values**2).max()
        found[found < _LEAST_SHARE * strongest] = 0.0
        return found

    def spectrum(self, drive: Drive) -> Drive:
        """Tones for the tones of a drive, near the frequency of each.

        They have together the energy of the drive on any plate (Parseval), but for what it excites
        far beside. Above the threshold at its own frequency.
        """
        found, thresholds = [], self.table.thresholds
        for own, weights in drive:
            for row in np.flatnonzero(self.shares[own]).tolist():
                factor = math.sqrt(self.shares[own, row]) * thresholds[row] / thresholds[own]
                found.append((row, np.asarray(factor * weights, dtype=np.complex64)))
        return found

    def forms(self, steady: Forms, some: IntArray) -> Forms:
        """Forms over the envelope at some of the table's frequencies, from steady ones at all."""
        shares, own = self.shares[some].astype(np.float32), np.sqrt(self.shares[some, some])
        size = (np.abs(steady.targets) ** 2).sum(axis=(0, 2))
        gain = np.sqrt(shares @ size / np.maximum(size[some], _TINY))
        found, by_carrier = steady.at(some), own.astype(np.float32)[:, None, None, None]
        return replace(
            found,
            targets=found.targets * gain[:, None],
            quiet=(shares @ steady.quiet.reshape(len(steady.quiet), -1)).reshape(found.quiet.shape),
            level_margin=0.0,
            few=None if found.few is None else found.few * by_carrier,
            fine=None if found.fine is None else found.fine * by_carrier,
        )

    def lasting_long_enough(self, some: IntArray) -> IntArray:
        """Those of some of the table's frequencies whose spectrum does not reach 0; all, if none.

        A drive of fewer periods moves the plate as a whole, which no frequency of a table tells.
        """
        hertz, envelope = self.table.frequencies[some], self.envelope
        long = some if envelope.is_course else some[hertz * envelope.lasts >= _LEAST_PERIODS]
        return long if len(long) else some

    def over_drive(self, drive: Drive) -> OverDuration:
        """What fingers feel of a drive, as `over`; solved once."""
        hertz, drives = self.table.frequencies, self.table.highest_drives
        key = tuple([(row, weights.tobytes()) for row, weights in drive])
        if key not in self._solved:
            self._solved[key] = self.over(
                [
                    (float(hertz[row]), np.multiply(weights, drives[row], dtype=complex))
                    for row, weights in drive
                ]
            )
        return self._solved[key]

    def over(self, tones: Iterable[tuple[float, ComplexArray]]) -> OverDuration:
        """What fingers feel at their fine points of tones together.

        Of each its frequency [Hz] and the motions of the bases (eras,) [m].
        """
        table, tips = self.table, read_fingertips(self.table, self.places)
        k, p, r = tips.fine.shape
        loads = fingertip_loads(table.fingertip, self.places, self.loads)
        centres = tips.fine[: len(loads), 0].astype(float)
        fingers = [(at, load.fingertip) for at, load in zip(centres, loads, strict=True)]
        squares = np.zeros(())
        for frequency, bases in tones:
            found = enveloped_accelerations(
                table.in_time,
                bases,
                float(frequency),
                points=tips.fine.reshape(-1, r).astype(float),
                fingers=fingers,
                envelope=self.envelope.values,
                step=self.envelope.step,
            )
            threshold = detection_threshold(np.array(frequency), table.threshold)
            squares = squares + (found.real**2 + found.imag**2) / threshold**2
        return self.envelope.felt(squares.reshape(-1, k, p), tips.fine_weights.astype(float))
